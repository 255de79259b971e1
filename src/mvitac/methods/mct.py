"""Multimodal Contrastive Training (Yuan et al., CVPR 2021, arXiv:2104.12836) for vision and touch: what MViTac started from.

Towers, heads and momentum are MViTac's. What differs, as the MViTac paper tells it (section III-D, III-E): negatives come
from a queue of keys instead of the batch, and the inter-modal losses are dot products with a margin instead of InfoNCE:

    L_vt = mean over queries and queue of max(0, margin - q.k+ + q.k_i)

No training code is public and the exact margin loss could not be verified here: the hinge, its mean over the queue, and the
normalised embeddings are our reading. MCT's second modality was text; touch is augmented as an image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Views
from mvitac.methods.moco import QueueConfig
from mvitac.methods.mvitac import PARTS, MViTac, MViTacConfig
from mvitac.nn.encoders import EncoderConfig
from mvitac.nn.losses import queue_nce
from mvitac.nn.memory_bank import Queue

QUEUES = [f"{modality}_{head}" for modality in ("vision", "touch") for head in ("intra", "inter")]
"""One for the keys of each head of each modality, named as ``MViTac.keys`` names them but for the view."""


@dataclass(frozen=True, kw_only=True)
class MCTConfig(QueueConfig):
    """MViTac's towers with a queue and a margin, as in the method it adapts."""

    name: ClassVar[str] = "mct"

    margin: float = 0.2
    """By how much a pair's cosine must exceed that of a query with a key of the queue; not known for MCT."""
    temperature: float = 0.07
    """tau of the intra-modal losses."""
    lambda_inter: float = 1.0
    """Weight of the two inter-modal losses."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_fields(positive=("temperature",), weight=("margin", "lambda_inter"))

    def build(self, spec: DataSpec, encoder: EncoderConfig) -> MCT:
        self.check_pairs(spec)
        return MCT(self, spec, encoder)


def hinge(
    query: Float[Tensor, "B D"], key: Float[Tensor, "B D"], queue: Float[Tensor, "K D"], margin: float
) -> Float[Tensor, ""]:
    """max(0, margin - q.k+ + q.k_i), mean over B queries and K queue entries; normalised embeddings; fp32."""
    with torch.autocast(query.device.type, enabled=False):
        query, key = F.normalize(query.float(), dim=1), F.normalize(key.float(), dim=1)
        return F.relu(margin - (query * key).sum(1, keepdim=True) + query @ queue.T).mean()


class MCT(Contrastive):
    """MViTac's query and key towers, a queue for each head of each modality."""

    views = 2

    def __init__(self, config: MCTConfig, spec: DataSpec, encoder: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        same = ("temperature", "lambda_inter", "momentum", "momentum_end", "out", "hidden", "head_norm")
        self.towers = MViTac(MViTacConfig(**{name: getattr(config, name) for name in same}), spec, encoder)
        self.queues = nn.ModuleDict()
        self.pending: dict[str, Tensor] = {}

    def prepare(self, rows: Tensor) -> None:
        size = self.config.queue_size(len(rows))
        self.queues = nn.ModuleDict({name: Queue(size, self.config.out) for name in QUEUES})

    def queries(self, batch: Views) -> dict[str, Tensor]:
        return self.towers.queries(batch)

    def keys(self, batch: Views) -> dict[str, Tensor]:
        return self.towers.keys(batch)

    def contrast(self, z: dict[str, Tensor]) -> dict[str, Tensor]:
        assert self.queues, "prepare(rows) comes first"
        config = self.config
        key = {name: z[f"k1_{name}"] for name in QUEUES}
        query = {name: z[f"q0_{name}"] for name in QUEUES}
        self.pending = key
        queue: dict[str, Tensor] = {name: q.keys for name, q in self.queues.items()}  # type: ignore[misc]
        losses = {}
        for part, (mine, other) in PARTS.items():
            if mine == other:
                name = f"{mine}_intra"
                losses[part] = queue_nce(query[name], key[name], queue[name], config.temperature)
            else:
                name = f"{other}_inter"
                losses[part] = hinge(query[f"{mine}_inter"], key[name], queue[name], config.margin)
        loss = losses["vv"] + losses["tt"] + config.lambda_inter * (losses["vt"] + losses["tv"])
        return {"loss": loss, **losses}

    def encoders(self) -> dict[str, nn.Module]:
        return self.towers.encoders()

    def projectors(self) -> dict[str, nn.Module]:
        return self.towers.projectors()

    def after_step(self, progress: float) -> None:
        for name, keys in self.pending.items():
            self.queues[name].push(keys)  # type: ignore[operator]
        self.towers.after_step(progress)
