"""Datasets, one file each; importing this package registers them. No torch here: packing workers import it."""

from mvitac.datasets import calandra, folder, packed, simulated
from mvitac.datasets.base import DatasetConfig

__all__ = ["DatasetConfig", "calandra", "folder", "packed", "simulated"]
