"""Datasets, one file (or folder) each. Importing this package imports and registers all of them."""

from mvitac.datasets.base import DatasetConfig
from mvitac.registry import import_all

__all__ = ["DatasetConfig"]
import_all(__name__, __path__)
