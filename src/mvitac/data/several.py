"""Several packs as one: the rows of one pack after another, images read where they are.

A ``MixedPack`` is one training set from other datasets, sensors, image sizes and missing modalities. A ``JoinedPack`` is
for probes that learn on one pack and are scored on another.
"""

import copy
import functools
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mvitac.data.lazy import Pieces
from mvitac.data.pack import Pack
from mvitac.data.row_hashes import image_sums, known_images, number_hint, row_hashes
from mvitac.data.spec import MODALITIES, AnyTask, DataSpec, Task, ValueTask
from mvitac.registry import unknown
from mvitac.system.files import brief, digest

OWN = re.compile(r"(id|group|touch_group|press|part|sensor|(has|crc|bytes|label)_.*)")
"""Columns that a mix does not take over as they are."""


class _Several(Pack):
    def _open(self, packs: Sequence[Pack]) -> None:
        """Show the images of ``packs``, one pack after another; spec and size are set."""
        self._packs, self.store, self.num = packs, "raw", sum(pack.num for pack in packs)
        starts = np.cumsum([0, *(pack.num for pack in packs)])
        pieces = {m: [pack.images.get(m) for pack in packs].__getitem__ for m in self.spec.modalities}
        self.images = {m: Pieces(self._shape(m, self.num), starts, piece) for m, piece in pieces.items()}

    @property
    def own_ids(self) -> np.ndarray:
        return np.concatenate([pack.own_ids for pack in self._packs])


Columns = dict[str, pa.Array | pa.ChunkedArray]


def _columns(
    part: str, pack: Pack, taken: Mapping[str, str], prefixed: Mapping[str, str], tasks: Mapping[str, AnyTask]
) -> Columns:
    """The columns of one part of several.

    Args:
        part: Name of the part.
        pack: The part.
        taken: Its columns that are taken over -> their new names.
        prefixed: New columns whose cells get the prefix ``<part>/`` -> those of the part.
        tasks: Its tasks by name -> tasks of all parts, by whose classes labels are numbered.
    """
    table: Columns = {new: pack.table.column(own) for own, new in taken.items()}
    table |= {new: _text(f"{part}/{cell}" for cell in pack.column(own).astype(str)) for new, own in prefixed.items()}
    table["sensor"] = _text(np.array(pack.sensor_names)[pack.sensors])
    for modality in MODALITIES:
        there = pack.has(modality) if modality in pack.spec.modalities else np.zeros(pack.num, bool)
        table[f"has_{modality}"] = pa.array(there)
    for own in pack.spec.tasks:
        if isinstance(task := tasks.get(own.name), Task):
            numbers = [task.classes.index(name) if name in task.classes else -2 for name in own.classes]
            labels = np.array([*numbers, -1])[pack.column(f"label_{own.name}").astype(int)]  # -1 (no label) is the last
            if (labels == -2).any():
                new = next(name for name in own.classes if name not in task.classes)
                raise unknown(f"class of {task.name}", f"{new} ({pack.path})", task.classes)
            table[f"label_{task.name}"] = pa.array(labels)
    return table


def _text(cells: Iterable[str]) -> pa.Array:
    return pa.array(list(cells), pa.string())


def _known_image(pack: Pack, rows: np.ndarray, sums: np.ndarray) -> tuple[str, int] | None:
    """The first image of ``rows`` that is among ``sums``, and how many there are of its modality."""
    for same, modality in zip(known_images(pack, rows, sums).T, MODALITIES, strict=True):
        if same.any():
            return f"the {modality} image of row {str(pack.own_ids[rows[same][0]])!r}", int(same.sum())
    return None


class JoinedPack(_Several):
    """Train and val rows of ``learn`` followed by test rows of ``score``.

    Tasks are those that both packs have, with the classes of ``learn``. ValueError if there is none, or the packs have
    other image shapes, classes that ``learn`` lacks, or a group or an image in both (test rows would not be unseen).

    Attributes:
        learn: The first pack; its rows come first.
    """

    def __init__(self, learn: Pack, score: Pack) -> None:
        self.path, self.meta, self.learn, self.size = score.path, score.meta, learn, learn.size
        self.digests = {"learn": learn.digest, "score": score.digest}
        for modality in MODALITIES:
            shapes = [(pack.size, pack.spec.channels(modality)) for pack in (learn, score)]
            if any(num for _, num in shapes) and shapes[0] != shapes[1]:
                each = [f"{num} channels at {size} px" for size, num in shapes]
                raise ValueError(
                    f"{modality} has {each[0]} in {learn.path} and {each[1]} in {score.path}: pack both alike"
                )
        tasks = _common_tasks(learn, score)
        learned = _side(learn, tasks, "learned", {"train", "val"})
        scored = _side(score, tasks, "scored", {"test"})
        names = [name for name in learned.column_names if name in scored.column_names]
        try:
            self.table = pa.concat_tables([learned.select(names), scored.select(names)], promote_options="permissive")
        except pa.ArrowException as error:
            raise ValueError(f"the packs' columns differ in kind ({brief(error)})") from None
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
            raise ValueError(
                f"{found[0]} is learned from in {learn.path} and scored in {score.path}, one of {found[1]}: give packs"
                " whose splits agree, or leave these rows out"
            )

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


