"""SimCLR (Chen et al., ICML 2020, arXiv:2002.05709), for each modality separately: NT-Xent between two views of an image.

Each of the 2B views must identify the other view of its image among the 2B - 1 remaining ones.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from tyro.conf import Fixed

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig, with_sum
from mvitac.nn.encoders import Encoders, Head, build_towers


@dataclass(frozen=True, kw_only=True)
class SimCLRConfig(MethodConfig):
    """Contrast two views of an image with the rest of the batch, per modality."""

    name: ClassVar[str] = "simclr"
    takes_missing: ClassVar[bool] = True

    temperature: float = 0.1
    """Temperature tau (SimCLR, table 5: .1 is best with normalised embeddings)."""
    out: Fixed[int] = 128
    """Width of the embeddings (SimCLR: 128)."""
    hidden: Fixed[int] = 512
    """Hidden width of the 2-layer head (SimCLR: the trunk's width)."""
    head_norm: Fixed[bool] = True
    """BatchNorm after the first layer of the head (as in the authors' code)."""


def nt_xent(a: Float[Tensor, "B D"], b: Float[Tensor, "B D"], temperature: float) -> Float[Tensor, ""]:
    """NT-Xent (SimCLR, eq. 1), mean over all 2B views, in fp32. Row i of ``a`` and row i of ``b`` are views of one image."""
    with torch.autocast(a.device.type, enabled=False):
        z = F.normalize(torch.cat([a, b]).float(), dim=1)
        logits = z @ z.T / temperature
        logits = logits.masked_fill(torch.eye(len(z), dtype=torch.bool, device=z.device), float("-inf"))
        return F.cross_entropy(logits, torch.arange(len(z), device=z.device).roll(len(a)))


class SimCLR(Contrastive, config=SimCLRConfig):
    """A tower per modality."""

    views = 2

    def __init__(self, config: SimCLRConfig, spec: DataSpec, encoder: Encoders) -> None:
        super().__init__()
        self.config = config
        sizes = config.hidden, config.out
        self.towers = build_towers(encoder, spec, lambda width: Head(width, *sizes, norm=config.head_norm))

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        return with_sum({m: nt_xent(z[m, 0], z[m, 1], self.config.temperature) for m in self.towers if (m, 0) in z})
