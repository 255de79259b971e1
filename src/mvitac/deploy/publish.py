"""Publish runs: fit the probes on a finished run's data, and write one artifact folder."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch

from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask, ValueTask
from mvitac.datasets.simulated import SimulatedConfig
from mvitac.deploy.artifact import preprocessing, read
from mvitac.deploy.card import card
from mvitac.evaluation.controls import Records, controls_of
from mvitac.evaluation.evaluate import as_trained, check_unseen, noted, stored_result
from mvitac.evaluation.features import fitting
from mvitac.evaluation.leaks import FILE, Scored, Source, mark_split_leaks
from mvitac.evaluation.probe import FittedProbes, probe_model, scorable, split_rows
from mvitac.evaluation.regressors import Linear
from mvitac.evaluation.scores import summarise
from mvitac.evaluation.sensors import sensors_of
from mvitac.evaluation.value_scores import error_by_range
from mvitac.model import Model, load
from mvitac.nn.encoders import build_trunk
from mvitac.nn.linear_probe import Error, LinearProbe, ProbeInfo, ValueInfo
from mvitac.registry import to_json
from mvitac.run import load_run
from mvitac.system.files import brief, write_atomic, write_json
from mvitac.system.locks import new_folder
from mvitac.system.progress import work
from mvitac.system.sealed_folder import ARTIFACT

NUM_RANGES, RANGE_ROWS = 8, 20
"""Most ranges of a predicted value that have an error of their own, and fewest test rows in one."""


def fit_probes(model: Model, pack: Pack) -> list[tuple[LinearProbe, dict[str, Any]]]:
    """The linear probe of every task and modality of ``pack``, and its record, as fitted and scored by ``mvitac probe``.

    That of values is ridge regression. A task without labelled rows in train and test has none: it could not be scored.
    """
    modalities = fitting(model, pack, in_use=True)
    tasks = {m: scorable(pack, m) for m in (*modalities, *(["both"] if len(modalities) == 2 else []))}
    records: Records = []
    fitted: FittedProbes = {}
    with work("fitting probes", sum(map(len, tasks.values())), "probes"):
        for source, some in tasks.items():
            records += probe_model(model, pack, some, [source], ["linear"], fitted=fitted) if some else []
    known = {task.name: task for task in pack.spec.all_tasks}
    linear = [record for record in records if record["probe"] == "linear"]  # others are of the model's own heads
    linear.sort(key=lambda record: list(known).index(record["task"]))
    made = [fitted[record["task"], record["modality"], "linear"] for record in linear]
    return [(_as_published(pack, known[r["task"]], r, *one), r) for r, one in zip(linear, made, strict=True)]


def _as_published(pack: Pack, task: AnyTask, record: dict[str, Any], fitted: Any, guess: np.ndarray) -> LinearProbe:
    """A ``fitted`` probe with its ``record``; ``guess`` is what it predicts for the test rows."""
    rows, known = split_rows(pack, task, record["modality"]), {key: record[key] for key in ("task", "modality")}
    if isinstance(task, ValueTask):
        scored = zip(record["targets"], pack.values(task)[rows.test].T, guess.T, strict=True)
        errors = tuple(_error(target, t[~np.isnan(t)], g[~np.isnan(t)]) for target, t, g in scored)
        info = ValueInfo(**known, targets=task.targets, errors=errors, num_test=len(rows.test))
    else:
        labels = pack.labels(task.name)
        majority = float((labels[rows.test] == np.bincount(labels[rows.fitted]).argmax()).mean())
        about = {"accuracy": record["accuracy"], "majority": majority, "num_test": len(rows.test)}
        info = ProbeInfo(**known, classes=task.classes, **about)
    parts = [*fitted.weights(), *([fitted.bounds] if isinstance(fitted, Linear) else [])]
    return LinearProbe(info, *(torch.from_numpy(part).float() for part in parts))


def _error(target: dict[str, Any], true: np.ndarray, guess: np.ndarray) -> Error:
    ranges = error_by_range(guess, guess - true, max(1, min(NUM_RANGES, len(true) // RANGE_ROWS)))
    edges, spread = tuple(each["low"] for each in ranges[1:]), tuple(each["rmse"] for each in ranges)
    return Error(**{key: float(target[key]) for key in ("r2", "mae", "rmse")}, edges=edges, spread=spread)


def _scores(run: Path, model: Model, pack: Pack, records: Records) -> dict[str, Any]:
    """The probes' ``records`` with those of the controls, as printed by ``mvitac probe``, JSON-ready."""
    own = {"source": model.run.method.name, "seed": model.run.seed}
    if stored := stored_result([run], pack):
        tasks = {record["task"] for record in records}
        controls = [r for r in stored["records"] if "run" not in r and r["task"] in tasks]
    else:
        controls = _controls(model, pack, records)
    return {
        **{"data": pack.spec.name, "group_by": pack.spec.group_by, "notes": list(pack.spec.notes)},
        "leaks": mark_split_leaks(pack, [*records, *controls]),
        "summary": summarise([*({**own, **record} for record in records), *controls]),
    }


