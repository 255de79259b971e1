"""The table and the tasks of several packs as one (``data/mixed_pack.py``)."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import pyarrow as pa

from mvitac.data.pack import Pack
from mvitac.data.spec import MODALITIES, AnyTask, DataSpec, Task, ValueTask

OWN = re.compile(r"(id|group|touch_group|press|part|sensor|(has|crc|bytes|label)_.*)")
"""Columns that are not taken over as they are."""

Renamed = Mapping[str, Mapping[str, str]]  # part -> column of its table -> name of that column in the mix


def renamed_columns(parts: Mapping[str, Pack]) -> Renamed:
    """Names of all columns that are taken over.

    A name becomes <part>/<name> if its columns differ in kind or unit, or only some of them are a task's or a control's.
    """
    kinds: dict[str, set[str]] = {}
    for pack in parts.values():
        uses = {target.name: f" in {target.unit}" for task in pack.spec.values for target in task.targets}
        uses |= {c: f"{uses.get(c, '')}, control" for used in pack.spec.controls.values() for c in used}
        for column in pack.table.schema:
            if not OWN.fullmatch(column.name) and not pa.types.is_null(column.type):
                kinds.setdefault(column.name, set()).add(_kind(column.type) + uses.get(column.name, ""))
    same = {name for name, found in kinds.items() if len(found) == 1}
    taken = {part: [n for n in pack.table.column_names if n in kinds] for part, pack in parts.items()}
    return {part: {n: n if n in same else f"{part}/{n}" for n in names} for part, names in taken.items()}


def _kind(column: pa.DataType) -> str:
    number = pa.types.is_integer(column) or pa.types.is_floating(column)
    return "number" if number else "text" if pa.types.is_string(column) else str(column)


class MixedTasks:
    """Tasks and controls of the parts. Equal ones with one name are one; others of one name become <part>/<name>.

    Attributes:
        of: (part, name in the part) -> the task in the mix.
        controls: Control -> columns.
    """

    def __init__(self, parts: Mapping[str, Pack], columns: Renamed) -> None:
        tasks = [(part, task) for part, pack in parts.items() for task in pack.spec.all_tasks]
        given = {(part, task.name): _renamed(task, columns[part]) for part, task in tasks}
        alike: dict[str, set[object]] = {}
        for (_, name), task in given.items():
            alike.setdefault(name, set()).add(_meaning(task))
        self.of: dict[tuple[str, str], AnyTask] = {}
        first: dict[str, AnyTask] = {}
        for (part, name), task in given.items():
            own = replace(task, name=f"{part}/{task.name}", only={**task.only, "part": part})
            self.of[part, name] = first.setdefault(name, task) if len(alike[name]) == 1 else own
        used = {
            (part, name): tuple(columns[part][c] for c in given)
            for part, pack in parts.items()
            for name, given in pack.spec.controls.items()
        }
        self.controls: dict[str, tuple[str, ...]] = {}
        for (part, name), asked in used.items():
            one = len({other for (_, n), other in used.items() if n == name}) == 1
            self.controls[name if one else f"{part}/{name}"] = asked

    @property
    def tasks(self) -> tuple[Task, ...]:
        return tuple({t.name: t for t in self.of.values() if isinstance(t, Task)}.values())

    @property
    def values(self) -> tuple[ValueTask, ...]:
        return tuple({t.name: t for t in self.of.values() if isinstance(t, ValueTask)}.values())


def _renamed(task: AnyTask, columns: Mapping[str, str]) -> AnyTask:
    only = {columns.get(name, name): value for name, value in task.only.items()}
    task = replace(task, only=only, split=columns[task.split])
    if isinstance(task, Task):
        return task
    return replace(task, targets=tuple(replace(t, name=columns[t.name]) for t in task.targets))


def _meaning(task: AnyTask) -> object:
    """What two tasks must share to be one. Classes may be numbered differently."""
    asked = frozenset(task.classes) if isinstance(task, Task) else task.targets
    return type(task), asked, tuple(sorted(task.only.items())), task.split


def mixed_table(parts: Mapping[str, Pack], columns: Renamed, tasks: MixedTasks) -> pa.Table:
    """The rows of all parts, one part after another.

    Ids, groups, touch groups and presses get the prefix ``<part>/``. Column part names the part, column sensor the sensor
    (the part, if it has no such column). Rows of other parts have label -1, value NaN, and split "hidden" in the split of a
    task that their part does not have.
    """
    splits = {task.split for task in tasks.of.values()} - {"split"}
    filters = {name for task in tasks.of.values() for name in task.only}
    numbers = {target.name for task in tasks.values for target in task.targets}
    numbers |= {column for used in tasks.controls.values() for column in used}
    labels = {task.name for task in tasks.tasks}
    pressed = all("press" in pack.table.column_names for pack in parts.values())
    tables = []
    for part, pack in parts.items():
        given, new = pack.table.column_names, columns[part]
        table: dict[str, pa.Array | pa.ChunkedArray] = {new[n]: pack.table.column(n) for n in given if n in new}
        touch = "touch_group" if "touch_group" in given else "group"
        named = {"id": "id", "group": "group", "touch_group": touch, **({"press": "press"} if pressed else {})}
        table |= {name: _text(f"{part}/{one}" for one in pack.column(own).astype(str)) for name, own in named.items()}
        table["part"] = _text([part] * pack.num)
        table["sensor"] = _text(pack.column("sensor").astype(str)) if "sensor" in given else table["part"]
        for modality in MODALITIES:
            there = pack.has(modality) if modality in pack.spec.modalities else np.zeros(pack.num, bool)
            table[f"has_{modality}"] = pa.array(there)
        table |= _labels(part, pack, tasks, labels)
        table |= {name: _text(pack.column(old).astype(str)) for old, name in new.items() if name in filters}
        table |= {name: _text(["hidden"] * pack.num) for name in splits - table.keys()}
        empty = pa.array(np.full(pack.num, np.nan))
        table |= {name: table[name].cast(pa.float64()) if name in table else empty for name in numbers}
        tables.append(pa.table(table))
    return pa.concat_tables(tables, promote_options="permissive")


def _text(cells: Iterable[str]) -> pa.Array:
    return pa.array(list(cells), pa.string())


def _labels(part: str, pack: Pack, tasks: MixedTasks, labels: set[str]) -> dict[str, pa.Array]:
    """The label columns of one part: every class by its number in the mix."""
    found = {f"label_{name}": pa.array(np.full(pack.num, -1)) for name in labels}
    for own in pack.spec.tasks:
        task = tasks.of[part, own.name]
        assert isinstance(task, Task)
        numbers = np.array([*(task.classes.index(name) for name in own.classes), -1])  # -1 (no label) is the last
        found[f"label_{task.name}"] = pa.array(numbers[pack.column(f"label_{own.name}").astype(int)])
    return found


def mixed_spec(parts: Mapping[str, Pack], tasks: MixedTasks, channels: Mapping[str, int], notes: list[str]) -> DataSpec:
    """The description of all parts together."""
    specs = {name: pack.spec for name, pack in parts.items()}
    units = {spec.group_by for spec in specs.values()}
    return DataSpec(
        name=f"mix of {', '.join(specs)}",
        vision_channels=channels["vision"],
        touch_channels=channels["touch"],
        tasks=tasks.tasks,
        values=tasks.values,
        group_by=units.pop() if len(units) == 1 else "group",
        controls=tasks.controls,
        licence="; ".join(f"{name}: {spec.licence}" for name, spec in specs.items()),
        source="; ".join(f"{name}: {spec.source}" for name, spec in specs.items()),
        notes=(*notes, *(f"{name}: {note}" for name, spec in specs.items() for note in spec.notes)),
        difference=any(spec.difference for spec in specs.values()),
    )
