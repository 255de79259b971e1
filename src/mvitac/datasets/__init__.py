"""Datasets, one file each; importing this package registers them. No torch here: packing workers import it."""

from mvitac.datasets import folder, packed, simulated, touch_and_go
from mvitac.datasets.base import DatasetConfig

__all__ = ["DatasetConfig", "folder", "packed", "simulated", "touch_and_go"]
