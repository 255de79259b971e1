"""The supervised reference: one trunk per modality, concatenated features, one linear layer per task, trained end to end.

This is how the paper describes its ResNet-18 rows (appendix C). It also shows how much of a task the same network can learn
from labels: its own heads are scored, and its frozen trunks are probed like those of any other method.

From the weights of another run (``Run.init``) the same method is fine-tuning, of all weights or of a part of them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask, DataSpec, Task
from mvitac.methods.base import Method, MethodConfig, Views, with_sum
from mvitac.nn.encoders import Encoders, build_trunk, features_of, num_features
from mvitac.registry import check_known, check_range


@dataclass(frozen=True, kw_only=True)
class LabelledConfig(MethodConfig):
    """Fields shared by the supervised methods: tasks and modalities to learn from."""

    tasks: tuple[str, ...] = ()
    """Tasks to learn. Default: all tasks with classes; if the dataset has none, all tasks with values."""
    modalities: tuple[Literal["touch", "vision"], ...] = ()
    """Modalities to learn from. Default: all modalities of the dataset."""
    label_splits: ClassVar[tuple[str, ...]] = ("train", "val")
    """The rows that probes are fitted on."""

    def training_rows(self, pack: Pack) -> np.ndarray:
        """Pack rows with a label to learn from, by the split of their task, and with the modalities to learn from."""
        modalities = self.modalities_of(pack.spec)
        known = {task.name: pack.answered(task, *self.label_splits) for task in self.tasks_of(pack.spec)}
        labelled = np.any(list(known.values()), axis=0)
        self.check_complete(pack, np.flatnonzero(pack.whole & labelled), modalities)
        seen = np.all([pack.has(m) for m in modalities], axis=0)
        for task, there in known.items():
            if not there[seen].any():
                raise ValueError(f"task {task!r} has no labelled rows to train on: choose a self-supervised --method")
        return np.flatnonzero(seen & labelled)

    def tasks_of(self, spec: DataSpec) -> tuple[AnyTask, ...]:
        """Tasks to learn; ValueError if the dataset lacks one, or has none."""
        known = {task.name: task for task in spec.all_tasks}
        check_known("task", self.tasks, known)
        if not known:
            raise ValueError(f"dataset {spec.name!r} has no labels and no values: choose a self-supervised method")
        return tuple(known[name] for name in self.tasks) or spec.tasks or spec.values

    def modalities_of(self, spec: DataSpec) -> tuple[str, ...]:
        """The modalities to learn from, in the dataset's order; ValueError if the dataset lacks one."""
        check_known("modality", self.modalities, spec.modalities)
        return tuple(m for m in spec.modalities if m in (self.modalities or spec.modalities))

    def without_idle(self, spec: DataSpec) -> Self:
        return replace(self, modalities=self.modalities_of(spec))

    def heads(self, spec: DataSpec, layers: Callable[[int], nn.Module]) -> dict[str, nn.Module]:
        """A head for each task to learn. ``layers`` creates one with this number of outputs."""
        found = {}
        for task in self.tasks_of(spec):
            num = len(task.classes if isinstance(task, Task) else task.targets)
            found[task.name] = layers(num) if isinstance(task, Task) else ValueHead(layers(num), num)
        return found


class ValueHead(nn.Module):
    """Values [B, T] in their units from features [B, D]: the outputs of ``layers``, scaled to ``mean`` and ``std`` [T]."""

    mean: Tensor
    std: Tensor

    def __init__(self, layers: nn.Module, num: int) -> None:
        super().__init__()
        self.layers = layers
        self.register_buffer("mean", torch.zeros(num))
        self.register_buffer("std", torch.ones(num))

    def learn_scale(self, values: Tensor) -> None:
        known = values.double().numpy()
        self.mean.copy_(torch.from_numpy(np.nanmean(known, axis=0)))
        self.std.copy_(torch.from_numpy(np.nanstd(known, axis=0)).clamp(min=1e-12))

    def forward(self, features: Tensor) -> Tensor:
        return self.layers(features).float() * self.std + self.mean

    def loss(self, features: Tensor, values: Tensor) -> Tensor:
        """Smooth L1 on standardised values, mean over the measured ones; 0 if none is."""
        wanted = (values - self.mean) / self.std
        known = ~wanted.isnan()
        each = F.smooth_l1_loss(self.layers(features).float(), wanted.nan_to_num(), reduction="none")
        return (each * known).sum() / known.sum().clamp(min=1)


