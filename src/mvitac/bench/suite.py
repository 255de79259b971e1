"""Suites: versioned definitions of tasks (``suites/*.toml``), and their data opened as packs.

A suite fixes data, rows, splits, probes, seeds and controls. Its digest covers all of it except the pins, which are the
digests of the data that was measured. A definition that changes gets another name (sim-v3).
"""

import re
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mvitac.bench.external.adapters import parse
from mvitac.data.pack import Pack
from mvitac.data.several import JoinedPack
from mvitac.data.spec import AnyTask, DataSpec, Task
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.simulated import SimulatedConfig
from mvitac.datasets.table.splits import folds
from mvitac.evaluation import few_labels
from mvitac.evaluation.probe import VALUE_PROBES
from mvitac.evaluation.probe_config import Probe
from mvitac.registry import check_known, from_json, to_json, unknown
from mvitac.system.files import brief, digest, parse_toml

SUITES = Path(__file__).parent / "suites"
VERSION = re.compile(r"-v\d+$")  # at the end of a suite's name
Pinned = Literal["same", "other pixels", "other rows", "not pinned"]
"""Data beside the pins of its suite. Only simulated data may have other rows: those of another processor's arithmetic."""


@dataclass(frozen=True, kw_only=True)
class SuiteTask:
    name: str  # its name in the data
    modalities: tuple[Literal["touch", "vision", "both"], ...]  # features to probe
    labels: tuple[float, ...] = ()  # fractions of the labels with which the linear probe is fitted once more

    def __post_init__(self) -> None:
        for share in self.labels:
            if not 0 < share < 1:
                raise ValueError(f"task {self.name!r}: labels {share}: give fractions above 0 and below 1")
        given = (*self.modalities, *(few_labels.name(100 * share) for share in self.labels))
        if not self.modalities or len({*given}) < len(given):
            raise ValueError(f"task {self.name!r}: give touch, vision or both, and nothing twice")


@dataclass(frozen=True, kw_only=True)
class Form:
    """One way in which the data of a set exists."""

    name: str
    data: dict[str, Any]  # options of a dataset config, with its name
    at: dict[str, str] = field(default_factory=dict)
    """Option that names a place -> the place below --data-root. Empty: the data is simulated."""
    score_on: dict[str, Any] = field(default_factory=dict)
    """Options that are different in the data that is scored, if probes are fitted on other data (a new sensor)."""
    pins: dict[str, str] = field(default_factory=dict)
    """Digests of the rows and of the images of each modality, where the suite was measured."""


@dataclass(frozen=True, kw_only=True)
class SuiteSet:
    name: str
    forms: tuple[Form, ...]
    """The first one that is found below --data-root is used. Scores of different forms are not compared."""
    tasks: tuple[SuiteTask, ...]
    folds: int = 0  # cross-validation over this number of folds of whole groups; 0 = the data's own split
    val_every: int = 2  # of the groups tested in the next fold, every n-th chooses the regularisation
    names: tuple[str, ...] = ()  # what owners of encoders call this data in their list of training data

    def __post_init__(self) -> None:
        if self.folds < 0 or self.folds == 1:
            raise ValueError(f"set {self.name!r}: folds {self.folds}: give 2 or more, or 0 for the data's own split")
        if self.val_every < 1:
            raise ValueError(f"set {self.name!r}: val_every {self.val_every}: give 1 or more")
        if not self.tasks or not self.forms or len({task.name for task in self.tasks}) < len(self.tasks):
            raise ValueError(f"set {self.name!r} needs at least one task and one form, and no task twice")


