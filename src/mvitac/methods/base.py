"""The interface of a pre-training method, and the batch it receives.

Shapes: B images in a batch, V views of each image, C channels, H x W pixels, D features.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, fields
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from mvitac.data.pack import Pack
from mvitac.data.spec import DataSpec
from mvitac.nn.encoders import SCRATCH, Encoders, keep_modes
from mvitac.registry import Registered, check_range

RANGES = {
    **dict.fromkeys(("temperature", "student_temperature", "teacher_temperature"), (1e-6, 1e6)),
    **dict.fromkeys(("momentum", "bank_momentum", "centre_momentum", "ema"), (0, 1)),
    **dict.fromkeys(("margin", "lambda_inter", "lambda_sensor", "invariance", "variance", "covariance"), (0, 1e6)),
    **dict.fromkeys(("out", "hidden"), (1, 65536)),
    **{"queue": (1, 1 << 24), "num_negatives": (1, 1 << 20), "num_targets": (1, 64)},
    **{"mask_ratio": (0.01, 0.99), "dropout": (0, 0.99)},
}
"""Fields of methods' configs -> what they may be. A method checks its other numbers in its own ``__post_init__``."""
Embeddings = dict[Hashable, Tensor]
"""Tensors [B, ...], row i of pair i. Keys are plain tuples of the method's choice, e.g. ``("q", "touch", 0)``."""


@dataclass(frozen=True)
class Views:
    """A batch as a method sees it."""

    images: dict[str, list[Tensor]]
    """modality -> V tensors [B, C, H, W], augmented and normalised. A modality that the dataset, or all but one row of the
    batch, lacks is absent. If ``both`` is given, B is the number of rows that have the modality. A locked
    trunk whose views do not vary is given its features [B, D] instead."""
    labels: dict[str, Tensor]
    """task -> [B] int64, -1 = unlabelled. Only supervised methods use it."""
    rows: Tensor
    """[B] int64, the row of each pair in its pack. Memory banks are indexed by it."""
    values: dict[str, Tensor] = field(default_factory=dict)
    """Task with values -> [B, T] float32 in the units of its targets, NaN = not measured. For supervised methods."""
    both: dict[str, Tensor] = field(default_factory=dict)
    """Modality -> [P] int64, positions in its images of the rows that have both modalities, if some rows lack one."""
    seed: Tensor = field(default_factory=lambda: torch.tensor(0))
    """Integer, a function of (seed, step), for what a method draws for each row, e.g. masks (``nn.vit.row_uniform``)."""


class Method(nn.Module, ABC):
    """A pre-training method. It computes losses; devices, precision, optimisers, logs, checkpoints are the loop's."""

    views: ClassVar[int] = 1
    """Views per image that ``forward`` needs."""

    def __init_subclass__(cls, config: "type[MethodConfig] | None" = None) -> None:
        if config:
            config.method = cls

    def train(self, mode: bool = True) -> Self:
        super().train(mode)
        keep_modes(self)
        return self

    @abstractmethod
    def forward(self, batch: Views) -> dict[str, Tensor]:
        """Return the scalars of one batch: "loss" is minimised, the others are logged.

        It must be pure: no parameter update, no printing, no ``.item()``. ``torch.compile`` relies on it.
        """

    @abstractmethod
    def encoders(self) -> dict[str, nn.Module]:
        """The networks that are kept: modality -> trunk from images [B, C, H, W] to features [B, D]."""

    def classifiers(self) -> dict[str, nn.Module]:
        """task -> head on the features of all ``encoders``, concatenated in their order. {} if there are none.

        A head returns logits [B, K] of a task with classes, and values [B, T] in their units of a task with values.
        """
        return {}

    def projectors(self) -> dict[str, nn.Module]:
        """modality -> head from features into the space shared by both modalities. {} if there is none."""
        return {}

    def prepare(self, rows: Tensor) -> None:
        """Allocate memory that depends on the pack ``rows`` [N] int64 (ascending) to train on, e.g. a memory bank.

        Called once, after the weights are initialised and before a checkpoint is loaded.
        """

    def learn_scale(self, values: dict[str, Tensor]) -> None:
        """Take mean and standard deviation of ``values``, those of all training rows. Called once, after ``prepare``."""

    def after_step(self, progress: float) -> None:
        """Run the updates that follow the optimiser's step, e.g. of a momentum encoder.

        Values it needs from the batch are left by ``forward`` in the attribute ``pending``, which ``forward`` itself
        never reads. ``progress`` is the share of the run that is done, from 0 to 1.
        """


