"""LeRobot datasets, read and written."""

from mvitac.datasets.lerobot import reader

__all__ = ["reader"]
