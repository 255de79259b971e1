"""Cross-modal InfoNCE of SSVTP (Kerr et al., RSS 2023, arXiv:2209.13042), as the MViTac paper compares with it.

One trunk and one linear layer per modality, one view per image, no momentum encoder, in-batch negatives in both directions:
the inter-modal half of MViTac without its key towers.

What could be verified: InfoNCE between vision and touch, ResNet-18s (MViTac, appendix C), 128 dimensions and batch 128 in
MViTac's comparison against 8 and 512 in SSVTP's own. What could not, since no training code is public: the temperature
(MViTac's .07 here), the head (linear here) and whether the two directions are averaged (here) or summed. SSVTP also rotates
its pairs and trains on spatially aligned DIGIT images; that is its data, and not repeated here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, MethodConfig, Views
from mvitac.nn.encoders import EncoderConfig, build_towers
from mvitac.nn.losses import info_nce


@dataclass(frozen=True, kw_only=True)
class SSVTPConfig(MethodConfig):
    """InfoNCE between vision and touch alone."""

    name: ClassVar[str] = "ssvtp"

    temperature: float = 0.07
    """tau; not known for SSVTP, MViTac's best here."""
    out: int = 128
    """Width of the embeddings (128 in MViTac's comparison, 8 in SSVTP)."""

    def __post_init__(self) -> None:
        self.check_fields(positive=("temperature",), width=("out",))

    def build(self, spec: DataSpec, encoder: EncoderConfig) -> SSVTP:
        self.check_pairs(spec)
        return SSVTP(self, spec, encoder)


class SSVTP(Contrastive):
    """Two towers, one symmetric loss."""

    def __init__(self, config: SSVTPConfig, spec: DataSpec, encoder: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.towers = build_towers(encoder, spec, lambda width: nn.Linear(width, config.out))

    def queries(self, batch: Views) -> dict[str, Tensor]:
        return {m: tower(batch.images[m][0]) for m, tower in self.towers.items()}

    def contrast(self, z: dict[str, Tensor]) -> dict[str, Tensor]:
        vt = info_nce(z["vision"], z["touch"], self.config.temperature)
        tv = info_nce(z["touch"], z["vision"], self.config.temperature)
        return {"loss": (vt + tv) / 2, "vt": vt, "tv": tv}

    def encoders(self) -> dict[str, nn.Module]:
        return {m: tower.trunk for m, tower in self.towers.items()}  # type: ignore[misc]

    def projectors(self) -> dict[str, nn.Module]:
        return {m: tower.head for m, tower in self.towers.items()}  # type: ignore[misc]