class Contrastive(Method):
    """A method whose losses use only tensors that are computed separately for each pair.

    It implements ``contrast`` instead of ``forward``, and may add ``queries`` and ``keys``. The training step can then
    embed a batch in chunks (gradient caching) or on several processes (all-gathered negatives), and compute the loss over
    all of it (``training/step.py``).
    """

    towers: nn.ModuleDict
    """modality -> trunk and head (``build_towers``); a method that has others names its ``encoders`` itself."""

    def queries(self, batch: Views) -> Embeddings:
        """Embeddings that receive gradients; by default ("touch", 1) is the tower's of the second view of touch."""
        images = batch.images
        return {(m, i): tower(images[m][i]) for m, tower in present(self.towers, batch) for i in range(self.views)}

    def keys(self, batch: Views) -> Embeddings:
        """Tensors without gradients, e.g. embeddings of momentum encoders, or row numbers."""
        return {}

    @abstractmethod
    def contrast(self, z: Embeddings) -> dict[str, Tensor]:
        """Compute the losses of ``forward`` from all ``queries`` and ``keys``. May set ``pending``."""

    def forward(self, batch: Views) -> dict[str, Tensor]:
        return self.contrast(self.queries(batch) | self.keys(batch))

    def encoders(self) -> dict[str, nn.Module]:
        return {m: tower.trunk for m, tower in self.towers.items()}  # type: ignore[misc]


def present(towers: nn.ModuleDict, batch: Views) -> list[tuple[str, nn.Module]]:
    """(modality, tower) of the modalities that the batch has."""
    return [(modality, tower) for modality, tower in towers.items() if modality in batch.images]


def row_pairs(z: Embeddings, x: str, y: str, query: Hashable, key: Hashable) -> tuple[Tensor, Tensor] | None:
    """The embeddings ``query`` of modality ``x`` and ``key`` of ``y``, of the rows that have both.

    ``z`` has ``Views.both`` under ("both", modality), if the batch has it. None if fewer than two rows have both.
    """
    if query not in z or key not in z:
        return None
    if x == y or ("both", x) not in z:
        return z[query], z[key]
    return (z[query][z["both", x]], z[key][z["both", y]]) if len(z["both", x]) > 1 else None


def with_sum(losses: dict[str, Tensor]) -> dict[str, Tensor]:
    """``losses`` and, as "loss", their sum."""
    return {"loss": torch.stack(list(losses.values())).sum(), **losses}


@dataclass(frozen=True, kw_only=True)
class MethodConfig(Registered, ABC):
    """Base of every method's config. A config is defined in the same file as its method."""

    method: ClassVar[Callable[..., Method]]
    """The class that ``build`` makes, which names this config: ``class MoCo(Contrastive, config=MoCoConfig)``."""
    needs_pairs: ClassVar[bool] = False
    """Whether the method needs both modalities. If not, it also trains on vision or touch alone."""
    takes_missing: ClassVar[bool] = False
    """Whether rows of a batch may lack a modality: they then have no part in the losses that need it."""
    needs_vit: ClassVar[bool] = False
    """Whether the trunk must be a plain ViT."""
    label_splits: ClassVar[tuple[str, ...]] = ("train",)
    """Splits whose labels ``Views.labels`` has."""

    def __post_init__(self) -> None:
        for own in fields(self):
            if own.name in RANGES:
                check_range(self, *RANGES[own.name], own.name)

    def on_tiny_trunk(self, spec: DataSpec, encoder: Encoders) -> Method:
        """The method on a trunk that is built in no time, to find out whether and how it works on the dataset."""
        trunk = "mvitac_tiny_vit" if self.needs_vit else "mvitac_tiny"
        return self.build(spec, encoder.changed(trunk=trunk, weights=SCRATCH))

    @property
    def sensor_view(self) -> bool:
        """Whether ``Views.images["touch"]`` ends with one more view, of the same press through another sensor."""
        return False

    def training_rows(self, pack: Pack) -> np.ndarray:
        """Pack rows to train on, ascending: train and unlabelled, with all modalities of their dataset (part of a mix)."""
        rows = pack.rows("train", "unlabelled")
        rows = rows[pack.whole[rows]]
        if not self.takes_missing:
            self.check_complete(pack, rows, pack.spec.modalities)
        return rows

    def check_complete(self, pack: Pack, rows: np.ndarray, modalities: tuple[str, ...]) -> None:
        for modality in modalities:
            if len(lacking := rows[~pack.has(modality)[rows]]):
                no = f"{len(lacking)} rows of part {', '.join(np.unique(pack.column('part')[lacking]))} have no {modality}"
                needs = f"method {self.name!r} needs {' and '.join(modalities)} of every row"
                raise ValueError(f"{needs}, but {no}: choose another --method")

    def without_idle(self, spec: DataSpec) -> Self:
        """This config with every setting that has no effect on the dataset at a fixed value."""
        return self

    def build(self, spec: DataSpec, encoder: Encoders) -> Method:
        """Create the method with fresh weights. Raises ValueError if it cannot work on the dataset."""
        if self.needs_pairs and len(spec.modalities) < 2:
            only = f"dataset {spec.name!r} has {', '.join(spec.modalities)} only"
            raise ValueError(f"method {self.name!r} learns from pairs, but {only}: choose another --method")
        return self.method(self, spec, encoder)
