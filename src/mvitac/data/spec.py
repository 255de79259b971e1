"""What a dataset is: its modalities, its tasks, its groups, its owner. No torch here: packing workers import it."""

from __future__ import annotations

from dataclasses import dataclass, field

from mvitac.registry import LATER

MODALITIES = ("vision", "touch")


@dataclass(frozen=True, kw_only=True)
class Task:
    """One question that a linear probe asks of the features."""

    name: str
    classes: tuple[str, ...]
    """Class names by label; the label column is ``label_<name>``, -1 = unlabelled."""
    only: dict[str, str] = field(default_factory=dict)
    """Rows the task is about, as column -> value, e.g. {"phase": "during"} for grasp success."""
    split: str = "split"
    """Column with the side a row is on for this task, where the owners divide it otherwise than for pre-training."""


@dataclass(frozen=True, kw_only=True)
class DataSpec:
    """What a method, a probe and a reader of results must know about a dataset."""

    name: str
    vision_channels: int
    """3, or 0 where the dataset has no camera."""
    touch_channels: int
    """3 for one optical sensor, 6 for two stacked on channels (FACTS section 1), 0 for none."""
    tasks: tuple[Task, ...]
    group_by: str
    """What a ``group`` is (instance, object, recording): the unit of splits and of intervals."""
    controls: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Controls made of table columns: name -> numeric columns a logistic regression gets *instead of* features."""
    licence: str
    source: str
    """Who owns it and where it is found."""
    notes: tuple[str, ...] = ()
    """What must be said beside every result, e.g. what the two sides of a published split share."""
    difference: bool = field(default=False, metadata=LATER)
    """Whether touch is stored as (touch - background) / 2 + 128; False also of what was written before this was said."""

    def __post_init__(self) -> None:
        if not (self.vision_channels or self.touch_channels):
            raise ValueError(f"dataset {self.name!r} has neither vision nor touch images: name at least one of them")

        for name, channels in (("vision_channels", self.vision_channels), ("touch_channels", self.touch_channels)):
            if channels < 0 or channels % 3:
                raise ValueError(f"{name} {channels}: give a multiple of 3, three for each camera or sensor")
        names = [task.name for task in self.tasks]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"task {name!r} is there twice: give each task its own name")

    def channels(self, modality: str) -> int:
        return {"vision": self.vision_channels, "touch": self.touch_channels}[modality]

    @property
    def modalities(self) -> tuple[str, ...]:
        """The modalities this dataset has, in the order of ``MODALITIES``."""
        return tuple(m for m in MODALITIES if self.channels(m))
