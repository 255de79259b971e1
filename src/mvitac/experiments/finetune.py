"""``mvitac finetune``: train a model's encoders with labels, beside the frozen probe and training from scratch.

    <out>/seed0/              the fine-tuned model of each seed: a run like any other, with its scores in scores.json
          scratch/seed0/      the same network from random weights, with the same labels
          choice.json         what was tried on held-out groups, and the scores there
          scores.json         all scores on test rows
          10-percent/...      the same for each further share of the labelled groups

Settings are chosen on held-out groups of the labelled rows, never on test rows: first the learning rate, then the number of
steps, then whether the heads start as linear probes (LP-FT, arXiv:2202.10054). The final model learns from all of these
groups. A call that is repeated continues.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask, Task
from mvitac.datasets.base import DatasetConfig
from mvitac.evaluation.controls import scratch
from mvitac.evaluation.evaluate import ProbeConfig, check_unseen, chosen
from mvitac.evaluation.features import features
from mvitac.evaluation.leaks import Scored, Source, leaks_of, read_sources
from mvitac.evaluation.probe import ProbeSplit, probe_features, score_own_head, split_rows
from mvitac.methods.supervised import SupervisedConfig
from mvitac.model import Model, load
from mvitac.nn.finetuning import Part
from mvitac.nn.initial import Init
from mvitac.run import Optim, Run
from mvitac.system.files import check_place, digest, read_json, write_json
from mvitac.training.loop import train
from mvitac.transforms.random_views import Augment, ViewAugment

FROZEN, SCRATCH = "frozen, linear probe", "from scratch"
CHOICE = "choice"
"""Folder of the run that is tried, and the stem of the file with what was tried."""
Say = Callable[[str], object]


@dataclass(frozen=True, kw_only=True)
class Finetuning:
    """What is trained, with which labels, and the settings that are tried on held-out groups."""

    labels: tuple[str, ...] = ()
    """Tasks with classes to learn. Default: all of the data, unless --values names some."""
    values: tuple[str, ...] = ()
    """Tasks with values to learn."""
    train: Part = "all"
    """What of the encoders is trained, beside new heads. all. last-stage: the last stage of the trunk. lora: low-rank updates
    of all layers, and BatchNorm. attentive: an attention over the last feature map. head: nothing."""
    modalities: tuple[Literal["touch", "vision"], ...] = ()
    """Modalities to learn from. Default: all that the model and the data have."""
    lr: tuple[float, ...] = (3e-4, 1e-4, 1e-3, 3e-3)
    """Learning rates to try (AdamW, cosine schedule). The first is used where there are too few groups to choose."""
    steps: tuple[int, ...] = (200, 600)
    """Numbers of steps to try."""
    batch_size: int = 32
    """Pairs per step; at most all labelled rows."""
    rank: int = 8
    """Rank of the updates of lora."""
    fractions: tuple[float, ...] = (100.0,)
    """Percentages of the labelled groups to learn from, such as 1 5 10 100: one row of models each."""
    seeds: int = 1
    """Number of seeds. Each draws its own groups, batches and views."""
    from_scratch: bool = True
    """Also train all of the same network from random weights with the same labels. Its settings are chosen alike."""
    allow_leak: bool = False
    """Go on if the model, or one it started from, was trained on test rows or groups. LEAK stands beside every score."""

    def __post_init__(self) -> None:
        for name in ("lr", "steps", "fractions"):
            if not (given := getattr(self, name)) or len(set(given)) < len(given):
                raise ValueError(f"{name} {given}: give at least one number, and none twice")
        if not all(0 < percent <= 100 for percent in self.fractions):
            raise ValueError(f"fractions {self.fractions}: give percentages above 0, at most 100")
        if self.seeds < 1:
            raise ValueError(f"seeds {self.seeds}: give at least 1")


@dataclass(frozen=True)
class _Job:
    """Fine-tuning of one model on one pack."""

    asked: Finetuning
    ancestor: Path
    model: Model
    pack: Pack
    run: Run
    tasks: tuple[AnyTask, ...]
    out: Path
    say: Say

    def settings(self, percent: float, seed: int, *, start: bool, **changes: Any) -> Run:
        """The run with these labels; ``changes`` are lr, steps, and heads_from and hold_out of the method."""
        lr, steps = changes.pop("lr"), changes.pop("steps")
        assert isinstance(self.run.method, SupervisedConfig)
        method = replace(self.run.method, share=percent / 100, share_seed=seed, **changes)
        method = method if start else replace(method, train="all")
        run = replace(self.run, method=method, seed=seed, steps=steps, optim=replace(self.run.optim, lr=lr))
        rows = len(method.training_rows(self.pack))
        return replace(run, batch_size=max(2, min(run.batch_size, rows)), init=run.init if start else Init())

    def folder(self, percent: float) -> Path:
        return self.out if percent == 100 else self.out / f"{percent:g}-percent"

    @cached_property
    def modality(self) -> str:
        names = self.run.method.modalities  # type: ignore[attr-defined]
        return "both" if len(names) == 2 else names[0]


def finetune(
    ancestor: Path, data: DatasetConfig, asked: Finetuning, out: Path, *, resume: bool = False, say: Say = print
) -> dict[str, Any]:
    """Fine-tune the model at ``ancestor`` on the labels of ``data``, and score it next to what it must beat.

    Args:
        ancestor: Folder of a finished run, or of an artifact.
        data: The labelled data.
        asked: What to train.
        out: Folder for the runs and scores.
        resume: Continue in ``out``.
        say: Called with lines of progress.

    Returns:
        The content of scores.json: "records", "summary" (fraction -> task -> modality -> source), "chosen" (fraction ->
        source -> settings), "leaks".

    Raises:
        ValueError: If the labels, the data and the model do not fit together, or there are too few groups.
    """
    check_place(out / "scores.json")
    if out.exists() and any(out.iterdir()) and not resume:
        raise ValueError(f"{out} is not empty: continue it with --resume, or choose another --out")
    job = _prepared(ancestor, data, asked, out, say)
    _check_same(job)
    sources = check_unseen([ancestor], [job.model], job.pack, job.tasks, allow_leak=asked.allow_leak)[0]
    records: list[dict[str, Any]] = []
    settings: dict[str, Any] = {}
    for percent in asked.fractions:
        found, settings[f"{percent:g}"] = _fraction(job, percent, sources)
        records += found
    result = {
        "data": job.pack.spec.name,
        "pack": job.pack.digest,
        "ancestor": str(ancestor),
        "group_by": job.pack.spec.group_by,
        "notes": list(job.pack.spec.notes),
        "leaks": leaks_of(records),
        "trained": asked.train,
        "chosen": settings,
        "records": records,
    }
    write_json(out / "scores.json", result)
    return result


def _prepared(ancestor: Path, data: DatasetConfig, asked: Finetuning, out: Path, say: Say) -> _Job:
    """Open model and data, and check that they fit together."""
    model = load(ancestor)
    pack = data.open()
    known = {"labels": [t.name for t in pack.spec.tasks], "values": [t.name for t in pack.spec.values]}
    for option, names in known.items():
        for name in getattr(asked, option):
            if name not in names:
                raise ValueError(f"--{option} {name}: {pack.spec.name!r} has {', '.join(names) or 'none'}")
    names = (*asked.labels, *asked.values) or tuple(known["labels"] or known["values"])
    tasks = tuple(chosen(pack, ProbeConfig(tasks=names))[0])
    modalities = asked.modalities or tuple(m for m in pack.spec.modalities if m in model.encoders)
    for modality in modalities:
        model.check_modality(modality)
        if model.spec.channels(modality) != pack.spec.channels(modality):
            raise ValueError(
                f"{ancestor} was trained on {modality} of {model.spec.channels(modality)} channels, {pack.spec.name!r} has"
                f" {pack.spec.channels(modality)}: give data of the same sensors and frames"
            )
    if not modalities:
        raise ValueError(f"{ancestor} has {', '.join(model.encoders)}, {pack.spec.name!r} has none of it")
    method = SupervisedConfig(tasks=names, modalities=modalities, train=asked.train, rank=asked.rank)
    if asked.modalities:
        method.modalities_of(pack.spec)
    side = min(model.run.augment.eval_size, pack.size)
    light = ViewAugment(scale=(0.8, 1.0), flip=0.0, grayscale=0.0)
    run = replace(
        scratch(model.run),
        recipe="finetune",
        data=data,
        method=method,
        init=Init(path=ancestor, modalities=modalities, heads=False).resolved(),
        augment=Augment(size=side, vision=light, touch=light),
        optim=Optim(
            name="adamw", lr=1e-3, eps=1e-8, weight_decay=0.05, decay_norms=False, schedule="cosine", warmup=0.1
        ),
        batch_size=asked.batch_size,
        sampler="shuffle",
        positives="same-image",
        chunk=0,
        precision="auto",
        eval_every=0,
        checkpoint_every=0,
    )
    job = _Job(asked, ancestor, model, pack, run, tasks, out, say)
    for task in tasks:
        split_rows(pack, task, job.modality)
        _check_classes(job, task)
    return job


def _check_classes(job: _Job, task: AnyTask) -> None:
    if not isinstance(task, Task):
        return
    rows = job.run.method.training_rows(job.pack)
    seen = {task.classes[label] for label in set(job.pack.labels(task.name, "train", "val")[rows]) - {-1}}
    if len(seen) < 2:
        raise ValueError(
            f"task {task.name!r} has labels of one class only in train ({', '.join(seen)}): there is nothing to learn"
        )


def _check_same(job: _Job) -> None:
    """Check that what is in the folder is about the same model, data and settings; note them if it is new."""
    key = digest([job.run.digest(), job.pack.digest, repr(replace(job.asked, seeds=1, fractions=(100.0,)))])
    file = job.out / "finetune.json"
    if file.exists() and read_json(file, "a fine-tuning")["digest"] != key:
        raise ValueError(f"{job.out} holds other settings, data or weights: give the same ones, or another --out")
    if not file.exists():
        if job.out.exists() and any(job.out.iterdir()):
            raise ValueError(f"{job.out} is no fine-tuning to continue: choose another --out")
        write_json(file, {"digest": key, "ancestor": str(job.ancestor)})


# -- one share of the labels --------------------------------------------------------------------------------------------


def _fraction(job: _Job, percent: float, sources: list[Source] | None) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Choose settings, train and score every seed. Returns records and the chosen settings."""
    folder, records, settings = job.folder(percent), [], {}
    scored = Scored(job.pack)
    kinds = {f"fine-tuned, {job.asked.train}": True} | ({SCRATCH: False} if job.asked.from_scratch else {})
    for seed in range(job.asked.seeds):
        for kind, start in kinds.items():
            settings[kind] = settings.get(kind) or _choose(job, percent, kind, start)
            path = folder / f"seed{seed}" if start else folder / "scratch" / f"seed{seed}"
            best = {key: settings[kind][key] for key in ("lr", "steps", "heads_from")}
            run = job.settings(percent, seed, start=start, **best)
            job.say(f"{percent:g} %: {kind}, seed {seed}, {run.steps} steps of {run.batch_size}")
            train(run, path, resume=True, quiet=True, pack=job.pack)
            own = _own_scores(job, path, percent, kind, scored)
            write_json(path / "scores.json", {"data": job.pack.spec.name, "pack": job.pack.digest, "records": own})
            records += own
        records += _frozen(job, percent, seed, scored, sources)
    return records, settings


