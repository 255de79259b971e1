"""Converts a manifest's text cells to a pack's columns: labels, controls, groups, splits and ids."""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from mvitac.data.checks.table_checks import KEYS
from mvitac.data.pack_table import SPLITS
from mvitac.data.spec import UNGROUPED, Target, Task, ValueTask, listed
from mvitac.datasets.table.image_columns import Selection
from mvitac.datasets.table.manifest import Manifest, number_of, text_of

MAX_ONE_HOT = 64


@dataclass(frozen=True, kw_only=True)
class Grouping:
    """The group and touch group of each row, and what they are called."""

    groups: list[str]
    group_by: str
    touch_groups: list[str]
    touch_group_by: str


def read_task(selected: Selection, column: str, counts: Sequence[bool]) -> tuple[Task, list[int]]:
    """Return the task of a label column and its class number per row, -1 if unlabelled or not in ``counts``."""
    cells = [row[column] if counted else "" for row, counted in zip(selected.rows, counts, strict=True)]
    names = {cell for cell in cells if cell}
    labelled = sum(bool(cell) for cell in cells)
    if len(names) < 2:
        what = f"only the class {min(names)!r}" if names else "no labels"
        raise ValueError(f"{selected.where}: column {column!r} has {what} in {len(cells)} rows: a task needs two")
    if len(names) == labelled >= 10:
        raise ValueError(
            f"{selected.where}: column {column!r} has another value in each of its {labelled} rows (e.g."
            f" {min(names)!r}): classes must repeat; a measurement is named with --values {column}:UNIT"
        )
    if all(number_of(name) is not None for name in names):
        classes = sorted(names, key=lambda name: (float(name), name))
    else:
        classes = sorted(names)
    labels = {name: i for i, name in enumerate(classes)}
    return Task(name=column, classes=tuple(classes)), [labels.get(cell, -1) for cell in cells]


def element_of(name: str) -> tuple[str, int]:
    """Return the vector and the number of the element that ``name`` is: state[2] is ("state", 2); else ("", 0)."""
    found = re.fullmatch(r"(.+)\[(\d+)\]", name)
    return (found[1], int(found[2])) if found else ("", 0)


def with_elements(manifest: Manifest, names: Iterable[str]) -> Manifest:
    """Return ``manifest`` with a column for each of ``names`` that is an element of a vector, e.g. state[2], from 0."""
    made: dict[str, list[str]] = {}
    for name in names:
        vector, number = element_of(name)
        if name in manifest.columns or vector not in manifest.columns:
            continue
        cells = [[part.strip() for part in row.get(vector, "").strip("[]()").split(",")] for row in manifest.rows]
        if number >= (longest := max(map(len, cells))):
            raise ValueError(
                f"{manifest.file}: {name} does not exist: {vector} has {longest} numbers, {vector}[0] to"
                f" {vector}[{longest - 1}]"
            )
        found = (cell[number] if number < len(cell) else "" for cell in cells)
        made[name] = ["" if text == "None" else text_of(text) for text in found]
    if not made:
        return manifest
    rows = [{**row, **{name: cells[i] for name, cells in made.items()}} for i, row in enumerate(manifest.rows)]
    return replace(manifest, columns=(*manifest.columns, *made), rows=rows)


def value_task(text: str) -> ValueTask:
    """Parse "force_n:N", or "pose=z_mm:mm,tilt_deg:deg" for a task with several targets."""
    name, _, listed = text.rpartition("=")
    pairs = [part.strip().rpartition(":") for part in listed.split(",")]
    if not all(column and unit for column, _, unit in pairs) or len({column for column, _, _ in pairs}) < len(pairs):
        raise ValueError(f"values {text!r}: write column:unit, or name=column:unit,column:unit, e.g. force_n:N")
    if not name and len(pairs) > 1:
        raise ValueError(f"values {text!r}: give several columns one name, e.g. pose={listed}")
    targets = tuple(Target(name=column, unit=unit) for column, _, unit in pairs)
    return ValueTask(name=name.strip() or targets[0].name, targets=targets)


