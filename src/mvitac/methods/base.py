"""One training batch as a method sees it.

Shapes: N rows of a dataset, B images in a batch, V views of each image, C channels, H x W pixels.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Self

from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.nn.encoders import EncoderConfig
from mvitac.registry import Registered


@dataclass(frozen=True)
class Views:
    """A batch as a method sees it: V augmented, normalised views [B, C, H, W] of every image, per modality."""

    images: dict[str, list[Tensor]]
    """modality -> V tensors; a modality the dataset lacks is absent."""
    labels: dict[str, Tensor]
    """task -> [B] int64, -1 = unlabelled; only supervised references look at it."""
    rows: Tensor
    """[B] int64, the row of each pair in its pack (memory banks are indexed by it)."""


class Method(nn.Module, ABC):
    """A pre-training method. Devices, precision, optimisers, logging and checkpoints are never its business."""

    views: ClassVar[int] = 1
    """Views per image that ``forward`` unpacks."""

    @abstractmethod
    def forward(self, batch: Views) -> dict[str, Tensor]:
        """Scalars of one batch: "loss" is minimised, the rest is logged. Pure: no update, no print, no sync."""

    @abstractmethod
    def encoders(self) -> dict[str, nn.Module]:
        """What outlives pre-training: modality -> trunk from [B, C, H, W] to features [B, D]."""

    def classifiers(self) -> dict[str, nn.Module]:
        """task -> classifier from all ``encoders``' features, concatenated in their order, to logits; {} if none."""
        return {}

    def projectors(self) -> dict[str, nn.Module]:
        """modality -> head from features into the space both modalities share, for retrieval; {} if there is none."""
        return {}

    def prepare(self, rows: Tensor) -> None:
        """Called once, after the weights are drawn and before any are restored, with the pack rows [N] (ascending int64)
        that training draws from: the place to make memory that is sized or indexed by them."""
        return

    def after_step(self, progress: float) -> None:
        """What happens after the optimiser's step, e.g. the momentum update; ``progress`` runs from 0 to 1.

        What it needs of the batch, ``forward`` leaves in an attribute (``pending``) that ``forward`` never reads.
        """
        return


class Contrastive(Method):
    """A method whose losses need nothing of a batch but what is computed from each pair apart: tensors [B, ...], row i of
    pair i, such as embeddings.

    Saying so in three parts lets the loop embed a batch in chunks (gradient caching) or on many processes (all-gathered
    negatives) and contrast all of it at once (``training/step.py``).
    """

    @abstractmethod
    def queries(self, batch: Views) -> dict[str, Tensor]:
        """Embeddings that gradients flow into."""

    def keys(self, batch: Views) -> dict[str, Tensor]:
        """What none flows into, such as embeddings of momentum towers, or the pairs' row numbers."""
        return {}

    @abstractmethod
    def contrast(self, z: dict[str, Tensor]) -> dict[str, Tensor]:
        """The losses of ``forward`` from all ``queries`` and ``keys``, by name; may leave ``pending``."""

    def forward(self, batch: Views) -> dict[str, Tensor]:
        return self.contrast(self.queries(batch) | self.keys(batch))


@dataclass(frozen=True, kw_only=True)
class MethodConfig(Registered, ABC):
    """Base of every method's config, which lies beside its method."""

    def check_fields(
        self,
        *,
        positive: tuple[str, ...] = (),
        weight: tuple[str, ...] = (),
        share: tuple[str, ...] = (),
        width: tuple[str, ...] = (),
    ) -> None:
        """ValueError unless the named fields are > 0, >= 0, in [0, 1] (or None) and 1 to 65536 (or None) respectively."""
        for name in positive:
            if not (getattr(self, name) > 0 and math.isfinite(getattr(self, name))):
                raise ValueError(f"{name} {getattr(self, name)}: give a positive number")
        for name in weight:
            if not (getattr(self, name) >= 0 and math.isfinite(getattr(self, name))):
                raise ValueError(f"{name} {getattr(self, name)}: give a finite number >= 0")
        for name in share:
            if getattr(self, name) is not None and not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} {getattr(self, name)}: give a number from 0 to 1")
        for name in width:
            if not 1 <= getattr(self, name) <= 65536:
                raise ValueError(f"{name} {getattr(self, name)}: give 1 to 65536")

    def check_pairs(self, spec: DataSpec) -> None:
        """ValueError unless the dataset has both modalities."""
        if len(spec.modalities) < 2:
            have = ", ".join(spec.modalities)
            raise ValueError(
                f"method {self.name!r} learns from pairs, dataset {spec.name!r} has {have} only:"
                " choose --method mvitac or a method per modality (simclr, moco, byol, dino, vicreg)"
            )

    def labels_needed(self, spec: DataSpec) -> tuple[str, ...]:
        """Tasks whose labels it learns from; none for a self-supervised method."""
        return ()

    def without_idle(self, spec: DataSpec) -> Self:
        """The same method on a dataset, settings that do nothing there at one value: equal ones train alike."""
        return self

    @abstractmethod
    def build(self, spec: DataSpec, encoder: EncoderConfig) -> Method:
        """The method with fresh weights for a dataset; ValueError if it cannot work on that dataset."""
