"""The momentum copy of a module (paper eq. 1-3, after MoCo): whole module, so that no part can be forgotten."""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from torch import Tensor, nn


def rising(m: float, end: float | None, progress: float) -> float:
    """m at ``progress`` (0 to 1) of a run: constant, or rising to ``end`` along a half cosine (BYOL, MoCo v3)."""
    return m if end is None else end - (end - m) * (math.cos(math.pi * progress) + 1) / 2


class Momentum(nn.Module):
    """A frozen copy of ``query`` that follows it: theta_k <- m theta_k + (1 - m) theta."""

    def __init__(self, query: nn.Module, *, running_norm: bool = False) -> None:
        """``running_norm``: its BatchNorm uses the statistics that follow the query's, never those of its own batch, so
        that a key tells nothing of its neighbours (EMAN, Cai et al., CVPR 2021)."""
        super().__init__()
        self.module = copy.deepcopy(query).requires_grad_(False)
        self.running_norm = running_norm

    def train(self, mode: bool = True) -> Momentum:
        return super().train(mode and not self.running_norm)

    @torch.no_grad()
    def forward(self, *inputs: Any) -> Any:
        return self.module(*inputs)

    @torch.no_grad()
    def follow(self, query: nn.Module, m: float) -> None:
        """Move every parameter and every floating buffer towards ``query``'s; integer buffers (counters) are copied."""
        mine: list[Tensor] = [*self.module.parameters(), *self.module.buffers()]
        theirs: list[Tensor] = [*query.parameters(), *query.buffers()]
        floating = [(k, q) for k, q in zip(mine, theirs, strict=True) if k.is_floating_point()]
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage] - one call for all tensors
            [k for k, _ in floating], [q.detach() for _, q in floating], 1 - m
        )
        counters = [(k, q) for k, q in zip(mine, theirs, strict=True) if not k.is_floating_point()]
        if counters:
            torch._foreach_copy_([k for k, _ in counters], [q for _, q in counters])  # pyright: ignore[reportPrivateImportUsage]
