"""A dataset that is a table of samples: labels, groups, splits, controls, and the images that its rows refer to.

The table is checked completely before the first image is decoded.
"""

import json
import math
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mvitac.data.pack_table import SPLITS
from mvitac.data.source import Lost, Sample, Source, one_stamp
from mvitac.data.spec import AnyTask, DataSpec
from mvitac.data.stamps import number_of
from mvitac.datasets.base import KEEPING, DatasetConfig
from mvitac.datasets.table import clocks, columns, images, splits
from mvitac.datasets.table.columns import Condition, all_hold, value_task
from mvitac.datasets.table.image_refs import span_of
from mvitac.datasets.table.images import Background, Row, bundles, read_rows
from mvitac.datasets.table.manifest import READERS, Manifest
from mvitac.datasets.table.splits import BY_GROUP
from mvitac.registry import check_range, to_json, unknown
from mvitac.system.files import parse_json

VERSION = 3  # version of this reader. Increase it when the same table would give another pack.
MAX_TOGETHER = 1024  # rows of one video that are read in one pass, if their images fit into ``MAX_TOGETHER_BYTES``
MAX_TOGETHER_BYTES = 600 << 20
"""Memory per worker for these images at the stored size: 1024 rows of two gels and a camera at 256 px."""
CONTROL_NAMES = ("majority", "mean", "pixels", "border", "untrained", "imagenet", "start")
"""Controls that every probe computes by itself."""


@dataclass(frozen=True, kw_only=True)
class RowsConfig(DatasetConfig, ABC):
    """A dataset that is a table: which columns mean what."""

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
    forms and blanks are made equal, and whole numbers: 1.0 is 1."""
    values: tuple[str, ...] = ()
    """Columns of numbers to predict, as column:unit, e.g. force_n:N; or several as one task: pose=z_mm:mm,tilt_deg:deg.
    state[2] is the third number of a column of lists. An empty cell or NaN is not measured."""
    group: str | None = None
    """Column of the group (object, recording), the unit of splits and confidence intervals; default: "group" if it
    exists, else the video of the row's frame, else each row is its own group."""
    touch_group: str | None = None
    """Column of near-duplicates (one touch, one grasp), which a batch keeps apart; default: the recording, episode or
    demonstration of the group, where the data knows it, else the group."""
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
    """Conditions on rows without contact, e.g. "phase=empty". No samples: a sensor's first 16 give its background."""
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
    """Of images of uint16 or floating-point numbers (.png, .tif, .npy, arrays): what becomes black and white, as
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
        pairs = [text.rpartition("=") for text in self.controls]  # one of a single column may be named after it
        found = {(name or listed).strip(): tuple(c.strip() for c in listed.split(",")) for name, _, listed in pairs}
        if len(found) < len(pairs):
            raise ValueError(f"controls {' '.join(self.controls)}: give every control a name of its own")
        return found

    def numbers(self) -> list[str]:
        """Return the manifest columns that hold numbers: those of values, and those of controls."""
        return [*self._targets(), *(column for used in self.control_columns().values() for column in used)]

    def smooth(self) -> list[str]:
        """Return the columns that are interpolated in logs: values that are not also a name of something."""
        names = {*self.labels, self.group, self.touch_group, self.split, self.sensor}
        return [name for name in self._targets() if self.interpolate == "linear" and name not in names]

    def _targets(self) -> list[str]:
        return [target.name for text in self.values for target in value_task(text).targets]

    def looks(self) -> dict[str, dict[str, Any]]:
        """Return image column -> fields of its references: crop, span and bgr."""
        looks: dict[str, dict[str, Any]] = {}
        for name, texts, many in (("crop", self.crop, 4), ("span", self.range, 2)):
            for text in texts:
                column, _, listed = text.partition("=")
                numbers = [number for part in listed.split(":") if (number := number_of(part)) is not None]
                good = len(numbers) == many == listed.count(":") + 1
                pixels = listed.replace(":", "").isdecimal() and all(numbers[2:])
                if not good or not (numbers[0] < numbers[1] if many == 2 else pixels):
                    raise ValueError(f"{text!r}: write COLUMN={'x:y:width:height' if many == 4 else 'LOW:HIGH'}")
                if name in looks.setdefault(column, {}):
                    raise ValueError(f"{text!r}: {column} has another before it, give one")
                looks[column][name] = tuple(map(int, numbers) if many == 4 else numbers)
        return looks

    def conditioned(self) -> list[str]:
        return [Condition.parse(text).column for text in (*self.only, *self.label_only, *self.no_contact)]

    def vectors(self) -> set[str]:
        """Return the columns that may be lists of numbers: what is named, such as state, or has an element state[2]."""
        return {columns.element_of(name)[0] or name for name in self.numbers()}

    @abstractmethod
    def manifest(self) -> Manifest:
        """Return the table; ValueError if it does not exist or is invalid."""

    def source(self) -> Source:
        return Rows(self)


@dataclass(frozen=True, kw_only=True)
class RecordedConfig(RowsConfig, ABC):
    """Options of tables whose rows may be frames of recordings, which follow each other closely."""

    every: int | None = None
    """Use every n-th frame of a recording; by default all images, every row of an episode, and every fifth frame of a
    video or image of a bag. Rows of a table, HDF5 or zarr are all used."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.every is not None:
            check_range(self, 1, math.inf, "every")


