"""Converts a table's text cells to a pack's columns: labels, values, controls. And conditions on rows."""

import math
import operator
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from mvitac.data.checks.table_checks import KEYS
from mvitac.data.pack_table import SPLITS
from mvitac.data.spec import UNGROUPED, Target, Task, ValueTask, listed
from mvitac.data.stamps import number_of
from mvitac.datasets.table.manifest import Manifest, Row, normal, text_of

COMPARE: dict[str, Callable[[float, float], bool]] = {"<=": operator.le, ">=": operator.ge}


@dataclass(frozen=True)
class Condition:
    """A row filter: a column, one of = != <= >=, and a value."""

    column: str
    sign: str
    value: str

    @classmethod
    def parse(cls, text: str) -> "Condition":
        match = re.fullmatch(r"\s*([^<>=!]+?)\s*(<=|>=|!=|=)\s*([^<>=!]*?)\s*", text)
        if match is None or (match[2] in COMPARE and number_of(match[3]) is None):
            raise ValueError(f"condition {text!r}: write column=value, column!=value, column<=number or column>=number")
        return cls(*match.groups())

    def holds(self, row: Row) -> bool:
        """Return whether ``row`` meets the condition; an empty cell is neither <= nor >= anything."""
        cell, wanted = row[self.column], normal(text_of(self.value))
        if self.sign in COMPARE:
            number = number_of(cell)
            return number is not None and COMPARE[self.sign](number, float(wanted))
        if wanted.casefold() in ("true", "false"):
            cell, wanted = cell.casefold(), wanted.casefold()
        elif "." in cell + wanted and None not in (numbers := (number_of(cell), number_of(wanted))):  # 0.10 is 0.1
            return (numbers[0] == numbers[1]) == (self.sign == "=")
        return (cell == wanted) == (self.sign == "=")


def all_hold(conditions: Iterable[str], table: Manifest) -> list[bool]:
    parsed = [Condition.parse(text) for text in conditions]
    return [all(condition.holds(row) for condition in parsed) for row in table.rows]


def read_task(table: Manifest, column: str, counts: Sequence[bool]) -> tuple[Task, list[int]]:
    """Return the task of a label column and its class number per row, -1 if unlabelled or not in ``counts``."""
    cells = [row[column] if counted else "" for row, counted in zip(table.rows, counts, strict=True)]
    names = {cell for cell in cells if cell}
    labelled = sum(bool(cell) for cell in cells)
    if len(names) < 2:
        what = f"only the class {min(names)!r}" if names else "no labels"
        raise ValueError(f"{table.path}: column {column!r} has {what} in {len(cells)} rows: a task needs two")
    if len(names) == labelled >= 10:
        hint = f"a measurement is --values {column}:UNIT"
        raise ValueError(f"{table.path}: column {column!r} has another value in each of its {labelled} rows: {hint}")
    numbers = all(number_of(name) is not None for name in names)
    classes = sorted(names, key=lambda name: (float(name), name)) if numbers else sorted(names)
    labels = {name: i for i, name in enumerate(classes)}
    return Task(name=column, classes=tuple(classes)), [labels.get(cell, -1) for cell in cells]


def element_of(name: str) -> tuple[str, int]:
    """Return the vector and the number of the element that ``name`` is: state[2] is ("state", 2); else ("", 0)."""
    found = re.fullmatch(r"(.+)\[(\d+)\]", name)
    return (found[1], int(found[2])) if found else ("", 0)


def with_elements(table: Manifest, names: Iterable[str]) -> Manifest:
    """Return ``table`` with a column for each of ``names`` that is an element of a vector, e.g. state[2], from 0."""
    rows = table.rows
    for name in names:
        vector, number = element_of(name)
        if name in table.columns or vector not in table.columns:
            continue
        cells = [[part.strip() for part in row[vector].strip("[]()").split(",")] for row in rows]
        for i, cell in enumerate(cells):
            if number >= len(cell) and text_of(cell[0]) not in ("", "None"):
                has = f"{vector} has {len(cell)} numbers, counted from 0"
                raise ValueError(f"{table.at(i)}: {name} does not exist: {has}")
            if any("[" in part for part in cell):
                raise ValueError(f"{table.at(i)}: {vector} has lists in a list: write them as one, or as columns")
        texts = (cell[number] if number < len(cell) else "" for cell in cells)
        found = ["" if text == "None" else text_of(text) for text in texts]
        rows = [{**row, name: text} for row, text in zip(rows, found, strict=True)]
    return replace(table, rows=rows)


