"""Reads and writes LeRobot datasets."""

from mvitac.datasets.lerobot import reader

__all__ = ["reader"]
