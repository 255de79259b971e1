"""Two packs as one for probes that learn on the one and are scored on the other."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pyarrow as pa

from mvitac.data.pack import Pack
from mvitac.data.row_hashes import image_sums
from mvitac.data.several import Several, columns_of_part, known_image, text
from mvitac.data.spec import MODALITIES, AnyTask, Task, ValueTask
from mvitac.system.files import brief


class JoinedPack(Several):
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
                    f"{modality} has {each[0]} in {learn.path}, {each[1]} in {score.path}: pack both alike"
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
            where = f"is learned from in {learn.path} and scored in {score.path}, one of {found[1]}"
            raise ValueError(f"{found[0]} {where}: give packs whose splits agree")

    def _shared(self) -> tuple[str, int] | None:
        """A group or an image that probes learn from and are scored on, and how many there are."""
        groups, sums, by = self.column("group").astype(str), image_sums(self), self.spec.group_by
        for task in self.spec.all_tasks:
            learned, scored = (self.rows(*splits, by=task.split) for splits in (("train", "val"), ("test",)))
            if by != "row" and len(both := np.intersect1d(groups[learned], groups[scored])):
                return f"{by} {str(both[0])!r}", len(both)
            if found := known_image(self, scored, sums[learned]):
                return found
        return None


def _common_tasks(learn: Pack, score: Pack) -> dict[str, AnyTask]:
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
    table = columns_of_part(part, pack, taken, {"id": "id"}, tasks)
    for name in {"split", *(task.split for task in tasks.values())}:
        table[name] = text(s if s in keep else "hidden" for s in pack.table.column(name).to_pylist())
    return pa.table(table)