def value_task(text: str) -> ValueTask:
    """Parse "force_n:N", or "pose=z_mm:mm,tilt_deg:deg" for a task with several targets."""
    name, named, listed = text.rpartition("=")
    pairs = [part.strip().rpartition(":") for part in listed.split(",")]
    if not all(column and unit for column, _, unit in pairs) or len({column for column, _, _ in pairs}) < len(pairs):
        raise ValueError(f"values {text!r}: write column:unit, or name=column:unit,column:unit, e.g. force_n:N")
    if not name.strip() and (named or len(pairs) > 1):
        raise ValueError(f"values {text!r}: give the columns one name, e.g. pose={listed}")
    targets = tuple(Target(name=column, unit=unit) for column, _, unit in pairs)
    return ValueTask(name=name.strip() or targets[0].name, targets=targets)


def read_values(
    table: Manifest, tasks: Sequence[ValueTask], counts: Sequence[bool]
) -> tuple[dict[str, list[float]], list[list[int]]]:
    """Return the columns of numbers of ``tasks``, NaN where a cell is empty or its row does not count.

    For each task also 0 for the rows with a value and -1 for the others, like the labels of a task with one class.
    """
    columns: dict[str, list[float]] = {}
    for target in (target for task in tasks for target in task.targets):
        columns[target.name] = [math.nan] * len(counts)
        for i, (row, counted) in enumerate(zip(table.rows, counts, strict=True)):
            if counted and (cell := row[target.name]):
                if (value := number_of(cell)) is None:
                    of = f"an element, such as {target.name}[0]" if cell[0] in "[(" else "a finite number, or nothing"
                    raise ValueError(f"{table.at(i)}: {target.name} is {cell!r}: give {of}")
                columns[target.name][i] = value
    for name, found in columns.items():
        if len({value for value in found if value == value}) < 2:  # NaN differs from itself
            raise ValueError(f"{table.path}: column {name!r} has fewer than two different values")
    found = ([columns[target.name] for target in task.targets] for task in tasks)
    return columns, [[-1 if all(map(math.isnan, row)) else 0 for row in zip(*each, strict=True)] for each in found]


def check_names(table: Manifest, names: Iterable[str], own: Collection[str]) -> None:
    """Raise ValueError if a column of numbers has one of the names that packing gives: it would replace that column."""
    for name in names:
        if name in own or name.startswith(("has_", "crc_", "bytes_")):
            raise ValueError(f"{table.path}: column {name!r} has a name of the pack itself: copy it to another name")


def read_controls(table: Manifest, columns: Iterable[str], labels: Sequence[Sequence[int]]) -> dict[str, list[float]]:
    """Return the numbers of control ``columns``; a row without a label may lack them, as no probe reads it: 0."""
    labelled = [any(task[i] >= 0 for task in labels) for i in range(len(table.rows))]
    made: dict[str, list[float]] = {}
    for column in columns:
        values = [number_of(row[column]) for row in table.rows]
        for i, value in enumerate(values):
            if labelled[i] and (value is None or abs(value) > 1e30):  # which probes could not square
                cell = f"{column!r} is {table.rows[i][column]!r}, not a number below 1e30"
                raise ValueError(f"{table.at(i)} is labelled, and control column {cell}")
        made[column] = [value or 0.0 for value in values]
    return made


def ungrouped(column: str | None, texts: Mapping[str, Sequence[str]], splits: Sequence[str]) -> list[str]:
    """Say that every row is its own group, and which texts repeat themselves in train and in test.

    ``column`` is that of the groups, of which nothing is said if no text does. ``texts``: the cells of each column. Those
    that hold numbers, or other splits, are no names of objects.
    """
    found = []
    for name, cells in texts.items():
        values = set(cells) - {""}
        numbers = name not in KEYS and all(number_of(value) is not None for value in values)
        if numbers or values <= set(SPLITS) or not 1 < len(values) <= len(cells) / 2:
            continue
        test = {cell for cell, split in zip(cells, splits, strict=True) if split == "test"} - {""}
        if both := test & {cell for cell, split in zip(cells, splits, strict=True) if split != "test"}:
            found.append(f"{name} {len(both)} of {len(test)}")
    shared = f" (of those in test, also in train: {listed(found, 6)})" if found else ""
    why = f"column {column} has another value in each row" if column else "no --group was given"
    wide = f"{why}, {UNGROUPED}: where rows show one object or recording, scores are too high and intervals too narrow"
    return [] if column and not found else [wide + shared]
