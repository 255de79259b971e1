"""``mvitac adapt``: a model on unlabelled data of a new sensor, what it gains there and what it forgets of the old ones.

The run's own method goes on from its weights for a few steps. The result is a run like any other, with all scores in
adapted.json.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mvitac.data.pack import Pack
from mvitac.datasets.base import DatasetConfig
from mvitac.evaluation.evaluate import check_unseen
from mvitac.evaluation.features import fitting
from mvitac.evaluation.leaks import Scored, Source, read_sources
from mvitac.evaluation.probe import probe_model, scorable, split_rows
from mvitac.evaluation.retrieval import cross_modal, retrieved_rows
from mvitac.model import Model, load
from mvitac.nn.initial import Init
from mvitac.run import Run
from mvitac.system.files import brief, write_json
from mvitac.system.progress import shown, work
from mvitac.training.loop import train
from mvitac.training.setup import check_out

NEW, OLD = "new data", "old data"


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """How far a model is adapted, and on what it is scored."""

    steps: int = 200
    """Steps of the run's own method on the new data."""
    lr: float | None = None
    """Peak learning rate. Default: a tenth of that of the run."""
    batch_size: int | None = None
    """Pairs per step. Default: as in the run; at most all rows."""
    seed: int = 0
    """Random seed of batches and views."""
    old: Path | None = None
    """Pack of the old sensors, for what is forgotten. Default: the data of the run, if it is there."""
    allow_leak: bool = False
    """Score also on rows or groups that the model was trained on. LEAK stands beside every such score."""


def adapt(
    ancestor: Path,
    data: DatasetConfig,
    asked: Adaptation,
    out: Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    say: Callable[[str], object] = print,
) -> dict[str, Any]:
    """Adapt the model at ``ancestor`` (a run or an artifact) to ``data``, and score both on the new and the old data.

    Labels are only used for scores. ``say`` is called with lines of progress. ValueError if the data does not fit the
    model, or the model saw what would be scored.

    Returns:
        The content of adapted.json: "records", each with "data" (what it was scored on), "source" (before or after),
        "task" (R@5 for retrieval), "modality" (or direction) and its scores.
    """
    check_out(out, resume)
    model, pack = load(ancestor), data.open(quiet=quiet)
    if lacking := [m for m in model.encoders if m not in pack.spec.modalities]:
        raise ValueError(f"{ancestor} was trained with {lacking[0]}, which the data lacks")
    fitting(model, pack)
    packs = {NEW: pack} | _old_pack(model, asked.old, say)
    sources = {  # refuses leaks before anything is trained
        name: check_unseen([ancestor], one, scorable(one), allow_leak=asked.allow_leak)[0]
        for name, one in packs.items()
    }
    train(_run_of(model, ancestor, data, pack, asked), out, resume=resume, quiet=quiet, pack=pack)
    records, after = [], load(out)
    with shown(quiet=quiet), work("scoring before and after", 2 * len(packs), "parts") as advance:
        for name, one in packs.items():
            learned = read_sources(out)
            for source, scored, known in (("before", model, sources[name]), ("after", after, learned)):
                found = _scores(scored, one, known)
                records += [{"data": name, "source": source, "seed": asked.seed, **record} for record in found]
                advance()
    result = {
        "ancestor": str(ancestor),
        "group_by": pack.spec.group_by,
        "notes": list(pack.spec.notes),
        "records": records,
    }
    write_json(out / "adapted.json", result, sealed=True)
    return result


def _run_of(model: Model, ancestor: Path, data: DatasetConfig, pack: Pack, asked: Adaptation) -> Run:
    old = model.run.fresh()
    lr = old.optim.lr / 10 if asked.lr is None else asked.lr
    size = asked.batch_size or max(2, min(old.batch_size, len(old.method.training_rows(pack))))
    optim = replace(old.optim, lr=lr, schedule="cosine", warmup=0.1)
    run = replace(old, recipe="adapt", data=data, init=Init(path=ancestor), optim=optim)
    return replace(run, steps=asked.steps, batch_size=size, seed=asked.seed, eval_every=0, checkpoint_every=0)


def _old_pack(model: Model, given: Path | None, say: Callable[[str], object]) -> dict[str, Pack]:
    """What the model was trained on, or the pack ``given``; {} if neither is there."""
    if given:
        return {OLD: Pack(given)}
    try:
        return {OLD: model.open_data(quiet=True)}
    except ValueError as error:
        say(f"what is forgotten is not scored: {brief(error)} (--old PACK names data of the old sensors)")
        return {}


def _scores(model: Model, pack: Pack, learned: Sequence[Source] | None) -> list[dict[str, Any]]:
    """Records of linear probes of every task, and of retrieval between modalities: on test groups, or val without any."""
    tasks, scored = {task.name: task for task in scorable(pack)}, Scored(pack)
    modalities = [*pack.spec.modalities, *(["both"] if len(pack.spec.modalities) == 2 else [])]
    records: list[dict[str, Any]] = []
    for record in probe_model(model, pack, [*tasks.values()], modalities, ["linear"]) if tasks else ():
        leak = scored.leak(learned, split_rows(pack, tasks[record["task"]]).test)
        records += [{**record, "leak": leak}] if record["probe"] == "linear" else []
    rows = retrieved_rows(pack)
    rows = rows if len(rows) else pack.rows("val", having=pack.spec.modalities)
    for record in cross_modal(model, pack, rows) if len(rows) else ():
        records.append({**record, "task": "R@5", "modality": record["direction"], "leak": scored.leak(learned, rows)})
    return records
