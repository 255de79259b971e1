"""Pre-training methods, one file each; importing this package registers them."""

from mvitac.methods import byol, calandra, cmc, dino, mct, moco, mvitac, simclr, ssvtp, supervised, vicreg
from mvitac.methods.base import Method, MethodConfig

__all__ = [
    "Method",
    "MethodConfig",
    "byol",
    "calandra",
    "cmc",
    "dino",
    "mct",
    "moco",
    "mvitac",
    "simclr",
    "ssvtp",
    "supervised",
    "vicreg",
]
