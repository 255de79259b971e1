"""The supervised reference: one trunk per modality, concatenated features, one linear layer per task, trained end to end.

This is how the paper describes its ResNet-18 rows (appendix C). It also shows how much of a task the same network can learn
from labels: its own classifiers are scored, and its frozen trunks are probed like those of any other method.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mvitac.data.pack import Pack
from mvitac.data.spec import DataSpec
from mvitac.methods.base import Method, MethodConfig, Views, with_sum
from mvitac.nn.encoders import EncoderConfig, build_trunk, num_features
from mvitac.registry import formerly, unknown


@dataclass(frozen=True, kw_only=True)
class LabelledConfig(MethodConfig):
    """Fields shared by the supervised methods: tasks and modalities to learn from."""

    tasks: tuple[str, ...] = ()
    """Tasks to learn. Default: all tasks of the dataset."""
    modalities: tuple[Literal["touch", "vision"], ...] = ()
    """Modalities to learn from. Default: all modalities of the dataset."""
    labels: Literal["train", "train-and-val"] = field(default="train-and-val", metadata=formerly("train"))
    """Splits whose labels are learned from. train-and-val: the rows that probes are fitted on. train: rows of train alone,
    as in version 0.1.0."""

    @property
    def label_splits(self) -> tuple[str, ...]:
        return ("train",) if self.labels == "train" else ("train", "val")

    def training_rows(self, pack: Pack) -> np.ndarray:
        """Pack rows with a label to learn from, by the split of their task, and with the modalities to learn from."""
        if self.labels == "train":
            rows = super().training_rows(pack)
        else:
            rows = np.flatnonzero(np.logical_and.reduce([pack.has(m) for m in self.modalities_of(pack.spec)]))
        labelled = {task: pack.labels(task, *self.label_splits)[rows] >= 0 for task in self.labels_needed(pack.spec)}
        for task, there in labelled.items():
            if not there.any():
                raise ValueError(f"task {task!r} has no labelled rows to train on: choose a self-supervised --method")
        return rows[np.logical_or.reduce(list(labelled.values()))]

    def labels_needed(self, spec: DataSpec) -> tuple[str, ...]:
        """Tasks to learn. Raises ValueError if the dataset lacks one, or has none."""
        known = [task.name for task in spec.tasks]
        for task in self.tasks:
            if task not in known:
                raise ValueError(f"task {task!r} is not in dataset {spec.name!r}: it has {', '.join(known) or 'none'}")
        if not known:
            raise ValueError(f"dataset {spec.name!r} has no labels: choose a self-supervised method")
        return self.tasks or tuple(known)

    def modalities_of(self, spec: DataSpec) -> tuple[str, ...]:
        """The modalities to learn from, in the dataset's order. Raises ValueError if the dataset lacks one."""
        for modality in self.modalities:
            if modality not in spec.modalities:
                raise unknown("modality", modality, spec.modalities)
        return tuple(m for m in spec.modalities if m in (self.modalities or spec.modalities))

    def without_idle(self, spec: DataSpec) -> Self:
        return replace(self, modalities=self.modalities_of(spec))

    def num_classes(self, spec: DataSpec) -> dict[str, int]:
        """task -> number of classes, for each task to learn."""
        known = {task.name: len(task.classes) for task in spec.tasks}
        return {name: known[name] for name in self.labels_needed(spec)}


@dataclass(frozen=True, kw_only=True)
class SupervisedConfig(LabelledConfig):
    """Cross-entropy on the labels of the dataset, on all tasks at once unless tasks are named."""

    name: ClassVar[str] = "supervised"

    def build(self, spec: DataSpec, encoder: EncoderConfig) -> Supervised:
        trunks = {m: build_trunk(encoder, spec.channels(m), spec.frames(m)) for m in self.modalities_of(spec)}
        width = sum(num_features(trunk) for trunk in trunks.values())
        return Supervised(trunks, {task: nn.Linear(width, num) for task, num in self.num_classes(spec).items()})


class Supervised(Method):
    """One classifier per task on the concatenated features."""

    def __init__(self, trunks: dict[str, nn.Module], classifiers: dict[str, nn.Module]) -> None:
        super().__init__()
        self.trunks = nn.ModuleDict(trunks)
        # A list, because task names may contain characters that module names may not.
        self.tasks = tuple(classifiers)
        self.heads = nn.ModuleList(classifiers.values())

    def forward(self, batch: Views) -> dict[str, Tensor]:
        features = torch.cat([trunk(batch.images[m][0]) for m, trunk in self.trunks.items()], dim=1)
        losses: dict[str, Tensor] = {}
        for task, head in zip(self.tasks, self.heads, strict=True):
            labels = batch.labels[task]
            total = F.cross_entropy(head(features).float(), labels, ignore_index=-1, reduction="sum")
            losses[task] = total / (labels >= 0).sum().clamp(min=1)  # 0, not NaN, for a batch without labels
        return with_sum(losses)

    def encoders(self) -> dict[str, nn.Module]:
        return dict(self.trunks.items())

    def classifiers(self) -> dict[str, nn.Module]:
        return dict(zip(self.tasks, self.heads, strict=True))