class Rows(Source):
    """Reads a table. An item is one row, or the rows of one video (one row group, ...), which are read in one pass."""

    def __init__(self, config: RowsConfig) -> None:
        self._config = config
        table = config.manifest()
        if config.log:
            names = [name for name in (*config.touch, config.vision, "touch", "left", "right", "vision") if name]
            how: Any = {"smooth": config.smooth(), "tolerance": config.tolerance}
            table = clocks.join(table, config.log, names, numbers=config.numbers(), **how)
        table = columns.with_elements(table, config.numbers())
        self._digest = table.digest
        self._vision, self._touch = images.find(table, config.vision, config.touch)
        self._images = tuple(column for column in (self._vision, *self._touch) if column)
        self._group = config.group or ("group" if "group" in table.columns else table.group)
        self._split = config.split or ("split" if "split" in table.columns else BY_GROUP)
        self._check_used(table)
        self._sensor = config.sensor or ("sensor" if "sensor" in table.columns else None)
        label_columns = config.labels or table.labels
        value_tasks = [value_task(text) for text in config.values]
        targets = [target.name for task in value_tasks for target in task.targets]
        used = (*label_columns, *targets, self._group, *({self._split} - {BY_GROUP}), self._sensor, config.touch_group)
        used += (*config.conditioned(), *(c for used in config.control_columns().values() for c in used))
        table.check(*used, *{"id"} & {*table.columns})

        table, grounds = self._select(table)
        asked = {"vision": self._images[: bool(self._vision)], "touch": self._touch}
        missing = images.check_present(table, asked, config.allow_missing)
        stamps = images.check_files(table, self._images, grounds)
        group_by, groups, touch_groups = self._groups(table)
        counts = all_hold(config.label_only, table)
        read = [columns.read_task(table, column, counts) for column in label_columns]
        values, measured = columns.read_values(table, value_tasks, counts)
        tasks, labels = [*(task for task, _ in read), *value_tasks], [*(label for _, label in read), *measured]
        assigned = self._assign(table, {f"groups ({group_by})": groups, "touch groups": touch_groups}, tasks, labels)
        controls = config.control_columns()
        extra = columns.read_controls(table, dict.fromkeys(c for used in controls.values() for c in used), labels)

        own: dict[str, list[Any]] = {"id": table.ids(), "group": groups, "touch_group": touch_groups}
        own |= {"split": assigned, **{f"label_{task.name}": label for task, label in read}}
        columns.check_names(table, [*values, *extra], {*own, "sensor"})
        own |= values | {f"has_{m}": [not lacks for lacks in lacking] for m, lacking in missing.items()}
        self._rows = self._make_rows(table, grounds, own, extra)

        row_bytes = 3 * config.size**2 * len(self._images)
        self._items = bundles(self._rows, max(1, min(MAX_TOGETHER, MAX_TOGETHER_BYTES // row_bytes)))
        self._stamps = [one_stamp(stamps[r.path] for i in item for r in self._rows[i].refs()) for item in self._items]
        cuts = {column: ":".join(map(str, look["crop"])) for column, look in config.looks().items() if "crop" in look}
        self._spec = DataSpec(
            name=config.title or (config.path if config.path.is_dir() else config.path.parent).resolve().name,
            vision_channels=3 if self._vision else 0,
            touch_channels=3 * len(self._touch),
            tasks=tuple(task for task, _ in read),
            values=tuple(value_tasks),
            group_by=group_by,
            controls=controls,
            licence=config.licence,
            source=config.source_url or "not given",
            notes=self._notes(table, group_by, len({*groups}) == len(groups), assigned),
            difference=config.difference,
            crop={m: ", ".join(cuts[c] for c in own if c in cuts) for m, own in asked.items() if {*own} & {*cuts}},
        )
        parse_json(json.dumps([to_json(self._spec), [*{*groups}]], ensure_ascii=False))  # or no result could be read

    def _check_used(self, table: Manifest) -> None:
        config, listed = self._config, table.path.suffix.lower() in READERS
        idle: dict[str, Any] = {"pictures": listed and "the table names its images"}
        alone = not config.log and "--data.log names no other clock"
        idle |= {"tolerance": listed and alone, "interpolate": config.name != "rosbag" and alone}
        given = self._split != BY_GROUP and f"column {self._split!r} says the split"
        idle |= dict.fromkeys(("test_share", "val_share", "split_seed"), given)
        for name, why in idle.items():
            if why and getattr(config, name, None) != getattr(type(config), name, None):
                raise ValueError(f"--data.{name.replace('_', '-')} has no effect, {why}: leave it out")

    def _groups(self, table: Manifest) -> tuple[str, list[str], list[str]]:
        if self._group:
            group_by, groups = self._group, table.filled(self._group, "group")
        else:
            group_by, groups = splits.group_by_video(table.root, table.numbers, [table.images[c] for c in self._images])
        if self._config.touch_group:
            return group_by, groups, table.filled(self._config.touch_group, "touch_group")
        if table.group in (None, self._group):
            return group_by, groups, groups
        return group_by, groups, [f"{g}/{row[table.group]}" for g, row in zip(groups, table.rows, strict=True)]

    def _select(self, table: Manifest) -> tuple[Manifest, list[Background]]:
        """Return the rows that become samples with their images, and the background of each (none for raw images)."""
        config, grounds = self._config, self._config.background or ("background",)
        shown = (*self._images, *(grounds if config.difference and not config.no_contact else ()))
        table.check(*shown, images=True)
        table = table.resolved(shown, {*self._images, *grounds})
        if (looks := config.looks()) or config.bgr:
            table.check(*looks, images=True)
            like = dict(zip(grounds, self._touch, strict=False))  # a background is cropped as its touch
            how = {column: looks.get(like.get(column, column), {}) | {"bgr": config.bgr} for column in shown}
            seen = {c: [ref and replace(ref, **how[c]) for ref in refs] for c, refs in table.images.items()}
            table = replace(table, images=seen)
        table = table.filtered(all_hold(config.only, table), f"no row meets {' and '.join(config.only)}")
        if not config.no_contact and not config.difference:
            return table, []
        empty = all_hold(config.no_contact, table) if config.no_contact else None
        found = images.backgrounds(table, self._touch, grounds, self._sensor, empty)
        if empty is None:
            return table, found
        found = [ground for ground, none in zip(found, empty, strict=True) if not none]
        return table.filtered([not none for none in empty], f"every row meets {' and '.join(config.no_contact)}"), found

    def _assign(
        self, table: Manifest, whole: dict[str, list[str]], tasks: Sequence[AnyTask], labels: Sequence[Sequence[int]]
    ) -> list[str]:
        """Return the split of each row, from its column or assigned by group; those of one ``whole`` are in one."""
        config, column, where = self._config, self._split, str(table.path)
        groups = next(iter(whole.values()))
        if column == BY_GROUP:
            found = splits.assign_splits(groups, labels, config.test_share, config.val_share, config.split_seed)
        else:
            found = table.filled(column, "split")
            for split in {*found} - {*SPLITS}:
                raise ValueError(f"{where}: {unknown(f'split in column {column!r}', split, SPLITS)}")
        if not config.allow_leak:
            for what, names in whole.items():
                splits.check_leak(where, column, what, names, found)
            for names in filter(None, (self._images[: bool(self._vision)], self._touch)):  # left here, right there
                there = [(ref, at) for name in names for ref, at in zip(table.images[name], found, strict=True) if ref]
                paths = [str(ref) for ref, _ in there]  # links are rare, and to follow them is slow
                images = [*map(os.path.realpath if any(map(os.path.islink, paths)) else os.path.normpath, paths)]
                splits.check_leak(where, column, f"{' and '.join(names)} images", images, [side for _, side in there])
        splits.check_sides(where, column, found, tasks, labels, len(set(groups)))
        return found

    def _notes(self, table: Manifest, group_by: str, single: bool, assigned: Sequence[str]) -> tuple[str, ...]:
        """What results say about logs, about how images are shown, and about groups that no column names."""
        notes = [*table.notes]
        notes += [f"{text} is the part of the images that is used, squeezed to a square" for text in self._config.crop]
        for column in self._images:  # judged by the first image
            ref = next((ref for ref in table.images[column] if ref), None)
            if ref and (span := span_of(ref)):
                notes.append("{} has more than 8 bits: {:g} is black, {:g} white".format(column, *span))
        if group_by == "video":
            notes.append("no column says the groups, so frames of one video are one group")
        if single or group_by == "row":
            known = {*self._config.labels, *table.labels, self._split, self._sensor, *self._images}
            texts = {name: [row[name] for row in table.rows] for name in table.rows[0] if name not in known}
            for column in self._images:  # file names up to their last number
                files = (os.path.splitext(os.path.basename(ref.path))[0] if ref else "" for ref in table.images[column])
                if (stems := [re.sub(r"\d+\D*$", "", file) for file in files]) not in texts.values():
                    texts[f"names of {column} files"] = stems
            notes += columns.ungrouped(None if group_by == "row" else group_by, texts, assigned)
        return tuple(notes)

    def _make_rows(
        self, table: Manifest, grounds: Sequence[Background], own: dict[str, list[Any]], extra: dict[str, list[float]]
    ) -> list[Row]:
        """Combine the pack's ``own`` columns, the manifest's other columns and the controls' numbers (``extra``)."""
        if self._sensor:
            own["sensor"] = [row[self._sensor] for row in table.rows]
        # Which modalities a row has is checked, not read; column order is part of the pack's digest.
        known = {*own, *self._images, "has_vision", "has_touch"}
        rows = []
        for i, (number, cells) in enumerate(zip(table.numbers, table.rows, strict=True)):
            row = {name: values[i] for name, values in own.items()}
            row |= {name: cell for name, cell in cells.items() if name not in known}
            row |= {name: values[i] for name, values in extra.items()}
            touch = tuple(ref for column in self._touch if (ref := table.images[column][i]))
            vision = table.images[self._vision][i] if self._vision else None
            rows.append(Row(number, vision, touch, grounds[i] if grounds and touch else (), row))
        return rows

    def spec(self) -> DataSpec:
        return self._spec

    def items(self) -> list[str]:
        numbers = ([self._rows[i].number for i in item] for item in self._items)
        return [f"row {n[0]}" if len(n) == 1 else f"{len(n)} rows from row {n[0]}" for n in numbers]

    def samples_per_item(self) -> list[int]:
        return [len(item) for item in self._items]

    def fingerprint(self) -> dict[str, Any]:
        options = {k: v for k, v in to_json(self._config).items() if k not in ("path", *KEEPING)}
        reader = f"{self._config.name} {VERSION}"
        return {"reader": reader, "title": self._spec.name, "manifest": self._digest, "options": options}

    def stamps(self) -> list[int]:
        return self._stamps

    def read(self, item: int) -> list[Sample | Lost]:
        return read_rows([self._rows[i] for i in self._items[item]], self._config.size)
