"""MViTac: contrastive learning within and across vision and touch (Dave, Lygerakis, Rueckert, ICRA 2024, eq. 1-14).

The paper's case, for a batch of vision images v and touch images t. A tower is a trunk with two heads, (intra, inter):

    v_q, v_k = augment(v), augment(v);  t_q, t_k = augment(t), augment(t)
    q_vv, q_vt = query_vision(v_q)                       # eq. 4, 9    theta; phi_v, phi_t
    q_tt, q_tv = query_touch(t_q)                        # eq. 6, 12   psi; Phi_t, Phi_v
    k_vv, k_tv = key_vision(v_k)                         # eq. 5, 13   no gradient
    k_tt, k_vt = key_touch(t_k)                          # eq. 7, 10   no gradient
    loss = nce(q_vv, k_vv) + nce(q_tt, k_tt) + lambda_inter * (nce(q_vt, k_vt) + nce(q_tv, k_tv))    # eq. 8, 11, 14
    update(query_vision, query_touch, gradient(loss))
    key = m * key + (1 - m) * query                      # eq. 1-3, for every parameter of both key towers

Notation of the paper: f(.; theta) encodes vision, f(.; psi) touch. Heads: phi_v (vision, intra), phi_t (vision, inter),
Phi_t (touch, intra), Phi_v (touch, inter). In z_xy, x is the modality of the query and y the modality of the key.
Shapes: images [B, C, H, W], features [B, D], embeddings z [B, 128].
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor, nn
from tyro.conf import Fixed

from mvitac.data.pack import Pack
from mvitac.data.spec import DataSpec
from mvitac.methods.base import Contrastive, Embeddings, MethodConfig, Views, present, row_pairs
from mvitac.nn.encoders import Encoders, Head, build_trunk, draws_random_numbers, features_of, num_features
from mvitac.nn.losses import info_nce
from mvitac.nn.momentum import Momentum
from mvitac.system.threads import in_branches

HEADS = ("intra", "inter")
PARTS = {"vv": ("vision", "vision"), "tt": ("touch", "touch"), "vt": ("vision", "touch"), "tv": ("touch", "vision")}
"""loss -> (modality of its queries, modality of its keys)."""


@dataclass(frozen=True, kw_only=True)
class MViTacConfig(MethodConfig):
    """Momentum contrast within and across vision and touch. With one modality, only its intra-modal loss is used."""

    name: ClassVar[str] = "mvitac"
    takes_missing: ClassVar[bool] = True

    temperature: float = 0.07
    """Temperature tau of InfoNCE. The paper compares .07, .2, .5 and 1; .07 is best."""
    lambda_inter: float = 1.0
    """Weight of the two inter-modal losses (eq. 14). Not given in the paper; 1 in the authors' code."""
    lambda_sensor: float = 0.0
    """Weight of one more loss beside eq. 14: a touch view is told from others by the same press through another sensor
    (rows with the same value in column press and another in column sensor). 0: none (paper)."""
    momentum: float = 0.99
    """Momentum m of eq. 1-3. Not given in the paper; .99 in the authors' code."""
    keys: Literal["momentum", "end-to-end"] = "momentum"
    """Network that computes the keys. momentum: a momentum copy of the query tower (paper). end-to-end: the query tower
    itself, with gradients (as in SimCLR; the name is from MoCo, figure 2). Each view is then query and key
    in turn, and momentum has no effect."""
    pairs: Literal["crossed", "all"] = "crossed"
    """Views paired by the inter-modal losses. crossed: a view of one modality with the other view of the other modality
    (paper). all: with both views of the other modality, at no extra forward pass; needs end-to-end keys."""
    losses: tuple[Literal["vv", "tt", "vt", "tv"], ...] = ("vv", "tt", "vt", "tv")
    """Losses of eq. 14 to minimise. The paper minimises all four."""
    out: Fixed[int] = 128
    """Width of the embeddings z (paper: 128)."""
    hidden: Fixed[int] = 512
    """Hidden width of the 2-layer heads. Not given in the paper; 2048 in the authors' code; 512 is the trunk's width."""
    dropout: Fixed[float] = 0.0
    """Dropout in the heads. None in the paper; .5 in the authors' code."""
    head_norm: Fixed[bool] = False
    """BatchNorm after the first layer of the heads, as in MoCo v3 and SimCLR v2. None in the paper."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.losses or len(set(self.losses)) < len(self.losses):
            raise ValueError(f"losses {self.losses}: give one or more of vv, tt, vt, tv, each once")
        if self.pairs == "all" and not self.both_ways:
            raise ValueError("pairs 'all' needs each view as query and key: give keys 'end-to-end', or pairs 'crossed'")

    @property
    def sensor_view(self) -> bool:
        return self.lambda_sensor > 0

    @property
    def both_ways(self) -> bool:
        """Whether each view is used as query and as key."""
        return self.keys == "end-to-end"

    def training_rows(self, pack: Pack) -> np.ndarray:
        rows = super().training_rows(pack)
        if self.sensor_view:
            pairs = np.zeros((2, 0), np.int64)
            if "press" in pack.table.column_names:
                pairs = np.unique(np.stack([pack.presses[rows], pack.sensors[rows]]), axis=1)
            if not (np.bincount(pairs[0]) > 1).any():
                raise ValueError("lambda_sensor needs rows of one press (column press) and of different sensors")
        has = {modality: pack.has(modality)[rows] for modality in pack.spec.modalities}
        parts = [PARTS[part] for part in self.losses if set(PARTS[part]) <= has.keys()]
        return rows[np.any([has[x] & has[y] for x, y in parts], axis=0)] if parts else rows

    def without_idle(self, spec: DataSpec) -> Self:
        mine = replace(self, losses=tuple(part for part in possible_losses(spec) if part in self.losses))
        if "touch" not in spec.modalities:
            mine = replace(mine, lambda_sensor=0.0)
        return mine if len(spec.modalities) > 1 else replace(mine, lambda_inter=1.0, pairs="crossed")

    def build(self, spec: DataSpec, encoder: Encoders) -> "MViTac":
        possible = possible_losses(spec)
        if not set(self.losses) & set(possible):
            lacking = f"losses {', '.join(self.losses)}: dataset {spec.name!r} lacks a modality"
            raise ValueError(f"{lacking}, give some of {', '.join(possible)}")
        if self.sensor_view and "touch" not in spec.modalities:
            raise ValueError(f"lambda_sensor {self.lambda_sensor}: dataset {spec.name!r} has no touch, leave it out")
        return MViTac(self, spec, encoder)


def possible_losses(spec: DataSpec) -> tuple[str, ...]:
    """The losses of eq. 14 that can be computed with a dataset's modalities."""
    return tuple(part for part, used in PARTS.items() if set(used) <= set(spec.modalities))


