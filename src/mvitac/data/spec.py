"""Description of a dataset: modalities, tasks, groups, owner."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from mvitac.registry import check_known

MODALITIES = ("vision", "touch")
UNGROUPED = "so every row is its own group"  # is in the note of a table whose rows are their own groups
SUFFIXES = {"raw": ".npy", "jpeg": ".jpegs"}  # of image files, by how images are stored
Store = Literal["raw", "jpeg"]
QUALITY = 95
PHASES = ("before", "during", "after")  # values of column phase: the moments of a grasp


@dataclass(frozen=True, kw_only=True)
class _About:
    name: str
    only: dict[str, str] = field(default_factory=dict)
    """Column -> value that a row must have to belong to the task, e.g. {"phase": "during"} for grasp success."""
    split: str = "split"
    """Column with the split of this task, if it differs from that of pre-training."""


@dataclass(frozen=True, kw_only=True)
class Task(_About):
    """A classification task for linear probes."""

    classes: tuple[str, ...]
    """Class names, indexed by label. The label column is ``label_<name>``; -1 = unlabelled."""


def listed(names: Sequence[str], most: int = 8) -> str:
    """``names`` for people; of more than ``most`` the first, and how many are left."""
    rest = len(names) - most
    return ", ".join(names[:most]) + f" and {rest} more" * (rest > 0)


@dataclass(frozen=True, kw_only=True)
class Target:
    """A measured number and its unit, e.g. force_n in N. ``name`` is the column of the table; NaN = not measured."""

    name: str
    unit: str


@dataclass(frozen=True, kw_only=True)
class ValueTask(_About):
    """A regression task for probes: one number (a force) or several (the six numbers of a pose)."""

    targets: tuple[Target, ...]

    def __post_init__(self) -> None:
        if not self.targets:
            raise ValueError(f"task {self.name!r} has no targets: name at least one column with its unit")


AnyTask = Task | ValueTask


@dataclass(frozen=True, kw_only=True)
class Window:
    """Which frames of a touch one row shows (``data/windows.py``)."""

    frames: int = 1
    stride: float = 1.0
    """Distance of two frames, in units of the column ``order``."""
    of: tuple[str, ...] = ("touch",)
    """Modalities that have windows; the others show the current frame."""
    order: str | None = None
    """Column that orders the frames of a touch. None: frame, seq or time."""
    short: Literal["repeat", "leave-out"] = "repeat"
    """Rows with fewer earlier frames repeat their first one, or are left out."""
    minus_first: bool = False
    """Whether frames are stored as (frame - first frame of the touch) / 2 + 128."""

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= 64:
            raise ValueError(f"num_frames {self.frames}: give 1 (single images) to 64")
        if not 0 < self.stride < math.inf:
            raise ValueError(f"stride {self.stride}: give a positive number of frames, or of units of --data.order")

    @property
    def active(self) -> bool:
        """Whether images differ from single raw frames."""
        return self.frames > 1 or self.minus_first


@dataclass(frozen=True, kw_only=True)
class DataSpec:
    """What methods, probes and reports need to know about a dataset."""

    name: str
    vision_channels: int
    """3, or 0 without a camera."""
    touch_channels: int
    """3 for one optical sensor, 6 for two stacked on channels (as in the paper's grasping experiment), 0 for none."""
    tasks: tuple[Task, ...]
    group_by: str
    """What a ``group`` is (instance, object, recording): the unit of splits and of confidence intervals."""
    controls: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Control name -> numeric columns on which a logistic regression is fitted *instead of* features."""
    licence: str
    source: str
    """Owner and location of the data."""
    notes: tuple[str, ...] = ()
    """Notes to print with every result, e.g. what train and test of a published split share."""
    difference: bool = False
    """Whether touch is stored as (touch - background) / 2 + 128."""
    crop: dict[str, str] = field(default_factory=dict)
    """Modality -> part of its images that is stored, as x:y:width:height of each sensor; without a name, all of them."""
    values: tuple[ValueTask, ...] = ()
    """Tasks whose answer is a number with a unit."""
    window: Window = Window()
    """The frames that one row shows, stacked on channels."""
    sensors: tuple[str, ...] = ()
    """Of a trained model: names of the touch sensors of its training rows; () in packs (``Pack.sensor_names``)."""

    def __post_init__(self) -> None:
        if not (self.vision_channels or self.touch_channels):
            raise ValueError(f"dataset {self.name!r} has neither vision nor touch images: name at least one of them")
        for name, channels in (("vision_channels", self.vision_channels), ("touch_channels", self.touch_channels)):
            if channels < 0 or channels % 3:
                raise ValueError(f"{name} {channels}: give a multiple of 3, three for each camera or sensor")
        names = [task.name for task in self.all_tasks]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"task {name!r} occurs twice: give each task its own name")
        units: dict[str, str] = {}
        for target in (target for task in self.values for target in task.targets):
            if (unit := units.setdefault(target.name, target.unit)) != target.unit:
                raise ValueError(f"{target.name!r} has two units, {unit} and {target.unit}: give a column one unit")

    @property
    def all_tasks(self) -> tuple[AnyTask, ...]:
        return (*self.tasks, *self.values)

    @property
    def split_columns(self) -> tuple[str, ...]:
        """The columns with the splits of pre-training and of all tasks."""
        return tuple(dict.fromkeys(("split", *(task.split for task in self.all_tasks))))

    def channels(self, modality: str) -> int:
        """Channels of an image as encoders get it: of all frames of a window together."""
        return self.frames(modality) * {"vision": self.vision_channels, "touch": self.touch_channels}[modality]

    def frames(self, modality: str) -> int:
        return self.window.frames if modality in self.window.of else 1

    @property
    def modalities(self) -> tuple[str, ...]:
        return tuple(m for m in MODALITIES if self.channels(m))


LIMITS = {"size": (8, 1024), "workers": (0, 1024), "max_damaged": (0, 1), "quality": (1, 100)}


def check_request(store: str = "raw", **given: float) -> None:
    for name, value in given.items():
        low, high = LIMITS[name]
        if not low <= value <= high:
            raise ValueError(f"{name} {value} is not possible: give {low} to {high}")
    check_known("store", [str(store)], SUFFIXES)


def stored_as(store: Store, quality: int) -> dict[str, Any]:
    """Return the storage options that identify a pack."""
    return {"store": store} if store == "raw" else {"store": store, "quality": quality}
