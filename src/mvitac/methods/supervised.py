"""The supervised reference: one trunk per modality, features concatenated, one linear layer per task, end to end.

As the paper describes its ResNet-18 rows (appendix C). Here it is also the yardstick that says how much of a task the
labels could teach the same network; its frozen trunks are probed like any other method's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mvitac.batch import Views
from mvitac.encoders import EncoderConfig, build_trunk
from mvitac.methods.base import Method, MethodConfig
from mvitac.spec import DataSpec


@dataclass(frozen=True, kw_only=True)
class SupervisedConfig(MethodConfig):
    """Cross-entropy on the dataset's own labels, all tasks at once unless one is named."""

    name: ClassVar[str] = "supervised"

    tasks: tuple[str, ...] = ()
    """Tasks to learn; none given = all of the dataset's."""

    def labels_needed(self, spec: DataSpec) -> tuple[str, ...]:
        return self.tasks or tuple(task.name for task in spec.tasks)

    def build(self, spec: DataSpec, encoder: EncoderConfig) -> Supervised:
        known = {task.name: task for task in spec.tasks}
        for task in self.tasks:
            if task not in known:
                raise ValueError(f"task {task!r} is not in dataset {spec.name!r}: it has {', '.join(known) or 'none'}")
        if not known:
            raise ValueError(f"dataset {spec.name!r} has no labels: choose a self-supervised method")
        chosen = self.tasks or tuple(known)
        return Supervised(spec, encoder, {name: len(known[name].classes) for name in chosen})


class Supervised(Method):
    """Concatenated features [B, 512 per modality] to one linear classifier per task."""

    def __init__(self, spec: DataSpec, encoder: EncoderConfig, num_classes: dict[str, int]) -> None:
        super().__init__()
        self.trunks = nn.ModuleDict({m: build_trunk(encoder, spec.channels(m)) for m in spec.modalities})
        width = sum(int(trunk.num_features) for trunk in self.trunks.values())  # type: ignore[arg-type]
        # Task names may hold characters a module name may not, hence the list.
        self.tasks = tuple(num_classes)
        self.classifiers = nn.ModuleList(nn.Linear(width, num) for num in num_classes.values())

    def forward(self, batch: Views) -> dict[str, Tensor]:
        features = torch.cat([trunk(batch.images[m][0]) for m, trunk in self.trunks.items()], dim=1)
        losses: dict[str, Tensor] = {}
        for task, classifier in zip(self.tasks, self.classifiers, strict=True):
            labels = batch.labels[task]
            total = F.cross_entropy(classifier(features).float(), labels, ignore_index=-1, reduction="sum")
            losses[task] = total / (labels >= 0).sum().clamp(min=1)  # a batch without labels is 0, not NaN
        return {"loss": torch.stack(list(losses.values())).sum(), **losses}

    def encoders(self) -> dict[str, nn.Module]:
        return dict(self.trunks.items())
