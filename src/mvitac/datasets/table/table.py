"""Reads a table of samples: labels, groups, splits, controls, and the images that its rows refer to.

The table is checked completely before the first image is decoded.
"""

import math
import os
import re
from abc import ABC
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from mvitac.data.pack_table import SPLITS
from mvitac.data.source import Lost, Sample, Source, one_stamp
from mvitac.data.spec import AnyTask, DataSpec
from mvitac.datasets.base import KEEPING
from mvitac.datasets.table import clocks, columns, image_columns, splits
from mvitac.datasets.table.columns import all_hold, value_task
from mvitac.datasets.table.image_columns import Background
from mvitac.datasets.table.image_refs import span_of
from mvitac.datasets.table.manifest import Manifest
from mvitac.datasets.table.options import TableOptions
from mvitac.datasets.table.read_rows import Row, bundles, read_rows
from mvitac.datasets.table.splits import BY_GROUP
from mvitac.registry import check_range, to_json, unknown

VERSION = 3  # version of this reader. Increase it when the same table would give another pack.
MAX_TOGETHER = 1024  # rows of one video that are read in one pass, if their images fit into ``MAX_TOGETHER_BYTES``
MAX_TOGETHER_BYTES = 600 << 20
"""Memory per worker for these images at the stored size: 1024 rows of two gels and a camera at 256 px."""


@dataclass(frozen=True, kw_only=True)
class RowsConfig(TableOptions, ABC):
    """A dataset that is a table."""

    def source(self) -> Source:
        return Rows(self)


