"""The momentum copy of a module (paper eq. 1-3, after MoCo). It copies the whole module, so that no part is forgotten."""

import copy
import math
from typing import Any

import torch
from torch import nn

from mvitac.nn.encoders import is_locked


def momentum_at(progress: float, start: float) -> float:
    """Momentum m at ``progress`` (0 to 1) of a run: from ``start`` to 1 along a half cosine (BYOL)."""
    return 1 - (1 - start) * (math.cos(math.pi * progress) + 1) / 2


class Momentum(nn.Module):
    """A frozen copy of the module ``query`` that follows it: theta_k <- m theta_k + (1 - m) theta."""

    def __init__(self, query: nn.Module) -> None:
        super().__init__()
        shared = {id(module): module for module in query.modules() if is_locked(module)}
        self.module = copy.deepcopy(query, shared).requires_grad_(False)
        self._query = (query,)  # in a tuple, or its parameters would be listed here, too

    @torch.no_grad()
    def forward(self, *inputs: Any) -> Any:
        return self.module(*inputs)

    @torch.no_grad()
    def follow(self, m: float) -> None:
        """Move all parameters and floating-point buffers towards the query's. Copy integer buffers (counters)."""
        mine, theirs = ([*module.parameters(), *module.buffers()] for module in (self.module, *self._query))
        floating = [(k, q) for k, q in zip(mine, theirs, strict=True) if k is not q and k.is_floating_point()]
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage] - one call for all tensors
            [k for k, _ in floating], [q.detach() for _, q in floating], 1 - m
        )
        if counters := [(k, q) for k, q in zip(mine, theirs, strict=True) if not k.is_floating_point()]:
            torch._foreach_copy_([k for k, _ in counters], [q for _, q in counters])  # pyright: ignore[reportPrivateImportUsage]
