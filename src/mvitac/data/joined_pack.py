"""Two packs as one: train probes on the first and test them on the second (another sensor, room or robot)."""

from dataclasses import replace

import numpy as np
import pyarrow as pa

from mvitac.data.lazy import Pieces
from mvitac.data.pack import Images, Pack
from mvitac.data.row_hashes import image_sums, known_images
from mvitac.data.spec import MODALITIES, AnyTask, Task, ValueTask
from mvitac.registry import unknown
from mvitac.system.files import brief


class JoinedPack(Pack):
    """Train and val rows of ``learn`` followed by test rows of ``score``.

    Tasks are those that both packs have, with the classes of ``learn``. ValueError if there is none, or the packs have
    other image shapes, classes that ``learn`` lacks, or a group or an image in both (test rows would not be unseen).

    Attributes:
        learn: The first pack; its rows come first.
    """

    def __init__(self, learn: Pack, score: Pack) -> None:
        self.path, self.meta, self.learn = score.path, score.meta, learn
        self.num, self.size, self.store = learn.num + score.num, learn.size, "raw"
        self.digests = {"learn": learn.digest, "score": score.digest}
        _check_shapes(learn, score)
        tasks = _common_tasks(learn, score)
        columns = {"split", *(task.split for task, _ in tasks)}
        learned = _side(learn, tasks, columns, "learned", {"train", "val"})
        self.table = _joined(learned, _side(score, tasks, columns, "scored", {"test"}))
        theirs = score.spec.controls
        self.spec = replace(
            learn.spec,
            name=f"{score.path.name}, probes learned on {learn.path.name}",
            tasks=tuple(task for task, _ in tasks if isinstance(task, Task)),
            values=tuple(task for task, _ in tasks if isinstance(task, ValueTask)),
            controls={name: given for name, given in learn.spec.controls.items() if theirs.get(name) == given},
            notes=tuple(dict.fromkeys((*learn.spec.notes, *score.spec.notes))),
        )
        starts = np.array([0, learn.num, self.num])
        self.images: dict[str, Images] = {
            m: Pieces(self._shape(m, self.num), starts, [learn.images[m], score.images[m]].__getitem__)
            for m in self.spec.modalities
        }
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
            for same, modality in zip(known_images(self, scored, sums[learned]).T, MODALITIES, strict=True):
                if same.any():
                    return f"the {modality} image of row {str(self.own_ids[scored[same][0]])!r}", int(same.sum())
        return None

    @property
    def own_ids(self) -> np.ndarray:
        return np.array([one.partition("/")[2] for one in self.column("id")])


def _check_shapes(learn: Pack, score: Pack) -> None:
    for modality in ("vision", "touch"):
        shapes = [(pack.size, pack.spec.channels(modality)) for pack in (learn, score)]
        if any(num for _, num in shapes) and shapes[0] != shapes[1]:
            raise ValueError(
                f"{modality} has {shapes[0][1]} channels at {shapes[0][0]} px in {learn.path} and {shapes[1][1]} at"
                f" {shapes[1][0]} px in {score.path}: pack both with the same shape (--data.size)"
            )


def _common_tasks(learn: Pack, score: Pack) -> list[tuple[AnyTask, AnyTask]]:
    """Return the tasks that both packs have, as defined by each."""
    known = {task.name: task for task in learn.spec.all_tasks}
    tasks = [(known[task.name], task) for task in score.spec.all_tasks if task.name in known]
    if not tasks:
        names = [", ".join(task.name for task in pack.spec.all_tasks) or "none" for pack in (learn, score)]
        raise ValueError(f"no task is in both packs: {learn.path} has {names[0]}, {score.path} {names[1]}")
    for ours, theirs in tasks:
        if (ours.only, ours.split) != (theirs.only, theirs.split):
            raise ValueError(f"task {ours.name!r} is about other rows or split otherwise in {score.path}")
        if isinstance(ours, ValueTask) or isinstance(theirs, ValueTask):
            asked = [_targets(task) for task in (ours, theirs)]
            if asked[0] != asked[1]:
                raise ValueError(f"task {ours.name!r} is {asked[0]} in {learn.path} and {asked[1]} in {score.path}")
    return tasks


def _targets(task: AnyTask) -> str:
    if isinstance(task, Task):
        return "classes"
    return ", ".join(f"{target.name} in {target.unit}" for target in task.targets)


def _side(pack: Pack, tasks: list[tuple[AnyTask, AnyTask]], splits: set[str], name: str, keep: set[str]) -> pa.Table:
    """Return the columns of ``pack`` that probes read.

    Rows of splits other than ``keep`` get the split "hidden" in the columns ``splits``. Labels are numbered as in the first
    task of each pair; ids get the prefix ``name``.
    """
    read = {
        "id",
        "group",
        *(f"crc_{modality}" for modality in MODALITIES),
        *(c for task, _ in tasks for c in task.only),
        *(target.name for task, _ in tasks if isinstance(task, ValueTask) for target in task.targets),
        *(c for cs in pack.spec.controls.values() for c in cs),
    }
    columns = {n: pack.table.column(n) for n in pack.table.column_names if n in read}
    columns["id"] = pa.array([f"{name}/{one}" for one in columns["id"].to_pylist()])
    for column in splits:
        columns[column] = pa.array([s if s in keep else "hidden" for s in pack.table.column(column).to_pylist()])
    columns["sensor"] = pa.array(np.array(pack.sensor_names)[pack.sensors])
    for modality in pack.spec.modalities:
        columns[f"has_{modality}"] = pa.array(pack.has(modality))
    own = {task.name: task for task in pack.spec.tasks}
    for task in (task for task, _ in tasks if isinstance(task, Task)):
        numbers = [task.classes.index(c) if c in task.classes else -2 for c in own[task.name].classes]
        labels = np.array([*numbers, -1])[pack.column(f"label_{task.name}").astype(int)]  # -1 (no label) is the last
        if (labels == -2).any():
            new = next(c for c in own[task.name].classes if c not in task.classes)
            raise unknown(f"class of {task.name}", f"{new} ({pack.path})", task.classes)
        columns[f"label_{task.name}"] = pa.array(labels)
    return pa.table(columns)


def _joined(first: pa.Table, second: pa.Table) -> pa.Table:
    """Return the rows of both tables with their common columns."""
    names = [name for name in first.column_names if name in second.column_names]
    try:
        return pa.concat_tables([first.select(names), second.select(names)], promote_options="permissive")
    except pa.ArrowException as error:
        raise ValueError(f"the packs' columns differ in kind ({brief(error)})") from None
