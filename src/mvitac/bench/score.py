"""Score one encoder on a suite, part by part: every task of every set, and the controls beside it.

A part that is finished is kept in <out>/parts until the result is written, so an interrupted bench continues. The parts
of the controls stay: they are the same for every encoder of the folder.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.bench.result import trimmed
from mvitac.bench.suite import Opened, Suite, SuiteSet, SuiteTask, Untrained, open_set
from mvitac.data.jpeg import Lazy
from mvitac.data.pack import Images, Pack
from mvitac.data.spec import AnyTask, DataSpec
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation.controls import Records, label_controls, pixel_controls
from mvitac.evaluation.evaluate import check_unseen
from mvitac.evaluation.features import features
from mvitac.evaluation.leaks import UNKNOWN, Scored
from mvitac.evaluation.probe import joined, names_in, probe_all, split_rows
from mvitac.evaluation.robustness import few_labels
from mvitac.evaluation.scores import pool
from mvitac.methods.base import MethodConfig
from mvitac.model import Model, fresh
from mvitac.nn.encoders import SCRATCH, EncoderConfig
from mvitac.registry import default
from mvitac.run import Run
from mvitac.system.files import digest, read_json, write_json
from mvitac.system.progress import work
from mvitac.system.provenance import provenance
from mvitac.transforms.random_views import Augment


class _Channels(Lazy):
    """Some channels of images: one sensor of several that are stacked."""

    def __init__(self, images: Images, first: int, num: int) -> None:
        super().__init__((*images.shape[:3], num))
        self.images, self.kept = images, slice(first, first + num)

    def _made(self, rows: np.ndarray) -> np.ndarray:
        return self.images[rows][..., self.kept]


def sensors(pack: Pack, modality: str, channels: int) -> list[Pack]:
    """Views of ``pack`` whose images have ``channels``: one for each of the sensors that are stacked."""
    have = pack.spec.channels(modality)
    views = [pack] if have == channels else [copy.copy(pack) for _ in range(have // channels)]
    for k, view in enumerate(views if have != channels else ()):
        view.images = {**pack.images, modality: _Channels(pack.images[modality], k * channels, channels)}
        view.digests = {**pack.digests, modality: f"channels {k * channels} to {(k + 1) * channels}"}
        view.spec = replace(pack.spec, **{f"{modality}_channels": channels})
    return views


def misfit(model: Model, pack: Pack, modality: str) -> str:
    """Why ``model`` cannot read the images of a modality; "" if it can."""
    if modality not in model.encoders:
        return f"the encoder has no {modality}"
    have, takes = pack.spec.channels(modality), model.spec.channels(modality)
    if model.spec.frames(modality) > 1:
        return f"the encoder takes windows of {model.spec.frames(modality)} {modality} frames, the data has single ones"
    if modality == "touch" and model.spec.difference != pack.spec.difference:
        return "the encoder takes touch minus its background, the data has none"
    if not takes or have % takes:
        return f"the encoder takes {takes} channels of {modality}, the data has {have}"
    return ""


@dataclass
class Reader:
    """Features of one model for one set, of all rows that its tasks need. Two stacked sensors are read one by one."""

    model: Model
    opened: Opened
    name: str
    """What errors call the model."""
    known: dict[tuple[str, bool], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    def read(self, modality: str, rows: np.ndarray, maps: bool = False) -> np.ndarray:
        """Features [len(rows), D] or maps [len(rows), P, D]; ValueError if they are no finite numbers."""
        parts = []
        for m in names_in(modality, self.opened.packs[0]):
            if (m, maps) not in self.known:
                self.known[m, maps] = self._all(m, maps)
            own, z = self.known[m, maps]
            parts.append(z[np.searchsorted(own, rows)])
        return joined(parts)

    def _all(self, modality: str, maps: bool) -> tuple[np.ndarray, np.ndarray]:
        """All rows of a modality that are needed, and their features."""
        pack = self.opened.packs[0]
        asked = [(task, m) for ask, task in self.opened.tasks for m in ask.modalities if modality in names_in(m, pack)]
        rows = np.unique(
            np.concatenate([split_rows(view, task, m).all for view in self.opened.packs for task, m in asked])
        )
        views = sensors(pack, modality, self.model.spec.channels(modality))
        z = joined([features(self.model, view, modality, rows, maps=maps) for view in views])
        if z.ndim != 2 + maps or len(z) != len(rows):
            raise ValueError(
                f"{self.name} gives features of shape {list(z.shape)} for {len(rows)} {modality} images:"
                f" [{len(rows)}, D] is needed, one vector per image"
            )
        bad = int((~np.isfinite(z).reshape(len(z), -1).all(axis=1)).sum())
        if bad:
            raise ValueError(
                f"{self.name} gives NaN or infinite features for {bad} of {len(rows)} {modality} images of"
                f" {pack.spec.name}: check its weights and preprocessing"
            )
        return rows, z


def probe_reader(reader: Reader, suite: Suite, ask: SuiteTask, task: AnyTask) -> Records:
    """Records of every modality that the model can read, by the probes of the suite; folds are pooled."""
    pack = reader.opened.packs[0]
    able = [m for m in ask.modalities if not any(misfit(reader.model, pack, one) for one in names_in(m, pack))]
    own = {"source": "", "seed": reader.model.run.seed}
    each = []
    for view in reader.opened.packs if able else ():
        maps = (lambda m, rows: reader.read(m, rows, maps=True)) if "attentive" in suite.probes else None
        found = probe_all(reader.read, view, [task], able, suite.probes, suite.seed, maps)
        for modality, share in ((m, share) for m in able for share in ask.labels):
            rows = split_rows(view, task, modality)
            few = few_labels(reader.read(modality, rows.all), view, task, rows, share, suite.seed)
            found.append({"task": task.name, "modality": modality, "probe": f"{100 * share:g} % of labels", **few})
        each.append([{**own, **record} for record in found])
    return pool(each) if len(each) > 1 else [record for found in each for record in found]


def control_records(readers: Sequence[Reader], opened: Opened, suite: Suite, ask: SuiteTask, task: AnyTask) -> Records:
    """Records of majority or mean, the data's own columns, pixels, border, and the untrained trunks ``readers``."""
    each = [label_controls(view, [task]) + pixel_controls(view, [task], ask.modalities) for view in opened.packs]
    linear = replace(suite, probes=("linear",))
    trunks = [r for reader in readers for r in probe_reader(reader, linear, ask, task)]
    return (pool(each) if len(each) > 1 else each[0]) + [{**r, "source": "untrained"} for r in trunks]


