"""Pre-training methods, one file each; importing this package registers them."""

from mvitac.methods import mvitac, supervised
from mvitac.methods.base import Method, MethodConfig

__all__ = ["Method", "MethodConfig", "mvitac", "supervised"]