def _controls(model: Model, pack: Pack, records: Records) -> Records:
    """The controls of the (task, modality) of ``records``. Without its weights, the ImageNet trunk is left out."""
    # The initial weights that an artifact names may be any file or download.
    run, controls = model.run.fresh() if model.foreign else model.run, []
    try:
        for modality in model.encoders:
            build_trunk(run.encoder[modality], 3)
    except ValueError:
        run = run.fresh()
    sources: dict[tuple[str, ...], list[AnyTask]] = {}
    for task in pack.spec.all_tasks:
        sources.setdefault(tuple(r["modality"] for r in records if r["task"] == task.name), []).append(task)
    for modalities, tasks in sources.items():
        if modalities:
            controls += controls_of([run], pack, tasks, modalities, ["linear"], [model.spec])[0]
    return controls


def own_data(model: Model, instead: str, *, few: int = 0) -> Pack:
    """The data ``model`` was trained on; the ValueError where it cannot be opened ends with ``instead``, what to do.

    ``few``: of simulated data, which may have to be made first, only so many items. Splits are the same.
    """
    data = model.run.data
    try:
        if few and isinstance(data, SimulatedConfig):
            return replace(data, num=min(data.num, few)).open()
        return model.open_data()
    except ValueError as error:
        raise ValueError(f"the data this model was trained on is not here ({brief(error)}): {instead}") from None


def with_probes(model: Model, pack: Pack) -> Model:
    """``model`` with probes: its own if it has some (an artifact), else fitted on ``pack``."""
    if not model.probes:
        model.probes = {probe.info.name: probe for probe, _ in fit_probes(model, as_trained(model, pack))}
        model.spec = replace(model.spec, crop=pack.spec.crop)  # what the answers are for
    return model


def _fit_and_score(run: Path, model: Model, pack: Pack, allow_leak: bool) -> tuple[list[Source] | None, dict[str, Any]]:
    """Fit the probes of ``model``; returns what it learned from, if that is known, and the scores of ``_scores``."""
    tasks = {task.name: task for task in scorable(pack)}
    learned, scored = check_unseen([run], pack, [*tasks.values()], allow_leak=allow_leak)[0], Scored(pack)
    fitted = fit_probes(model, pack)
    for probe, record in fitted:
        q = probe.info
        record["leak"] = scored.leak(learned, split_rows(pack, tasks[q.task], q.modality).test)
        mark_split_leaks(pack, [record])
        probe.info = replace(q, leak=record["leak"])
    model.probes = {probe.info.name: probe for probe, _ in fitted}
    return learned, _scores(run, model, pack, [record for _, record in fitted])


def publish(run: Path, out: Path, pack: Pack | None = None, *, allow_leak: bool = False, half: bool = False) -> Path:
    """Write the artifact of a finished run into the new folder ``out``.

    It is loaded once, as a check, before it gets its name. ``pack``: data to fit probes on (default: the run's own).
    With ``allow_leak``, its rows or groups may be some that the run was trained on; the card says LEAK beside scores.
    ``half``: kernels and matrices are rounded to fp16. Raises Busy if another process writes ``out``, else ValueError.
    """
    with new_folder(out) as partial:
        model = load(run)
        for weight in (w for w in model.state_dict().values() if half and w.ndim > 1):
            weight.copy_(weight.half())
        _, record = load_run(run)
        if pack is None:
            pack = noted(own_data(model, "fit the probes on a pack, --on PACK"), [run])
        elif not scorable(pack := as_trained(model, pack)):
            raise ValueError(f"{pack.path} has labelled rows of no task in train and test: leave --on out")
        learned, scores = _fit_and_score(run, model, pack, allow_leak)
        met = sensors_of(pack, pack.rows("train", "val", "unlabelled"))  # by the probes, if not by the encoders
        model.spec = replace(model.spec, sensors=tuple(sorted({*model.spec.sensors, *met})), crop=pack.spec.crop)
        model.save(partial / "model.safetensors", half=half)
        if model.probes:
            tensors = {f"{r.info.name}.{k}": v for r in model.probes.values() for k, v in r.state_dict().items()}
            write_atomic(partial / "probes.safetensors", lambda file: file.write(safetensors.torch.save(tensors)))
        write_json(partial / "run.json", record, sealed=True)
        if learned is not None:
            shutil.copyfile(run / FILE, partial / FILE)
        keys, infos = ("name", "licence", "source"), [r.info for r in model.probes.values()]
        about = {
            "preprocessing": preprocessing(model),
            "probes": [to_json(q) for q in infos if isinstance(q, ProbeInfo)],
            "values": [to_json(q) for q in infos if isinstance(q, ValueInfo)],
            "data": {**{key: getattr(pack.spec, key) for key in keys}, "digest": pack.digest},
            "trained_on": {key: getattr(model.spec, key) for key in keys},
            "start": record.get("start"),
            "scores": scores,
        }
        write_atomic(partial / "README.md", lambda file: file.write(card(model, about).encode()))
        ARTIFACT.write(partial, about)
        read(partial)
    return out