def untrained(about: Untrained, seed: int) -> Model:
    """The untrained trunk: one for each modality, for three channels."""
    encoder = EncoderConfig(trunk=about.trunk, weights=SCRATCH)
    method, augment = default(MethodConfig, "simclr"), Augment(size=about.size, whole=about.size)
    run = Run(method=method, data=PackConfig(), encoder=encoder, augment=augment, seed=seed)
    channels = {"vision_channels": 3, "touch_channels": 3}
    spec = DataSpec(name="nothing", tasks=(), group_by="row", licence="", source="", **channels)
    return fresh(run, spec, about.size)


@dataclass(frozen=True)
class Entry:
    """An encoder to score: its seeds, where they are, and its name in errors.

    ``said`` is what its owner says of its training data; None if nothing is known.
    """

    models: Sequence[Model]
    paths: Sequence[Path]
    name: str
    said: str | None = None

    def leaks(self, opened: Opened, task: AnyTask, names: Sequence[str]) -> list[str]:
        """For each seed, what it saw of the test rows (``evaluation.leaks``)."""
        pack = opened.packs[0]
        rows = np.unique(np.concatenate([split_rows(view, task).test for view in opened.packs]))
        scored, found = Scored(pack), []
        for path, model in zip(self.paths, self.models, strict=True):
            (sources,) = check_unseen([path], [model], pack, [], allow_leak=True)
            found.append(scored.leak(sources, rows) if sources is not None else self._declared(names))
        return found

    def _declared(self, names: Sequence[str]) -> str:
        """The leak that the owner's own words admit; without a list of rows, more is not known."""
        if self.said is None:
            return UNKNOWN
        named = [name for name in names if name.lower() in self.said.lower()]
        return f"its owner's training had {named[0]}; which rows is not known" if named else ""