def _choose(job: _Job, percent: float, kind: str, start: bool) -> dict[str, Any]:
    """The settings with the best score on held-out groups, tried one after the other."""
    asked = job.asked
    best: dict[str, Any] = {"lr": asked.lr[0], "steps": asked.steps[0], "heads_from": "probe" if start else "random"}
    plan = {"lr": asked.lr, "steps": asked.steps, "heads_from": ("probe", "random") if start else ("random",)}
    if all(len(values) == 1 for values in plan.values()):
        return best
    try:
        job.settings(percent, 0, start=start, hold_out=True, **best)
    except ValueError as error:
        if percent == 100 and max(len(asked.lr), len(asked.steps)) > 1:
            raise ValueError(f"{error}: give one --lr and one --steps") from None
        job.say(f"{percent:g} %: {kind}: {error}: first of --lr and --steps")
        return best
    for name, values in plan.items():
        scores = {value: _tried(job, percent, kind, start, {**best, name: value}) for value in values}
        best[name] = max(scores, key=lambda value: scores[value])  # the first of equals
    best["held out"] = _tried(job, percent, kind, start, best)
    return best


def _tried(job: _Job, percent: float, kind: str, start: bool, settings: dict[str, Any]) -> float:
    """Score on held-out groups with ``settings``, mean over tasks; from choice.json if it was tried before."""
    folder = job.folder(percent)
    file, work = folder / f"{CHOICE}.json", folder / CHOICE
    tried: dict[str, float] = read_json(file, "what was tried") if file.exists() else {}
    settings = {key: settings[key] for key in ("lr", "steps", "heads_from")}
    name = f"{kind}: " + ", ".join(f"{key} {value}" for key, value in settings.items())
    if name not in tried:
        run = job.settings(percent, 0, start=start, hold_out=True, **settings)
        path = work / digest(run.digest())[:12]
        train(run, path, resume=True, quiet=True, pack=job.pack)
        learned = run.method.training_rows(job.pack)
        everything = replace(run.method, hold_out=False).training_rows(job.pack)  # type: ignore[call-arg]
        model, scores = load(path), []
        for task in job.tasks:
            rows = _answered(job, task, np.setdiff1d(everything, learned))
            scores.append(_score(score_own_head(model, job.pack, task, rows)) if len(rows) else np.nan)
        tried[name] = float(np.nanmean(scores))
        write_json(file, tried)
        job.say(f"{percent:g} %: {name}: {100 * tried[name]:.1f} on held-out {job.pack.spec.group_by}s")
    shutil.rmtree(work, ignore_errors=True)
    return tried[name]


