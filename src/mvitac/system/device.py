"""Which device a run computes on and in which precision, and their names for the record."""

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


def has_bf16(device: torch.device) -> bool:
    """Whether ``device`` computes bf16 products itself: CUDA from 8.0, CPUs with AVX512-BF16 or AMX that oneDNN may use.

    Elsewhere torch emulates them, up to 100 times as slow as fp32. Arm CPUs count as elsewhere: nobody measured them.
    """
    if device.type == "cuda":
        with torch.cuda.device(device):
            own = torch.cuda.is_bf16_supported(including_emulation=False)
            return own and torch.cuda.get_device_capability() >= (8, 0)
    if device.type != "cpu":
        return False
    chip = [getattr(torch.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported")]
    library = getattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", None)  # knows of limits such as ONEDNN_MAX_CPU_ISA
    # They are private to torch: a version without them gets fp32, which is right everywhere.
    return any(ask is not None and ask() for ask in chip) and library is not None and library()


def pick_precision(name: str, device: torch.device) -> str:
    """What ``Run.precision`` means on ``device``: auto is bf16 where the hardware computes it, else fp32."""
    if name == "auto":
        return "bf16" if has_bf16(device) else "fp32"
    return name


def describe_precision(asked: str, precision: str, device: torch.device) -> str:
    """What the networks compute in, for the reader: what auto became, and what bf16 costs where it is emulated."""
    kind = {"cpu": "CPU", "cuda": "GPU"}.get(device.type, "device")
    if asked == "auto":
        lacks = "" if precision == "bf16" else f", as this {kind} does not compute bf16 itself"
        return f"precision: {precision} (auto{lacks})"
    if precision == "bf16" and not has_bf16(device):
        return (
            f"precision: bf16, which this {kind} only emulates, up to 100 times as slow as fp32: use --precision auto"
        )
    return f"precision: {precision}"
