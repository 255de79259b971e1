"""``--data folder``: anybody's images, named by a manifest or laid out in class folders.

A **manifest** (.csv, .parquet or .jsonl) has one row per sample; its paths are relative to its own folder, or absolute:

    vision,touch,material,object,split
    vision/0001.jpg,touch/0001.jpg,wood,table_3,train

**Class folders** need no manifest. Files are paired by their path below the modality's folder, without the suffix:

    <root>/vision/<class>/<name>.jpg            <root>/touch/<class>/<name>.png          every file its own group
    <root>/vision/<class>/<group>/<name>.jpg    ...                                      or grouped by a folder
    <root>/train/vision/<class>/...             <root>/test/vision/<class>/...           or split by a folder above
    <root>/left/<class>/...                     <root>/right/<class>/...                 two sensors instead of touch

They read as the manifest that they amount to, with columns vision, touch (or left, right), label, group and, where the
folders split, split. Everything that can be wrong with a manifest is said before the first image is decoded; rows are
counted from 1, the header not counted.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.columns import filled, read_controls, read_ids, read_task
from mvitac.datasets.images import decode, size_of
from mvitac.datasets.manifest import Condition, Manifest, find_manifest, list_class_folders, read_manifest
from mvitac.datasets.splits import BY_GROUP, check_leak, check_sides, check_split_names, deal
from mvitac.pack import Sample, Source
from mvitac.record import digest
from mvitac.registry import to_json
from mvitac.spec import DataSpec

VERSION = 1
"""Raised when the same manifest would give another pack."""
CONTROL_NAMES = ("majority", "pixels", "border", "untrained", "imagenet")
"""What the probe itself calls its controls."""


@dataclass(frozen=True, kw_only=True)
class FolderConfig(DatasetConfig):
    """An image folder, or a manifest naming vision path, touch path, labels, group and split."""

    name: ClassVar[str] = "folder"

    path: Path = Path("data")
    """A manifest (.csv, .parquet, .jsonl), a folder with a manifest.* in it, or a folder of class folders."""
    title: str | None = None
    """Name in results; default: the folder's name."""
    vision: str | None = None
    """Column of camera image paths; default: "vision" if there is one; "" = none."""
    touch: tuple[str, ...] = ()
    """Column of tactile image paths, or two columns (left right) to stack on channels; default: "touch", else "left"
    and "right", if there are any; "" = none."""
    labels: tuple[str, ...] = ()
    """Columns that become tasks; classes are their sorted distinct values, an empty cell or NaN is unlabelled."""
    group: str | None = None
    """Column of the unit of splits and of intervals (object, recording); default: "group" if there is one, else every
    row is alone, which is wrong for frames of one video."""
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
    controls: tuple[str, ...] = ()
    """Controls as "name=column[,column]": a logistic regression gets these columns instead of features; columns that
    are not numbers become one-hot."""
    only: tuple[str, ...] = ()
    """Rows to read, e.g. "seq<=4" "sensor=digit" "label_conflict!=1"; all conditions must hold."""
    label_only: tuple[str, ...] = ()
    """Rows whose labels count, in the same form; the others stay as unlabelled rows for pre-training."""
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
        for name, columns in self.control_columns().items():
            if not name or not all(columns):
                raise ValueError(f"control {name!r}: write it as name=column or name=column,column")
            if name in CONTROL_NAMES:
                raise ValueError(f"control {name!r} is made anyway: choose a name not among {', '.join(CONTROL_NAMES)}")
        for text in (*self.only, *self.label_only):
            Condition.parse(text)

    def control_columns(self) -> dict[str, tuple[str, ...]]:
        """Control name -> manifest columns."""
        pairs = [text.partition("=") for text in self.controls]
        if len({name.strip() for name, _, _ in pairs}) < len(pairs):
            raise ValueError(f"controls {' '.join(self.controls)}: give every control a name of its own")
        return {name.strip(): tuple(c.strip() for c in columns.split(",")) for name, _, columns in pairs}

    def source(self) -> Source:
        return Folder(self)


@dataclass(frozen=True)
class Row:
    """One manifest row, ready to be read."""

    number: int
    vision: str | None
    touch: tuple[str, ...]
    columns: dict[str, Any] = field(default_factory=dict)