def _score(record: dict[str, Any]) -> float:
    return record["accuracy"] if "accuracy" in record else record["r2"]


def _answered(job: _Job, task: AnyTask, rows: np.ndarray) -> np.ndarray:
    return rows[job.pack.answered(task, "train", "val")[rows]]


def _own_scores(job: _Job, path: Path, percent: float, kind: str, scored: Scored) -> list[dict[str, Any]]:
    """Test scores of the heads of the run in ``path``."""
    model = load(path)
    learned = read_sources(path, model.run, job.pack.digest, job.pack)
    records = []
    for task in job.tasks:
        rows = split_rows(job.pack, task, job.modality).test
        known = {"source": kind, "seed": model.run.seed, "run": str(path), "fraction": percent, "task": task.name}
        known |= {"modality": job.modality, "probe": "own", "leak": scored.leak(learned, rows)}
        records.append({**known, **score_own_head(model, job.pack, task, rows)})
    return records


def _frozen(
    job: _Job, percent: float, seed: int, scored: Scored, sources: list[Source] | None
) -> list[dict[str, Any]]:
    """Test scores of linear probes on the frozen encoders, fitted on the rows that this seed is fine-tuned on."""
    method = replace(job.run.method, share=percent / 100, share_seed=seed)  # type: ignore[call-arg]
    rows = method.training_rows(job.pack)
    try:
        learned = replace(method, hold_out=True).training_rows(job.pack)
    except ValueError:  # too few groups: C is chosen on the rows that the probe is fitted on
        learned = rows
    records, names = [], job.run.method.modalities  # type: ignore[attr-defined]
    for task in job.tasks:
        fitted, held = _answered(job, task, learned), _answered(job, task, np.setdiff1d(rows, learned))
        test = split_rows(job.pack, task, job.modality).test
        if not len(held) or (isinstance(task, Task) and len(set(job.pack.labels(task.name)[fitted])) < 2):
            fitted = held = _answered(job, task, rows)
        parts = ProbeSplit(fitted, held, test)
        x = np.concatenate([features(job.model, job.pack, m, parts.all) for m in names], axis=1)
        known = {"source": FROZEN, "seed": seed, "fraction": percent, "task": task.name, "modality": job.modality}
        known |= {"probe": "linear", "leak": scored.leak(sources, test)}
        records.append({**known, **probe_features(x, job.pack, task, parts, "linear", seed)})
    return records
