"""Keys kept across batches: a queue of the latest keys (MoCo), and a bank with one key per training row (CMC).

Both are read in ``forward`` and written only in ``after_step``. Shapes: D dimensions, N rows, K places.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn


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
        self.keys[(self.place + torch.arange(len(keys), device=keys.device)) % size] = keys
        self.place.copy_((self.place + len(keys)) % size)


class Bank(nn.Module):
    """One L2-normalised embedding per training row: a moving average of the row's embeddings."""

    values: Tensor  # [N, D]

    def __init__(self, num_rows: int, width: int) -> None:
        super().__init__()
        bound = (3 / width) ** 0.5  # uniform in +-sqrt(3 / D), as CMC's code: unit length in expectation
        self.register_buffer("values", torch.empty(num_rows, width).uniform_(-bound, bound))

    def dots(self, query: Float[Tensor, "B D"], at: Int[Tensor, "B K"]) -> Float[Tensor, "B K"]:
        # Multiply with all rows, then select the drawn ones: the same numbers as gathering B x K rows, in far less memory.
        return (query @ self.values.T).gather(1, at)

    @torch.no_grad()
    def follow(self, at: Int[Tensor, " B"], z: Float[Tensor, "B D"], m: float) -> None:
        """values[at] <- normalised m values[at] + (1 - m) z."""
        self.values[at] = F.normalize(m * self.values[at] + (1 - m) * z.float(), dim=1)
