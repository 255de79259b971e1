"""From a manifest's text to a pack's columns: labels, controls, groups, ids."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from mvitac.data.pack import SPLITS
from mvitac.data.spec import Task
from mvitac.datasets.table.manifest import Manifest, number_of

MAX_ONE_HOT = 64


def read_task(
    where: str, column: str, rows: Sequence[dict[str, str]], counts: Sequence[bool]
) -> tuple[Task, list[int]]:
    """The task of a label column, and its class number per row (-1 = unlabelled or not counted)."""
    cells = [row[column] if counted else "" for row, counted in zip(rows, counts, strict=True)]
    names = {cell for cell in cells if cell}
    labelled = sum(bool(cell) for cell in cells)
    if len(names) < 2:
        what = f"only the class {min(names)!r}" if names else "no labels"
        raise ValueError(f"{where}: column {column!r} has {what} in {len(rows)} rows: a task needs two classes")
    if len(names) == labelled >= 10:
        raise ValueError(
            f"{where}: column {column!r} has another value in each of its {labelled} rows (e.g. {min(names)!r}):"
            " classes must repeat; is it a measurement or a name?"
        )
    if all(number_of(name) is not None for name in names):
        classes = sorted(names, key=lambda name: (float(name), name))
    else:
        classes = sorted(names)
    places = {name: i for i, name in enumerate(classes)}
    return Task(name=column, classes=tuple(classes)), [places.get(cell, -1) for cell in cells]


def read_controls(
    where: str,
    controls: dict[str, tuple[str, ...]],
    numbers: Sequence[int],
    rows: Sequence[dict[str, str]],
    targets: Sequence[Sequence[int]],
) -> tuple[dict[str, list[float]], dict[str, tuple[str, ...]]]:
    """Numeric columns for the pack, and which of them every control uses."""
    labelled = [any(target[i] >= 0 for target in targets) for i in range(len(rows))]
    made: dict[str, dict[str, list[float]]] = {}
    for column in dict.fromkeys(c for columns in controls.values() for c in columns):
        cells = [row[column] for row in rows]
        empty = [n for n, cell, counted in zip(numbers, cells, labelled, strict=True) if counted and not cell]
        if empty:
            raise ValueError(
                f"{where}: control column {column!r} is empty in {len(empty)} labelled rows, first row {empty[0]}"
            )
        values = [number_of(cell) for cell in cells]
        if all(value is not None or not cell for value, cell in zip(values, cells, strict=True)):
            # An unlabelled row is never probed; 0 stands for its gap.
            made[column] = {column: [value or 0.0 for value in values]}
            continue
        names = sorted({cell for cell in cells if cell})
        if len(names) > MAX_ONE_HOT:
            raise ValueError(
                f"{where}: control column {column!r} has {len(names)} values that are not numbers, e.g. {names[0]!r}:"
                f" at most {MAX_ONE_HOT} become one-hot"
            )
        made[column] = {f"{column}={name}": [float(cell == name) for cell in cells] for name in names}
    columns = {name: values for each in made.values() for name, values in each.items()}
    return columns, {name: tuple(c for column in given for c in made[column]) for name, given in controls.items()}


def filled(where: str, numbers: Sequence[int], rows: Sequence[dict[str, str]], column: str, what: str) -> list[str]:
    """The cells of ``column``, none of them empty."""
    empty = [number for number, row in zip(numbers, rows, strict=True) if not row[column]]
    if empty:
        hint = f"; write one of {', '.join(SPLITS)}" if what == "split" else ""
        raise ValueError(
            f"{where}: column {column!r} ({what}) is empty in {len(empty)} rows, first row {empty[0]}{hint}"
        )
    return [row[column] for row in rows]


def read_ids(where: str, manifest: Manifest, numbers: Sequence[int], rows: Sequence[dict[str, str]]) -> list[str]:
    """The column "id" if there is one, else the row numbers."""
    if "id" not in manifest.columns:
        return [f"{number:06d}" for number in numbers]
    ids = filled(where, numbers, rows, "id", "id")
    twice = [name for name, count in Counter(ids).items() if count > 1]
    if twice:
        raise ValueError(f"{where}: id {twice[0]!r} stands in several rows: ids must differ")
    return ids