@dataclass(frozen=True, kw_only=True)
class Suite:
    name: str
    title: str
    probes: tuple[Probe, ...]  # probes of encoders; the page shows the first. Controls have the linear one.
    seed: int  # seed of the probes, and of which labels are kept
    untrained: tuple[str, ...]  # the seeds of the control "untrained": external encoders with random weights
    imagenet: str  # the control "imagenet", a frozen external encoder; left out where its weights cannot be had
    sets: tuple[SuiteSet, ...]

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise ValueError("the suite has no name: give one")
        if self.seed < 0:
            raise ValueError(f"suite {self.name!r}: seed {self.seed}: give a number >= 0")
        if not ({*self.probes} & {*VALUE_PROBES} and self.untrained and self.sets):
            raise ValueError(f"suite {self.name!r} needs linear or knn, and at least one of untrained and sets")
        for each in (self.probes, [parse(text).seed for text in self.untrained], [one.name for one in self.sets]):
            if len({*each}) < len(each):
                raise ValueError(f"suite {self.name!r}: of {', '.join(map(str, each))} one is there twice")

    def definition(self) -> dict[str, Any]:
        value = to_json(self)
        for form in (form for one in value["sets"] for form in one["forms"]):
            del form["pins"]
        return value

    def digest(self) -> str:
        return digest(self.definition())


def shipped() -> list[str]:
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def find_suite(name: str) -> Suite:
    """The suite ``name``, or that in a TOML file; ValueError if there is none or it is invalid."""
    file = Path(name) if name.endswith(".toml") else SUITES / f"{name}.toml"
    if not file.is_file():
        raise unknown("suite", name, [*shipped(), "FILE.toml"])
    try:
        suite = from_json(Suite, parse_toml(file.read_text()), "suite")
        for form in (form for one in suite.sets for form in one.forms):
            _check_places(form, _config(form, Path(), form.data))
            if form.pins and suite.name not in shipped():
                raise ValueError(f"form {form.name!r} has pins, which only shipped suites keep: leave them out")
        for text, weights in {**dict.fromkeys(suite.untrained, "random"), suite.imagenet: "pretrained"}.items():
            if (getattr(adapter := parse(text), "weights", ""), adapter.reads) != (weights, "both"):
                raise ValueError(f"control {text!r}: give external:timm/NAME,weights={weights}, which reads both")
        if file == Path(name) and (now := outdated(suite)):
            raise ValueError(f"{now} of this version is another suite: give it another name than {suite.name}")
    except ValueError as error:
        raise ValueError(f"{file} is not a suite ({brief(error)})") from None
    return suite


def outdated(suite: Suite) -> str:
    """The suite of this version that has the name of ``suite``, or its name but for the version, and is another; or ""."""
    now = {VERSION.sub("", name): name for name in shipped()}.get(VERSION.sub("", suite.name), "")
    return now if now and (now != suite.name or find_suite(now).digest() != suite.digest()) else ""


def _check_places(form: Form, config: DatasetConfig) -> None:
    """ValueError unless all places that the form names are below --data-root: a suite may be a stranger's."""
    hints = typing.get_type_hints(type(config))
    for name in {**form.data, **form.score_on}:
        if "Path" in str(hints.get(name)) or name in ("url", "parts"):
            raise ValueError(f"form {form.name!r} names a place in {name!r}: say in 'at' where it is below --data-root")
    for place in (*form.at.values(), *(text.rpartition(":")[0] for text in getattr(config, "log", ()))):
        if Path(place).is_absolute() or {"..", "~"} & {*Path(place).parts} or ":" in place:
            raise ValueError(f"form {form.name!r}: {place!r} is not a place below --data-root")


def _config(form: Form, root: Path, options: dict[str, Any]) -> DatasetConfig:
    places = {option: str(root / place) for option, place in form.at.items()}
    return from_json(DatasetConfig, {**options, **places}, "data")


def simulated_spec(form: Form) -> DataSpec | None:
    """The spec of data that is simulated, which needs no files; None of other data."""
    config = _config(form, Path(), form.data)
    return config.source().spec() if isinstance(config, SimulatedConfig) else None


@dataclass(frozen=True)
class Opened:
    form: str  # name of the form
    packs: tuple[Pack, ...]  # one per fold, which differ in the column split only
    tasks: tuple[tuple[SuiteTask, AnyTask], ...]  # what the suite asks, and the task as the data defines it
    digests: dict[str, str]  # of the data

    @property
    def beside(self) -> str:
        """Digest of what scores and controls depend on, too, and ``digests`` have not: the data's controls, touches."""
        pack = self.packs[0]
        used = {n: [pack.column(c).astype(str).tolist() for c in columns] for n, columns in pack.spec.controls.items()}
        return digest([used, pack.touch_groups.tolist()])


