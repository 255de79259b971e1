"""Options of a dataset that is a table: which columns mean what."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.table import columns
from mvitac.datasets.table.columns import Condition, value_task
from mvitac.datasets.table.manifest import Manifest, number_of
from mvitac.registry import check_range

CONTROL_NAMES = ("majority", "pixels", "border", "untrained", "imagenet", "start")
"""Controls that every probe computes by itself."""


@dataclass(frozen=True, kw_only=True)
class TableOptions(DatasetConfig, ABC):
    """Which columns of a table mean what."""

    path: Path = Path("data")
    """Path of the data."""
    title: str | None = None
    """Name of the dataset in results; default: the folder's name."""
    vision: str | None = None
    """Column of camera images; default: "vision" if it exists; "" = none."""
    touch: tuple[str, ...] = ()
    """Column of tactile images, or two columns (left right) to stack on channels; default: "touch" if it exists, else
    "left" and "right"; "" = none."""
    labels: tuple[str, ...] = ()
    """Columns that become tasks. Classes are the sorted distinct values; an empty cell or NaN is unlabelled. Unicode
    forms and blanks are made equal."""
    values: tuple[str, ...] = ()
    """Columns of numbers to predict, as column:unit, e.g. force_n:N; or several as one task: pose=z_mm:mm,tilt_deg:deg.
    state[2] is the third number of a column of lists. An empty cell or NaN is not measured."""
    group: str | None = None
    """Column of the group (object, recording), the unit of splits and confidence intervals; default: "group" if it
    exists, else the video of the row's frame, else each row is its own group."""
    touch_group: str | None = None
    """Column of near-duplicates (one touch, one grasp), which a batch keeps apart; default: the group."""
    split: str | None = None
    """Column with train, val, test or unlabelled; default: "split" if it exists, else "by-group", which assigns whole
    groups using the next three fields."""
    test_share: float = 0.25
    """Fraction of groups in the test split (by-group)."""
    val_share: float = 0.15
    """Fraction of groups in the validation split (by-group)."""
    split_seed: int = 0
    """Random seed for assigning groups to splits (by-group)."""
    allow_leak: bool = False
    """Accept a group, touch group or image that is in more than one split."""
    allow_missing: bool = False
    """Accept rows without a camera image or without a tactile image. Pairs and probes skip them where they need it."""
    controls: tuple[str, ...] = ()
    """Controls as "name=column[,column]": a logistic regression on these columns of numbers instead of features."""
    only: tuple[str, ...] = ()
    """Conditions on the rows to read, e.g. "seq<=4" "sensor=digit" "label_conflict!=1"; all must hold."""
    label_only: tuple[str, ...] = ()
    """Conditions on the rows whose labels count; other rows are unlabelled and used for pre-training only."""
    sensor: str | None = None
    """Column with the name of the touch sensor; default: "sensor" if it exists."""
    difference: Annotated[bool, tyro.conf.arg(name="subtract-background")] = False
    """Store (touch - background) / 2 + 128 instead of the raw image, so that no contact is mid-gray."""
    background: tuple[str, ...] = ()
    """Columns of the no-contact images, one per touch column; default: "background"."""
    no_contact: tuple[str, ...] = ()
    """Conditions on rows without contact, e.g. "phase=empty". They are not samples: the mean of the first 16 of a sensor
    is its background."""
    log: tuple[str, ...] = ()
    """Logs with a clock of their own, as FILE:COLUMN (the column of time stamps), e.g. force.csv:stamp; stamp-0.35 sets
    that clock back. Their columns are joined to the rows by time (``datasets/table/clocks.py``)."""
    tolerance: float = 0.02
    """Largest distance in seconds of a row from a measurement of its logs, or a frame of its other cameras."""
    interpolate: Literal["linear", "nearest"] = "linear"
    """How the numbers of values are taken from logs. Other columns are of the nearest time."""
    crop: tuple[str, ...] = ()
    """Part of the images to use, as COLUMN=x:y:width:height in pixels from the top left corner, e.g. touch=40:0:560:480.
    It is squeezed to a square, as every image is."""
    range: tuple[str, ...] = ()
    """Of images of 16 bits or floating-point numbers (.png, .tif, .npy, arrays): what becomes black and white, as
    COLUMN=LOW:HIGH; by default 0 and 65535, or 0 and 1 of floats."""
    bgr: bool = False
    """Images are stored blue first, as OpenCV writes arrays to HDF5 or zarr."""
    licence: str = "unknown"
    """Licence of the data."""
    source_url: str = ""
    """URL of the data."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, 0, 1, "test_share", "val_share")
        check_range(self, 0, math.inf, "split_seed", "tolerance")
        if self.test_share + self.val_share >= 1:
            raise ValueError(f"test_share {self.test_share} and val_share {self.val_share} leave nothing to train on")
        if self.background and self.no_contact:
            raise ValueError("background and no_contact: give only one of them, a touch has one background")
        if (self.background or self.no_contact) and not self.difference:
            raise ValueError("a background is only used with subtract-background: add that option, or leave this out")
        self.conditioned()
        self.looks()
        if len(self.touch) > 2:
            raise ValueError(f"touch {' '.join(self.touch)}: give one column, or two to stack (left right)")
        for name in self.control_columns():
            if name in CONTROL_NAMES:
                raise ValueError(f"control {name!r} is always computed: choose another name")

    def control_columns(self) -> dict[str, tuple[str, ...]]:
        """Return control name -> manifest columns."""
        pairs = [text.partition("=") for text in self.controls]
        if len({name.strip() for name, _, _ in pairs}) < len(pairs):
            raise ValueError(f"controls {' '.join(self.controls)}: give every control a name of its own")
        return {name.strip(): tuple(c.strip() for c in listed.split(",")) for name, _, listed in pairs}

    def numbers(self) -> list[str]:
        """Return the manifest columns that hold numbers: those of values, and those of controls."""
        named = [target.name for text in self.values for target in value_task(text).targets]
        return [*named, *(column for used in self.control_columns().values() for column in used)]

    def looks(self) -> dict[str, dict[str, Any]]:
        """Return image column -> fields of its references: crop, span and bgr."""
        looks: dict[str, dict[str, Any]] = {}
        for name, texts, many in (("crop", self.crop, 4), ("span", self.range, 2)):
            for text in texts:
                column, _, listed = text.partition("=")
                numbers = [number for part in listed.split(":") if (number := number_of(part)) is not None]
                good = len(numbers) == many == listed.count(":") + 1
                if not good or (numbers[0] >= numbers[1] if many == 2 else min(numbers) < 0 or not all(numbers[2:])):
                    raise ValueError(f"{text!r}: write COLUMN={'x:y:width:height' if many == 4 else 'LOW:HIGH'}")
                looks.setdefault(column, {})[name] = tuple(map(int, numbers) if many == 4 else numbers)
        return looks

    def conditioned(self) -> list[str]:
        """Return the columns that the conditions name."""
        return [Condition.parse(text).column for text in (*self.only, *self.label_only, *self.no_contact)]

    def vectors(self) -> set[str]:
        """Return the columns of lists of numbers of which an element is named, such as state of state[2]."""
        return {columns.element_of(name)[0] for name in self.numbers()} - {""}

    @abstractmethod
    def manifest(self) -> Manifest:
        """Return the table; ValueError if it does not exist or is invalid."""
