"""Several packs as one, images read where they are: ``MixedPack`` to train on, ``JoinedPack`` for probes."""

import functools
import itertools
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mvitac.data.lazy import Pieces
from mvitac.data.pack import Pack
from mvitac.data.row_hashes import IMAGES, image_sums, known_images, row_hashes
from mvitac.data.spec import MODALITIES, AnyTask, DataSpec, Task, ValueTask
from mvitac.registry import unknown
from mvitac.system.files import digest

Columns = dict[str, pa.Array | pa.ChunkedArray]
Tasks = Mapping[str, AnyTask]
"""Name of a task in a part -> the task of all parts."""


SHARED = "is in train or val of part"  # and in test of another one: in a note of a mix


class _Several(Pack):
    """Rows of packs one after another; a subclass sets ``path``, ``table``, ``spec``, ``size`` and ``digests``."""

    def _open(self, packs: Sequence[Pack]) -> None:
        self._packs, self.store, self.num = packs, "raw", sum(pack.num for pack in packs)
        starts = np.cumsum([0, *(pack.num for pack in packs)])
        pieces = {m: [pack.images.get(m) for pack in packs].__getitem__ for m in self.spec.modalities}
        self.images = {m: Pieces(self._shape(m, self.num), starts, piece) for m, piece in pieces.items()}

    @property
    def own_ids(self) -> np.ndarray:
        return np.concatenate([pack.own_ids for pack in self._packs])


class MixedPack(_Several):
    """The rows of all ``parts``, one part after another.

    A row has the split, labels, values and groups of its part. A part without a modality has no image of it.

    Attributes:
        weights: How often each part is drawn in training, relative to the others; () = by its number of rows.

    Args:
        parts: Name -> pack, at least two.
        size: Side of the images in pixels; images of another side are resized when they are read. 0: the largest side.
        allow_leak: Accept groups, rows and images that one part has in train and another in test.

    Raises:
        ValueError: If a part has no rows to train on, the parts differ in channels or in what touch images show, or are
            the same data, or train of one part and test of another share groups, rows or images.
    """

    weights: tuple[float, ...] = ()

    def __init__(self, parts: Mapping[str, Pack], *, size: int = 0, allow_leak: bool = False) -> None:
        self.parts, packs = dict(parts), list(parts.values())
        _check_parts(parts)
        self.path, self.meta = Path(" + ".join(str(pack.path) for pack in packs)), {}
        self.size = size or max(pack.size for pack in packs)
        self.digests = {name: pack.digest for name, pack in parts.items()} | {"size": digest(self.size)}
        how = f"px are resized to {self.size} px as they are read"
        notes = [f"{name}: images of {pack.size} {how}" for name, pack in parts.items() if pack.size != self.size]
        if found := _shared_by_parts(parts):
            if not allow_leak:
                raise ValueError(f"{found}: pack them with equal splits, leave a part out, or give --data.allow-leak")
            notes.append(found)
        tasks = _mixed_tasks(parts)
        self.spec = _mixed_spec(parts, tasks, notes)
        tables = (pa.table(_mixed_columns(part, parts, tasks[part], self.spec)) for part in parts)
        self.table = pa.concat_tables(tables, promote_options="permissive")
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
        drawn = np.array(self.weights or np.bincount(self.part_of[rows], minlength=len(self.parts)))
        return drawn / drawn.sum()

    def alone(self, part: str) -> Pack:
        """This pack with the rows of all other parts hidden, and the modalities of ``part``."""
        inside = self.part_of == list(self.parts).index(part)
        made = self.with_splits({"split": np.where(inside, self.column("split").astype(str), "hidden")})
        lacking = {f"{m}_channels": 0 for m in self.spec.modalities if m not in self.parts[part].spec.modalities}
        made.spec = replace(self.spec, **lacking)
        return made


def _check_parts(parts: Mapping[str, Pack]) -> None:
    if len({pack.digest for pack in parts.values()}) < len(parts):
        raise ValueError(f"two of the parts {', '.join(parts)} are the same data: give each pack once, with a weight")
    for name, pack in parts.items():
        if not len(pack.rows("train", "unlabelled")):
            raise ValueError(f"part {name} ({pack.path}) has no rows in split train or unlabelled: leave it out")
    for modality in MODALITIES:
        given = {name: num for name, pack in parts.items() if (num := pack.spec.channels(modality))}
        if len(set(given.values())) > 1:
            raise ValueError(f"{modality} channels differ: {given}; pack all with the same number of sensors")
    minus = {pack.spec.difference: name for name, pack in parts.items() if pack.spec.touch_channels}
    if len(minus) > 1:
        raise ValueError(f"touch is minus its background in {minus[True]} and not in {minus[False]}: pack both alike")


