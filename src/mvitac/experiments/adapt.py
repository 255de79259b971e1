"""``mvitac adapt``: a model on unlabelled data of a new sensor, what it gains there and what it forgets of the old ones.

First the running statistics of BatchNorm are estimated anew on the new data (Li et al., arXiv:1603.04779), then the run's
own method goes on from its weights for a few steps. The folder is that of a run like any other, with the scores before and
after in adapted.json.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mvitac.data.joined_pack import JoinedPack
from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask
from mvitac.datasets.base import DatasetConfig
from mvitac.evaluation.controls import scratch
from mvitac.evaluation.evaluate import check_unseen
from mvitac.evaluation.leaks import Scored, Source, read_sources
from mvitac.evaluation.probe import cross_modal, probe_model, retrieved_rows, split_rows
from mvitac.model import Model, load
from mvitac.nn.initial import Init
from mvitac.run import Run
from mvitac.system.files import brief, write_json
from mvitac.system.progress import work
from mvitac.training.loop import train
from mvitac.training.setup import check_out

NEW, OLD, TRANSFER = "new data", "old data", "probes of old labels on new data"
BEFORE, AFTER = "before", "after"
Say = Callable[[str], object]


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """How far a model is adapted, and on what it is scored."""

    steps: int = 200
    """Steps of the run's own method on the new data. 0 = new statistics of BatchNorm only."""
    lr: float | None = None
    """Peak learning rate. Default: a tenth of that of the run."""
    batches: int = 16
    """Batches on which the statistics of BatchNorm are estimated anew. 0 = keep them."""
    batch_size: int | None = None
    """Pairs per step. Default: as in the run; at most all rows."""
    seed: int = 0
    """Random seed of batches and views."""
    old: Path | None = None
    """Pack of the old sensors, for what is forgotten. Default: the data of the run, if it is there."""
    allow_leak: bool = False
    """Score also on rows or groups that the model was trained on. LEAK stands beside every such score."""

    def __post_init__(self) -> None:
        if self.batches < 0 or self.steps < 0 or not self.batches + self.steps:
            raise ValueError(f"steps {self.steps}, batches {self.batches}: give numbers >= 0, not both 0")
        if self.lr is not None and not self.lr > 0:
            raise ValueError(f"lr {self.lr}: give a positive learning rate")


def adapt(
    ancestor: Path,
    data: DatasetConfig,
    asked: Adaptation,
    out: Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    say: Say = print,
) -> dict[str, Any]:
    """Adapt the model at ``ancestor`` to ``data`` and score both on the new and on the old data.

    Args:
        ancestor: Folder of a finished run, or of an artifact.
        data: Data of the new sensor. Labels are only used for scores.
        asked: How far.
        out: Folder of the new run.
        resume: Continue in ``out``.
        quiet: Show no progress bar.
        say: Called with lines of progress.

    Returns:
        The content of adapted.json: "records", each with "data" (what it was scored on), "source" (before or after), "task"
        (or a direction of retrieval), "modality" and its scores.

    Raises:
        ValueError: If the data does not fit the model, or the model saw what would be scored.
    """
    check_out(out, resume)
    model, pack = load(ancestor), data.open(quiet=quiet)
    run = _run_of(model, ancestor, data, pack, asked)
    old = _old_pack(model, asked.old, say)
    packs = {NEW: pack} | ({OLD: old} if old else {})
    sources = {  # before anything is trained
        name: check_unseen([ancestor], [model], one, _scorable(one), allow_leak=asked.allow_leak)[0]
        for name, one in packs.items()
    }
    train(run, out, resume=resume, quiet=quiet, pack=pack)
    after = load(out)
    if old and (joined := _joined(old, pack, say)):
        packs[TRANSFER], sources[TRANSFER] = joined, sources[NEW]
    records = []
    for name, one in packs.items():
        with work(f"scores on {name}"):
            learned = {BEFORE: sources[name], AFTER: read_sources(out, after.run, pack.digest, one)}
            for source, scored in ((BEFORE, model), (AFTER, after)):
                found = _scores(scored, one, learned[source], retrieval=name != TRANSFER)
                records += [{"data": name, "source": source, "seed": asked.seed, **record} for record in found]
    result = {"ancestor": str(ancestor), "group_by": pack.spec.group_by, "records": records}
    write_json(out / "adapted.json", result)
    return result


def _run_of(model: Model, ancestor: Path, data: DatasetConfig, pack: Pack, asked: Adaptation) -> Run:
    """The run of ``model`` on the new data, from its weights."""
    check_channels(model, pack, model.encoders)
    old = scratch(model.run)
    num = len(old.method.training_rows(pack))
    return replace(
        old,
        recipe="adapt",
        data=data,
        init=Init(path=ancestor),
        renew_norms=asked.batches,
        steps=asked.steps,
        optim=replace(old.optim, lr=asked.lr or old.optim.lr / 10, schedule="cosine", warmup=0.1),
        batch_size=asked.batch_size or max(2, min(old.batch_size, num)),
        seed=asked.seed,
        eval_every=0,
        checkpoint_every=0,
    )


def check_channels(model: Model, pack: Pack, modalities: Sequence[str]) -> None:
    """Raise ValueError unless images of ``pack`` have the channels that ``model`` was trained on."""
    for modality in modalities:
        model.check_modality(modality)
        own, given = model.spec.channels(modality), pack.spec.channels(modality)
        if own != given:
            raise ValueError(
                f"the model was trained on {modality} of {own} channels, {pack.spec.name!r} has {given or 'no ' + modality}:"
                " give data of the same modalities, sensors side by side, and frames"
            )


def _old_pack(model: Model, given: Path | None, say: Say) -> Pack | None:
    """What the model was trained on, or the pack that was named."""
    if given:
        return Pack(given)
    try:
        return model.open_data(quiet=True)
    except ValueError as error:
        say(f"what is forgotten is not scored: {brief(error)} (--old PACK names data of the old sensors)")
        return None


def _joined(old: Pack, new: Pack, say: Say) -> Pack | None:
    """Probes learned on ``old`` and scored on ``new``: a sensor nobody labelled. None if the packs do not allow it."""
    try:
        return JoinedPack(old, new) if _scorable(old) and _scorable(new) else None
    except ValueError as error:
        say(f"{TRANSFER}: not scored ({error})")
        return None


def _scorable(pack: Pack) -> list[AnyTask]:
    """The tasks that have rows to fit and rows to score."""
    found = []
    for task in pack.spec.all_tasks:
        try:
            split_rows(pack, task)
        except ValueError:
            continue
        found.append(task)
    return found


def _scores(model: Model, pack: Pack, learned: Sequence[Source] | None, *, retrieval: bool) -> list[dict[str, Any]]:
    """Records of linear probes of every task, and of retrieval across modalities."""
    tasks, scored = _scorable(pack), Scored(pack)
    modalities = [*pack.spec.modalities, *(["both"] if len(pack.spec.modalities) == 2 else [])]
    records = probe_model(model, pack, tasks, modalities, ["linear"]) if tasks else []
    records = [record for record in records if record["probe"] == "linear"]
    by_name = {task.name: task for task in tasks}
    for record in records:
        record["leak"] = scored.leak(learned, split_rows(pack, by_name[record["task"]]).test)
    rows = retrieved_rows(pack)
    rows = rows if len(rows) else pack.rows("val", having=pack.spec.modalities)
    for found in cross_modal(model, pack, rows) if retrieval else ():
        leak = scored.leak(learned, rows)
        records.append({**found, "task": "R@5", "modality": found["direction"], "leak": leak})
    return records
