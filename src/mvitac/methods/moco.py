"""MoCo v2 (He et al., CVPR 2020, arXiv:1911.05722; Chen et al., arXiv:2003.04297), for each modality separately.

The positive of a query is the momentum tower's embedding of another view of the same image. The negatives are a queue of
the last K keys; the other keys of the batch are not used. MViTac keeps the momentum tower and drops the queue.
Not implemented: shuffled BatchNorm (section 3.3). Queries and keys of a batch are normalised by statistics of the same rows,
which can reveal the positive.
"""

from abc import ABC
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn
from tyro.conf import Fixed

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig, Views, present, with_sum
from mvitac.nn.encoders import Encoders, Head, build_towers
from mvitac.nn.losses import queue_nce
from mvitac.nn.memory_bank import Queue
from mvitac.nn.momentum import Momentum

KEYS_PER_ROW = 0.125
"""Most keys per training row. In a longer queue, a row often meets its own older key and those of its positives."""


@dataclass(frozen=True, kw_only=True)
class QueueConfig(MethodConfig, ABC):
    """Fields shared by the methods with a queue (moco, mct)."""

    queue: int = 4096
    """Number of keys K in each queue: 5 % of Touch and Go, as MoCo's 65,536 are of ImageNet. At most one for eight rows."""
    momentum: float = 0.999
    """Momentum m of the key towers (MoCo: .999)."""
    out: Fixed[int] = 128
    """Width of the embeddings (MoCo: 128)."""
    hidden: Fixed[int] = 512
    """Hidden width of the 2-layer heads (MoCo v2: the trunk's width)."""
    head_norm: Fixed[bool] = False
    """BatchNorm after the first layer of the heads (MoCo v2: none)."""

    def queue_size(self, num_rows: int) -> int:
        return min(self.queue, max(1, int(KEYS_PER_ROW * num_rows)))


@dataclass(frozen=True, kw_only=True)
class MoCoConfig(QueueConfig):
    """Momentum contrast with a queue, per modality."""

    name: ClassVar[str] = "moco"
    takes_missing: ClassVar[bool] = True

    temperature: float = 0.2
    """Temperature tau (MoCo v2: .2)."""


class MoCo(Contrastive, config=MoCoConfig):
    """A query tower, its momentum copy and a queue per modality."""

    views = 2

    def __init__(self, config: MoCoConfig, spec: DataSpec, encoder: Encoders) -> None:
        super().__init__()
        self.config = config
        sizes = config.hidden, config.out
        self.towers = build_towers(encoder, spec, lambda width: Head(width, *sizes, norm=config.head_norm))
        self.key = nn.ModuleDict({m: Momentum(tower) for m, tower in self.towers.items()})
        self.queues = nn.ModuleDict()
        self.pending: dict[str, Tensor] = {}

    def prepare(self, rows: Tensor) -> None:
        self.queues = nn.ModuleDict({m: Queue(self.config.queue_size(len(rows)), self.config.out) for m in self.towers})

    def queries(self, batch: Views) -> Embeddings:
        return {("q", m): tower(batch.images[m][0]) for m, tower in present(self.towers, batch)}

    def keys(self, batch: Views) -> Embeddings:
        return {("k", m): tower(batch.images[m][1]) for m, tower in present(self.key, batch)}

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        assert self.queues, "call prepare(rows) first"
        self.pending = {m: z["k", m] for m in self.towers if ("k", m) in z}
        queue: dict[str, Tensor] = {m: queue.keys for m, queue in self.queues.items()}  # type: ignore[misc]
        return with_sum({m: queue_nce(z["q", m], z["k", m], queue[m], self.config.temperature) for m in self.pending})

    def after_step(self, progress: float) -> None:
        for modality, keys in self.pending.items():
            self.queues[modality].push(keys)  # type: ignore[operator]
        for tower in self.key.values():
            tower.follow(self.config.momentum)  # type: ignore[operator]
