"""Keys remembered across batches: a queue of the last ones (MoCo), a bank with one per row of the data (CMC).

Both are read in ``forward`` and written in ``after_step`` only. Shapes: D dimensions, N rows, K places.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn


class Queue(nn.Module):
    """The last K keys, L2-normalised; random directions until enough have come (as in MoCo)."""

    keys: Tensor
    """[K, D]."""
    place: Tensor
    """[1] int64: where the next key goes."""

    def __init__(self, size: int, width: int) -> None:
        super().__init__()
        self.register_buffer("keys", F.normalize(torch.randn(size, width), dim=1))
        self.register_buffer("place", torch.zeros(1, dtype=torch.int64))

    @torch.no_grad()
    def push(self, keys: Float[Tensor, "B D"]) -> None:
        """Put ``keys`` over the oldest ones; of more than K only the last K stay."""
        size = len(self.keys)
        keys = F.normalize(keys.float(), dim=1)[-size:]
        at = (self.place + torch.arange(len(keys), device=keys.device)) % size
        self.keys[at] = keys
        self.place.copy_((self.place + len(keys)) % size)


class Bank(nn.Module):
    """One L2-normalised embedding per training row, which moves towards each new one of that row."""

    values: Tensor
    """[N, D]."""

    def __init__(self, num_rows: int, width: int) -> None:
        super().__init__()
        bound = (3 / width) ** 0.5  # uniform in +-sqrt(3 / D): unit length in expectation, as CMC's code starts it
        self.register_buffer("values", torch.empty(num_rows, width).uniform_(-bound, bound))

    @torch.no_grad()
    def follow(self, at: Int[Tensor, " B"], z: Float[Tensor, "B D"], m: float) -> None:
        """values[at] <- normalised m values[at] + (1 - m) z."""
        self.values[at] = F.normalize(m * self.values[at] + (1 - m) * z.float(), dim=1)
