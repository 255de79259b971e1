"""Several packs as one training set: other datasets, sensors, image sizes and missing modalities."""

import functools
import itertools
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mvitac.data.pack import Pack
from mvitac.data.row_hashes import image_sums, row_hashes
from mvitac.data.several import Columns, Several, columns_of_part, known_image, text
from mvitac.data.spec import MODALITIES, AnyTask, DataSpec, Task, ValueTask
from mvitac.system.files import digest

OWN = re.compile(r"(id|group|touch_group|press|part|sensor|(has|crc|bytes|label)_.*)")
"""Columns that a mix does not take over as they are."""


class MixedPack(Several):
    """The rows of all ``parts``, one part after another.

    A row has the split, labels, values and groups that it has in its part (``_mixed_table``). A part without a modality has
    no image of it.

    Attributes:
        weights: How often each part is drawn in training, relative to the others; () = by its number of rows.
        temperature: Without weights, parts are drawn in proportion to (number of rows)^temperature.
        one_part: Whether all rows of a batch are of one part.

    Args:
        parts: Name -> pack, at least two.
        size: Side of the images in pixels; images of another side are resized when they are read. 0: the largest side.
        allow_leak: Accept groups, rows and images that one part has in train and another in test.

    Raises:
        ValueError: If a part has no rows to train on, the parts differ in channels or in what touch images show, or are
            the same data, or train of one part and test of another share groups, rows or images.

    Examples:
        >>> pack = MixedPack({"tag": Pack("packs/tag"), "mine": Pack("packs/mine")})  # doctest: +SKIP
        >>> pack.column("part")[pack.rows("train")]  # doctest: +SKIP
    """

    weights: tuple[float, ...] = ()
    temperature: float = 1.0
    one_part: bool = False

    def __init__(self, parts: Mapping[str, Pack], *, size: int = 0, allow_leak: bool = False) -> None:
        self.parts, packs = dict(parts), list(parts.values())
        channels = _check(self.parts)
        self.path, self.meta = Path(" + ".join(str(pack.path) for pack in packs)), {}
        self.size = size or max(pack.size for pack in packs)
        self.digests = {name: pack.digest for name, pack in parts.items()} | {"size": digest(self.size)}
        columns = _renamed(parts)
        tasks = _Tasks(parts, columns)
        self.table = _mixed_table(parts, columns, tasks)
        notes = [
            f"{name}: images of {pack.size} px are resized to {self.size} px when they are read"
            for name, pack in parts.items()
            if pack.size != self.size
        ]
        if found := _shared(parts):
            if not allow_leak:
                raise ValueError(f"{found}: pack them with splits that agree, leave a part out, or give allow_leak")
            notes.append(found)
        self.spec = _mixed_spec(parts, tasks, channels, notes)
        self._open(packs)

    @functools.cached_property
    def whole(self) -> np.ndarray:
        return np.concatenate([pack.whole for pack in self.parts.values()])

    @functools.cached_property
    def hidden(self) -> np.ndarray:
        return np.concatenate([pack.hidden for pack in self.parts.values()])

    @functools.cached_property
    def phased(self) -> bool:
        return any(pack.phased for pack in self.parts.values())

    @functools.cached_property
    def part_of(self) -> np.ndarray:
        """int64 [N], number of each row's part."""
        return np.repeat(np.arange(len(self.parts)), [pack.num for pack in self.parts.values()])

    def shares(self, rows: np.ndarray) -> np.ndarray:
        """Share [parts] of each part in the rows that training draws from ``rows``."""
        sizes = np.bincount(self.part_of[rows], minlength=len(self.parts))
        drawn = np.array(self.weights) if self.weights else sizes**self.temperature * (sizes > 0)
        return drawn / drawn.sum()

    @property
    def weighted(self) -> bool:
        """Whether training draws from the parts otherwise than from one pack of all rows."""
        return bool(self.weights) or self.temperature != 1 or self.one_part

    def alone(self, part: str) -> Pack:
        """This pack with the rows of all other parts hidden, and the modalities of ``part``."""
        inside = self.part_of == list(self.parts).index(part)
        made = self.with_splits({"split": np.where(inside, self.column("split").astype(str), "hidden")})
        lacking = {f"{m}_channels": 0 for m in self.spec.modalities if m not in self.parts[part].spec.modalities}
        made.spec = replace(self.spec, **lacking)
        return made


