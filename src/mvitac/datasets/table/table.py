"""A table of samples becomes a dataset: labels, groups, splits, controls, and the images that its rows name.

Whatever can be wrong with the table is said before the first image is decoded.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.images import difference, fit, shrink
from mvitac.data.source import Lost, Sample, Source, one_stamp
from mvitac.data.spec import DataSpec
from mvitac.datasets.base import KEEPING, DatasetConfig
from mvitac.datasets.table.columns import filled, read_controls, read_ids, read_task
from mvitac.datasets.table.image_columns import check_files, check_present, image_columns, read_backgrounds
from mvitac.datasets.table.image_refs import Damage, ImageRef, mean_image, read_all
from mvitac.datasets.table.manifest import Condition, Manifest
from mvitac.datasets.table.splits import BY_GROUP, assign_splits, by_video, check_leak, check_sides, check_split_names
from mvitac.registry import to_json
from mvitac.system.files import digest

VERSION = 3
"""Raised when the same table would give another pack."""
CONTROL_NAMES = ("majority", "pixels", "border", "untrained", "imagenet")
"""What the probe itself calls its controls."""
MAX_TOGETHER = 1024
"""Rows of one video read in one pass, where their images fit into ``MAX_TOGETHER_BYTES``."""
MAX_TOGETHER_BYTES = 600 << 20
"""What every worker may hold of them at the stored size: 1024 rows of two gels and a camera at 256 px."""


@dataclass(frozen=True, kw_only=True)
class RowsConfig(DatasetConfig, ABC):
    """What every dataset that is a table shares: which columns are what."""

    path: Path = Path("data")
    """Where the data lies."""
    title: str | None = None
    """Name in results; default: the folder's name."""
    vision: str | None = None
    """Column of camera images; default: "vision" if there is one; "" = none."""
    touch: tuple[str, ...] = ()
    """Column of tactile images, or two columns (left right) to stack on channels; default: "touch", else "left"
    and "right", if there are any; "" = none."""
    labels: tuple[str, ...] = ()
    """Columns that become tasks; classes are their sorted distinct values, an empty cell or NaN is unlabelled."""
    group: str | None = None
    """Column of the unit of splits and of intervals (object, recording); default: "group" if there is one, else the video
    that a row's frame is of, else every row is alone."""
    touch_group: str | None = None
    """Column of near-duplicates (one touch, one grasp), kept apart in batches; default: the group."""
    split: str | None = None
    """Column with train, val, test or unlabelled; default: "split" if there is one, else "by-group", which deals the
    groups out by the three fields below."""
    test_share: float = 0.25
    """Share of the groups that only score (by-group)."""
    val_share: float = 0.15
    """Share of the groups that choose (by-group)."""
    split_seed: int = 0
    """Another number is another dealing of the groups (by-group)."""
    allow_leak: bool = False
    """Accept a split that puts one group, touch group or image on two sides."""
    allow_missing: bool = False
    """Accept rows without a camera or without a tactile image; pairs and probes leave them out where it is missing."""
    controls: tuple[str, ...] = ()
    """Controls as "name=column[,column]": a logistic regression gets these columns instead of features; columns that
    are not numbers become one-hot."""
    only: tuple[str, ...] = ()
    """Rows to read, e.g. "seq<=4" "sensor=digit" "label_conflict!=1"; all conditions must hold."""
    label_only: tuple[str, ...] = ()
    """Rows whose labels count, in the same form; the others stay as unlabelled rows for pre-training."""
    sensor: str | None = None
    """Column that says which sensor a row's touch is from; default: "sensor" if there is one."""
    difference: bool = False
    """Store touch minus its background, halved, plus one half (no contact is mid-gray) instead of the raw image."""
    background: tuple[str, ...] = ()
    """Columns of the no-contact images that belong to the touch columns; default: "background"."""
    no_contact: tuple[str, ...] = ()
    """Rows that show a sensor without contact, e.g. "phase=empty": instead of samples they become their sensor's
    background, the mean of the first 16."""
    licence: str = "unknown"
    """Under which terms the data may be used."""
    source_url: str = ""
    """Where the data is found."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.touch) > 2:
            raise ValueError(f"touch {' '.join(self.touch)}: give one column, or two to stack (left right)")
        named = Counter([*self.touch, *([self.vision] if self.vision else [])])
        if max(named.values(), default=1) > 1:
            raise ValueError(f"column {named.most_common(1)[0][0]!r} is named twice: every image needs its own column")
        if len(set(self.labels)) < len(self.labels):
            raise ValueError(f"labels {' '.join(self.labels)}: name every column once")
        for name, share in (("test_share", self.test_share), ("val_share", self.val_share)):
            if not 0 <= share < 1:
                raise ValueError(f"{name} {share}: give a share of the groups in [0, 1)")
        if self.test_share + self.val_share >= 1:
            raise ValueError(f"test_share {self.test_share} and val_share {self.val_share} leave nothing to train on")
        if self.split_seed < 0:
            raise ValueError(f"split_seed {self.split_seed}: give a number >= 0")
        if self.background and self.no_contact:
            raise ValueError("background and no_contact: give the one or the other, a touch has one background")
        if (self.background or self.no_contact) and not self.difference:
            raise ValueError("a background is only used for difference images: add difference, or leave it out")
        for name, columns in self.control_columns().items():
            if not name or not all(columns):
                raise ValueError(f"control {name!r}: write it as name=column or name=column,column")
            if name in CONTROL_NAMES:
                raise ValueError(f"control {name!r} is made anyway: choose a name not among {', '.join(CONTROL_NAMES)}")
        for text in (*self.only, *self.label_only, *self.no_contact):
            Condition.parse(text)

    def control_columns(self) -> dict[str, tuple[str, ...]]:
        """Control name -> manifest columns."""
        pairs = [text.partition("=") for text in self.controls]
        if len({name.strip() for name, _, _ in pairs}) < len(pairs):
            raise ValueError(f"controls {' '.join(self.controls)}: give every control a name of its own")
        return {name.strip(): tuple(c.strip() for c in columns.split(",")) for name, _, columns in pairs}

    @abstractmethod
    def manifest(self) -> Manifest:
        """The table; ValueError if it is not there or makes no sense."""

    def source(self) -> Source:
        return Rows(self)


Looked = dict[ImageRef, tuple[tuple[int, int], np.ndarray]]
"""Place -> height and width of its image where it lies, and the image at the stored size."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the table, ready to be read: where its images lie and what it puts into the pack's table."""

    number: int
    vision: ImageRef | None
    touch: tuple[ImageRef, ...]
    background: tuple[tuple[ImageRef, ...], ...]
    """Per touch image the no-contact images whose mean it is compared with; empty = raw images."""
    columns: dict[str, Any]

    def places(self) -> Iterator[ImageRef]:
        """Of every image that it is made of."""
        yield from (place for place in (self.vision, *self.touch) if place)
        yield from (place for many in self.background for place in many)


