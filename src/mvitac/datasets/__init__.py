"""Datasets, one file each. Importing this package imports every file in it, and so registers them all.

No torch here: packing workers import it.
"""

from mvitac.datasets.base import DatasetConfig
from mvitac.registry import import_all

__all__ = ["DatasetConfig"]
import_all(__name__, __path__)
