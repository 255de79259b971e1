"""Pre-training methods, one file each. Importing this package imports and registers all of them."""

from mvitac.methods.base import Method, MethodConfig
from mvitac.registry import import_all

__all__ = ["Method", "MethodConfig"]
import_all(__name__, __path__)
