"""Datasets, one file each; importing this package registers them. No torch here: packing workers import it."""

from mvitac.datasets import (
    calandra,
    folder,
    hub,
    lerobot,
    packed,
    physiclear,
    simulated,
    slip_grasp,
    slip_gsmini,
    stream,
    touch_and_go,
    vt60,
    webdataset,
)
from mvitac.datasets.base import DatasetConfig

__all__ = [
    "DatasetConfig",
    "calandra",
    "folder",
    "hub",
    "lerobot",
    "packed",
    "physiclear",
    "simulated",
    "slip_grasp",
    "slip_gsmini",
    "stream",
    "touch_and_go",
    "vt60",
    "webdataset",
]
