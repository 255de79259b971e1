"""Datasets, one file (or folder) each. Importing this package imports and registers all of them."""

from mvitac.datasets.base import DatasetConfig, dataset
from mvitac.registry import import_all

__all__ = ["DatasetConfig", "dataset"]
import_all(__name__, __path__)
