"""MViTac (Dave, Lygerakis, Rueckert, ICRA 2024): intra- and inter-modal contrast of vision and touch, eq. 1-14.

Notation of the paper: encoders f(.; theta) for vision and f(.; psi) for touch; heads phi_v (vision, intra), phi_t
(vision, inter), Phi_t (touch, intra), Phi_v (touch, inter); q = query, k = key. z_xy: x is the query's modality, y the
key's. Two views of each image: the first feeds the query tower, the second the key tower. Shapes: images [B, C, H, W],
features [B, D], embeddings z [B, 128].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

from torch import Tensor, nn

from mvitac.batch import Views
from mvitac.encoders import EncoderConfig, Head, build_trunk
from mvitac.losses import info_nce
from mvitac.methods.base import Contrastive, MethodConfig
from mvitac.momentum import Momentum, rising
from mvitac.spec import DataSpec


@dataclass(frozen=True, kw_only=True)
class MViTacConfig(MethodConfig):
    """Momentum contrast within and across vision and touch; on touch-only (or vision-only) data its intra loss alone."""

    name: ClassVar[str] = "mvitac"

    temperature: float = 0.07
    """tau of InfoNCE; the best of .07, .2, .5, 1 in the paper."""
    lambda_inter: float = 1.0
    """Weight of the two inter-modal losses (eq. 14); not given in the paper, 1 in the authors' code."""
    momentum: float = 0.99
    """m of eq. 1-3; not given in the paper, .99 in the authors' code."""
    momentum_end: float | None = None
    """If given, m rises to this along a half cosine (as in BYOL and MoCo v3); the paper has no schedule."""
    losses: tuple[Literal["vv", "tt", "vt", "tv"], ...] = ("vv", "tt", "vt", "tv")
    """Which of the four losses of eq. 14 to minimise; the paper minimises all."""
    shared_heads: bool = False
    """One head per encoder for intra and inter losses alike, instead of the paper's two."""
    out: int = 128
    """Width of the embeddings z (paper: 128)."""
    hidden: int = 512
    """Hidden width of the 2-layer heads; not given in the paper (2048 in the authors' code), 512 is the trunk's width."""
    dropout: float = 0.0
    """Dropout in the heads; none in the paper, .5 in the authors' code."""
    head_norm: bool = False
    """BatchNorm after the heads' first layer, as in MoCo v3 and SimCLR v2; none in the paper."""

    def __post_init__(self) -> None:
        if not (self.temperature > 0 and math.isfinite(self.temperature)):
            raise ValueError(f"temperature {self.temperature}: give a positive number, e.g. 0.07")
        if not (self.lambda_inter >= 0 and math.isfinite(self.lambda_inter)):
            raise ValueError(f"lambda_inter {self.lambda_inter}: give a finite weight >= 0")
        for name, m in (("momentum", self.momentum), ("momentum_end", self.momentum_end)):
            if m is not None and not 0 <= m <= 1:
                raise ValueError(f"{name} {m}: give 0 (keys copy the queries) to 1 (keys never move)")
        for name, width in (("out", self.out), ("hidden", self.hidden)):
            if not 1 <= width <= 65536:
                raise ValueError(f"head width {name} {width}: give 1 to 65536")
        if not self.losses or len(set(self.losses)) < len(self.losses):
            raise ValueError(f"losses {self.losses}: give one or more of vv, tt, vt, tv, each once")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout {self.dropout}: give a probability in [0, 1)")

    def build(self, spec: DataSpec, encoder: EncoderConfig) -> MViTac:
        if not set(self.losses) & set(_possible(spec)):
            raise ValueError(
                f"losses {', '.join(self.losses)} need another modality than dataset {spec.name!r} has:"
                f" give some of {', '.join(_possible(spec))}"
            )
        return MViTac(self, spec, encoder)


def _possible(spec: DataSpec) -> tuple[str, ...]:
    """The losses of eq. 14 that a dataset's modalities allow."""
    own = tuple({"vision": "vv", "touch": "tt"}[m] for m in spec.modalities)
    return (*own, "vt", "tv") if len(own) == 2 else own


class Tower(nn.Module):
    """One encoder with its two heads: an image passes the trunk once and leaves as (z intra, z inter)."""

    def __init__(self, config: MViTacConfig, encoder: EncoderConfig, channels: int) -> None:
        super().__init__()
        self.trunk = build_trunk(encoder, channels)

        def head() -> Head:
            features = int(self.trunk.num_features)  # type: ignore[arg-type]
            return Head(features, config.hidden, config.out, dropout=config.dropout, norm=config.head_norm)

        self.intra = head()
        self.inter = self.intra if config.shared_heads else head()

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        features = self.trunk(images)
        return self.intra(features), self.inter(features)


class MViTac(Contrastive):
    """Query towers, their momentum copies, four losses."""

    views = 2

    def __init__(self, config: MViTacConfig, spec: DataSpec, encoder: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        # vision: theta, phi_v (intra), phi_t (inter); touch: psi, Phi_t (intra), Phi_v (inter)
        self.query = nn.ModuleDict({m: Tower(config, encoder, spec.channels(m)) for m in spec.modalities})
        self.key = nn.ModuleDict({m: Momentum(tower) for m, tower in self.query.items()})

    def queries(self, batch: Views) -> dict[str, Tensor]:
        z: dict[str, Tensor] = {}
        if "vision" in batch.images:
            z["vv_q"], z["vt_q"] = self.query["vision"](batch.images["vision"][0])  # eq. 4, 9
        if "touch" in batch.images:
            z["tt_q"], z["tv_q"] = self.query["touch"](batch.images["touch"][0])  # eq. 6, 12
        return z

    def keys(self, batch: Views) -> dict[str, Tensor]:
        z: dict[str, Tensor] = {}
        if "vision" in batch.images:
            z["vv_k"], z["tv_k"] = self.key["vision"](batch.images["vision"][1])  # eq. 5, 13
        if "touch" in batch.images:
            z["tt_k"], z["vt_k"] = self.key["touch"](batch.images["touch"][1])  # eq. 7, 10
        return z

    def contrast(self, z: dict[str, Tensor]) -> dict[str, Tensor]:
        parts = [part for part in ("vv", "tt", "vt", "tv") if f"{part}_q" in z and f"{part}_k" in z]
        losses = {p: info_nce(z[f"{p}_q"], z[f"{p}_k"], self.config.temperature) for p in parts}  # eq. 8, 11
        # eq. 14; a loss that is left out of it is still told, as a witness of what the others do to it
        weight = {"vv": 1.0, "tt": 1.0, "vt": self.config.lambda_inter, "tv": self.config.lambda_inter}
        total = sum(weight[name] * loss for name, loss in losses.items() if name in self.config.losses)
        return {"loss": total, **losses}  # type: ignore[dict-item]

    def encoders(self) -> dict[str, nn.Module]:
        return {m: tower.trunk for m, tower in self.query.items()}  # type: ignore[misc]

    def projectors(self) -> dict[str, nn.Module]:
        return {m: tower.inter for m, tower in self.query.items()}  # type: ignore[misc]

    def after_step(self, progress: float) -> None:
        m = rising(self.config.momentum, self.config.momentum_end, progress)
        for modality, tower in self.query.items():
            self.key[modality].follow(tower, m)  # type: ignore[operator]  # eq. 1-3
