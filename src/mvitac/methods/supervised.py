"""The supervised reference: one trunk per modality, features concatenated, one linear layer per task, end to end.

As the paper describes its ResNet-18 rows (appendix C). It is also the yardstick that says how much of a task the labels
could teach the same network: its own classifiers are scored, and its frozen trunks probed like any other method's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Method, MethodConfig, Views
from mvitac.nn.encoders import EncoderConfig, build_trunk, num_features
from mvitac.registry import unknown


@dataclass(frozen=True, kw_only=True)
class LabelledConfig(MethodConfig):
    """What the supervised references share: which labels they learn from, which images they see."""

    tasks: tuple[str, ...] = ()
    """Tasks to learn; none given = all of the dataset's."""
    modalities: tuple[Literal["touch", "vision"], ...] = ()
    """Modalities to learn from; none given = all the dataset has."""

    def labels_needed(self, spec: DataSpec) -> tuple[str, ...]:
        known = [task.name for task in spec.tasks]
        for task in self.tasks:
            if task not in known:
                raise ValueError(f"task {task!r} is not in dataset {spec.name!r}: it has {', '.join(known) or 'none'}")
        if not known:
            raise ValueError(f"dataset {spec.name!r} has no labels: choose a self-supervised method")
        return self.tasks or tuple(known)

    def modalities_of(self, spec: DataSpec) -> tuple[str, ...]:
        """The modalities to learn from, in the dataset's order; ValueError if it lacks one."""
        for modality in self.modalities:
            if modality not in spec.modalities:
                raise unknown("modality", modality, spec.modalities)
        return tuple(m for m in spec.modalities if m in (self.modalities or spec.modalities))

    def without_idle(self, spec: DataSpec) -> Self:
        return replace(self, modalities=self.modalities_of(spec))

    def num_classes(self, spec: DataSpec) -> dict[str, int]:
        """task -> number of classes, for the tasks to learn."""
        known = {task.name: len(task.classes) for task in spec.tasks}
        return {name: known[name] for name in self.labels_needed(spec)}


@dataclass(frozen=True, kw_only=True)
class SupervisedConfig(LabelledConfig):
    """Cross-entropy on the dataset's own labels, all tasks at once unless one is named."""

    name: ClassVar[str] = "supervised"

    def build(self, spec: DataSpec, encoder: EncoderConfig) -> Supervised:
        trunks = {m: build_trunk(encoder, spec.channels(m)) for m in self.modalities_of(spec)}
        width = sum(num_features(trunk) for trunk in trunks.values())
        return Supervised(trunks, {task: nn.Linear(width, num) for task, num in self.num_classes(spec).items()})


class Supervised(Method):
    """Concatenated features to one classifier per task."""

    def __init__(self, trunks: dict[str, nn.Module], classifiers: dict[str, nn.Module]) -> None:
        super().__init__()
        self.trunks = nn.ModuleDict(trunks)
        # Task names may hold characters a module name may not, hence the list.
        self.tasks = tuple(classifiers)
        self.heads = nn.ModuleList(classifiers.values())

    def forward(self, batch: Views) -> dict[str, Tensor]:
        features = torch.cat([trunk(batch.images[m][0]) for m, trunk in self.trunks.items()], dim=1)
        losses: dict[str, Tensor] = {}
        for task, head in zip(self.tasks, self.heads, strict=True):
            labels = batch.labels[task]
            total = F.cross_entropy(head(features).float(), labels, ignore_index=-1, reduction="sum")
            losses[task] = total / (labels >= 0).sum().clamp(min=1)  # a batch without labels is 0, not NaN
        return {"loss": torch.stack(list(losses.values())).sum(), **losses}

    def encoders(self) -> dict[str, nn.Module]:
        return dict(self.trunks.items())

    def classifiers(self) -> dict[str, nn.Module]:
        return dict(zip(self.tasks, self.heads, strict=True))
