"""Score one encoder on a suite, task by task, and the controls beside it.

Scores of a finished task are kept in <out>/parts until the result is written, so an interrupted bench continues. Those of
the controls stay: they are the same for every encoder of the folder.
"""

import copy
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.bench.check import NO_IMAGENET
from mvitac.bench.external import ExternalModel, open_model
from mvitac.bench.result import stored
from mvitac.bench.suite import Opened, Suite, SuiteSet, SuiteTask, open_set
from mvitac.data.lazy import Changed
from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask
from mvitac.evaluation import few_labels
from mvitac.evaluation.controls import Records, label_controls, pixel_controls
from mvitac.evaluation.features import features
from mvitac.evaluation.leaks import Scored, declared_leak, read_sources
from mvitac.evaluation.probe import names_in, probe_all, split_rows
from mvitac.evaluation.scores import pool
from mvitac.model import Model
from mvitac.system.files import digest, fields_of, read_json, write_json
from mvitac.system.progress import work
from mvitac.system.provenance import provenance


def sensors(pack: Pack, modality: str, channels: int) -> list[Pack]:
    """Views of ``pack`` for an encoder of ``channels``: one for each of the sensors that are stacked."""
    if (have := pack.spec.channels(modality)) == channels:
        return [pack]
    views = []
    for first in range(0, have, channels):
        views.append(view := copy.copy(pack))
        own = Changed(pack.images[modality], channels, lambda rows, x, i=first: x[..., i : i + channels])
        view.images = {**pack.images, modality: own}
        view.digests = {**pack.digests, modality: f"channels from {first}"}
    return views


def misfit(model: Model, pack: Pack, modality: str) -> str:
    """Why ``model`` cannot read the images of a modality; "" if it can."""
    if modality not in model.encoders:
        return f"the encoder has no {modality}"
    if isinstance(model, ExternalModel):
        return ""
    have, takes = pack.spec.channels(modality), model.spec.channels(modality)
    if model.spec.frames(modality) > 1:
        return f"the encoder takes windows of {model.spec.frames(modality)} frames, the data has single ones"
    if modality == "touch" and model.spec.difference != pack.spec.difference:
        return "the encoder was trained on touch minus its background, the data has raw images"
    return f"the encoder takes {takes} channels of {modality}, the data has {have}" if have % takes else ""


@dataclass
class Reader:
    """Features of one model for one set, of all rows that its tasks need. Stacked sensors are read one by one."""

    model: Model
    opened: Opened
    name: str
    known: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @cached_property
    def bound(self) -> tuple[Model, Pack]:
        """The model and the data, for each other (``ExternalModel.on``)."""
        pack = self.opened.packs[0]
        return self.model.on(pack) if isinstance(self.model, ExternalModel) else (self.model, pack)

    @property
    def notes(self) -> list[str]:
        """What the data lacks that the encoder's owner wants."""
        return list(self.bound[0].notes) if isinstance(self.bound[0], ExternalModel) else []

    def read(self, modality: str, rows: np.ndarray) -> np.ndarray:
        """Features [len(rows), D] of touch or vision."""
        if modality not in self.known:
            self.known[modality] = self._all(modality)
        own, z = self.known[modality]
        return z[np.searchsorted(own, rows)]

    def _all(self, modality: str) -> tuple[np.ndarray, np.ndarray]:
        """All rows of a modality that are needed, and their features; ValueError if these are no finite numbers."""
        model, pack = self.bound
        asked = [(task, m) for ask, task in self.opened.tasks for m in ask.modalities if modality in names_in(m, pack)]
        rows = np.unique(np.concatenate([split_rows(v, task, m).all for v in self.opened.packs for task, m in asked]))
        parts = sensors(pack, modality, model.spec.channels(modality))
        z = np.concatenate([features(model, part, modality, rows) for part in parts], axis=1)
        if bad := int((~np.isfinite(z).all(axis=1)).sum()):
            what = f"NaN or infinite features of {modality} for {bad} of {len(rows)} images"
            raise ValueError(f"{self.name} gives {what}: check its weights and preprocessing")
        return rows, z

    def score(self, suite: Suite, ask: SuiteTask, task: AnyTask, source: str, probes: Sequence[str]) -> Records:
        """Records of every modality that the model can read; folds are pooled."""
        pack, each = self.opened.packs[0], []
        able = [m for m in ask.modalities if not any(misfit(self.model, pack, one) for one in names_in(m, pack))]
        kinds = [*probes, *(few_labels.name(100 * share) for share in ask.labels)]
        for view in self.opened.packs if able else ():
            found = probe_all(self.read, view, [task], able, kinds, suite.seed)
            each.append([{"source": source, "seed": self.model.seed, **record} for record in found])
        return pool(each) if len(each) > 1 else [record for found in each for record in found]