def _shared_by_parts(parts: Mapping[str, Pack]) -> str:
    """Say what train (or val) of one part and test of another have in common; "" if nothing."""
    for (a, one), (b, other) in itertools.permutations(parts.items(), 2):
        learned = one.rows("train", "val", "unlabelled")
        scored = np.flatnonzero(np.any([other.column(c) == "test" for c in other.spec.split_columns], axis=0))
        hashes = list(zip(("id", "group"), row_hashes(one), row_hashes(other), strict=True))
        where = f"{SHARED} {a} and in test of part {b}, one of"
        for column, ours, theirs in hashes[::-1]:
            if len(both := scored[np.isin(theirs[scored], ours[learned])]):
                by = other.spec.group_by if column == "group" else "row"
                return f"{by} {str(other.column(column)[both[0]])!r} {where} {len(np.unique(theirs[both]))}"
        if found := _known_image(other, scored, image_sums(one)[learned]):
            return f"{found[0]} {where} {found[1]}"
    return ""


def _mixed_tasks(parts: Mapping[str, Pack]) -> dict[str, Tasks]:
    """The tasks of each part. Those of one name that mean the same are one; others become <part>/<name>. So do values
    of a column that another part measures for a task of another name: a mix has one column of each name."""
    tasks = [task for pack in parts.values() for task in pack.spec.all_tasks]
    first = {task.name: task for task in reversed(tasks)}
    shared = {name for name in first if len({_meaning(task) for task in tasks if task.name == name}) == 1}
    for pack, task in itertools.product(parts.values(), first.values()):
        columns = {target.name for own in pack.spec.values for target in own.targets}
        if isinstance(task, ValueTask) and task.name not in {own.name for own in pack.spec.values}:
            shared -= {task.name for target in task.targets if target.name in columns}
    return {
        part: {t.name: first[t.name] if t.name in shared else _of_part(part, t) for t in pack.spec.all_tasks}
        for part, pack in parts.items()
    }


def _meaning(task: AnyTask) -> object:
    """What two tasks must share to be one. Classes may be numbered differently."""
    asked = frozenset(task.classes) if isinstance(task, Task) else task.targets
    return type(task), asked, tuple(sorted(task.only.items())), task.split


def _of_part(part: str, task: AnyTask) -> AnyTask:
    own = replace(task, name=f"{part}/{task.name}", only={**task.only, "part": part})
    if isinstance(own, ValueTask):
        own = replace(own, targets=tuple(replace(target, name=f"{part}/{target.name}") for target in own.targets))
    return own


def _mixed_spec(parts: Mapping[str, Pack], tasks: Mapping[str, Tasks], notes: Sequence[str]) -> DataSpec:
    specs = {name: pack.spec for name, pack in parts.items()}
    every = list({task.name: task for own in tasks.values() for task in own.values()}.values())
    units = {spec.group_by for spec in specs.values()}
    controls: dict[str, tuple[str, ...]] = {}
    for part, spec in specs.items():
        for name, columns in spec.controls.items():
            alike = all(other.controls.get(name, columns) == columns for other in specs.values())
            own = name if alike else f"{part}/{name}"
            controls[own] = tuple(_CONTROL.format(own, column) for column in columns)
    return DataSpec(
        name=f"mix of {', '.join(specs)}",
        vision_channels=max(spec.vision_channels for spec in specs.values()),
        touch_channels=max(spec.touch_channels for spec in specs.values()),
        tasks=tuple(task for task in every if isinstance(task, Task)),
        values=tuple(task for task in every if isinstance(task, ValueTask)),
        group_by=units.pop() if len(units) == 1 else "group",
        controls=controls,
        licence="; ".join(f"{name}: {spec.licence}" for name, spec in specs.items()),
        source="; ".join(f"{name}: {spec.source}" for name, spec in specs.items()),
        notes=(*notes, *(f"{name}: {note}" for name, spec in specs.items() for note in spec.notes)),
        difference=any(spec.difference for spec in specs.values()),
    )


_CONTROL = "control/{}/{}"
"""A mix's column of a control, which in another part may be measured values."""
OWN = re.compile(r"(id|group|touch_group|press|part|sensor|(has|crc|bytes|label)_.*)")
"""Columns that a mix does not take over as they are."""


