"""BYOL (Grill et al., NeurIPS 2020, arXiv:2006.07733) for each modality by itself: no negatives at all.

The online tower's prediction of one view meets the momentum (target) tower's embedding of the other, both ways round:
L = |q(z) - z'|^2 of normalised vectors = 2 - 2 cos. The predictor q and the moving target keep it from collapsing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, MethodConfig, Views
from mvitac.nn.encoders import EncoderConfig, Head, Projected, build_trunk, num_features
from mvitac.nn.momentum import Momentum, rising


@dataclass(frozen=True, kw_only=True)
class BYOLConfig(MethodConfig):
    """Predict the momentum tower's embedding of another view, per modality."""

    name: ClassVar[str] = "byol"

    momentum: float = 0.996
    """m of the target tower at the start (BYOL: .996)."""
    momentum_end: float | None = 1.0
    """m rises to this along a half cosine (BYOL: 1)."""
    out: int = 256
    """Width of the embeddings (BYOL: 256)."""
    hidden: int = 1024
    """Hidden width of projector and predictor: twice the trunk's, as BYOL's 4096 is twice ResNet-50's."""

    def __post_init__(self) -> None:
        self.check_fields(share=("momentum", "momentum_end"), width=("out", "hidden"))

    def build(self, spec: DataSpec, encoder: EncoderConfig) -> BYOL:
        return BYOL(self, spec, encoder)


def regression(prediction: Float[Tensor, "B D"], target: Float[Tensor, "B D"]) -> Float[Tensor, ""]:
    """2 - 2 cos(prediction, target), mean over the batch (BYOL, eq. 2); fp32."""
    return (2 - 2 * F.cosine_similarity(prediction.float(), target.float(), dim=1)).mean()


class BYOL(Contrastive):
    """An online tower with a predictor and a momentum tower per modality."""

    views = 2

    def __init__(self, config: BYOLConfig, spec: DataSpec, encoder: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.online, self.predictor = nn.ModuleDict(), nn.ModuleDict()
        for modality in spec.modalities:
            trunk = build_trunk(encoder, spec.channels(modality))
            self.online[modality] = Projected(trunk, Head(num_features(trunk), config.hidden, config.out, norm=True))
            self.predictor[modality] = Head(config.out, config.hidden, config.out, norm=True)
        self.target = nn.ModuleDict({m: Momentum(tower) for m, tower in self.online.items()})

    def queries(self, batch: Views) -> dict[str, Tensor]:
        return {
            f"{m}_q{i}": self.predictor[m](online(batch.images[m][i]))
            for m, online in self.online.items()
            for i in (0, 1)
        }

    def keys(self, batch: Views) -> dict[str, Tensor]:
        return {f"{m}_k{i}": target(batch.images[m][i]) for m, target in self.target.items() for i in (0, 1)}

    def contrast(self, z: dict[str, Tensor]) -> dict[str, Tensor]:
        losses = {
            m: regression(z[f"{m}_q0"], z[f"{m}_k1"]) + regression(z[f"{m}_q1"], z[f"{m}_k0"]) for m in self.online
        }
        return {"loss": torch.stack(list(losses.values())).sum(), **losses}

    def encoders(self) -> dict[str, nn.Module]:
        return {m: tower.trunk for m, tower in self.online.items()}  # type: ignore[misc]

    def after_step(self, progress: float) -> None:
        m = rising(self.config.momentum, self.config.momentum_end, progress)
        for modality, tower in self.online.items():
            self.target[modality].follow(tower, m)  # type: ignore[operator]