@dataclass(frozen=True, kw_only=True)
class RecordedConfig(RowsConfig, ABC):
    """Options of tables whose rows may be frames of recordings, which follow each other closely."""

    every: int | None = None
    """Use every n-th frame of a recording; by default all images, every row of an episode, and every fifth frame of a
    video or image of a bag. Rows of a table are all used."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.every is not None:
            check_range(self, 1, math.inf, "every")


class Rows(Source):
    """Reads a table. An item is one row, or the rows of one video (one row group, ...), which are read in one pass."""

    def __init__(self, config: TableOptions) -> None:
        self._config = config
        self._title = config.title or (config.path if config.path.is_dir() else config.path.parent).resolve().name
        table = columns.with_elements(self._joined(config.manifest()), config.numbers())
        self._digest = table.digest
        self._vision, self._touch = image_columns.find(table, config.vision, config.touch)
        self._images = tuple(column for column in (self._vision, *self._touch) if column)
        self._group = config.group or ("group" if "group" in table.columns else table.group)
        self._split = config.split or ("split" if "split" in table.columns else BY_GROUP)
        self._sensor = config.sensor or ("sensor" if "sensor" in table.columns else None)
        label_columns = config.labels or table.labels
        value_tasks = [value_task(text) for text in config.values]
        targets = [target.name for task in value_tasks for target in task.targets]
        split = None if self._split == BY_GROUP else self._split
        table.check(*label_columns, *targets, self._group, split, self._sensor, config.touch_group)
        table.check(*config.conditioned(), *(c for used in config.control_columns().values() for c in used))

        table, grounds = self._select(table)
        asked = {"vision": self._images[: bool(self._vision)], "touch": self._touch}
        missing = image_columns.check_present(table, asked, config.allow_missing)
        stamps = image_columns.check_files(table, self._images, grounds)

        group_by, groups = self._grouping(table)
        touch_groups = table.filled(config.touch_group, "touch_group") if config.touch_group else groups
        counts = all_hold(config.label_only, table)
        read = [columns.read_task(table, column, counts) for column in label_columns]
        values, measured = columns.read_values(table, value_tasks, counts)
        tasks, labels = [*(task for task, _ in read), *value_tasks], [*(label for _, label in read), *measured]
        assigned = self._assign(table, {f"groups ({group_by})": groups, "touch groups": touch_groups}, tasks, labels)
        controls = config.control_columns()
        extra = columns.read_controls(table, dict.fromkeys(c for used in controls.values() for c in used), labels)

        own: dict[str, Sequence[Any]] = {"id": table.ids(), "group": groups, "touch_group": touch_groups}
        own |= {"split": assigned, **{f"label_{task.name}": label for task, label in read}}
        columns.check_names(table, [*values, *extra], {*own, "sensor"})
        own |= values | {f"has_{m}": [not lacks for lacks in lacking] for m, lacking in missing.items()}
        self._rows = self._make_rows(table, grounds, own, extra)

        row_bytes = 3 * config.size**2 * len(self._images)
        self._items = bundles(self._rows, max(1, min(MAX_TOGETHER, MAX_TOGETHER_BYTES // row_bytes)))
        used = [[ref for i in item for ref in self._rows[i].refs()] for item in self._items]
        self._stamps = [one_stamp(stamps[ref.path] for ref in refs) for refs in used]
        self._spec = DataSpec(
            name=self._title,
            vision_channels=3 if self._vision else 0,
            touch_channels=3 * len(self._touch),
            tasks=tuple(task for task, _ in read),
            values=tuple(value_tasks),
            group_by=group_by,
            controls=controls,
            licence=config.licence,
            source=config.source_url or "not given",
            notes=self._notes(table, group_by, assigned, {task.name: label for task, label in read}),
            difference=config.difference,
        )

    def _scaled(self, table: Manifest) -> tuple[str, ...]:
        """Say what is cropped, and how more than 8 bits become gray levels, judged by the first image of each column."""
        notes = [f"{text} is the part of the images that is used, squeezed to a square" for text in self._config.crop]
        for column in self._images:
            ref = next((ref for ref in table.images[column] if ref), None)
            if ref and (span := span_of(ref)):
                notes.append("{} has more than 8 bits: {:g} is black, {:g} white".format(column, *span))
        return tuple(notes)

    def _joined(self, table: Manifest) -> Manifest:
        """Return ``table`` with the columns of the logs."""
        config, names = self._config, ("touch", "left", "right", "vision")
        images = [name for name in (*config.touch, config.vision, *names) if name]
        how: Any = {"tolerance": config.tolerance, "linear": config.interpolate == "linear"}
        return clocks.join(table, config.log, images, numbers=config.numbers(), **how) if config.log else table

    def _select(self, table: Manifest) -> tuple[Manifest, list[Background]]:
        """Return the rows that become samples with their images, and the background of each (none for raw images)."""
        config = self._config
        backgrounds = (config.background or ("background",)) if config.difference and not config.no_contact else ()
        table.check(*backgrounds)
        paths = {*self._images, *(config.background or ("background",))}
        table = table.resolved((*self._images, *backgrounds), paths)
        if (looks := config.looks()) or config.bgr:
            table.check(*looks)
            like = dict(zip(backgrounds, self._touch, strict=False))  # a background is cropped as its touch
            how = {column: looks.get(like.get(column, column), {}) | {"bgr": config.bgr} for column in table.images}
            seen = {c: [ref and replace(ref, **how[c]) for ref in refs] for c, refs in table.images.items()}
            table = replace(table, images=seen)
        table = table.kept(all_hold(config.only, table), f"no row meets {' and '.join(config.only)}")
        if not config.no_contact and not config.difference:
            return table, []
        empty = all_hold(config.no_contact, table) if config.no_contact else None
        grounds = image_columns.backgrounds(table, self._touch, config.background, self._sensor, empty)
        if empty is None:
            return table, grounds
        kept = [not none for none in empty]
        grounds = [ground for ground, keep in zip(grounds, kept, strict=True) if keep]
        return table.kept(kept, f"every row meets {' and '.join(config.no_contact)}"), grounds

    def _grouping(self, table: Manifest) -> tuple[str, list[str]]:
        """Return what a group is, and the group of each row."""
        if self._group:
            return self._group, table.filled(self._group, "group")
        return splits.group_by_video(table.root, table.numbers, [table.images[column] for column in self._images])

    def _assign(
        self,
        table: Manifest,
        whole: dict[str, list[str]],
        tasks: Sequence[AnyTask],
        labels: Sequence[Sequence[int]],
    ) -> list[str]:
        """Return the split of each row, from its column or assigned by group; those of one ``whole`` are in one."""
        config, column, where = self._config, self._split, str(table.path)
        groups = next(iter(whole.values()))
        if column == BY_GROUP:
            found = splits.assign_splits(groups, labels, config.test_share, config.val_share, config.split_seed)
        else:
            found = table.filled(column, "split")
            for number, split in zip(table.numbers, found, strict=True):
                if split not in SPLITS:
                    raise ValueError(f"{where} row {number}: {unknown(f'split in column {column!r}', split, SPLITS)}")
        if not config.allow_leak:
            for what, names in whole.items():
                splits.check_leak(where, column, what, names, found)
            for name in self._images:
                there = [(ref, side) for ref, side in zip(table.images[name], found, strict=True) if ref]
                images = [os.path.normpath(str(ref)) for ref, _ in there]
                splits.check_leak(where, column, f"{name} images", images, [side for _, side in there])
        splits.check_sides(where, column, found, tasks, labels, len(set(groups)))
        return found

    def _notes(
        self, table: Manifest, group_by: str, assigned: Sequence[str], labels: dict[str, list[int]]
    ) -> tuple[str, ...]:
        """What results say about logs, and about groups that no column names."""
        told = (*table.notes, *self._scaled(table))
        if group_by == "video":
            return (*told, "no column says the groups, so frames of one video are one group")
        if group_by != "row":
            return told
        known = {*labels, self._split, self._sensor, *self._images}
        texts = {name: [row[name] for row in table.rows] for name in table.rows[0] if name not in known}
        for column in self._images:  # file names up to their last number
            files = (os.path.splitext(os.path.basename(ref.path))[0] if ref else "" for ref in table.images[column])
            if (stems := [re.sub(r"\d+\D*$", "", file) for file in files]) not in texts.values():
                texts[f"{column} files"] = stems
        return (*told, columns.ungrouped(texts, assigned, [*labels.values()]))

    def _make_rows(
        self,
        table: Manifest,
        grounds: Sequence[Background],
        own: dict[str, Sequence[Any]],
        extra: dict[str, list[float]],
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
        return {
            "reader": f"{self._config.name} {VERSION}",
            "title": self._title,
            "manifest": self._digest,
            "options": {k: v for k, v in to_json(self._config).items() if k not in ("path", *KEEPING)},
        }

    def stamps(self) -> list[int]:
        return self._stamps

    def read(self, item: int) -> list[Sample | Lost]:
        return read_rows([self._rows[i] for i in self._items[item]], self._config.size)
