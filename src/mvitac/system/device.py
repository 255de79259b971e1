"""Device selection and description."""

from __future__ import annotations

import torch


def pick_device(name: str) -> torch.device:
    """Return the device called ``name`` (``Run.device``); ValueError if it does not exist."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except (RuntimeError, ValueError):
        raise ValueError(f"unknown device {name!r}: give auto, cpu, cuda or cuda:N") from None
    there = {"cpu": True, "cuda": True, "mps": torch.backends.mps.is_available()}
    if not there.get(device.type):
        raise ValueError(f"device {name!r} does not exist or is not supported: give auto, cpu, cuda or cuda:N")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(
            f"device {name!r} does not exist: torch sees {torch.cuda.device_count()} CUDA GPUs; use cpu or auto"
        )
    return device


def describe(device: torch.device) -> str:
    """Return a description of the device: the name of a GPU, or the number of CPU threads."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"