@dataclass(frozen=True)
class Entry:
    """An encoder to score: the models of its seeds, their folders, its name, and the words on its training data."""

    models: Sequence[Model]
    places: Sequence[str]
    name: str
    trained_on: str | None

    def leaks(self, opened: Opened, task: AnyTask, names: Sequence[str]) -> list[str]:
        """What each seed saw of the test rows (``evaluation.leaks``); without a list of rows, what its owner says."""
        rows = np.unique(np.concatenate([split_rows(view, task).test for view in opened.packs]))
        pack, found = opened.packs[0], []
        for place, model in zip(self.places, self.models, strict=True):
            sources = None if isinstance(model, ExternalModel) else read_sources(Path(place))
            declared = declared_leak(self.trained_on, names)
            found.append(declared if sources is None else Scored(pack).leak(sources, rows, names))
        return found


def score_suite(entry: Entry, suite: Suite, root: Path | None, parts: Path, key: str) -> Iterator[dict[str, Any]]:
    """Score ``entry``, and yield a block for each task: "set", "task", and "not_run" or its records.

    ``root`` holds the real data. Scores of finished tasks are kept in ``parts``, under ``key``, the encoder's digest.
    """
    here = provenance()
    beside, lacking = trunks(suite)
    weights = [model.weights_digest() for _, model in beside]
    with work(f"{entry.name} on {suite.name}", sum(len(one.tasks) for one in suite.sets), "tasks") as advance:
        for one in suite.sets:
            opened = open_set(one, root)
            if isinstance(opened, str):
                yield from ({"set": one.name, "task": ask.name, "not_run": opened} for ask in one.tasks)
                advance(len(one.tasks))
                continue
            own = [Reader(model, opened, entry.name) for model in entry.models]
            readers = [Reader(model, opened, name) for name, model in beside]
            for ask, task in opened.tasks:
                about = [suite.digest(), one.name, ask.name, opened.digests, opened.beside]
                about += [here["versions"], here["commit"]]
                asked = suite, ask, task
                controls = kept_part(parts, "controls", [*about, weights], partial(_controls, readers, opened, *asked))
                scored = kept_part(parts, key, about, partial(_scores, own, *asked))
                block = _block(entry, one, opened, ask, task, scored, controls)
                yield {**block, "notes": [*own[0].notes, *lacking]} if scored else block
                advance()


def trunks(suite: Any) -> tuple[list[tuple[str, ExternalModel]], list[str]]:
    """The controls that are networks, by name, and a note on that of ImageNet where its weights cannot be had."""
    found = [("untrained", open_model(text)) for text in suite.untrained]
    try:
        return [*found, ("imagenet", open_model(suite.imagenet))], []
    except ValueError as error:
        print(f"mvitac: {NO_IMAGENET}: {error}", file=sys.stderr)
        return found, [NO_IMAGENET]


def _scores(readers: Sequence[Reader], suite: Suite, ask: SuiteTask, task: AnyTask) -> Records:
    return [stored(record) for reader in readers for record in reader.score(suite, ask, task, "", suite.probes)]


def _controls(readers: Sequence[Reader], opened: Opened, suite: Suite, ask: SuiteTask, task: AnyTask) -> Records:
    """Majority or mean, the data's own columns, pixels, border, and the untrained and ImageNet trunks of ``readers``."""
    each = [label_controls(view, [task]) + pixel_controls(view, [task], ask.modalities) for view in opened.packs]
    found = [r for reader in readers for r in reader.score(suite, ask, task, reader.name, ["linear"])]
    found = [{**r, "seed": None} if r["source"] == "imagenet" else r for r in found]
    return [stored(record) for record in (*(pool(each) if len(each) > 1 else each[0]), *found)]


def _block(
    entry: Entry, one: SuiteSet, opened: Opened, ask: SuiteTask, task: AnyTask, own: Records, controls: Records
) -> dict[str, Any]:
    pack = opened.packs[0]
    why = {m: [misfit(entry.models[0], pack, each) for each in names_in(m, pack)] for m in ask.modalities}
    left_out = {m: next(filter(None, reasons)) for m, reasons in why.items() if any(reasons)}
    block: dict[str, Any] = {"set": one.name, "task": task.name}
    if not own:
        return block | {"not_run": next(iter(left_out.values()))}
    names = [np.unique(v.column("group")[split_rows(v, task).test].astype(str)).tolist() for v in opened.packs]
    block |= {"form": opened.form, "data": opened.digests, "group_by": pack.spec.group_by}
    block |= {"groups": [name for fold in names for name in fold], "leaks": entry.leaks(opened, task, one.names)}
    return block | {"left_out": left_out, "records": [*own, *controls]}


def kept_part(parts: Path, key: str, about: list[Any], score: Callable[[], Records]) -> Records:
    """The records of a part of a result: those kept, else scored now and kept."""
    path = parts / f"{key[:16]}-{(of := digest([key, *about]))[:24]}.json"
    if not path.exists():
        write_json(path, {"of": of, "records": score()}, sealed=True)
    part = read_json(path, "a part of a bench")
    with fields_of(path):
        assert part["of"] == of, "it is of another task, data or encoder"
        return part["records"]