def _check(parts: Mapping[str, Pack]) -> dict[str, int]:
    """Check that the parts fit together; return the channels of each modality."""
    digests: dict[str, str] = {}
    for name, pack in parts.items():
        if twin := digests.get(pack.digest):
            raise ValueError(f"parts {twin} and {name} are the same data: give each pack once, with a weight")
        digests[pack.digest] = name
        if not len(pack.rows("train", "unlabelled")):
            raise ValueError(f"part {name} ({pack.path}) has no rows in split train or unlabelled: leave it out")
    channels = {}
    for modality in MODALITIES:
        given = {name: num for name, pack in parts.items() if (num := pack.spec.channels(modality))}
        if len(set(given.values())) > 1:
            counts = ", ".join(f"{num} in {name}" for name, num in given.items())
            raise ValueError(f"{modality} channels differ: {counts}; pack them with the same number of sensors")
        channels[modality] = next(iter(given.values()), 0)
    minus = {pack.spec.difference: name for name, pack in parts.items() if pack.spec.touch_channels}
    if len(minus) > 1:
        raise ValueError(f"touch is minus its background in {minus[True]} and not in {minus[False]}: pack both alike")
    return channels


def _shared(parts: Mapping[str, Pack]) -> str:
    """Say what train (or val) of one part and test of another have in common; "" if nothing."""
    for (a, one), (b, other) in itertools.permutations(parts.items(), 2):
        learned = one.rows("train", "val", "unlabelled")
        scored = np.flatnonzero(np.any([other.column(c) == "test" for c in other.spec.split_columns], axis=0))
        hashes = list(zip(("id", "group"), row_hashes(one), row_hashes(other), strict=True))
        where = f"is in train of part {a} and in test of part {b}, one of"
        for column, ours, theirs in hashes[::-1]:
            both = scored[np.isin(theirs[scored], ours[learned])]
            if len(both):
                by = other.spec.group_by if column == "group" else "row"
                return f"{by} {str(other.column(column)[both[0]])!r} {where} {len(np.unique(theirs[both]))}"
        if found := known_image(other, scored, image_sums(one)[learned]):
            return f"{found[0]} {where} {found[1]}"
    return ""


Renamed = Mapping[str, Mapping[str, str]]  # part -> column of its table -> name of that column in the mix


def _renamed(parts: Mapping[str, Pack]) -> Renamed:
    """Names of all columns that a mix takes over.

    A name becomes <part>/<name> if its columns differ in kind or unit, or only some of them are a task's or a control's.
    """
    kinds: dict[str, set[str]] = {}
    for pack in parts.values():
        uses = {target.name: f" in {target.unit}" for task in pack.spec.values for target in task.targets}
        uses |= {c: f"{uses.get(c, '')}, control" for used in pack.spec.controls.values() for c in used}
        for column in pack.table.schema:
            if not OWN.fullmatch(column.name) and not pa.types.is_null(column.type):
                number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
                kind = "number" if number else str(column.type)
                kinds.setdefault(column.name, set()).add(kind + uses.get(column.name, ""))
    same = {name for name, found in kinds.items() if len(found) == 1}
    taken = {part: [n for n in pack.table.column_names if n in kinds] for part, pack in parts.items()}
    return {part: {n: n if n in same else f"{part}/{n}" for n in names} for part, names in taken.items()}


class _Tasks:
    """Tasks and controls of the parts. Equal ones with one name are one; others of one name become <part>/<name>.

    Attributes:
        of: Part -> name of its task -> the task in the mix.
        controls: Control -> columns.
    """

    def __init__(self, parts: Mapping[str, Pack], columns: Renamed) -> None:
        given = {p: {t.name: _with_columns(t, columns[p]) for t in pack.spec.all_tasks} for p, pack in parts.items()}
        alike: dict[str, set[object]] = {}
        first: dict[str, AnyTask] = {}
        for name, task in (pair for tasks in given.values() for pair in tasks.items()):
            alike.setdefault(name, set()).add(_meaning(task))
            first.setdefault(name, task)
        self.of = {
            part: {
                name: first[name]
                if len(alike[name]) == 1
                else replace(task, name=f"{part}/{name}", only={**task.only, "part": part})
                for name, task in tasks.items()
            }
            for part, tasks in given.items()
        }
        self.all = list({task.name: task for tasks in self.of.values() for task in tasks.values()}.values())
        used = {
            (part, name): tuple(columns[part][c] for c in asked)
            for part, pack in parts.items()
            for name, asked in pack.spec.controls.items()
        }
        self.controls: dict[str, tuple[str, ...]] = {}
        for (part, name), asked in used.items():
            one = len({other for (_, n), other in used.items() if n == name}) == 1
            self.controls[name if one else f"{part}/{name}"] = asked


