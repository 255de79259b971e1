"""DINO (Caron et al., ICCV 2021, arXiv:2104.14294), for each modality separately: no negatives, K learned prototypes.

A head turns features into scores of K prototypes. The student's distribution over them for one view must match that of the
momentum (teacher) tower for the other view, in both directions:

    L = -sum_k P_t(k) log P_s(k),    P_s = softmax(s / tau_s),    P_t = softmax((t - c) / tau_t)

The centre c is a moving average of the teacher's scores and keeps one prototype from winning everywhere. The low
temperature tau_t keeps the distribution from becoming uniform.
Sources: the paper (eq. 1-4, appendix C); https://github.com/facebookresearch/dino (main_dino.py).
Not implemented: small local crops (every method here uses two views), the warm-up of tau_t, freezing the last layer in the
first epoch, gradient clipping (owners: norm 3), a weight decay that rises from .04 to .4 (here the recipe's, for all
methods), and their truncated-normal start of the MLP.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from tyro.conf import Fixed

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig, Views, present, with_sum
from mvitac.nn.encoders import Encoders, build_towers
from mvitac.nn.momentum import Momentum, momentum_at

BOTTLENECK = 256
NORM = 0.577
"""Norm of the prototypes at the start (DINO's). They are normalised before use, so a larger one means smaller steps of their
direction: at 16 they hardly move."""


@dataclass(frozen=True, kw_only=True)
class DINOConfig(MethodConfig):
    """Match the momentum tower's centred, sharpened prototype scores of another view, per modality."""

    name: ClassVar[str] = "dino"
    takes_missing: ClassVar[bool] = True

    student_temperature: float = 0.1
    """Student temperature tau_s (DINO: .1)."""
    teacher_temperature: float = 0.04
    """Teacher temperature tau_t (DINO: .04, rising to .07 in long runs)."""
    centre_momentum: float = 0.9
    """Share of the old value that the centre keeps in a step (DINO: .9)."""
    momentum: float = 0.996
    """Momentum m of the teacher at the start (DINO: .996). It rises to 1 along a half cosine."""
    out: Fixed[int] = 4096
    """Number of prototypes K. DINO's 65,536 are 5 % of ImageNet; 4,096 are 5 % of Touch and Go."""
    hidden: Fixed[int] = 2048
    """Hidden width of the 3-layer head (DINO: 2048 for every trunk)."""


class Prototypes(nn.Module):
    """An MLP with a bottleneck: features [B, D] to cosines [B, K] with K learned directions."""

    def __init__(self, features: int, hidden: int, num: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(features, hidden), nn.GELU(), nn.Linear(hidden, hidden), nn.GELU(), nn.Linear(hidden, BOTTLENECK)
        )
        self.directions = nn.Parameter(torch.randn(num, BOTTLENECK) * (NORM / BOTTLENECK**0.5))

    def forward(self, features: Float[Tensor, "B D"]) -> Float[Tensor, "B K"]:
        return F.linear(F.normalize(self.mlp(features), dim=1), F.normalize(self.directions, dim=1))


def agreement(student: Float[Tensor, "B K"], teacher: Float[Tensor, "B K"]) -> Float[Tensor, ""]:
    """Cross-entropy between the teacher's and the student's distribution; scores are already divided by temperature."""
    return -(teacher.softmax(dim=1) * student.log_softmax(dim=1)).sum(1).mean()


class DINO(Contrastive, config=DINOConfig):
    """A student tower, its momentum copy (the teacher) and a centre per modality."""

    views = 2
    centre: Tensor
    """[modalities, K], in the order of ``student``."""

    def __init__(self, config: DINOConfig, spec: DataSpec, encoder: Encoders) -> None:
        super().__init__()
        self.config = config
        self.towers = build_towers(encoder, spec, lambda width: Prototypes(width, config.hidden, config.out))
        self.teacher = nn.ModuleDict({m: Momentum(tower) for m, tower in self.towers.items()})
        self.register_buffer("centre", torch.zeros(len(self.towers), config.out))
        self.pending: Tensor | None = None

    def keys(self, batch: Views) -> Embeddings:
        return {("teacher", m, i): t(batch.images[m][i]) for m, t in present(self.teacher, batch) for i in (0, 1)}

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        config, losses, means = self.config, {}, []
        with torch.autocast(self.centre.device.type, enabled=False):
            for m, centre in zip(self.towers, self.centre, strict=True):
                if (m, 0) not in z:
                    means.append(centre)  # after_step leaves it where it is
                    continue
                s = [z[m, i].float() / config.student_temperature for i in (0, 1)]
                raw = [z["teacher", m, i].float() for i in (0, 1)]
                t = [(scores - centre) / config.teacher_temperature for scores in raw]
                losses[m] = (agreement(s[0], t[1]) + agreement(s[1], t[0])) / 2
                means.append(torch.cat(raw).mean(0))
        self.pending = torch.stack(means)
        return with_sum(losses)

    def after_step(self, progress: float) -> None:
        assert self.pending is not None, "call forward first"
        self.centre.lerp_(self.pending, 1 - self.config.centre_momentum)
        for teacher in self.teacher.values():
            teacher.follow(momentum_at(progress, self.config.momentum))  # type: ignore[operator]
