"""Keys kept across batches: a queue of the latest keys (MoCo), and a bank with one key per training row (CMC).

Both are read in ``forward`` and written only in ``after_step``. Shapes: D dimensions, N rows, K places.
"""

import math
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from mvitac.system.distributed import World


class Queue(nn.Module):
    """The latest K keys, L2-normalised. It starts with random directions, as in MoCo."""

    keys: Tensor  # [K, D]
    place: Tensor  # [1] int64: where the next key goes

    def __init__(self, size: int, width: int) -> None:
        super().__init__()
        self.register_buffer("keys", F.normalize(torch.randn(size, width), dim=1))
        self.register_buffer("place", torch.zeros(1, dtype=torch.int64))

    @torch.no_grad()
    def push(self, keys: Float[Tensor, "B D"]) -> None:
        """Replace the oldest keys by ``keys``. Of more than K keys only the last K are kept."""
        size = len(self.keys)
        keys = F.normalize(keys.float(), dim=1)[-size:]
        at = (self.place + torch.arange(len(keys), device=keys.device)) % size
        self.keys[at] = keys
        self.place.copy_((self.place + len(keys)) % size)


class Bank(nn.Module):
    """One L2-normalised embedding per training row: a moving average of the row's embeddings.

    ``shard_banks`` distributes the rows over the processes: row i belongs to process i mod size. After that, all processes
    must call ``state_dict`` together. It returns the whole bank on rank 0 and nothing on the others. ``load_state_dict``
    takes the whole bank on every process.
    """

    values: Tensor
    """[N, D]. If sharded: the rows of this process and one spare row, which stands for the rows of all other processes.
    With it, shapes do not depend on the drawn rows, so that nothing has to wait for a GPU."""

    def __init__(self, num_rows: int, width: int) -> None:
        super().__init__()
        self.num, self.world = num_rows, World()
        bound = (3 / width) ** 0.5  # uniform in +-sqrt(3 / D), as CMC's code: unit length in expectation
        self.register_buffer("values", torch.empty(num_rows, width).uniform_(-bound, bound))

    @property
    def num_own(self) -> int:
        """Number of the bank's rows that this process holds."""
        return len(range(self.world.rank, self.num, self.world.size))

    def find(self, at: Int[Tensor, "*B"]) -> Int[Tensor, "*B"]:
        """Positions in ``values`` of the bank's rows ``at``; the spare row for rows of other processes."""
        rank, size = self.world.rank, self.world.size
        return at if size == 1 else torch.where(at % size == rank, at // size, self.num_own)

    def find_drawn(self, at: Int[Tensor, "B K"]) -> Int[Tensor, "B k"]:
        """Positions [B, k] in ``values`` of those of the rows ``at`` that this process holds, padded with the spare row.

        ``at`` are K rows for each query, drawn uniformly. On one process k = K. On several, k is a little above K times
        the share of rows this process holds. A query with more such rows loses the excess; the probability of that is
        below 1e-32 (Chernoff bound).
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
        """Inner products of queries with bank rows at positions ``place``, from ``find`` or ``find_drawn``.

        The mask is False for the spare row, whose products have no meaning. Values computed from the others must be
        summed over the processes with ``world.sum``.
        """
        # Multiply with all rows, then select the drawn ones: the same numbers as gathering B x K rows, in far less memory.
        return (self.world.spread(query) @ self.values.T).gather(1, place), place < self.num_own

    @torch.no_grad()
    def follow(self, at: Int[Tensor, " B"], z: Float[Tensor, "B D"], m: float) -> None:
        """values[at] <- normalised m values[at] + (1 - m) z."""
        at = self.find(at)
        self.values[at] = F.normalize(m * self.values[at] + (1 - m) * z.float(), dim=1)

    def _cut(self, whole: Float[Tensor, "N D"]) -> Tensor:
        """The part of ``whole`` that this process keeps in ``values``."""
        return whole if self.world.size == 1 else torch.cat([self.world.shard(whole), whole[:1]])

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        own = destination.pop(f"{prefix}values")
        whole = self.world.unshard(own[: self.num_own], self.num)
        if whole is not None:
            destination[f"{prefix}values"] = whole

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        whole = state_dict.get(f"{prefix}values")
        if isinstance(whole, Tensor) and len(whole) == self.num:  # otherwise torch reports what does not fit
            state_dict[f"{prefix}values"] = self._cut(whole)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def shard_banks(module: nn.Module, world: World) -> None:
    """Reduce every bank in ``module`` to the rows of this process. The banks must be equal on all processes before."""
    for bank in module.modules():
        if isinstance(bank, Bank):
            bank.world = world
            bank.values = bank._cut(bank.values)


def replicated(module: nn.Module) -> list[Tensor]:
    """The parameters and buffers of ``module`` that are equal on all processes: all except the shards of banks."""
    parts = [part for part in module.modules() if not isinstance(part, Bank)]
    return [tensor for part in parts for tensor in (*part.parameters(False), *part.buffers(False))]