def _with_columns(task: AnyTask, columns: Mapping[str, str]) -> AnyTask:
    only = {columns.get(name, name): value for name, value in task.only.items()}
    task = replace(task, only=only, split=columns[task.split])
    if isinstance(task, Task):
        return task
    return replace(task, targets=tuple(replace(t, name=columns[t.name]) for t in task.targets))


def _meaning(task: AnyTask) -> object:
    """What two tasks must share to be one. Classes may be numbered differently."""
    asked = frozenset(task.classes) if isinstance(task, Task) else task.targets
    return type(task), asked, tuple(sorted(task.only.items())), task.split


def _mixed_table(parts: Mapping[str, Pack], columns: Renamed, tasks: _Tasks) -> pa.Table:
    """The rows of all parts, one part after another.

    Ids, groups, touch groups and presses get the prefix ``<part>/``. Column part names the part, column sensor the sensor
    (the part, if it has no such column). Rows of other parts have label -1, value NaN, and split "hidden" in the split of a
    task that their part does not have.
    """
    splits = {task.split for task in tasks.all} - {"split"}
    filters = {name for task in tasks.all for name in task.only}
    numbers = {target.name for task in tasks.all if isinstance(task, ValueTask) for target in task.targets}
    numbers |= {column for used in tasks.controls.values() for column in used}
    labels = [f"label_{task.name}" for task in tasks.all if isinstance(task, Task)]
    pressed = ("press",) * all("press" in pack.table.column_names for pack in parts.values())
    tables = []
    for part, pack in parts.items():
        given, new = pack.table.column_names, columns[part]
        touch = "touch_group" if "touch_group" in given else "group"
        prefixed = {"id": "id", "group": "group", "touch_group": touch, **{name: name for name in pressed}}
        table: Columns = {name: pa.array(np.full(pack.num, -1)) for name in labels}
        table |= columns_of_part(part, pack, {n: new[n] for n in given if n in new}, prefixed, tasks.of[part])
        table["part"] = text([part] * pack.num)
        if "sensor" not in given:
            table["sensor"] = table["part"]
        table |= {name: text(pack.column(old).astype(str)) for old, name in new.items() if name in filters}
        table |= {name: text(["hidden"] * pack.num) for name in splits - table.keys()}
        empty = pa.array(np.full(pack.num, np.nan))
        table |= {name: table[name].cast(pa.float64()) if name in table else empty for name in numbers}
        tables.append(pa.table(table))
    return pa.concat_tables(tables, promote_options="permissive")


def _mixed_spec(parts: Mapping[str, Pack], tasks: _Tasks, channels: Mapping[str, int], notes: list[str]) -> DataSpec:
    specs = {name: pack.spec for name, pack in parts.items()}
    units = {spec.group_by for spec in specs.values()}
    return DataSpec(
        name=f"mix of {', '.join(specs)}",
        vision_channels=channels["vision"],
        touch_channels=channels["touch"],
        tasks=tuple(task for task in tasks.all if isinstance(task, Task)),
        values=tuple(task for task in tasks.all if isinstance(task, ValueTask)),
        group_by=units.pop() if len(units) == 1 else "group",
        controls=tasks.controls,
        licence="; ".join(f"{name}: {spec.licence}" for name, spec in specs.items()),
        source="; ".join(f"{name}: {spec.source}" for name, spec in specs.items()),
        notes=(*notes, *(f"{name}: {note}" for name, spec in specs.items() for note in spec.notes)),
        difference=any(spec.difference for spec in specs.values()),
    )
