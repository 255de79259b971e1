"""BYOL (Grill et al., NeurIPS 2020, arXiv:2006.07733), for each modality separately. It uses no negatives.

The online tower and a predictor q predict, from one view, the momentum (target) tower's embedding z' of the other view, in
both directions: L = |q(z) - z'|^2 of normalised vectors = 2 - 2 cos. The predictor and the moving target prevent collapse.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from tyro.conf import Fixed

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig, Views, present, with_sum
from mvitac.nn.encoders import Encoders, Head, Projected, build_trunk, num_features
from mvitac.nn.momentum import Momentum, momentum_at


@dataclass(frozen=True, kw_only=True)
class BYOLConfig(MethodConfig):
    """Predict the momentum tower's embedding of another view, per modality."""

    name: ClassVar[str] = "byol"
    takes_missing: ClassVar[bool] = True

    momentum: float = 0.996
    """Momentum m of the target tower at the start (BYOL: .996). It rises to 1 along a half cosine."""
    out: Fixed[int] = 256
    """Width of the embeddings (BYOL: 256)."""
    hidden: Fixed[int] = 1024
    """Hidden width of projector and predictor. Twice the trunk's width, as BYOL's 4096 is twice that of ResNet-50."""


def regression(prediction: Float[Tensor, "B D"], target: Float[Tensor, "B D"]) -> Float[Tensor, ""]:
    """2 - 2 cos(prediction, target), mean over the batch (BYOL, eq. 2), in fp32."""
    return (2 - 2 * F.cosine_similarity(prediction.float(), target.float(), dim=1)).mean()


class BYOL(Contrastive, config=BYOLConfig):
    """An online tower with a predictor, and a momentum tower, per modality."""

    views = 2

    def __init__(self, config: BYOLConfig, spec: DataSpec, encoder: Encoders) -> None:
        super().__init__()
        self.config = config
        self.towers, self.predictor = nn.ModuleDict(), nn.ModuleDict()
        for modality in spec.modalities:
            trunk = build_trunk(encoder[modality], spec.channels(modality), spec.frames(modality))
            self.towers[modality] = Projected(trunk, Head(num_features(trunk), config.hidden, config.out, norm=True))
            self.predictor[modality] = Head(config.out, config.hidden, config.out, norm=True)
        self.target = nn.ModuleDict({m: Momentum(tower) for m, tower in self.towers.items()})

    def queries(self, batch: Views) -> Embeddings:
        online = present(self.towers, batch)
        return {("q", m, i): self.predictor[m](tower(batch.images[m][i])) for m, tower in online for i in (0, 1)}

    def keys(self, batch: Views) -> Embeddings:
        return {("k", m, i): target(batch.images[m][i]) for m, target in present(self.target, batch) for i in (0, 1)}

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        seen = (m for m in self.towers if ("q", m, 0) in z)
        losses = {m: regression(z["q", m, 0], z["k", m, 1]) + regression(z["q", m, 1], z["k", m, 0]) for m in seen}
        return with_sum(losses)

    def after_step(self, progress: float) -> None:
        for target in self.target.values():
            target.follow(momentum_at(progress, self.config.momentum))  # type: ignore[operator]
