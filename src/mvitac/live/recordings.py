"""Predict from recordings: every frame of videos, folders of pictures or a pack, in batches, as ``Live`` would see it.

A table is a dict of columns: ``frame`` (its number) and ``time`` [s]; ``contact`` and ``touch`` (number of touches so
far), if the sensor was seen without contact; of a pack ``id``, ``group``, ``split``; and those of ``answers``.
"""

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np

from mvitac.data.pack import Pack
from mvitac.data.spec import Window
from mvitac.data.windows import windowed
from mvitac.deploy.engine import Engine, frame_shapes, spread_at
from mvitac.live.cameras import TOGETHER, Recording
from mvitac.live.contact import LiveConfig
from mvitac.live.predictor import Live, own_name
from mvitac.live.streams import Event, Stream
from mvitac.registry import from_json
from mvitac.system.files import brief
from mvitac.system.prefetch import prefetch

BATCH = 32
Table = dict[str, Any]


def answers(engine: Engine, outputs: dict[str, np.ndarray]) -> Table:
    """The columns of the engine's ``outputs``.

    Of classes: ``TASK``, ``TASK.confidence`` and ``TASK.CLASS``, its probability. Of values: ``TARGET [UNIT]`` and
    ``TARGET.spread [UNIT]``, the usual error of test rows in the same range; ``TASK.TARGET`` where a task has several.
    A name that is taken (``own_name``) is followed by what it is, in brackets.
    """
    table: Table = {}

    def put(name: str, kind: str, column: Any) -> None:
        table[own_name(name, kind, table)] = column

    for task, classes in engine.classes.items():
        p = outputs[f"probability_{task}"]
        put(task, "label", np.array(classes)[p.argmax(1)])
        put(f"{task}.confidence", "label", p.max(1))
        for k, name in enumerate(classes):
            put(f"{task}.{name}", "class", p[:, k])
    for task, targets in engine.values.items():
        for target, found in zip(targets, outputs[f"value_{task}"].T, strict=True):
            name, unit = target["name"] if len(targets) == 1 else f"{task}.{target['name']}", target["unit"]
            put(f"{name} [{unit}]", task, found)
            put(f"{name}.spread [{unit}]", task, [spread_at(target, value) for value in found.tolist()])
    return table


def pack_tables(engine: Engine, pack: Pack, about: Sequence[str] = ("group", "split")) -> Iterator[Table]:
    """Tables of the rows of a pack that have all images; ValueError if the model was trained on others.

    ``about``: further columns of the pack.
    """
    for modality in engine.inputs:
        if modality not in pack.images:
            raise ValueError(f"{pack.path} has no {modality}, which the model takes too")
        have, takes = pack.images[modality].shape[1:], frame_shapes(engine)[modality]
        if have != takes:
            what = f"{pack.path} has images of {modality} of {have}, the model takes {takes}"
            raise ValueError(f"{what}: name all its sensors (--{modality}), pack with --size {takes[0]}")
    if pack.spec.difference != engine.difference:
        where = "the pack" if pack.spec.difference else "the model"
        raise ValueError(f"{pack.path}: touch minus its background in {where} only: give recordings and --background")
    if engine.window:
        pack = windowed(pack, from_json(Window, {k: v for k, v in engine.window.items() if k != "layout"}))
    rows = np.flatnonzero(np.logical_and.reduce([pack.has(m) for m in engine.inputs]))
    known = [name for name in ("time", "contact", "id", *about) if name in pack.table.column_names]
    chunks = np.split(rows, range(BATCH, len(rows), BATCH))
    for some, images in prefetch((some, {m: pack.images[m][some] for m in engine.inputs}) for some in chunks):
        yield {"frame": some, **{name: pack.column(name)[some] for name in known}, **answers(engine, engine(**images))}


