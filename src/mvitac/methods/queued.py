"""What methods with a queue of momentum keys have in common (MoCo, MCT): the settings of queue, key tower and head."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass

from mvitac.methods.base import MethodConfig


@dataclass(frozen=True, kw_only=True)
class QueueConfig(MethodConfig, ABC):
    """Base of their configs; no method by itself."""

    queue: int = 4096
    """K, keys remembered for each head; MoCo's 65,536 are 5 % of ImageNet, 4,096 are 5 % of Touch and Go. Never more than
    half the training rows, so that a row seldom meets its own older key."""
    momentum: float = 0.999
    """m of the key towers (MoCo: .999)."""
    momentum_end: float | None = None
    """If given, m rises to this along a half cosine."""
    out: int = 128
    """Width of the embeddings (MoCo: 128)."""
    hidden: int = 512
    """Hidden width of the 2-layer heads (MoCo v2: the trunk's own width)."""
    head_norm: bool = False
    """BatchNorm after the heads' first layer (MoCo v2: none)."""

    def __post_init__(self) -> None:
        self.check_fields(share=("momentum", "momentum_end"), width=("out", "hidden"))
        if not 1 <= self.queue <= 1 << 24:
            raise ValueError(f"queue {self.queue}: give 1 to {1 << 24} keys")

    def queue_size(self, num_rows: int) -> int:
        """Keys to remember when training on ``num_rows`` rows."""
        return min(self.queue, max(1, num_rows // 2))