@dataclass(frozen=True, kw_only=True)
class SupervisedConfig(LabelledConfig):
    """Cross-entropy on labels, smooth L1 on values, on all tasks at once unless tasks are named."""

    name: ClassVar[str] = "supervised"

    share: float = 1.0
    """Share of the labelled groups to learn from, drawn at random; at least one group of each class."""
    draw: int = 1
    """Which random draw: 1, 2, ..."""
    hold_out: bool = False
    """Leave out some of these groups, on which settings are chosen: those of split val, else a fifth."""

    def __post_init__(self) -> None:
        check_range(self, 1, 65536, "draw")
        if not 0 < self.share <= 1:
            raise ValueError(f"share {self.share}: give a share of the groups, above 0, at most 1")

    def training_rows(self, pack: Pack) -> np.ndarray:
        rows = super().training_rows(pack)
        if self.share == 1 and not self.hold_out:
            return rows
        kept, held = self._drawn_groups(pack, rows)
        return rows[np.isin(pack.column("group")[rows].astype(str), kept if self.hold_out else [*kept, *held])]

    def _drawn_groups(self, pack: Pack, rows: np.ndarray) -> tuple[list[str], list[str]]:
        """Names of the groups to learn from, and of those to choose settings on. A larger share adds to a smaller."""
        groups, tasks = pack.column("group")[rows].astype(str), self.tasks_of(pack.spec)
        order = np.random.default_rng(self.draw).permutation(np.unique(groups))
        needed: dict[str, None] = {}
        for task in tasks:
            labels = pack.labels(task.name, *self.label_splits)[rows] if isinstance(task, Task) else np.zeros(len(rows))
            for label in np.unique(labels[labels >= 0]):
                mine = set(groups[labels == label])
                needed.setdefault(next(name for name in order if name in mine))
        drawn = [*needed, *(name for name in order if name not in needed)]
        drawn = drawn[: max(len(needed), round(self.share * len(drawn)))]
        spare = [name for name in drawn if name not in needed]
        held = [name for name in spare if name in set(groups[pack.column(tasks[0].split)[rows] == "val"])]
        held = held if len(held) > 1 else spare[max(0, len(spare) - len(drawn) // 5) :]
        if self.hold_out and not held:
            raise ValueError(f"{len(drawn)} labelled {pack.spec.group_by}s are too few to hold some out")
        return [name for name in drawn if name not in held], held

    def build(self, spec: DataSpec, encoder: Encoders) -> "Supervised":
        trunks = {m: build_trunk(encoder[m], spec.channels(m), spec.frames(m)) for m in self.modalities_of(spec)}
        width = sum(num_features(trunk) for trunk in trunks.values())
        return Supervised(trunks, self.heads(spec, lambda num: nn.Linear(width, num)))


class Supervised(Method):
    """One head per task on the concatenated features."""

    def __init__(self, trunks: dict[str, nn.Module], classifiers: dict[str, nn.Module]) -> None:
        super().__init__()
        self.trunks = nn.ModuleDict(trunks)
        # A list, because task names may contain characters that module names may not.
        self.tasks = tuple(classifiers)
        self.heads = nn.ModuleList(classifiers.values())

    def forward(self, batch: Views) -> dict[str, Tensor]:
        features = torch.cat([features_of(trunk, batch.images[m][0]) for m, trunk in self.trunks.items()], dim=1)
        losses: dict[str, Tensor] = {}
        for task, head in zip(self.tasks, self.heads, strict=True):
            if isinstance(head, ValueHead):
                losses[task] = head.loss(features, batch.values[task])
                continue
            labels = batch.labels[task]
            total = F.cross_entropy(head(features).float(), labels, ignore_index=-1, reduction="sum")
            losses[task] = total / (labels >= 0).sum().clamp(min=1)  # 0, not NaN, for a batch without labels
        return with_sum(losses)

    def learn_scale(self, values: dict[str, Tensor]) -> None:
        for task, head in zip(self.tasks, self.heads, strict=True):
            if isinstance(head, ValueHead):
                head.learn_scale(values[task])

    def encoders(self) -> dict[str, nn.Module]:
        return dict(self.trunks)

    def classifiers(self) -> dict[str, nn.Module]:
        return dict(zip(self.tasks, self.heads, strict=True))