class Folder(Source):
    """One item is one manifest row. Everything but the images' content is checked here, before any is decoded."""

    def __init__(self, config: FolderConfig) -> None:
        file = find_manifest(config.path)
        manifest = read_manifest(file) if file else list_class_folders(config.path)
        self._manifest_digest = manifest.digest
        self._options = {k: v for k, v in to_json(config).items() if k not in ("path", "workers", "size")}
        self._title = config.title or (config.path if config.path.is_dir() else config.path.parent).resolve().name

        vision, touch = _image_columns(config, manifest)
        labels = config.labels or (("label",) if file is None else ())
        group = config.group or ("group" if "group" in manifest.columns else None)
        split = config.split or ("split" if "split" in manifest.columns else BY_GROUP)
        conditions = [Condition.parse(text) for text in config.only]
        label_conditions = [Condition.parse(text) for text in config.label_only]
        controls = config.control_columns()
        asked = [*labels, group, config.touch_group, split if split != BY_GROUP else None]
        asked += [c.column for c in (*conditions, *label_conditions)] + [c for cs in controls.values() for c in cs]
        for column in asked:
            if column is not None:
                manifest.check(column)

        numbered = [
            (number, row)
            for number, row in enumerate(manifest.rows, 1)
            if all(condition.holds(row) for condition in conditions)
        ]
        if not numbered:
            raise ValueError(f"{manifest.file}: none of {len(manifest.rows)} rows meets {' and '.join(config.only)}")
        numbers, rows = [n for n, _ in numbered], [row for _, row in numbered]
        paths = self._check_files(manifest, numbers, rows, [c for c in (vision, *touch) if c])

        where = str(manifest.file)
        groups = filled(where, numbers, rows, group, "group")
        touch_groups = filled(where, numbers, rows, config.touch_group, "touch_group") if config.touch_group else groups
        counts = [all(condition.holds(row) for condition in label_conditions) for row in rows]
        tasks, targets = [], []
        for column in labels:
            task, target = read_task(where, column, rows, counts)
            tasks.append(task)
            targets.append(target)
        if split == BY_GROUP:
            splits = deal(groups, targets, config.test_share, config.val_share, config.split_seed)
        else:
            splits = filled(where, numbers, rows, split, "split")
            check_split_names(where, split, numbers, splits)
        if not config.allow_leak:
            check_leak(where, split, f"groups ({group})", groups, splits)
            check_leak(where, split, f"touch groups ({config.touch_group or group})", touch_groups, splits)
            for column in [c for c in (vision, *touch) if c]:
                check_leak(where, split, f"{column} images", [row[column] for row in rows], splits)
        check_sides(where, split, splits, tasks, targets, len(set(groups)))

        extra, names = read_controls(where, controls, numbers, rows, targets)
        images = {c for c in (vision, *touch) if c}
        ids = read_ids(where, manifest, numbers, rows)
        self._rows: list[Row] = []
        for i, row in enumerate(rows):
            carried = {name: cell for name, cell in row.items() if name not in images}
            own = {"id": ids[i], "group": groups[i], "touch_group": touch_groups[i], "split": splits[i]}
            own |= {f"label_{task.name}": target[i] for task, target in zip(tasks, targets, strict=True)}
            found = iter(paths[i])
            first = next(found) if vision else None
            # Column order is part of the pack's digest: ours first, then the manifest's that we do not interpret.
            columns = {
                **own,
                **{k: v for k, v in carried.items() if k not in own},
                **{k: v[i] for k, v in extra.items()},
            }
            self._rows.append(Row(numbers[i], first, tuple(found), columns))
        self._spec = DataSpec(
            name=self._title,
            vision_channels=3 if vision else 0,
            touch_channels=3 * len(touch),
            tasks=tuple(tasks),
            group_by=group or "row",
            controls=names,
            licence=config.licence,
            source=config.source_url or "not given",
        )

    def _check_files(
        self, manifest: Manifest, numbers: list[int], rows: list[dict[str, str]], columns: list[str]
    ) -> list[list[str]]:
        """Image paths per row, in the order of ``columns``; keeps their sizes for the fingerprint."""
        paths: list[list[str]] = []
        root = str(manifest.root)
        missing: list[str] = []
        self._sizes: list[int] = []
        for number, row in zip(numbers, rows, strict=True):
            for column in columns:
                if not row[column]:
                    raise ValueError(
                        f"{manifest.file} row {number} has no {column} path: fill it, or leave the row out (only)"
                    )
            paths.append([os.path.join(root, row[column]) for column in columns])
            for column, path in zip(columns, paths[-1], strict=True):
                size = size_of(path)
                self._sizes.append(size)
                if size <= 0:
                    missing.append(f"row {number} {column} {row[column]}{' (0 bytes)' if size == 0 else ''}")
        if missing:
            raise ValueError(
                f"{manifest.file}: {len(missing)} of {len(self._sizes)} image files are missing or empty, e.g."
                f" {'; '.join(missing[:3])} (paths are relative to {manifest.root})"
            )
        return paths

    def spec(self) -> DataSpec:
        return self._spec

    def items(self) -> list[str]:
        return [f"row {row.number}" for row in self._rows]

    def fingerprint(self) -> dict[str, Any]:
        return {
            "reader": f"folder {VERSION}",
            "title": self._title,
            "manifest": self._manifest_digest,
            "file_sizes": digest(self._sizes),
            "options": self._options,
        }

    def read(self, item: int) -> list[Sample]:
        row = self._rows[item]
        touches = [decode(path) for path in row.touch]
        if len(touches) == 2 and touches[0].shape != touches[1].shape:
            (h, w, _), (h2, w2, _) = touches[0].shape, touches[1].shape
            raise ValueError(
                f"{row.touch[0]} is {w} x {h}, {row.touch[1]} is {w2} x {h2}: stacked sensors need one size"
            )
        touch = np.concatenate(touches, axis=2) if touches else None
        return [Sample(vision=decode(row.vision) if row.vision else None, touch=touch, columns=row.columns)]


def _image_columns(config: FolderConfig, manifest: Manifest) -> tuple[str | None, tuple[str, ...]]:
    """The columns of vision and touch paths, asked for or found by their usual names."""
    have = manifest.columns
    vision = ("vision" if "vision" in have else None) if config.vision is None else config.vision or None
    if config.touch:
        touch = tuple(c for c in config.touch if c)
    else:
        touch = ("touch",) if "touch" in have else ("left", "right") if {"left", "right"} <= set(have) else ()
    for column in (vision, *touch):
        if column:
            manifest.check(column)
    if not (vision or touch):
        raise ValueError(
            f"{manifest.file} has no column vision, touch, or left and right (it has {', '.join(have)}):"
            " name the image columns by vision and touch"
        )
    return vision, touch
