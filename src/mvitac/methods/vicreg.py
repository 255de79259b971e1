"""VICReg (Bardes, Ponce, LeCun, ICLR 2022, arXiv:2105.04906), for each modality separately: no negatives, one tower.

Embeddings Z, Z' [B, D] of two views, eq. 1-6:

    v(Z) = mean over dimensions of max(0, 1 - sqrt(Var(z_j) + 1e-4))      variance: no dimension collapses
    c(Z) = 1/D * sum of squared off-diagonal entries of Cov(Z)            covariance: dimensions are decorrelated
    s    = mean squared difference of Z and Z'                            invariance: two views of an image agree
    L    = 25 s + 25 (v(Z) + v(Z')) / 2 + 1 (c(Z) + c(Z'))

The factor 1/2 of the variance term is from the authors' code (https://github.com/facebookresearch/vicreg), not the paper.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from tyro.conf import Fixed

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig, with_sum
from mvitac.nn.encoders import Encoders, build_towers


@dataclass(frozen=True, kw_only=True)
class VICRegConfig(MethodConfig):
    """Variance, invariance and covariance terms on two views, per modality."""

    name: ClassVar[str] = "vicreg"
    takes_missing: ClassVar[bool] = True

    invariance: float = 25.0
    """Weight of s (VICReg: 25)."""
    variance: float = 25.0
    """Weight of v (VICReg: 25)."""
    covariance: float = 1.0
    """Weight of c (VICReg: 1)."""
    hidden: Fixed[int] = 2048
    """Width of the three expander layers. Four times the trunk's width, as VICReg's 8192 is four times that of ResNet-50."""


def variance(z: Float[Tensor, "B D"]) -> Float[Tensor, ""]:
    """v(Z), eq. 1-2."""
    return F.relu(1 - torch.sqrt(z.var(dim=0) + 1e-4)).mean()


def covariance(z: Float[Tensor, "B D"]) -> Float[Tensor, ""]:
    """c(Z), eq. 3-4."""
    centred = z - z.mean(0)
    cov = centred.T @ centred / (len(z) - 1)
    return (cov.square().sum() - cov.diagonal().square().sum()) / z.shape[1]


class VICReg(Contrastive, config=VICRegConfig):
    """A tower with a 3-layer expander per modality."""

    views = 2

    def __init__(self, config: VICRegConfig, spec: DataSpec, encoder: Encoders) -> None:
        super().__init__()
        self.config = config
        hidden = config.hidden

        def expander(features: int) -> nn.Module:
            layers: list[nn.Module] = []
            for width in (features, hidden):
                layers += [nn.Linear(width, hidden), nn.BatchNorm1d(hidden), nn.ReLU()]
            return nn.Sequential(*layers, nn.Linear(hidden, hidden, bias=False))

        self.towers = build_towers(encoder, spec, expander)

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        losses: dict[str, Tensor] = {}
        for modality in (m for m in self.towers if (m, 0) in z):
            first, second = (z[modality, i].float() for i in (0, 1))
            with torch.autocast(first.device.type, enabled=False):
                s, v = F.mse_loss(first, second), (variance(first) + variance(second)) / 2
                c = covariance(first) + covariance(second)
            losses[modality] = self.config.invariance * s + self.config.variance * v + self.config.covariance * c
        return with_sum(losses)
