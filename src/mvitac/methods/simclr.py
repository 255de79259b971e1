"""SimCLR (Chen et al., ICML 2020, arXiv:2002.05709) for each modality by itself: NT-Xent between two views of an image.

Each of the 2B views must find the other view of its image among the 2B - 1 remaining ones. Vision and touch never meet.
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
from mvitac.nn.encoders import EncoderConfig, Head, build_towers


@dataclass(frozen=True, kw_only=True)
class SimCLRConfig(MethodConfig):
    """Two views of an image against the rest of the batch, per modality."""

    name: ClassVar[str] = "simclr"

    temperature: float = 0.1
    """tau (SimCLR, table 5: .1 is best with normalised embeddings)."""
    out: int = 128
    """Width of the embeddings (SimCLR: 128)."""
    hidden: int = 512
    """Hidden width of the 2-layer head (SimCLR: the trunk's own width)."""
    head_norm: bool = True
    """BatchNorm after the head's first layer (in the authors' code)."""

    def __post_init__(self) -> None:
        self.check_fields(positive=("temperature",), width=("out", "hidden"))

    def build(self, spec: DataSpec, encoder: EncoderConfig) -> SimCLR:
        return SimCLR(self, spec, encoder)


def nt_xent(a: Float[Tensor, "B D"], b: Float[Tensor, "B D"], temperature: float) -> Float[Tensor, ""]:
    """NT-Xent (SimCLR, eq. 1), mean over all 2B views; row i of ``a`` and of ``b`` are views of one image; fp32."""
    with torch.autocast(a.device.type, enabled=False):
        z = F.normalize(torch.cat([a, b]).float(), dim=1)
        logits = z @ z.T / temperature
        logits = logits.masked_fill(torch.eye(len(z), dtype=torch.bool, device=z.device), float("-inf"))
        num = len(a)
        return F.cross_entropy(logits, torch.arange(2 * num, device=z.device).roll(num))


class SimCLR(Contrastive):
    """A tower per modality."""

    views = 2

    def __init__(self, config: SimCLRConfig, spec: DataSpec, encoder: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.towers = build_towers(
            encoder, spec, lambda width: Head(width, config.hidden, config.out, norm=config.head_norm)
        )

    def queries(self, batch: Views) -> dict[str, Tensor]:
        return {f"{m}_{i}": tower(batch.images[m][i]) for m, tower in self.towers.items() for i in (0, 1)}

    def contrast(self, z: dict[str, Tensor]) -> dict[str, Tensor]:
        losses = {m: nt_xent(z[f"{m}_0"], z[f"{m}_1"], self.config.temperature) for m in self.towers}
        return {"loss": torch.stack(list(losses.values())).sum(), **losses}

    def encoders(self) -> dict[str, nn.Module]:
        return {m: tower.trunk for m, tower in self.towers.items()}  # type: ignore[misc]
