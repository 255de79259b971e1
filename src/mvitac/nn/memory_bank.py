"""Keys remembered across batches: a queue of the last ones (MoCo), a bank with one per row of the data (CMC).

Both are read in ``forward`` and written in ``after_step`` only. Shapes: D dimensions, N rows, K places.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from mvitac.system.distributed import World


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
    """One L2-normalised embedding per training row, which moves towards each new one of that row.

    It lies whole until ``shard_banks`` deals its rows out to many processes. ``state_dict`` is then to be asked for by all
    at once: rank 0 gets the whole bank, the others none of it. ``load_state_dict`` wants the whole one everywhere.
    """

    values: Tensor
    """[N, D]. Sharded: this process's rows and a spare one, at which all others are looked up and written: so shapes depend
    on no draw, and nothing waits for a GPU."""

    def __init__(self, num_rows: int, width: int) -> None:
        super().__init__()
        self.num, self.world = num_rows, World()
        bound = (3 / width) ** 0.5  # uniform in +-sqrt(3 / D): unit length in expectation, as CMC's code starts it
        self.register_buffer("values", torch.empty(num_rows, width).uniform_(-bound, bound))

    @property
    def num_own(self) -> int:
        """Rows of the bank that this process holds."""
        return len(range(self.world.rank, self.num, self.world.size))

    def find(self, at: Int[Tensor, "*B"]) -> Int[Tensor, "*B"]:
        """Where in ``values`` the bank's rows ``at`` are."""
        rank, size = self.world.rank, self.world.size
        return at if size == 1 else torch.where(at % size == rank, at // size, self.num_own)

    def find_drawn(self, at: Int[Tensor, "B K"]) -> Int[Tensor, "B k"]:
        """``find`` of those of the rows ``at``, drawn evenly, that this process holds, and of the spare row in between.

        On one process k = K. On more it is a little above K times the share of rows held: that a query has more of them, and
        loses those beyond, has a probability below 1e-32 (Chernoff's bound).
        """
        place, mean = self.find(at), at.shape[1] * self.num_own / self.num
        width = math.ceil(mean + 12 * mean**0.5 + 50)
        if width >= at.shape[1]:
            return place
        held = place < self.num_own
        column = torch.where(held, held.cumsum(1) - 1, width).clamp(max=width)
        return place.new_full((len(place), width + 1), self.num_own).scatter_(1, column, place)[:, :width]

    def dots(
        self, query: Float[Tensor, "B D"], place: Int[Tensor, "B K"]
    ) -> tuple[Float[Tensor, "B K"], Bool[Tensor, "B K"]]:
        """Inner products of each query, the same on all processes, with the rows found at ``place``; False where that is the
        spare one, whose products mean nothing. What is made of the others goes through ``world.sum``."""
        # All rows held at once, then the drawn ones: the same numbers as fetching B x K rows, in far less memory.
        return (self.world.spread(query) @ self.values.T).gather(1, place), place < self.num_own

    @torch.no_grad()
    def follow(self, at: Int[Tensor, " B"], z: Float[Tensor, "B D"], m: float) -> None:
        """values[at] <- normalised m values[at] + (1 - m) z."""
        at = self.find(at)
        self.values[at] = F.normalize(m * self.values[at] + (1 - m) * z.float(), dim=1)

    def _cut(self, whole: Float[Tensor, "N D"]) -> Tensor:
        """What this process holds of ``whole``, as ``values``."""
        return whole if self.world.size == 1 else torch.cat([self.world.shard(whole), whole[:1]])

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        own = destination.pop(f"{prefix}values")
        whole = self.world.unshard(own[: self.num_own], self.num)
        if whole is not None:
            destination[f"{prefix}values"] = whole

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        whole = state_dict.get(f"{prefix}values")
        if isinstance(whole, Tensor) and len(whole) == self.num:  # else torch says what is wrong with it
            state_dict[f"{prefix}values"] = self._cut(whole)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def shard_banks(module: nn.Module, world: World) -> None:
    """Keep this process's rows only of every bank in ``module``; the banks must be the same on all processes."""
    for bank in module.modules():
        if isinstance(bank, Bank):
            bank.world = world
            bank.values = bank._cut(bank.values)


def replicated(module: nn.Module) -> list[Tensor]:
    """The parameters and buffers of ``module`` that every process holds alike: all but the shards of banks."""
    parts = [part for part in module.modules() if not isinstance(part, Bank)]
    return [tensor for part in parts for tensor in (*part.parameters(False), *part.buffers(False))]
