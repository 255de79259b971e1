"""Which device a run computes on and in which precision, and their names for the record."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch


def pick_device(name: str) -> torch.device:
    """Return the device called ``name`` (``Run.device``); ValueError if it does not exist."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device).cpu()
    except (AssertionError, NotImplementedError, RuntimeError, ValueError):  # torch's kinds differ
        raise ValueError(f"device {name!r} does not exist or is not supported: give auto, cpu or cuda:N") from None
    return device


def describe(device: torch.device) -> str:
    """Return a description of the device: the name of a GPU, or the number of CPU threads."""
    threads = f"{device.type}, {torch.get_num_threads()} threads"
    return torch.cuda.get_device_name(device) if device.type == "cuda" else threads


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


WORTH = 0.9  # auto takes bf16 below this part of fp32's time: nearer to 1, noise would choose, anew for each seed


@dataclass(frozen=True)
class Hardware:
    """The device of a run, the precision of its networks, and a sentence about it."""

    device: torch.device
    precision: str
    sentence: str
    slowdown: float | None = None  # how many times as long as fp32 bf16 takes, where this was measured

    @classmethod
    def choose(cls, device: torch.device, asked: str, work: Callable[[], object] | None = None) -> "Hardware":
        """What ``Run.precision`` means on ``device``: auto is bf16 where the hardware computes it, else fp32.

        On a CPU that computes it, ``work`` (one pass of its networks) is timed in both: bf16 must be faster by a tenth.
        """
        kind, own = {"cpu": "CPU", "cuda": "GPU"}.get(device.type, "device"), has_bf16(device)
        if asked != "auto":
            emulated = f", which this {kind} only emulates, up to 100 times as slow as fp32: use --precision auto"
            return cls(device, asked, f"precision: {asked}{emulated if asked == 'bf16' and not own else ''}")
        if not own:
            return cls(device, "fp32", f"precision: fp32 (auto, as this {kind} does not compute bf16 itself)")
        if device.type != "cpu" or not work:
            return cls(device, "bf16", "precision: bf16 (auto)")
        slower = slowdown(device, work)
        precision = "bf16" if slower < WORTH else "fp32"
        return cls(device, precision, f"precision: {precision} (auto: bf16 takes {slower:.2f} of fp32's time)", slower)


def slowdown(device: torch.device, work: Callable[[], object]) -> float:
    """How many times as long as in fp32 ``work`` takes in bf16: the quickest of several turns in about half a second."""
    least, turns, end = {False: math.inf, True: math.inf}, 0, time.perf_counter() + 0.5
    while turns < 2 or time.perf_counter() < end:
        for bf16 in least:
            start = time.perf_counter()
            with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
                work()
            if turns:  # the first prepares the kernels
                least[bf16] = min(least[bf16], time.perf_counter() - start)
        turns += 1
    return least[True] / least[False]
