"""Lower bound on the time of a training step, and the measured peak arithmetic of the machine.

The bound is the bare networks on random tensors. Their convolutions are those of the library (`nn/small_conv.py`), so
the comparison is about the training loop alone.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable

import timm
import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from mvitac.nn.small_conv import use_products


class Floor:
    """Two query trunks forward and backward, two key trunks forward, heads, optimiser, EMA. No loss, input or logging.

    Args:
        trunk: Name of a timm model.
        device: Device of the networks.
        precision: "fp32" or "bf16" (autocast).
    """

    def __init__(self, trunk: str, device: torch.device, precision: str) -> None:
        def tower() -> nn.ModuleDict:
            body = use_products(timm.create_model(trunk, num_classes=0))

            def head() -> nn.Sequential:
                return nn.Sequential(nn.Linear(body.num_features, 512), nn.ReLU(), nn.Linear(512, 128))

            return nn.ModuleDict({"body": body, "intra": head(), "inter": head()})

        self.query = nn.ModuleList(tower() for _ in range(2)).to(device).to(memory_format=torch.channels_last)
        self.key = copy.deepcopy(self.query).requires_grad_(False)
        self.optimiser = torch.optim.Adam(self.query.parameters(), 1e-4, fused=True)
        self.weights = list(self.key.parameters()), list(self.query.parameters())
        self.bf16, self.device = precision == "bf16", device

    def __call__(self, images: list[Tensor]) -> None:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16):
            total = torch.zeros((), device=self.device)
            for tower, view in zip(self.query, images[:2], strict=True):
                features = tower["body"](view)
                total = total + tower["intra"](features).float().mean() + tower["inter"](features).float().mean()
            with torch.no_grad():
                for tower, view in zip(self.key, images[2:], strict=True):
                    features = tower["body"](view)
                    tower["intra"](features), tower["inter"](features)
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        self.optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(*self.weights, 0.01)

    def flop(self, images: list[Tensor]) -> int:
        """Count the floating-point operations of one step, in convolutions and matrix products."""
        # Small convolutions are made of addmm_, which torch does not count.
        in_place = {torch.ops.aten.addmm_: lambda total, a, b, **_: 2 * a[0] * a[1] * b[1]}
        with FlopCounterMode(display=False, custom_mapping=in_place) as counter:
            self(images)
        return counter.get_total_flops()


def peak(device: torch.device, precision: str) -> dict[str, float]:
    """Measure FLOP/s of a large matrix product and of a 3x3 convolution of a ResNet: the best of several calls."""
    dtype = torch.bfloat16 if precision == "bf16" else torch.float32
    side = 8192 if device.type == "cuda" else 1024
    a, b = (torch.randn(side, side, device=device, dtype=dtype) for _ in range(2))
    batch = 256 if device.type == "cuda" else 16
    x = torch.randn(batch, 128, 28, 28, device=device, dtype=dtype).contiguous(memory_format=torch.channels_last)
    w = torch.randn(128, 128, 3, 3, device=device, dtype=dtype).contiguous(memory_format=torch.channels_last)
    conv = 2 * batch * 28 * 28 * 128 * 128 * 9
    return {
        "matmul": 2 * side**3 / best(lambda: a @ b, device),
        "conv": conv / best(lambda: nn.functional.conv2d(x, w, padding=1), device),
    }


def best(run: Callable[[], object], device: torch.device, num: int = 8) -> float:
    """Return the shortest time of ``num`` calls in seconds."""
    return min(clock(run, device) for _ in range(num))


def clock(run: Callable[[], object], device: torch.device) -> float:
    """Return the seconds of one call. The device is synchronised before and after it.

    With one thread on a CPU, these are CPU seconds, which depend little on other programs.
    """
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    now = time.process_time if device.type == "cpu" and torch.get_num_threads() == 1 else time.perf_counter
    start = now()
    run()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return now() - start