def _mixed_columns(part: str, parts: Mapping[str, Pack], tasks: Tasks, mixed: DataSpec) -> Columns:
    """The columns of one part of a mix.

    Ids, groups, touch groups and presses get the prefix ``<part>/``. Column part names the part, column sensor the sensor
    (the part, if it has no such column). A row has label -1, value NaN and split "hidden" for a task that its part does not
    have. Other columns are left out where they are numbers in one part and text in another.
    """
    pack = parts[part]
    given = pack.table.column_names
    kinds = {name: {_kind(p.table, name) for p in parts.values()} - {""} for name in given if not OWN.fullmatch(name)}
    pressed = ("press",) * all("press" in other.table.column_names for other in parts.values())
    touch = "touch_group" if "touch_group" in given else "group"
    prefixed = {"id": "id", "group": "group", "touch_group": touch, **{name: name for name in pressed}}
    columns: Columns = {f"label_{task.name}": pa.array(np.full(pack.num, -1)) for task in mixed.tasks}
    columns |= _columns(part, pack, [name for name, found in kinds.items() if len(found) == 1], prefixed, tasks)
    columns["part"] = _text([part] * pack.num)
    if "sensor" not in given:
        columns["sensor"] = columns["part"]
    filters = {name for task in mixed.all_tasks for name in task.only} - {"part"}
    columns |= {name: _text(pack.column(name).astype(str)) for name in filters & {*given}}
    for split in {task.split for task in mixed.all_tasks} - {"split"}:
        columns[split] = _text(pack.column(split) if split in given else ["hidden"] * pack.num)
    numbers = [column for used in mixed.controls.values() for column in used]
    numbers += [target.name for task in mixed.values for target in task.targets]
    columns |= dict.fromkeys(numbers, pa.array(np.full(pack.num, np.nan)))
    measured: dict[str, str] = {}
    for name, used in pack.spec.controls.items():
        own = name if name in mixed.controls else f"{part}/{name}"
        measured |= {_CONTROL.format(own, column): column for column in used}
    for task in pack.spec.values:
        own = tasks[task.name]
        assert isinstance(own, ValueTask)
        measured |= {new.name: old.name for new, old in zip(own.targets, task.targets, strict=True)}
    return columns | {new: pa.array(pack.column(old).astype(float)) for new, old in measured.items()}


def _kind(table: pa.Table, name: str) -> str:
    if name not in table.column_names or pa.types.is_null(kind := table.column(name).type):
        return ""
    return "number" if pa.types.is_integer(kind) or pa.types.is_floating(kind) else str(kind)


class JoinedPack(_Several):
    """Train and val rows of ``learn`` followed by test rows of ``score``.

    Tasks are those that both packs have (of ``names``), with the classes of ``learn``. ValueError if there is none, or the
    packs have other image shapes, classes that ``learn`` lacks, or a group or an image in both.
    """

    def __init__(self, learn: Pack, score: Pack, names: Collection[str] = ()) -> None:
        self.path, self.meta, self.size = score.path, score.meta, learn.size
        self.digests = {"learn": learn.digest, "score": score.digest}
        for modality in MODALITIES:
            shapes = [(pack.size, pack.spec.channels(modality)) for pack in (learn, score)]
            if any(num for _, num in shapes) and shapes[0] != shapes[1]:
                each = [f"{num} channels at {size} px" for size, num in shapes]
                raise ValueError(f"{modality}: {each[0]} in {learn.path}, {each[1]} in {score.path}: pack both alike")
        tasks = _common_tasks(learn, score, names)
        learned = _side(learn, tasks, "learned", {"train", "val"})
        scored = _side(score, tasks, "scored", {"test"})
        shared = [name for name in learned.column_names if name in scored.column_names]
        self.table = pa.concat_tables([learned.select(shared), scored.select(shared)], promote_options="permissive")
        theirs = score.spec.controls
        self.spec = replace(
            learn.spec,
            name=f"{score.path.name}, probes learned on {learn.path.name}",
            tasks=tuple(task for task in tasks.values() if isinstance(task, Task)),
            values=tuple(task for task in tasks.values() if isinstance(task, ValueTask)),
            controls={name: given for name, given in learn.spec.controls.items() if theirs.get(name) == given},
            notes=tuple(dict.fromkeys((*learn.spec.notes, *score.spec.notes))),
        )
        self._open([learn, score])
        if found := self._shared():
            where = f"is learned from in {learn.path} and scored in {score.path}, one of {found[1]}"
            raise ValueError(f"{found[0]} {where}: give packs whose splits agree")

    def _shared(self) -> tuple[str, int] | None:
        """A group or an image that probes learn from and are scored on, and how many there are."""
        groups, sums, by = self.column("group").astype(str), image_sums(self), self.spec.group_by
        for task in self.spec.all_tasks:
            learned, scored = (self.rows(*splits, by=task.split) for splits in (("train", "val"), ("test",)))
            if by != "row" and len(both := np.intersect1d(groups[learned], groups[scored])):
                return f"{by} {str(both[0])!r}", len(both)
            if found := _known_image(self, scored, sums[learned]):
                return found
        return None