def score_suite(entry: Entry, suite: Suite, root: Path | None, parts: Path, key: str) -> Iterator[dict[str, Any]]:
    """Score ``entry`` task by task; each finished part is kept in the folder ``parts``.

    Args:
        entry: The encoder.
        suite: The suite.
        root: Folder of the real data.
        parts: Folder of finished parts.
        key: Digest of the encoder.

    Yields:
        A block for each task: "set", "task" and either "not_run" or what ``result.sign`` takes.

    Raises:
        ValueError: If the encoder reads none of the tasks, gives no finite features, or data is not that of the suite.
    """
    here = provenance()
    with work(f"scoring {entry.name} on {suite.name}", sum(len(one.tasks) for one in suite.sets), "tasks") as advance:
        for one in suite.sets:
            opened = open_set(one, root)
            if isinstance(opened, str):
                yield from ({"set": one.name, "task": ask.name, "not_run": opened} for ask in one.tasks)
                advance(len(one.tasks))
                continue
            readers = [Reader(model, opened, entry.name) for model in entry.models]
            controls = [Reader(untrained(suite.untrained, s), opened, "untrained") for s in suite.untrained.seeds]
            for ask, task in opened.tasks:
                about = [suite.digest(), one.name, ask.name, opened.digests, here["versions"], here["commit"]]
                beside = _kept(
                    parts,
                    ["controls", *about],
                    lambda a=ask, t=task, o=opened, c=controls: control_records(c, o, suite, a, t),
                )
                own = _kept(
                    parts,
                    [key, *about],
                    lambda a=ask, t=task, r=readers: [x for one in r for x in probe_reader(one, suite, a, t)],
                    key,
                )
                yield _block(entry, one, opened, ask, task, own, beside)
                advance()


def _block(
    entry: Entry, one: SuiteSet, opened: Opened, ask: SuiteTask, task: AnyTask, own: Records, beside: Records
) -> dict[str, Any]:
    """The records of one task with what they were scored on; "not_run" if the encoder reads none of its modalities."""
    pack = opened.packs[0]
    lacks = {m: [misfit(entry.models[0], pack, x) for x in names_in(m, pack)] for m in ask.modalities}
    lacking = {m: next(reason for reason in reasons if reason) for m, reasons in lacks.items() if any(reasons)}
    about = {"set": one.name, "task": task.name}
    if not own:
        return {**about, "not_run": next(iter(lacking.values()))}
    groups = [
        np.unique(view.column("group")[split_rows(view, task).test].astype(str)).tolist() for view in opened.packs
    ]
    return {
        **about,
        "form": opened.form,
        "data": opened.digests,
        "pinned": opened.pinned,
        "group_by": pack.spec.group_by,
        "groups": [name for fold in groups for name in fold],
        "lacking": lacking,
        "leaks": entry.leaks(opened, task, one.names),
        "records": [*own, *beside],
    }


def _kept(parts: Path, about: list[Any], score: Callable[[], Records], prefix: str = "controls") -> Records:
    """The records of a part: those kept in the folder ``parts``, else scored now and kept."""
    path = parts / f"{prefix[:16]}-{digest(about)[:24]}.json"
    if path.exists():
        return read_json(path, "a part of a bench")
    records = [trimmed(record) for record in score()]
    write_json(path, records)
    return records