class Tower(nn.Module):
    """An encoder with two heads: images [B, C, H, W] to embeddings (z intra, z inter), in one pass of the trunk."""

    def __init__(self, config: MViTacConfig, trunk: nn.Module) -> None:
        super().__init__()
        self.trunk = trunk
        sizes = num_features(trunk), config.hidden, config.out
        self.intra = Head(*sizes, dropout=config.dropout, norm=config.head_norm)
        self.inter = Head(*sizes, dropout=config.dropout, norm=config.head_norm)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        features = features_of(self.trunk, images)
        return self.intra(features), self.inter(features)


class MViTac(Contrastive):
    """Query towers, their momentum copies, and the four losses. The module's docstring has it in pseudo-code.

    Embeddings are keyed ``(q or k, modality, view, head)``, e.g. ``z["q", "vision", 0, "intra"]`` for q_vv.
    """

    views = 2

    def __init__(self, config: MViTacConfig, spec: DataSpec, encoder: Encoders) -> None:
        super().__init__()
        self.config = config
        # vision: theta, phi_v (intra), phi_t (inter); touch: psi, Phi_t (intra), Phi_v (inter)
        self.query = nn.ModuleDict()
        for m in spec.modalities:
            self.query[m] = Tower(config, build_trunk(encoder[m], spec.channels(m), spec.frames(m)))
        momentum = self.query if config.keys == "momentum" else {}
        self.key = nn.ModuleDict({m: Momentum(tower) for m, tower in momentum.items()})

    def queries(self, batch: Views) -> Embeddings:
        """Eq. 4, 6, 9, 12."""
        return embed("q", self.query, batch, slice(None) if self.config.both_ways else slice(1))

    def keys(self, batch: Views) -> Embeddings:
        """Eq. 5, 7, 10, 13. End-to-end keys are the queries themselves, so there is nothing to add."""
        z = embed("k", self.key, batch, slice(1, None))
        return z | {("both", m): positions for m, positions in batch.both.items()}

    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        k = "q" if self.config.both_ways else "k"
        losses = {}
        for part, (x, y) in PARTS.items():
            head = "intra" if x == y else "inter"
            found = [row_pairs(z, x, y, ("q", x, i, head), (k, y, j, head)) for i, j in self.view_pairs(head)]
            if terms := [info_nce(*pair, self.config.temperature) for pair in found if pair]:
                losses[part] = torch.stack(terms).mean()  # eq. 8, 11
        weight = {"vt": self.config.lambda_inter, "tv": self.config.lambda_inter}
        minimised = [weight.get(part, 1.0) * loss for part, loss in losses.items() if part in self.config.losses]
        # Its key is the same press through another sensor.
        if self.config.sensor_view and ("q", "touch", 0, "intra") in z:
            losses["sensor"] = info_nce(z["q", "touch", 0, "intra"], z[k, "touch", 2, "intra"], self.config.temperature)
            minimised.append(self.config.lambda_sensor * losses["sensor"])
        return {"loss": torch.stack(minimised).sum(), **losses}  # eq. 14; losses that are not minimised are logged too

    def view_pairs(self, head: str) -> tuple[tuple[int, int], ...]:
        """(view of the query, view of the key) of each term of a loss. The paper: ((0, 1),)."""
        crossed = ((0, 1), (1, 0)) if self.config.both_ways else ((0, 1),)
        # A view and itself are a trivial pair, so only inter-modal losses pair equal views.
        return (*crossed, (0, 0), (1, 1)) if head == "inter" and self.config.pairs == "all" else crossed

    def encoders(self) -> dict[str, nn.Module]:
        return {m: tower.trunk for m, tower in self.query.items()}  # type: ignore[misc]

    def projectors(self) -> dict[str, nn.Module]:
        return {m: tower.inter for m, tower in self.query.items()}  # type: ignore[misc]

    def after_step(self, progress: float) -> None:
        for key in self.key.values():
            key.follow(self.config.momentum)  # type: ignore[operator]  # eq. 1-3


