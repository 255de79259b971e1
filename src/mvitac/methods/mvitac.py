"""MViTac (Dave, Lygerakis, Rueckert, ICRA 2024): intra- and inter-modal contrast of vision and touch, eq. 1-14.

Notation of the paper: encoders f(.; theta) for vision and f(.; psi) for touch; heads phi_v (vision, intra), phi_t
(vision, inter), Phi_t (touch, intra), Phi_v (touch, inter); q = query, k = key. z_xy: x is the query's modality, y the
key's. Two views of each image: the first feeds the query tower, the second the key tower. Shapes: images [B, C, H, W],
features [B, D], embeddings z [B, 128].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal, Self

import torch
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, MethodConfig, Views
from mvitac.nn.encoders import EncoderConfig, Head, build_trunk, draws_random_numbers
from mvitac.nn.losses import info_nce
from mvitac.nn.momentum import Momentum, rising
from mvitac.system.processes import in_branches

PARTS = {"vv": ("vision", "vision"), "tt": ("touch", "touch"), "vt": ("vision", "touch"), "tv": ("touch", "vision")}
"""loss -> modality of its queries, of its keys."""


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
    keys: Literal["momentum", "end-to-end"] = "momentum"
    """Where keys come from: a momentum tower (the paper), or the query tower itself, learning from them too (SimCLR; named
    as in MoCo, figure 2). The latter is symmetric as it is, and takes no momentum."""
    key_norm: Literal["batch", "running"] = "batch"
    """Statistics of BatchNorm in momentum towers: of their own batch (the authors' code), or those that follow the query
    tower's (EMAN, arXiv:2101.08482)."""
    symmetric: bool = False
    """Each view is query and key in turn, the loss the mean of both ways (BYOL, MoCo v3); the paper has one way."""
    pairs: Literal["crossed", "all"] = "crossed"
    """Which views the inter-modal losses pair: a view of one modality with the other's other view (the paper's query and
    key), or with both, at the same forward passes. "all" needs each view as query and key: end-to-end or symmetric."""
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
        if self.pairs == "all" and not self.both_ways:
            raise ValueError(
                "pairs 'all' need each view as query and as key: give keys 'end-to-end', symmetric, or pairs 'crossed'"
            )
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout {self.dropout}: give a probability in [0, 1)")

    @property
    def both_ways(self) -> bool:
        """Whether each view is query and key."""
        return self.symmetric or self.keys == "end-to-end"

    def without_idle(self, spec: DataSpec) -> Self:
        mine = replace(self, losses=tuple(part for part in _possible(spec) if part in self.losses))
        return mine if len(spec.modalities) > 1 else replace(mine, lambda_inter=1.0, pairs="crossed")

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


def _embed(towers: nn.ModuleDict, batch: Views, name: str, views: list[int]) -> dict[str, Tensor]:
    """Embeddings of ``views`` of each modality by both heads, named e.g. q0_vision_intra."""

    def of(modality: str) -> dict[str, Tensor]:
        z = {}
        for view in views:
            intra, inter = towers[modality](batch.images[modality][view])
            z |= {f"{name}{view}_{modality}_intra": intra, f"{name}{view}_{modality}_inter": inter}
        return z

    branches = [partial(of, modality) for modality in towers]
    if batch.rows.device.type != "cpu" or draws_random_numbers(towers):
        return {key: tensor for branch in branches for key, tensor in branch().items()}
    return in_branches(branches)


class MViTac(Contrastive):
    """Query towers, their momentum copies, four losses."""

    views = 2

    def __init__(self, config: MViTacConfig, spec: DataSpec, encoder: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        # vision: theta, phi_v (intra), phi_t (inter); touch: psi, Phi_t (intra), Phi_v (inter)
        self.query = nn.ModuleDict({m: Tower(config, encoder, spec.channels(m)) for m in spec.modalities})
        momentum = self.query if config.keys == "momentum" else {}
        running = config.key_norm == "running"
        self.key = nn.ModuleDict({m: Momentum(tower, running_norm=running) for m, tower in momentum.items()})

    @property
    def directions(self) -> tuple[tuple[int, int], ...]:
        """(view of the query, view of the key) of every term of a loss."""
        return ((0, 1), (1, 0)) if self.config.both_ways else ((0, 1),)

    def queries(self, batch: Views) -> dict[str, Tensor]:
        return _embed(self.query, batch, "q", [q for q, _ in self.directions])  # eq. 4, 6, 9, 12

    def keys(self, batch: Views) -> dict[str, Tensor]:
        return _embed(self.key, batch, "k", [k for _, k in self.directions])  # eq. 5, 7, 10, 13

    def contrast(self, z: dict[str, Tensor]) -> dict[str, Tensor]:
        tower = "q" if self.config.keys == "end-to-end" else "k"
        losses = {}
        for part, (mine, other) in PARTS.items():
            if mine not in self.query or other not in self.query:
                continue
            head = "intra" if mine == other else "inter"
            same = ((0, 0), (1, 1)) if head == "inter" and self.config.pairs == "all" else ()
            ways = [
                info_nce(z[f"q{query}_{mine}_{head}"], z[f"{tower}{key}_{other}_{head}"], self.config.temperature)
                for query, key in self.directions + same
            ]
            losses[part] = torch.stack(ways).mean()  # eq. 8, 11
        weight = {"vt": self.config.lambda_inter, "tv": self.config.lambda_inter}
        # A loss that is left out of the sum is still told, as a witness of what the others do to it.
        weighted = [weight.get(part, 1.0) * loss for part, loss in losses.items() if part in self.config.losses]
        return {"loss": torch.stack(weighted).sum(), **losses}  # eq. 14, or what is left of it with one modality

    def encoders(self) -> dict[str, nn.Module]:
        return {m: tower.trunk for m, tower in self.query.items()}  # type: ignore[misc]

    def projectors(self) -> dict[str, nn.Module]:
        return {m: tower.inter for m, tower in self.query.items()}  # type: ignore[misc]

    def after_step(self, progress: float) -> None:
        m = rising(self.config.momentum, self.config.momentum_end, progress)
        for modality, key in self.key.items():
            key.follow(self.query[modality], m)  # type: ignore[operator]  # eq. 1-3