def _common_tasks(learn: Pack, score: Pack) -> dict[str, AnyTask]:
    """Return the tasks that both packs have by name, as defined by ``learn``."""
    known = {task.name: task for task in learn.spec.all_tasks}
    tasks = [(known[task.name], task) for task in score.spec.all_tasks if task.name in known]
    if not tasks:
        names = [", ".join(task.name for task in pack.spec.all_tasks) or "none" for pack in (learn, score)]
        raise ValueError(f"no task is in both packs: {learn.path} has {names[0]}, {score.path} {names[1]}")
    for ours, theirs in tasks:
        if (ours.only, ours.split) != (theirs.only, theirs.split):
            raise ValueError(f"task {ours.name!r} is about other rows or split otherwise in {score.path}")
        asked = [
            "classes" if isinstance(task, Task) else ", ".join(f"{t.name} in {t.unit}" for t in task.targets)
            for task in (ours, theirs)
        ]
        if asked[0] != asked[1]:
            raise ValueError(f"task {ours.name!r} is {asked[0]} in {learn.path} and {asked[1]} in {score.path}")
    return {ours.name: ours for ours, _ in tasks}


def _side(pack: Pack, tasks: Mapping[str, AnyTask], part: str, keep: set[str]) -> pa.Table:
    """Return the columns of ``pack`` that probes read; rows of splits other than ``keep`` get the split "hidden"."""
    read = {"group", *(f"crc_{modality}" for modality in MODALITIES)}
    read |= {column for task in tasks.values() for column in task.only}
    read |= {target.name for task in tasks.values() if isinstance(task, ValueTask) for target in task.targets}
    read |= {column for used in pack.spec.controls.values() for column in used}
    taken = {name: name for name in pack.table.column_names if name in read}
    table = _columns(part, pack, taken, {"id": "id"}, tasks)
    for name in {"split", *(task.split for task in tasks.values())}:
        table[name] = _text(s if s in keep else "hidden" for s in pack.table.column(name).to_pylist())
    return pa.table(table)


class MixedPack(_Several):
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
        made, own = copy.copy(self), self.parts[part].spec
        made.__dict__.pop("_answers", None)  # labels by split, of all parts
        inside = self.part_of == list(self.parts).index(part)
        splits = pa.array(np.where(inside, self.column("split").astype(str), "hidden"))
        made.table = self.table.set_column(self.table.schema.get_field_index("split"), "split", splits)
        lacking = {f"{m}_channels": 0 for m in self.spec.modalities if m not in own.modalities}
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
        raise ValueError(
            f"touch is stored minus its background in {minus[True]} and as it is in {minus[False]}: pack both alike"
        )
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
                hint = number_hint(one.spec.name, other) if column == "id" else ""
                return f"{by} {str(other.column(column)[both[0]])!r} {where} {len(np.unique(theirs[both]))}{hint}"
        if found := _known_image(other, scored, image_sums(one)[learned]):
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
        table |= _columns(part, pack, {n: new[n] for n in given if n in new}, prefixed, tasks.of[part])
        table["part"] = _text([part] * pack.num)
        if "sensor" not in given:
            table["sensor"] = table["part"]
        table |= {name: _text(pack.column(old).astype(str)) for old, name in new.items() if name in filters}
        table |= {name: _text(["hidden"] * pack.num) for name in splits - table.keys()}
        empty = pa.array(np.full(pack.num, np.nan))
        table |= {name: table[name].cast(pa.float64()) if name in table else empty for name in numbers}
        tables.append(pa.table(table))
    return pa.concat_tables(tables, promote_options="permissive")


def _mixed_spec(parts: Mapping[str, Pack], tasks: _Tasks, channels: Mapping[str, int], notes: list[str]) -> DataSpec:
    """The description of all parts together."""
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