def embed(name: str, towers: nn.ModuleDict, batch: Views, views: slice) -> Embeddings:
    """Embeddings of ``views`` of each modality by both heads, keyed ``(name, modality, view, head)``.

    On a CPU the two towers run side by side, except with dropout, which needs one order of random numbers. Where the
    features of a locked one are given, the other has all threads, and all views in one pass, which takes 5/6 of the time.
    Its BatchNorm then has the statistics of all views, as in SimCLR.
    """
    first = [images[0] for images in batch.images.values()]
    locked = any(x.ndim == 2 for x in first)

    def of(modality: str) -> Embeddings:
        shown = list(enumerate(batch.images[modality]))[views]
        if locked:
            both = towers[modality](torch.cat([images for _, images in shown]))
            found = zip(*(z.chunk(len(shown)) for z in both), strict=True)
        else:
            found = (towers[modality](images) for _, images in shown)
        pairs = zip(shown, found, strict=True)
        return {(name, modality, i, head): z for (i, _), pair in pairs for head, z in zip(HEADS, pair, strict=True)}

    branches = [partial(of, modality) for modality, _ in present(towers, batch)]
    if locked or any(x.device.type != "cpu" for x in first) or draws_random_numbers(towers):
        return {key: tensor for branch in branches for key, tensor in branch().items()}
    return in_branches(branches)