class Rows(Source):
    """One item is one row, or the rows of one video (of one row group, ...) that are best read in one pass."""

    sizes_at = "file_sizes"

    def __init__(self, config: RowsConfig) -> None:
        manifest = config.manifest()
        self._size = config.size
        self._name = config.name
        self._manifest_digest = manifest.digest
        self._options = {k: v for k, v in to_json(config).items() if k not in ("path", *KEEPING)}
        self._title = config.title or (config.path if config.path.is_dir() else config.path.parent).resolve().name

        vision, touch = image_columns(manifest, config.vision, config.touch)
        labels = config.labels or manifest.labels
        group = config.group or ("group" if "group" in manifest.columns else None)
        split = config.split or ("split" if "split" in manifest.columns else BY_GROUP)
        sensor = config.sensor or ("sensor" if "sensor" in manifest.columns else None)
        conditions = [Condition.parse(text) for text in config.only]
        label_conditions = [Condition.parse(text) for text in config.label_only]
        no_contact = [Condition.parse(text) for text in config.no_contact]
        controls = config.control_columns()
        asked = [*labels, group, config.touch_group, split if split != BY_GROUP else None, sensor]
        asked += [c.column for c in (*conditions, *label_conditions, *no_contact)]
        for column in (*asked, *(c for columns in controls.values() for c in columns)):
            if column is not None:
                manifest.check(column)

        kept = [i for i, row in enumerate(manifest.rows) if all(condition.holds(row) for condition in conditions)]
        if not kept:
            raise ValueError(f"{manifest.file}: none of {len(manifest.rows)} rows meets {' and '.join(config.only)}")
        places = {column: manifest.places(column) for column in (vision, *touch) if column}
        backgrounds = (
            read_backgrounds(manifest, places, touch, kept, sensor, config.background, no_contact)
            if config.difference
            else []
        )
        if no_contact:
            kept = [i for i in kept if not all(condition.holds(manifest.rows[i]) for condition in no_contact)]
            if not kept:
                raise ValueError(f"{manifest.file}: every row meets {' and '.join(config.no_contact)}: no samples left")
        numbers, rows = [i + 1 for i in kept], [manifest.rows[i] for i in kept]
        places = {column: [found[i] for i in kept] for column, found in places.items()}
        missing = check_present(manifest, places, vision, touch, numbers, config.allow_missing)
        self._sizes, files = check_files(manifest, places, backgrounds, numbers)

        where = str(manifest.file)
        group_by, groups = (
            (group, filled(where, numbers, rows, group, "group"))
            if group
            else by_video(manifest.root, numbers, places.values())
        )
        touch_groups = filled(where, numbers, rows, config.touch_group, "touch_group") if config.touch_group else groups
        counts = [all(condition.holds(row) for condition in label_conditions) for row in rows]
        tasks, targets = [], []
        for column in labels:
            task, target = read_task(where, column, rows, counts)
            tasks.append(task)
            targets.append(target)
        if split == BY_GROUP:
            splits = assign_splits(groups, targets, config.test_share, config.val_share, config.split_seed)
        else:
            splits = filled(where, numbers, rows, split, "split")
            check_split_names(where, split, numbers, splits)
        if not config.allow_leak:
            check_leak(where, split, f"groups ({group_by})", groups, splits)
            check_leak(where, split, f"touch groups ({config.touch_group or group_by})", touch_groups, splits)
            for column, found in places.items():
                there = [i for i, place in enumerate(found) if place]
                images = [os.path.normpath(str(found[i])) for i in there]
                check_leak(where, split, f"{column} images", images, [splits[i] for i in there])
        check_sides(where, split, splits, tasks, targets, len(set(groups)))

        extra, names = read_controls(where, controls, numbers, rows, targets)
        ids = read_ids(where, manifest, numbers, rows)
        self._rows: list[Row] = []
        for i, row in enumerate(rows):
            # Which modalities a row has is seen, not believed.
            carried = {name: cell for name, cell in row.items() if name not in (*places, "has_vision", "has_touch")}
            own: dict[str, Any] = {"id": ids[i], "group": groups[i], "touch_group": touch_groups[i], "split": splits[i]}
            own |= {f"label_{task.name}": target[i] for task, target in zip(tasks, targets, strict=True)}
            own |= {f"has_{modality}": not lacking[i] for modality, lacking in missing.items()}
            if sensor:
                own["sensor"] = row[sensor]
            if taken := extra.keys() & own.keys():
                raise ValueError(
                    f"{where}: control column {min(taken)!r} holds numbers and has the name of a column of the pack itself:"
                    " give a copy of it under another name"
                )
            # Column order is part of the pack's digest: ours first, then the manifest's that we do not interpret.
            carried = {k: v for k, v in carried.items() if k not in own}
            columns = {**own, **carried, **{k: v[i] for k, v in extra.items()}}
            pressed = tuple(place for c in touch if (place := places[c][i]))
            first = places[vision][i] if vision else None
            plain = tuple(b[numbers[i]] for b in backgrounds) if pressed else ()
            self._rows.append(Row(numbers[i], first, pressed, plain, columns))
        row_bytes = 3 * config.size**2 * sum(bool(column) for column in (vision, *touch))
        self._items = bundles(self._rows, max(1, min(MAX_TOGETHER, MAX_TOGETHER_BYTES // row_bytes)))
        self._stamps = [
            one_stamp((*files[place.path], *place.within()) for i in item for place in self._rows[i].places())
            for item in self._items
        ]
        self._spec = DataSpec(
            name=self._title,
            vision_channels=3 if vision else 0,
            touch_channels=3 * len(touch),
            tasks=tuple(tasks),
            group_by=group_by,
            controls=names,
            licence=config.licence,
            source=config.source_url or "not given",
            notes=("no column says the groups, so frames of one video are one group",) if group_by == "video" else (),
            difference=config.difference,
        )

    def spec(self) -> DataSpec:
        return self._spec

    def items(self) -> list[str]:
        numbers = ([self._rows[i].number for i in item] for item in self._items)
        return [f"row {n[0]}" if len(n) == 1 else f"{len(n)} rows from row {n[0]}" for n in numbers]

    def samples_per_item(self) -> list[int]:
        return [len(item) for item in self._items]

    def fingerprint(self) -> dict[str, Any]:
        return {
            "reader": f"{self._name} {VERSION}",
            "title": self._title,
            "manifest": self._manifest_digest,
            "file_sizes": digest(self._sizes),
            "options": self._options,
        }

    def stamps(self) -> list[int]:
        return self._stamps

    def read(self, item: int) -> list[Sample | Lost]:
        rows = [self._rows[i] for i in self._items[item]]
        lost: Damage = {}
        seen = self._look([row.vision for row in rows if row.vision], lost)
        num_touch = self._spec.touch_channels // 3
        felt = [self._look([row.touch[k] for row in rows if row.touch], lost) for k in range(num_touch)]
        samples: list[Sample | Lost] = []
        for row in rows:
            try:
                samples.append(self._sample(row, seen, felt, lost))
            except (ValueError, OSError) as error:
                if len(rows) == 1:
                    raise
                samples.append(Lost(f"row {row.number}", str(error)))  # the others of its video are still good
        return samples

    def _sample(self, row: Row, seen: Looked, felt: Sequence[Looked], lost: Damage) -> Sample:
        """``row`` with its images among those that were read; ValueError says which of them is damaged."""
        for place in (row.vision, *row.touch):
            if place in lost:
                raise ValueError(lost[place])
        touches = [images[place] for images, place in zip(felt, row.touch, strict=False)]
        if len({shape for shape, _ in touches}) > 1:
            (h, w), (h2, w2) = (shape for shape, _ in touches)
            raise ValueError(
                f"{row.touch[0]} is {w} x {h}, {row.touch[1]} is {w2} x {h2}: stacked sensors need one size"
            )
        pressed = [image for _, image in touches]
        if row.background:
            pressed = [self._minus(*both) for both in zip(touches, row.background, row.touch, strict=True)]
        sizes = {"touch": touches[0][0]} if touches else {}
        vision = None
        if row.vision:
            sizes["vision"], vision = seen[row.vision]
        touch = np.concatenate(pressed, axis=2) if pressed else None
        return Sample(vision=vision, touch=touch, columns=row.columns, sizes=sizes)

    def _look(self, places: Sequence[ImageRef], lost: Damage) -> Looked:
        """``places`` at the stored size, as a whole video would not fit otherwise; what is damaged goes to ``lost``."""
        found = read_all(places, lost)
        return {place: ((image.height, image.width), shrink(image, self._size)) for place, image in found}

    def _minus(
        self, touch: tuple[tuple[int, int], np.ndarray], background: tuple[ImageRef, ...], place: ImageRef
    ) -> np.ndarray:
        empty = mean_image(background)
        if empty.shape[:2] != touch[0]:
            (h, w), (h2, w2) = touch[0], empty.shape[:2]
            raise ValueError(f"{place} is {w} x {h}, its background {w2} x {h2}: a difference needs one size")
        return difference(touch[1], fit(empty, self._size))


def bundles(rows: Sequence[Row], most: int) -> list[list[int]]:
    """Row indices by item: rows whose images lie in the same containers, at most ``most``; others alone."""
    items: list[list[int]] = []
    open_items: dict[Any, list[int]] = {}
    for i, row in enumerate(rows):
        key = tuple(place.together() if place else None for place in (row.vision, *row.touch))
        if not any(key):
            items.append([i])
            continue
        item = open_items.get(key)
        if item is None or len(item) == most:
            item = open_items[key] = []
            items.append(item)
        item.append(i)
    return items
