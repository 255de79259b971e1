"""Cross-modal InfoNCE of SSVTP (Kerr et al., RSS 2023, arXiv:2209.13042), as the MViTac paper compares with it.

One trunk and one linear layer per modality, one view per image, no momentum encoder, in-batch negatives in both directions.
It is the inter-modal half of MViTac without key towers.

Verified: InfoNCE between vision and touch, ResNet-18 trunks (MViTac, appendix C), 128 dimensions and batch 128 in MViTac's
comparison, 8 and 512 in SSVTP's own. Not verified, since no training code is public: the temperature (here MViTac's .07),
the head (here linear), and whether the two directions are averaged (here) or summed. SSVTP also rotates its pairs and
trains on spatially aligned DIGIT images. That belongs to its data and is not repeated here.
"""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn
from tyro.conf import Fixed

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig
from mvitac.nn.encoders import Encoders, build_towers
from mvitac.nn.losses import info_nce


@dataclass(frozen=True, kw_only=True)
class SSVTPConfig(MethodConfig):
    """InfoNCE between vision and touch only."""

    name: ClassVar[str] = "ssvtp"
    needs_pairs: ClassVar[bool] = True

    temperature: float = 0.07
    """Temperature tau. Not known for SSVTP; this is MViTac's best."""
    out: Fixed[int] = 128
    """Width of the embeddings (128 in MViTac's comparison, 8 in SSVTP)."""


class SSVTP(Contrastive, config=SSVTPConfig):
    """Two towers, one symmetric loss."""

    def __init__(self, config: SSVTPConfig, spec: DataSpec, encoder: Encoders) -> None:
        super().__init__()
        self.config = config
        self.towers = build_towers(encoder, spec, lambda width: nn.Linear(width, config.out))

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        vt = info_nce(z["vision", 0], z["touch", 0], self.config.temperature)
        tv = info_nce(z["touch", 0], z["vision", 0], self.config.temperature)
        return {"loss": (vt + tv) / 2, "vt": vt, "tv": tv}

    def projectors(self) -> dict[str, nn.Module]:
        return {m: tower.head for m, tower in self.towers.items()}  # type: ignore[misc]