def open_set(one: SuiteSet, root: Path | None) -> Opened | str:
    """Open the data of a set; the reason in one line if it is not there. ValueError if it is not that of the suite."""
    for form in one.forms:
        if form.at and (root is None or not all((root / place).exists() for place in form.at.values())):
            continue
        made = [_config(form, root or Path(), form.data).open()]
        if form.score_on:
            made.append(_config(form, root or Path(), {**form.data, **form.score_on}).open())
        pack = JoinedPack(made[0], made[1]) if form.score_on else made[0]
        known = {task.name: task for task in pack.spec.all_tasks}
        check_known(f"task of {one.name}", (asked.name for asked in one.tasks), known)
        tasks = tuple((asked, known[asked.name]) for asked in one.tasks)
        packs = _fold(pack, one) if one.folds else (pack,)
        sides = zip(("", "scored "), made, strict=False)  # before the modalities of the data that is scored
        files = [(by + name.partition(".")[0], value) for by, each in sides for name, value in each.digests.items()]
        found = {name: value for name, value in files if not name.endswith("samples")}
        found["rows"] = _rows_digest(packs, [task for _, task in tasks])
        if pinned(form, found) == "other rows" and form.at:
            why = f"other rows, labels or splits than the suite: digest {found['rows'][:12]}"
            raise ValueError(f"the data of {one.name} ({form.name}) has {why}: get it again, or leave it out")
        return Opened(form.name, packs, tasks, found)
    places = " or ".join(dict.fromkeys(str((root or Path()) / p) for form in one.forms for p in form.at.values()))
    return f"{places} is not there" if root else f"no --data-root was given, where {places} would be"


def pinned(form: Form, found: dict[str, str]) -> Pinned:
    """Digests of data beside the pins of ``form``."""
    if not form.pins:
        return "not pinned"
    if found["rows"] != form.pins.get("rows"):
        return "other rows"
    return "same" if found == form.pins else "other pixels"


def _fold(pack: Pack, one: SuiteSet) -> tuple[Pack, ...]:
    """One view of ``pack`` per fold of its groups. Groups without any answer are "unlabelled"."""
    tasks = {task.name: task for task in pack.spec.all_tasks}
    groups = pack.column("group").astype(str)
    kept = sorted(set(groups[np.any([pack.answered(tasks[asked.name]) for asked in one.tasks], axis=0)].tolist()))
    if one.folds > len(kept):
        raise ValueError(f"{one.name} has {len(kept)} labelled groups, the suite asks for {one.folds} folds")
    first, strata = tasks[one.tasks[0].name], [""] * len(kept)
    if isinstance(first, Task):  # folds have an equal share of groups with each mean label; of values, of all groups
        labels = [own[own >= 0] for own in (pack.labels(first.name)[groups == group] for group in kept)]
        strata = [f"{known.mean():.2f}" if len(known) else "" for known in labels]
    sides = [dict(zip(kept, column, strict=True)) for column in folds(kept, strata, one.folds, one.val_every).values()]
    splits = ([side.get(group, "unlabelled") for group in groups.tolist()] for side in sides)
    return tuple(pack.with_splits({"split": split}) for split in splits)


def _rows_digest(packs: Sequence[Pack], tasks: Sequence[AnyTask]) -> str:
    """Digest of ids, groups, splits and answers. Unlike ``Pack.digest`` it does not depend on how the table was written."""
    pack, columns = packs[0], sorted({task.split for task in tasks})
    splits = [view.column(column).astype(str).tolist() for view in packs for column in columns]
    answers = [  # values in six digits: the last bits of a sum do not matter
        pack.labels(task.name).tolist()
        if isinstance(task, Task)
        else [f"{value:.6g}" for value in pack.values(task).ravel().tolist()]
        for task in tasks
    ]
    return digest([pack.own_ids.tolist(), pack.column("group").astype(str).tolist(), splits, answers])