def read_values(
    selected: Selection, tasks: Sequence[ValueTask], counts: Sequence[bool]
) -> tuple[dict[str, list[float]], list[list[int]]]:
    """Return the columns of numbers of ``tasks``, NaN where a cell is empty or its row does not count.

    For each task also 0 for the rows with a value and -1 for the others, like the labels of a task with one class.
    """
    columns: dict[str, list[float]] = {}
    for target in (target for task in tasks for target in task.targets):
        columns[target.name] = [math.nan] * len(counts)
        for i, (row, counted) in enumerate(zip(selected.rows, counts, strict=True)):
            if counted and (cell := row[target.name]):
                value = number_of(cell)
                if value is None:
                    raise ValueError(
                        f"{selected.manifest.at(selected.numbers[i])}: {target.name} is {cell!r}: give a finite number in"
                        f" {target.unit} without the unit, or leave the cell empty"
                    )
                columns[target.name][i] = value
    for name, found in columns.items():
        if len({value for value in found if value == value}) < 2:  # NaN differs from itself
            raise ValueError(f"{selected.where}: column {name!r} has fewer than two different values")
    known = [
        [0 if any(not math.isnan(columns[t.name][i]) for t in task.targets) else -1 for i in range(len(counts))]
        for task in tasks
    ]
    return columns, known


def check_names(where: str, names: Iterable[str], own: Collection[str]) -> None:
    """Raise ValueError if a column of numbers has one of the names that packing gives: it would replace that column."""
    for name in names:
        if name in own or name.startswith(("has_", "crc_", "bytes_")):
            raise ValueError(
                f"{where}: column {name!r} has the name of one of the pack itself: copy it to another name"
            )


def read_controls(
    selected: Selection, controls: dict[str, tuple[str, ...]], labels: Sequence[Sequence[int]]
) -> tuple[dict[str, list[float]], dict[str, tuple[str, ...]]]:
    """Return numeric pack columns for ``controls``, and the names of the columns that each control uses."""
    labelled = [any(task[i] >= 0 for task in labels) for i in range(len(selected.rows))]
    made = {c: _numeric(selected, c, labelled) for c in dict.fromkeys(c for given in controls.values() for c in given)}
    columns = {name: values for each in made.values() for name, values in each.items()}
    return columns, {name: tuple(c for column in given for c in made[column]) for name, given in controls.items()}


def _numeric(selected: Selection, column: str, labelled: Sequence[bool]) -> dict[str, list[float]]:
    """Return ``column`` as numbers, or one-hot columns if it holds text."""
    cells = [row[column] for row in selected.rows]
    empty = [n for n, cell, needed in zip(selected.numbers, cells, labelled, strict=True) if needed and not cell]
    if empty:
        raise ValueError(
            f"{selected.where}: control column {column!r} is empty in {len(empty)} labelled rows, first row {empty[0]}"
        )
    values = [number_of(cell) for cell in cells]
    if all(value is not None or not cell for value, cell in zip(values, cells, strict=True)):
        return {column: [value or 0.0 for value in values]}  # an empty cell is unlabelled, so never probed: any number
    names = sorted({cell for cell in cells if cell})
    if len(names) > MAX_ONE_HOT:
        raise ValueError(
            f"{selected.where}: control column {column!r} has {len(names)} values that are not numbers, e.g."
            f" {names[0]!r}: at most {MAX_ONE_HOT} become one-hot"
        )
    return {f"{column}={name}": [float(cell == name) for cell in cells] for name in names}


def ungrouped(texts: Mapping[str, Sequence[str]], splits: Sequence[str], labels: Sequence[Sequence[int]]) -> str:
    """Say that every row is its own group, and which texts repeat themselves in train and in test.

    ``texts``: the cells of each column. Those that hold numbers, or say the same as a label, are no names of objects.
    """
    found = []
    for name, cells in texts.items():
        values = set(cells) - {""}
        if values <= set(SPLITS) or (name not in KEYS and all(number_of(value) is not None for value in values)):
            continue
        if not 1 < len(values) <= len(cells) / 2 or any(_renames(cells, label) for label in labels):
            continue
        test = {cell for cell, split in zip(cells, splits, strict=True) if split == "test"} - {""}
        train = {cell for cell, split in zip(cells, splits, strict=True) if split != "test"}
        if both := test & train:
            found.append(f"{name} {len(both)} of {len(test)}")
    shared = f" (of those in test, also in train: {listed(found, 6)})" if found else ""
    return (
        f"{UNGROUPED}, so every row is its own group: where rows show one object or recording, scores are too high and"
        f" intervals too narrow{shared}"
    )


def _renames(cells: Sequence[str], labels: Sequence[int]) -> bool:
    """Whether each cell stands for one label and each label for one cell."""
    pairs = {(cell, label) for cell, label in zip(cells, labels, strict=True) if cell and label >= 0}
    return len(pairs) == len({cell for cell, _ in pairs}) == len({label for _, label in pairs})