def _common_tasks(learn: Pack, score: Pack, names: Collection[str]) -> dict[str, AnyTask]:
    known = {task.name: task for task in learn.spec.all_tasks if task.name in (names or (task.name,))}
    tasks = [(known[task.name], task) for task in score.spec.all_tasks if task.name in known]
    if not tasks:
        both = [", ".join(task.name for task in pack.spec.all_tasks) or "none" for pack in (learn, score)]
        raise ValueError(f"no task is in both packs: {learn.path} has {both[0]}, {score.path} {both[1]}")
    for ours, theirs in tasks:
        other = _about(theirs)
        for what, mine in _about(ours).items():
            if mine != other[what]:
                where = f"{mine} in {learn.path}, {other[what]} in {score.path}"
                raise ValueError(f"task {ours.name!r} has {what} {where}: pack both alike, or one without it")
    return {ours.name: ours for ours, _ in tasks}


def _about(task: AnyTask) -> dict[str, str]:
    """What two tasks must share to be joined; their classes are compared row by row."""
    units = "" if isinstance(task, Task) else ", ".join(f"{target.name}:{target.unit}" for target in task.targets)
    only = ", ".join(f"{column}={value}" for column, value in sorted(task.only.items()))
    return {"values": units or "none", "rows": only or "all", "split": task.split}


def _side(pack: Pack, tasks: Tasks, part: str, keep: set[str]) -> pa.Table:
    """Return the columns of ``pack`` that probes read; rows of splits other than ``keep`` get the split "hidden"."""
    plain = ["group", *(f"crc_{modality}" for modality in MODALITIES)]
    columns = _columns(part, pack, [name for name in plain if name in pack.table.column_names], {"id": "id"}, tasks)
    columns |= {name: _text(pack.column(name).astype(str)) for task in tasks.values() for name in task.only}
    numbers = {target.name for task in tasks.values() if isinstance(task, ValueTask) for target in task.targets}
    numbers |= {column for used in pack.spec.controls.values() for column in used}
    columns |= {name: pa.array(pack.column(name).astype(float)) for name in numbers}
    for name in {"split", *(task.split for task in tasks.values())}:
        columns[name] = _text(s if s in keep else "hidden" for s in pack.table.column(name).to_pylist())
    return pa.table(columns)


def _columns(part: str, pack: Pack, taken: Iterable[str], prefixed: Mapping[str, str], tasks: Tasks) -> Columns:
    """The columns of one part of several: those ``taken`` over; labels, numbered by the classes of ``tasks``; and new ones,
    ``prefixed``, whose cells are those of a column of the part after ``<part>/``."""
    columns: Columns = {name: pack.table.column(name) for name in taken}
    columns |= {new: _text(f"{part}/{cell}" for cell in pack.column(own).astype(str)) for new, own in prefixed.items()}
    columns["sensor"] = _text(np.array(pack.sensor_names)[pack.sensors])
    for modality in MODALITIES:
        there = pack.has(modality) if modality in pack.spec.modalities else np.zeros(pack.num, bool)
        columns[f"has_{modality}"] = pa.array(there)
    for own in pack.spec.tasks:
        if isinstance(task := tasks.get(own.name), Task):
            numbers = [task.classes.index(name) if name in task.classes else -2 for name in own.classes]
            labels = np.array([*numbers, -1])[pack.column(f"label_{own.name}").astype(int)]  # -1 (no label) is the last
            if (labels == -2).any():
                new = next(name for name in own.classes if name not in task.classes)
                raise unknown(f"class of {task.name}", f"{new} ({pack.path})", task.classes)
            columns[f"label_{task.name}"] = pa.array(labels)
    return columns


def _text(cells: Iterable[str]) -> pa.Array:
    return pa.array(list(cells), pa.string())


def _known_image(pack: Pack, rows: np.ndarray, sums: np.ndarray) -> tuple[str, int] | None:
    """The first image of ``rows`` that is among ``sums``, and how many there are of its modality."""
    for same, (modality, _) in zip(known_images(pack, rows, sums).T, IMAGES, strict=True):
        if same.any():
            return f"the {modality} image of row {str(pack.own_ids[rows[same][0]])!r}", int(same.sum())
    return None