class Recordings:
    """Recordings of all cameras and sensors of a model, made at the same time.

    Attributes:
        num: Frames of the first touch sensor, or of the camera where there is none.
        left_out: Of these, how many were damaged, or more than ``TOGETHER`` away from those of another recording.
        told: What was wrong with frames -> number of the first one.
        calibrated: Whether every touch sensor was seen without contact.
    """

    def __init__(
        self, engine: Engine, files: dict[str, list[Recording]], config: LiveConfig, free: Sequence[np.ndarray] = ()
    ) -> None:
        """As for ``Live``; ValueError if the engine takes others or needs a sensor without contact that is not seen."""
        self.engine, self.left_out, self.told = engine, 0, dict[str, int]()
        streams: Any = {
            m: [Stream(f"{m} {i}", file, clock=lambda file=file: file.time) for i, file in enumerate(several)]
            for m, several in files.items()
        }
        self.live = Live(engine, streams, config, free=free, always=True, tell=self._tell)
        self.pairs: list[tuple[Any, Recording]] = [(s, s.origin) for several in streams.values() for s in several]
        self.leading: Any = self.live.leading.origin
        self.calibrated = all(self._calibrate(stream.name, stream.origin) for stream in streams.get("touch", ()))
        if self.live.minus_rest and not self.calibrated:
            num = config.calibration
            raise ValueError(f"no {num} frames show the sensor without contact, as the model needs: give --background")
        self.num = len(self.leading.times)

    def _tell(self, event: Event) -> None:
        if event.what == "resolution changed":
            text = f"{event.text}: contact is learned again from there, as if nothing were touched"
            self.told.setdefault(text, self.leading.number)

    def _take(self, name: str, file: Recording) -> np.ndarray | None:
        """The next frame; None if it is damaged, which is noted."""
        try:
            return file.cropped(file.read())
        except ValueError as error:
            self.told.setdefault(f"{name}: {brief(error)}", file.number)
        return None

    def _calibrate(self, name: str, file: Recording) -> bool:
        """Learn the background of a touch sensor from its first frames, or the first without contact."""
        contact = self.live.contacts[name]
        while contact.background is None and file.number + 1 < len(file.times):
            if (image := self._take(name, file)) is not None:
                contact(image)
                if contact.uneasy:
                    text = f"{name} was touched or moved: contact is learned from later frames, or give --background"
                    self.told.setdefault(text, file.number)
        file.open()
        return contact.background is not None

    def tables(self) -> Iterator[Table]:
        """Tables of up to ``BATCH`` frames; the next are read while the engine computes."""
        rows = self._rows()
        batches = iter(lambda: [*zip(*islice(rows, BATCH), strict=True)], [])
        for numbers, times, contact, touch, images in prefetch(batches):
            table = {"frame": numbers, "time": np.round(times, 6)}
            if self.live.contacts and self.calibrated:
                table |= {"contact": contact, "touch": touch}
            given = {m: np.stack([each[m] for each in images]) for m in self.engine.inputs}
            yield table | answers(self.engine, self.engine(**given))

    def _rows(self) -> Iterator[tuple[int, float, bool | None, int, dict[str, np.ndarray]]]:
        """Number, time, contact and touch of each frame, and what the model gets of it."""
        for number, time in enumerate(self.leading.times.tolist()):
            for stream, file in self.pairs:
                while file.number < 0 or (file.number < number if file is self.leading else _nearer(file, time)):
                    if (image := self._take(stream.name, file)) is not None:
                        stream.take(image)
            newest = {m: [stream.newest() for stream in several] for m, several in self.live.streams.items()}
            apart = [abs(f.time - time) if f else np.inf for several in newest.values() for f in several]
            found, given = self.live.leading.newest(), None
            if max(apart) <= TOGETHER and found and found.time == time:
                self.live.remember()
                _, given = self.live.see(newest)  # type: ignore[arg-type]
            if given is None:  # also a sensor whose images change in size, until its background is known again
                self.left_out += 1
                continue
            yield number, time, self.live.contact, self.live.num_touches, given


def _nearer(file: Recording, time: float) -> bool:
    after = file.times[file.number + 1 : file.number + 2]
    return bool(len(after) and abs(after[0] - time) <= abs(file.time - time))
