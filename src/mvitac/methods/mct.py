"""Multimodal Contrastive Training (Yuan et al., CVPR 2021, arXiv:2104.12836), for vision and touch.

MViTac is built on it: towers, heads and momentum are the same. According to the MViTac paper (sections III-D and III-E),
MCT differs in two points. Its negatives come from a queue of keys instead of the batch. Its inter-modal losses are dot
products with a margin instead of InfoNCE:

    L_vt = mean over queries and queue of max(0, margin - q.k+ + q.k_i)

No training code is public, so the exact margin loss could not be verified. The hinge, its mean over the queue, and the
normalised embeddings are our reading. The second modality of MCT was text; here, touch is augmented as an image.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Embeddings
from mvitac.methods.moco import QueueConfig
from mvitac.methods.mvitac import PARTS, MViTac, MViTacConfig
from mvitac.nn.encoders import Encoders
from mvitac.nn.losses import queue_nce
from mvitac.nn.memory_bank import Queue

HEADS = [(modality, head) for modality in ("vision", "touch") for head in ("intra", "inter")]


@dataclass(frozen=True, kw_only=True)
class MCTConfig(QueueConfig):
    """MViTac's towers with a queue and a margin loss."""

    name: ClassVar[str] = "mct"
    needs_pairs: ClassVar[bool] = True

    margin: float = 0.2
    """Margin by which the cosine of a pair must exceed that of a query with a key of the queue. Not known for MCT."""
    temperature: float = 0.07
    """Temperature tau of the intra-modal losses."""
    lambda_inter: float = 1.0
    """Weight of the two inter-modal losses."""


def hinge(
    query: Float[Tensor, "B D"], key: Float[Tensor, "B D"], queue: Float[Tensor, "K D"], margin: float
) -> Float[Tensor, ""]:
    """max(0, margin - q.k+ + q.k_i), mean over B queries and K queue entries, on normalised embeddings in fp32."""
    with torch.autocast(query.device.type, enabled=False):
        query, key = F.normalize(query.float(), dim=1), F.normalize(key.float(), dim=1)
        return F.relu(margin - (query * key).sum(1, keepdim=True) + query @ queue.T).mean()


class MCT(MViTac, config=MCTConfig):
    """MViTac's query and key towers, and a queue for each head of each modality."""

    def __init__(self, config: MCTConfig, spec: DataSpec, encoder: Encoders) -> None:
        same = ("temperature", "lambda_inter", "momentum", "out", "hidden", "head_norm")
        super().__init__(MViTacConfig(**{name: getattr(config, name) for name in same}), spec, encoder)
        self.mct, self.queues = config, nn.ModuleDict()
        self.pending: dict[str, Tensor] = {}

    def prepare(self, rows: Tensor) -> None:
        size = self.mct.queue_size(len(rows))
        self.queues = nn.ModuleDict({f"{m}_{head}": Queue(size, self.mct.out) for m, head in HEADS})

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        assert self.queues, "call prepare(rows) first"
        losses, tau, margin = {}, self.mct.temperature, self.mct.margin
        self.pending = {f"{m}_{head}": z["k", m, 1, head] for m, head in HEADS}
        queues: dict[str, Tensor] = {name: queue.keys for name, queue in self.queues.items()}  # type: ignore[misc]
        for part, (x, y) in PARTS.items():
            head = "intra" if x == y else "inter"
            query, key, queue = z["q", x, 0, head], z["k", y, 1, head], queues[f"{y}_{head}"]
            losses[part] = queue_nce(query, key, queue, tau) if x == y else hinge(query, key, queue, margin)
        return {"loss": losses["vv"] + losses["tt"] + self.mct.lambda_inter * (losses["vt"] + losses["tv"]), **losses}

    def after_step(self, progress: float) -> None:
        for name, keys in self.pending.items():
            self.queues[name].push(keys)  # type: ignore[operator]
        super().after_step(progress)
