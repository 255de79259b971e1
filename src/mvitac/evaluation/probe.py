"""Probes of one model's frozen features on one pack: linear classifiers, regression and kNN.

Nothing is chosen on test rows: regularisation is chosen on split val, or on groups of train. Shapes: features [N, D].
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask, Task, ValueTask
from mvitac.evaluation.classifiers import Classifier, Constant, fit_knn, fit_linear, fit_papers, one_blas_thread
from mvitac.evaluation.features import features
from mvitac.evaluation.few_labels import few, percent_of
from mvitac.evaluation.probe_config import Standardise
from mvitac.evaluation.regressors import Linear, fit_curve, fit_neighbours, fit_ridge
from mvitac.evaluation.scores import score
from mvitac.evaluation.sensors import touch_features
from mvitac.evaluation.value_scores import score_values
from mvitac.model import Model
from mvitac.system.progress import tick
from mvitac.system.threads import in_threads

VALUE_PROBES = ("linear", "knn")
"""Probes of tasks with values: ridge regression, alpha chosen on validation groups, and the mean of the 20 nearest."""

FeatureSource = Callable[[str, np.ndarray], np.ndarray]  # (modality, pack rows) -> features [len(rows), D]
Fitted = Callable[[np.ndarray], np.ndarray]  # features -> class probabilities or values
FittedProbes = dict[tuple[str, str, str], tuple[Fitted, np.ndarray]]
"""Task, modality and kind of a probe -> the probe, and what it predicts for the test rows."""


@dataclass(frozen=True)
class ProbeSplit:
    """Row numbers of one task: rows to fit on, rows to choose C on, rows to score."""

    train: np.ndarray
    val: np.ndarray
    test: np.ndarray

    @property
    def fitted(self) -> np.ndarray:
        return np.concatenate([self.train, self.val])

    @property
    def all(self) -> np.ndarray:
        return np.concatenate([self.train, self.val, self.test])


def split_rows(pack: Pack, task: AnyTask, modality: str = "none") -> ProbeSplit:
    """Labelled (or measured) rows of ``task`` by split that have an image of ``modality`` ("both": both, "none": any).

    Without a validation split, a fifth of the training groups (or rows) is set aside for it. ValueError if no labelled
    row is left in train or in test, or a target has no different values there.
    """
    having = names_in(modality, pack)
    known = pack.answered(task)
    found = {s: pack.rows(s, only=task.only, having=having, by=task.split) for s in ("train", "val", "test")}
    train, val, test = (rows[known[rows]] for rows in found.values())
    if not len(train) or not len(test):
        where = "train" if not len(train) else "test"
        lacking = f" with {' and '.join(having)}" if having else ""
        raise ValueError(f"task {task.name!r} has no labelled rows{lacking} in split {where}: nothing to probe")
    if isinstance(task, ValueTask):
        _check_measured(pack.values(task), task, {"train": np.concatenate([train, val]), "test": test})
    if not len(val):
        # Rows where too few groups, or one class, would be left: to fit and to choose on the same rows is worse.
        for units in (pack.column("group")[train].astype(str), np.arange(len(train))):
            names = np.random.default_rng(0).permutation(np.unique(units))
            held = np.isin(units, names[: max(1, len(names) // 5)])
            one_class = isinstance(task, Task) and len(set(pack.labels(task.name)[train[~held]])) == 1
            if not held.all() and not one_class:
                return ProbeSplit(train[~held], train[held], test)
        val = train
    return ProbeSplit(train, val, test)


def scorable(pack: Pack, modality: str = "none") -> list[AnyTask]:
    """The tasks of ``pack`` that have labelled rows with ``modality`` in train and test."""
    found = []
    for task in pack.spec.all_tasks:
        with suppress(ValueError):
            split_rows(pack, task, modality)
            found.append(task)
    return found


def _check_measured(values: np.ndarray, task: ValueTask, rows: dict[str, np.ndarray]) -> None:
    """Check that each target has two different values in each of ``rows``, which float64 can square: it has an R2."""
    for t, target in enumerate(task.targets):
        for split, mine in rows.items():
            known = values[mine, t][np.isfinite(values[mine, t])]
            if len(np.unique(known)) < 2:
                why = f"{target.name} has fewer than two different values in split {split}"
                raise ValueError(f"task {task.name!r}: {why}: nothing to probe, leave it out or split otherwise")
            if not (1e-60 < (most := abs(known).max()) < 1e60 and known.std() > 1e-6 * most):
                why = f"{target.name} is from {known.min():.6g} to {known.max():.6g} in split {split}"
                raise ValueError(f"task {task.name!r}: {why}: rounding would decide R2, subtract an offset or scale it")


def names_in(modality: str, pack: Pack) -> tuple[str, ...]:
    """The modalities that "touch", "vision", "both" or "none" stands for."""
    return tuple(pack.spec.modalities) if modality == "both" else () if modality == "none" else (modality,)


def seen_by(pack: Pack, task: AnyTask, modalities: Sequence[str]) -> list[str]:
    """Those of ``modalities`` that ``task`` can be probed by: of a mix, those that the parts of its rows have."""
    rows = np.flatnonzero(pack.answered(task))
    has = {m: not pack.parts or bool(pack.has(m)[rows].any()) for m in pack.spec.modalities}
    return [modality for modality in modalities if all(has[m] for m in names_in(modality, pack))]


def probe_features(
    x: np.ndarray,
    pack: Pack,
    task: AnyTask,
    rows: ProbeSplit,
    kind: str,
    seed: int,
    paper: Classifier | None = None,
    few_kind: str = "linear",
) -> tuple[dict[str, Any], tuple[Fitted, np.ndarray]]:
    """Fit a probe of ``kind`` (``few_kind`` of few labels) on features ``x`` of ``rows.all``; ``paper`` is a fitted one.

    Returns its record, and the probe with what it predicts for the test rows.
    """
    if percent := percent_of(kind):
        train, val = few(pack, task, rows.train, rows.val, percent, seed)
        keep = np.concatenate([train, len(rows.train) + val, np.arange(len(rows.fitted), len(x))])
        x, rows, kind = x[keep], ProbeSplit(rows.train[train], rows.val[val], rows.test), few_kind
    num = len(rows.fitted)
    predict, extra = fit_probe(x[:num], pack, task, rows, kind, seed, paper)
    predicted = predict(x[num:])
    if isinstance(predict, Linear):
        extra["clipped"] = predict.clipped(x[num:])
    return {**score_rows(pack, task, rows.test, predicted), **extra}, (predict, predicted)


def fit_probe(
    x: np.ndarray, pack: Pack, task: AnyTask, rows: ProbeSplit, kind: str, seed: int, paper: Classifier | None = None
) -> tuple[Fitted, dict[str, Any]]:
    """Fit one probe on features ``x`` of ``rows.fitted``: linear, paper, knn, and ``curve`` for controls with values.

    Returns a function from features [N, D] to class probabilities [N, K] or values [N, T], and what was chosen (C or
    alpha of ``linear``). That of ``linear`` has ``weights()``.
    """
    if isinstance(task, ValueTask):
        values = pack.values(task)[rows.fitted]
        if kind == "linear":
            predict, alphas = fit_ridge(x, values, len(rows.val))
            return predict, {"alpha": alphas}
        return fit_curve(x, values, len(rows.val)) if kind == "curve" else fit_neighbours(x, values), {}
    labels = pack.labels(task.name)
    y, y_whole, num = labels[rows.train], labels[rows.fitted], len(task.classes)
    if len(np.unique(y)) < 2:
        return Constant(int(y[0]), num, x.shape[-1]), {}
    if kind == "linear":
        fitted, c = fit_linear(x[: len(y)], y, x[len(y) :], labels[rows.val], num)
        return fitted, {"C": c}
    if kind == "paper":
        return paper or fit_papers(x, [y_whole], [num], seed)[0], {}
    return fit_knn(x, y_whole, num), {}


def probe_model(
    model: Model,
    pack: Pack,
    tasks: Sequence[AnyTask],
    modalities: Sequence[str],
    probes: Sequence[str],
    standardise: tuple[Standardise, ...] = (),
    fitted: FittedProbes | None = None,
) -> list[dict[str, Any]]:
    """Probe every task and modality that ``model`` has an encoder for, and its own heads where it has some.

    The features are those of ``sensors.touch_features`` with ``standardise``; own heads read plain ones. There is one
    record per (task, modality, probe): these names and the scores of ``score_rows``. The probe of an own head is "own".
    """
    modalities = [m for m in modalities if set(names_in(m, pack)) <= set(model.encoders)]  # supervised: maybe one
    if not modalities:
        return []
    source = partial(touch_features, model, pack, standardise=standardise)
    records = probe_all(source, pack, tasks, modalities, probes, model.seed, fitted)
    return records + own_heads(model, pack, tasks, modalities)


def own_heads(
    model: Model, pack: Pack, tasks: Sequence[AnyTask], modalities: Sequence[str], among: np.ndarray | None = None
) -> list[dict[str, Any]]:
    """Records of the heads that the model trained along with its encoders, on test rows or on the labelled ``among``."""
    whole = "both" if len(model.encoders) == 2 else next(iter(model.encoders))
    known = {task.name: _outputs(task) for task in model.spec.all_tasks if task.name in model.tasks}
    records = []
    for task in tasks:
        if whole not in modalities or task.name not in known or set(_outputs(task)) - set(known[task.name]):
            continue  # not a task that it learned, or not all of its classes or targets
        rows = split_rows(pack, task, whole).test if among is None else among[pack.answered(task)[among]]
        if not len(rows):
            continue
        z = {m: torch.from_numpy(features(model, pack, m, rows, for_heads=True)) for m in model.encoders}
        # Match columns by name: this pack may order the classes differently or have fewer.
        columns = [known[task.name].index(name) for name in _outputs(task)]
        result = score_rows(pack, task, rows, model.answer(task.name, z).numpy()[:, columns])
        records.append({"task": task.name, "modality": whole, "probe": "own", **result})
    return records


def _outputs(task: AnyTask) -> tuple[Any, ...]:
    return task.classes if isinstance(task, Task) else task.targets


def score_rows(pack: Pack, task: AnyTask, rows: np.ndarray, predicted: np.ndarray) -> dict[str, Any]:
    """Score class probabilities [len(rows), K], or values [len(rows), T], ``predicted`` for pack ``rows``."""
    groups = group_numbers(pack, rows)
    if isinstance(task, ValueTask):
        return score_values(pack.values(task)[rows], predicted, groups, task.targets)
    return score(pack.labels(task.name)[rows], predicted, groups, len(task.classes))


def group_numbers(pack: Pack, rows: np.ndarray) -> np.ndarray:
    """The groups of ``rows``, numbered 0 .. G-1."""
    return np.unique(pack.column("group")[rows].astype(str), return_inverse=True)[1]


def probe_all(
    source: FeatureSource,
    pack: Pack,
    tasks: Sequence[AnyTask],
    modalities: Sequence[str],
    probes: Sequence[str],
    seed: int,
    fitted: FittedProbes | None = None,
) -> list[dict[str, Any]]:
    """Records of every (task, modality, probe) on the features of ``source``. The paper's probe has no values.

    ``source`` is asked once for each of touch and vision, with ascending rows. ``fitted`` receives the probes. Each of them
    advances the ``progress.work`` that counts "probes".
    """
    pairs = [(task, modality) for task in tasks for modality in seen_by(pack, task, modalities)]
    needed = np.unique(np.concatenate([np.arange(0), *(split_rows(pack, *pair).all for pair in pairs)]))
    names = dict.fromkeys(name for _, modality in pairs for name in names_in(modality, pack))
    own = {name: needed[pack.has(name)[needed]] for name in names}
    known = {name: source(name, rows) for name, rows in own.items()}

    def read(modality: str, rows: np.ndarray) -> np.ndarray:
        return np.concatenate([known[m][np.searchsorted(own[m], rows)] for m in names_in(modality, pack)], axis=1)

    classed = [task for task in tasks if isinstance(task, Task)]
    papers = _papers(read, pack, classed, modalities, seed) if "paper" in probes else {}

    def probed(pair: tuple[AnyTask, str]) -> list[dict[str, Any]]:
        task, modality = pair
        rows, records = split_rows(pack, task, modality), []
        x = read(modality, rows.all)
        for kind in probes_of(task, probes):
            result, made = probe_features(x, pack, task, rows, kind, seed, papers.get((task.name, modality)))
            if fitted is not None:
                fitted[task.name, modality, kind] = made
            tick("probes")
            records.append({"task": task.name, "modality": modality, "probe": kind, **result})
        return records

    with one_blas_thread():
        return [record for records in in_threads(probed, pairs) for record in records]


def probes_of(task: AnyTask, probes: Sequence[str]) -> list[str]:
    return [kind for kind in probes if isinstance(task, Task) or kind in VALUE_PROBES or percent_of(kind)]


def _papers(
    source: FeatureSource, pack: Pack, tasks: Sequence[Task], modalities: Sequence[str], seed: int
) -> dict[tuple[str, str], Classifier]:
    """The paper's probes by (task, modality). Tasks that share training rows are trained together."""
    found: dict[tuple[str, str], Classifier] = {}
    for modality in modalities:
        sharing: dict[bytes, list[Task]] = {}
        for task in (task for task in tasks if seen_by(pack, task, [modality])):
            sharing.setdefault(split_rows(pack, task, modality).fitted.tobytes(), []).append(task)
        for key, group in sharing.items():
            rows = np.frombuffer(key, np.int64)
            ys = [pack.labels(task.name)[rows] for task in group]
            fitted = fit_papers(source(modality, rows), ys, [len(task.classes) for task in group], seed)
            found.update({(task.name, modality): predict for task, predict in zip(group, fitted, strict=True)})
    return found
