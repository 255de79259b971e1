"""What frozen features are worth: linear probes, kNN and cross-modal retrieval, each beside its controls.

Nothing is ever chosen on test: the regularisation is chosen on held-out groups of train. Shapes: features [N, D].
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import confusion_matrix, f1_score, recall_score, roc_auc_score
from threadpoolctl import threadpool_limits

from mvitac import diagnostics
from mvitac.encoders import SCRATCH, build_trunk
from mvitac.heads import train_heads
from mvitac.model import Model, fresh, load, pack_features
from mvitac.pack import Pack
from mvitac.record import cache_dir, check_place, digest, write_atomic, write_json
from mvitac.registry import unknown
from mvitac.run import Run
from mvitac.spec import Task

PROBES = ("linear", "paper", "knn")
"""linear: logistic regression, C chosen on validation groups. paper: dropout .2, Adam 1e-4, 60 epochs. knn: 20 nearest."""
Probe = Literal["linear", "paper", "knn"]
STRENGTHS = (0.001, 0.01, 0.1, 1.0)
"""Inverse regularisation C that logistic regression may choose from."""
END_TO_END = ", end to end"
"""Added to a source's name where its own classifiers are scored, which it trained along with its encoders."""
NUM_DRAWS = 2000
"""Bootstrap draws behind every interval."""
MIN_GALLERY = 10
"""Test groups below which retrieval is left out: the best five of so few are half of them or all."""


@dataclass(frozen=True)
class Parts:
    """Row numbers of one task: what a probe learns from, what it chooses on, what it is scored on."""

    train: np.ndarray
    val: np.ndarray
    test: np.ndarray


def parts(pack: Pack, task: Task, modality: str = "none") -> Parts:
    """Labelled rows of ``task`` that have an image of ``modality`` ("both": of either, "none": of any), by split.

    Without a val split, a fifth of train's groups is set aside for choosing.
    """
    having = pack.spec.modalities if modality == "both" else () if modality == "none" else (modality,)
    labels = pack.column(f"label_{task.name}")
    train, val, test = (
        rows[labels[rows] >= 0]
        for rows in (
            pack.rows(split, only=task.only, having=having, by=task.split) for split in ("train", "val", "test")
        )
    )
    if not len(train) or not len(test):
        where = "train" if not len(train) else "test"
        lacking = f" with {' and '.join(having)}" if having else ""
        raise ValueError(f"task {task.name!r} has no labelled rows{lacking} in split {where}: nothing to probe")
    if not len(val):
        groups = pack.column("group")[train].astype(str)
        names = np.random.default_rng(0).permutation(np.unique(groups))
        held = np.isin(groups, names[: max(1, len(names) // 5)])
        if held.all() or len(set(labels[train[~held]])) < 2:  # one group: no honest choice is possible
            return Parts(train, train, test)
        train, val = train[~held], train[held]
    return Parts(train, val, test)


# -- features ---------------------------------------------------------------------------------------------------------


def features(model: Model, pack: Pack, modality: str, rows: np.ndarray) -> np.ndarray:
    """Features [len(rows), D] float32, computed once and cached by weights, data and rows."""
    device = next(model.parameters()).device
    key = digest([model.weights_digest(), pack.digest, modality, digest(rows.tolist()), device.type])
    path = cache_dir() / "features" / f"{key[:32]}.npy"
    if path.exists():
        try:
            return np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError):
            path.unlink()  # damaged: compute it again
    values = pack_features(model, pack, modality, rows).numpy()
    write_atomic(path, lambda file: np.save(file, values))
    return values


def thumbnails(pack: Pack, modality: str, rows: np.ndarray, side: int = 8) -> np.ndarray:
    """Control "pixels": the image averaged to side x side, flattened [len(rows), side * side * C]."""
    images = torch.from_numpy(pack.images[modality][rows]).permute(0, 3, 1, 2).float() / 255
    return F.adaptive_avg_pool2d(images, side).flatten(1).numpy()


def borders(pack: Pack, modality: str, rows: np.ndarray, side: int = 16, width: int = 2) -> np.ndarray:
    """Control "border": only the outer ring of a side x side thumbnail, where hardly any contact is ever seen."""
    ring = np.ones((side, side), bool)
    ring[width:-width, width:-width] = False
    pixels = thumbnails(pack, modality, rows, side).reshape(len(rows), -1, side, side)
    return pixels[:, :, ring].reshape(len(rows), -1)


# -- probes -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Logistic:
    """A fitted logistic regression on (z - mean) / std; called, it gives probabilities in ascending label order."""

    model: LogisticRegression
    mean: np.ndarray
    std: np.ndarray

    def __call__(self, z: np.ndarray) -> np.ndarray:
        return self.model.predict_proba((z - self.mean) / self.std)


def fit_linear(x: np.ndarray, y: np.ndarray, x_val: np.ndarray, y_val: np.ndarray) -> tuple[Logistic, float]:
    """Logistic regression on standardised features; C is the best on val, then train and val are fitted together.

    Returns it and C.
    """
    mean, std = x.mean(0), x.std(0) + 1e-6
    x, x_val = (x - mean) / std, (x_val - mean) / std
    # Ascending C, each start warm from the last: about a third of the steps of cold starts.
    model = LogisticRegression(max_iter=300, tol=1e-3, warm_start=True)
    # One BLAS thread: these products are small, and threads that wait for each other made it ten times slower.
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore", ConvergenceWarning)  # 300 L-BFGS steps are plenty for choosing
        scores = [model.set_params(C=c).fit(x, y).score(x_val, y_val) for c in STRENGTHS]
        c = STRENGTHS[int(np.argmax(scores))]
        if set(y_val) - set(y):  # a class only seen in val changes the shape of the weights
            model = LogisticRegression(max_iter=300, tol=1e-3)
        model.set_params(C=c).fit(np.concatenate([x, x_val]), np.concatenate([y, y_val]))
    return Logistic(model, mean, std), c


def fit_paper(x: np.ndarray, y: np.ndarray, num_classes: int, seed: int) -> Any:
    """The paper's probe (``heads.py``) of one task."""
    return fit_papers(x, [y], [num_classes], seed)[0]


def fit_papers(x: np.ndarray, ys: list[np.ndarray], num_classes: list[int], seed: int) -> list[Any]:
    """The paper's probes of several tasks on the same rows, trained together: a function to class probabilities each."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    labels = torch.from_numpy(np.stack(ys)).long()
    heads = train_heads(torch.from_numpy(x).float()[None].to(device), labels, num_classes, [seed])[0]

    def predict(z: np.ndarray, head: np.ndarray) -> np.ndarray:
        return np.asarray(torch.softmax(torch.from_numpy(z @ head[:, :-1].T + head[:, -1]), 1))

    return [partial(predict, head=head.numpy()) for head in heads]


def fit_knn(x: np.ndarray, y: np.ndarray, num_classes: int, k: int = 20) -> Any:
    """Weighted vote of the k nearest by cosine, as ``diagnostics.knn_accuracy``, giving vote shares per class."""
    bank = F.normalize(torch.from_numpy(x).float(), dim=1)
    labels = torch.from_numpy(y).long()

    def predict(z: np.ndarray) -> np.ndarray:
        near = (F.normalize(torch.from_numpy(z).float(), dim=1) @ bank.T).topk(min(k, len(bank)), dim=1)
        votes = torch.zeros(len(z), num_classes).scatter_add_(1, labels[near.indices], (near.values / 0.07).exp())
        return (votes / votes.sum(1, keepdim=True)).numpy()

    return predict


def score(y: np.ndarray, probabilities: np.ndarray, groups: np.ndarray, num_classes: int) -> dict[str, Any]:
    """Scores of one probe on test rows; ``groups`` are the rows' group numbers, for intervals."""
    guess = probabilities.argmax(1)
    present = np.unique(y)
    num_groups = int(groups.max()) + 1
    auroc = None
    no_division: dict[str, Any] = {"zero_division": 0}  # a class that is never guessed has precision 0
    if num_classes == 2 and len(present) == 2:
        auroc = float(roc_auc_score(y, probabilities[:, 1]))
    return {
        "accuracy": float((guess == y).mean()),
        "balanced_accuracy": float(recall_score(y, guess, labels=present, average="macro", **no_division)),
        "macro_f1": float(f1_score(y, guess, labels=present, average="macro", **no_division)),
        "auroc": auroc,
        "confusion": confusion_matrix(y, guess, labels=range(num_classes)).tolist(),
        "num_test": len(y),
        "group_sizes": np.bincount(groups, minlength=num_groups).tolist(),
        "group_correct": np.bincount(groups, weights=guess == y, minlength=num_groups).astype(int).tolist(),
    }


def spread_out(probabilities: np.ndarray, seen: np.ndarray, num_classes: int) -> np.ndarray:
    """Probabilities over the classes ``seen`` in training as columns of all ``num_classes``."""
    full = np.zeros((len(probabilities), num_classes))
    full[:, seen] = probabilities
    return full


def probe_features(
    x: np.ndarray, pack: Pack, task: Task, rows: Parts, kind: str, seed: int, paper: Any = None
) -> dict[str, Any]:
    """One probe of ``kind`` on features ``x`` [train + val + test rows in this order, D]; ``paper`` is a trained one."""
    labels = pack.column(f"label_{task.name}").astype(int)
    num_train, num_val, num = len(rows.train), len(rows.val), len(task.classes)
    y, y_val = labels[rows.train], labels[rows.val]
    learn, choose, test = x[:num_train], x[num_train : num_train + num_val], x[num_train + num_val :]
    whole, y_whole = np.concatenate([learn, choose]), np.concatenate([y, y_val])
    extra: dict[str, Any] = {}
    if len(np.unique(y)) < 2:
        probabilities = np.eye(num)[np.full(len(test), y[0])]  # one class only: nothing to learn
    elif kind == "linear":
        predict, extra["C"] = fit_linear(learn, y, choose, y_val)
        probabilities = spread_out(predict(test), np.unique(y_whole), num)
    elif kind == "paper":
        probabilities = (paper or fit_paper(whole, y_whole, num, seed))(test)
    elif kind == "knn":
        probabilities = fit_knn(whole, y_whole, num)(test)
    else:
        raise unknown("probe", kind, PROBES)
    return {**score_rows(pack, task, rows.test, probabilities), **extra}


# -- a whole probing session ------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Session:
    """What to probe, and which controls to put beside it."""

    probes: tuple[Probe, ...] = ("linear",)
    """linear: logistic regression, C chosen on held-out groups of train; paper: the paper's Adam probe; knn: 20 nearest."""
    tasks: tuple[str, ...] = ()
    """Tasks to probe; none given = all."""
    modalities: tuple[Literal["touch", "vision", "both"], ...] = ()
    """none given = all the data has."""
    controls: bool = True
    """Also score majority, untrained trunk, pixels, border, and the dataset's own controls."""
    imagenet: Path | None = None
    """ImageNet weights of the trunk (a file), for the frozen-ImageNet control."""

    def __post_init__(self) -> None:
        for name, values in (("probe", self.probes), ("task", self.tasks), ("modality", self.modalities)):
            for value in values:
                if values.count(value) > 1:
                    raise ValueError(f"{name} {value!r} is given twice: give it once")
        if self.imagenet and not self.imagenet.is_file():
            raise ValueError(f"imagenet {self.imagenet}: give a file that exists")


def probe_runs(paths: Sequence[Path], session: Session, pack: Pack | None = None) -> dict[str, Any]:
    """Probe finished runs (seeds of one method, or several methods, on one dataset) and their controls.

    Returns {"data", "pack", "records": [...], "retrieval": [...], "summary": {...}}, and leaves each run's own part in
    its probe.json. ``pack`` probes on other data than the run was trained on.
    """
    if not paths:
        raise ValueError("give at least one run's folder")
    for path in paths:
        if path.is_file():
            raise ValueError(f"{path} is a file: give the run's folder, where the scores are also written")
        if [p.resolve() for p in paths].count(path.resolve()) > 1:
            raise ValueError(f"run {path} is given twice: it would count as two seeds, give it once")
    models = [load(path) for path in paths]
    packs = [pack or model.run.data.open() for model in models]
    if len({p.digest for p in packs}) > 1:
        raise ValueError(
            "these runs were trained on different data: probe them apart, or give one pack for all with --on"
        )
    pack = packs[0]
    tasks, modalities = chosen(pack, session)
    for path, model in zip(paths, models, strict=True):
        check_place(path / "probe.json")
        for modality in pack.spec.modalities:
            if model.spec.channels(modality) != pack.spec.channels(modality):
                raise ValueError(
                    f"{path} cannot embed this data's {modality} ({pack.spec.channels(modality)} channels):"
                    f" it was trained on {model.spec.name!r}"
                )
    for task in tasks:
        for modality in modalities:
            parts(pack, task, modality)
    if session.controls:  # fetched now, so that one that cannot be had is not found out at the end
        for weights in _start_weights([m.run for m in models], session):
            build_trunk(replace(models[0].run.encoder, weights=weights), 3)
    records: list[dict[str, Any]] = []
    retrieval: list[dict[str, Any]] = []
    for path, model in zip(paths, models, strict=True):
        several = len({m.run.recipe for m in models}) > 1
        source = f"{model.run.method.name} ({model.run.recipe})" if several else model.run.method.name
        own = {"source": source, "seed": model.run.seed, "run": str(path)}
        mine = [{**own, **r} for r in _probe_model(model, pack, tasks, modalities, session.probes)]
        for record in mine:
            record["source"] += END_TO_END if record["probe"] == "own" else ""
        found = [{**own, **r} for r in cross_modal(model, pack)]
        write_json(
            path / "probe.json", {"data": pack.spec.name, "pack": pack.digest, "records": mine, "retrieval": found}
        )
        records += mine
        retrieval += found
    if session.controls:
        controls, found = controls_of([m.run for m in models], pack, tasks, modalities, session)
        records += controls
        retrieval += found
    return {
        "data": pack.spec.name,
        "pack": pack.digest,
        "group_by": pack.spec.group_by,
        "notes": list(pack.spec.notes),
        "classes": {task.name: list(task.classes) for task in tasks},
        "records": records,
        "retrieval": retrieval,
        "summary": summarise(records, session.probes[0]),
    }


def chosen(pack: Pack, session: Session) -> tuple[list[Task], list[str]]:
    """The tasks and modalities of ``session`` on this data; ValueError names what it lacks."""
    known = {task.name: task for task in pack.spec.tasks}
    if not known:
        raise ValueError(f"dataset {pack.spec.name!r} has no labels: nothing to probe")
    for name in session.tasks:
        if name not in known:
            raise unknown("task", name, known)
    have = [*pack.spec.modalities, *(["both"] if len(pack.spec.modalities) == 2 else [])]
    for modality in session.modalities:
        if modality not in have:
            raise unknown("modality", modality, have)
    if not session.probes:
        raise ValueError(f"no probes asked for: choose from {', '.join(PROBES)}")
    return [known[name] for name in session.tasks or known], list(session.modalities or have)


def _probe_model(
    model: Model, pack: Pack, tasks: Sequence[Task], modalities: Sequence[str], probes: Sequence[str]
) -> list[dict[str, Any]]:
    # A supervised reference may have learned from one modality only; the others are no business of its.
    modalities = [m for m in modalities if set(pack.spec.modalities if m == "both" else (m,)) <= set(model.encoders)]
    if not modalities:
        return []
    asked = [parts(pack, task, modality) for task in tasks for modality in modalities]
    needed = np.unique(np.concatenate([np.concatenate([p.train, p.val, p.test]) for p in asked]))
    own = {m: needed[pack.has(m)[needed]] for m in model.encoders if m in modalities or "both" in modalities}
    by_modality = {m: features(model, pack, m, rows) for m, rows in own.items()}

    def matrix(modality: str, rows: np.ndarray) -> np.ndarray:
        names = pack.spec.modalities if modality == "both" else (modality,)
        return np.concatenate([by_modality[m][np.searchsorted(own[m], rows)] for m in names], axis=1)

    records = _probe_all(matrix, pack, tasks, modalities, probes, model.run.seed)
    whole = "both" if len(model.encoders) == 2 else next(iter(model.encoders))
    for task in (task for task in tasks if task.name in model.tasks and whole in modalities):
        rows = parts(pack, task, whole).test
        z = {m: torch.from_numpy(matrix(m, rows)) for m in model.encoders}
        result = score_rows(pack, task, rows, model.classify(task.name, z).numpy())
        records.append({"task": task.name, "modality": whole, "probe": "own", **result})
    return records


def score_rows(pack: Pack, task: Task, rows: np.ndarray, probabilities: np.ndarray) -> dict[str, Any]:
    """Scores of class ``probabilities`` [len(rows), K] of pack ``rows``."""
    labels = pack.column(f"label_{task.name}").astype(int)[rows]
    groups = np.unique(pack.column("group")[rows].astype(str), return_inverse=True)[1]
    return score(labels, probabilities, groups, len(task.classes))


def _probe_all(
    matrix: Any, pack: Pack, tasks: Sequence[Task], modalities: Sequence[str], probes: Sequence[str], seed: int
) -> list[dict[str, Any]]:
    """Every (task, modality, probe) on the features ``matrix(modality, rows)``."""
    papers = _papers(matrix, pack, tasks, modalities, seed) if "paper" in probes else {}
    records = []
    for task in tasks:
        for modality in modalities:
            rows = parts(pack, task, modality)
            x = matrix(modality, np.concatenate([rows.train, rows.val, rows.test]))
            for kind in probes:
                result = probe_features(x, pack, task, rows, kind, seed, papers.get((task.name, modality)))
                records.append({"task": task.name, "modality": modality, "probe": kind, **result})
    return records


def _papers(
    matrix: Any, pack: Pack, tasks: Sequence[Task], modalities: Sequence[str], seed: int
) -> dict[tuple[str, str], Any]:
    """The paper's probes by (task, modality), those of tasks that learn from the same rows trained together."""
    found: dict[tuple[str, str], Any] = {}
    for modality in modalities:
        sharing: dict[bytes, list[Task]] = {}
        for task in tasks:
            rows = parts(pack, task, modality)
            sharing.setdefault(np.concatenate([rows.train, rows.val]).tobytes(), []).append(task)
        for key, group in sharing.items():
            rows = np.frombuffer(key, np.int64)
            ys = [pack.column(f"label_{task.name}").astype(int)[rows] for task in group]
            fitted = fit_papers(matrix(modality, rows), ys, [len(task.classes) for task in group], seed)
            found.update({(task.name, modality): predict for task, predict in zip(group, fitted, strict=True)})
    return found


def controls_of(
    runs: Sequence[Run], pack: Pack, tasks: Sequence[Task], modalities: Sequence[str], session: Session
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Records of every control beside ``runs``, and the retrieval of those that have a shared space."""
    records: list[dict[str, Any]] = []
    retrieval: list[dict[str, Any]] = []

    def add(source: str, seed: int | None, found: list[dict[str, Any]]) -> None:
        records.extend({"source": source, "seed": seed, **record} for record in found)

    for task in tasks:
        rows = parts(pack, task)
        everything = np.concatenate([rows.train, rows.val, rows.test])
        labels = pack.column(f"label_{task.name}").astype(int)
        common = np.bincount(labels[np.concatenate([rows.train, rows.val])], minlength=len(task.classes)).argmax()
        constant = np.eye(len(task.classes))[np.full(len(rows.test), common)]
        result = score_rows(pack, task, rows.test, constant)
        add("majority", None, [{"task": task.name, "modality": "none", "probe": "linear", **result}])
        for name, columns in pack.spec.controls.items():
            x = np.stack([pack.column(column)[everything].astype(float) for column in columns], axis=1)
            result = probe_features(x, pack, task, rows, "linear", 0)
            add(name, None, [{"task": task.name, "modality": "none", "probe": "linear", **result}])

    def pixels(modality: str, rows: np.ndarray) -> np.ndarray:
        names = pack.spec.modalities if modality == "both" else (modality,)
        return np.concatenate([thumbnails(pack, m, rows) for m in names], axis=1)

    add("pixels", None, _probe_all(pixels, pack, tasks, modalities, ["linear"], 0))
    if "touch" in modalities:
        ring = _probe_all(lambda m, rows: borders(pack, m, rows), pack, tasks, ["touch"], ["linear"], 0)
        add("border", None, ring)

    # The trunk before training, once for each seed and architecture among the runs; then the trunk they started from.
    starts = {(run.seed, run.encoder.trunk, run.augment.seen): run for run in runs}
    for run in starts.values():
        untrained = fresh(replace(run, encoder=replace(run.encoder, weights=SCRATCH)), pack.spec, pack.size)
        add("untrained", run.seed, _probe_model(untrained, pack, tasks, modalities, session.probes))
        retrieval += [{"source": "untrained", "seed": run.seed, **r} for r in cross_modal(untrained, pack)]
    for name in _start_weights(runs, session):
        start = fresh(replace(runs[0], encoder=replace(runs[0].encoder, weights=name)), pack.spec, pack.size)
        add("imagenet", None, _probe_model(start, pack, tasks, modalities, session.probes))
    return records, retrieval


def _start_weights(runs: Sequence[Run], session: Session) -> list[str]:
    weights = {str(session.imagenet)} if session.imagenet else set()
    return sorted(weights | {run.encoder.weights for run in runs if run.encoder.weights != SCRATCH})


def cross_modal(model: Model, pack: Pack) -> list[dict[str, Any]]:
    """Retrieval over unseen groups in the shared space, both directions: R@1/5/10 with its chance and group hits at 5.

    Empty without a shared space or with fewer than ``MIN_GALLERY`` test groups.
    """
    only = pack.spec.tasks[0].only if pack.spec.tasks else None
    rows = pack.rows("test", only=only, having=pack.spec.modalities)
    if len(model.projectors) < 2 or not len(rows):
        return []
    device = next(model.parameters()).device
    z = {
        m: model.project(m, torch.from_numpy(features(model, pack, m, rows)).to(device)).cpu()
        for m in pack.spec.modalities
    }
    groups = torch.from_numpy(np.unique(pack.column("group")[rows].astype(str), return_inverse=True)[1])
    num_groups = int(groups.max()) + 1
    if num_groups < MIN_GALLERY:
        return []
    records = []
    for query, gallery in (("vision", "touch"), ("touch", "vision")):
        ranks = diagnostics.retrieval_ranks(z[query], z[gallery], groups)
        hits = np.bincount(groups.numpy(), weights=(ranks < 5).numpy(), minlength=num_groups).astype(int)
        records.append(
            {
                "direction": f"{query} -> {gallery}",
                **diagnostics.recall_at(ranks),
                "chance R@5": min(1.0, 5 / num_groups),
                "num_groups": num_groups,
                "group_sizes": np.bincount(groups.numpy()).tolist(),
                "group_correct": hits.tolist(),
            }
        )
    return records


def interval(records: Sequence[dict[str, Any]]) -> tuple[float, float, float]:
    """Mean accuracy over runs and its 95 % interval, by a two-level bootstrap over test groups and over seeds.

    All records must score the same test groups. Groups (not rows) are drawn, since rows of a group are near-copies.
    One group says nothing about others: its interval is all of 0 to 1.
    """
    sizes = np.array(records[0]["group_sizes"], float)
    correct = np.array([r["group_correct"] for r in records], float)  # [S, G]
    if len(sizes) < 2:
        return float(correct.sum(1).mean() / sizes.sum()), 0.0, 1.0
    rng = np.random.default_rng(0)
    seeds = rng.integers(0, len(correct), (NUM_DRAWS, len(correct)))
    groups = rng.integers(0, len(sizes), (NUM_DRAWS, len(sizes)))
    weights = np.stack([np.bincount(g, minlength=len(sizes)) for g in groups])  # [draws, G]
    per_seed = weights @ correct.T / np.maximum(weights @ sizes, 1)[:, None]  # [draws, S]
    means = np.take_along_axis(per_seed, seeds, axis=1).mean(1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(correct.sum(1).mean() / sizes.sum()), float(low), float(high)


def paired_difference(
    ours: Sequence[dict[str, Any]], theirs: Sequence[dict[str, Any]]
) -> tuple[float, float, float, float]:
    """Accuracy of ``ours`` minus that of ``theirs`` over the same test groups: mean, 95 % interval, two-sided p.

    Bootstrap over test groups, the same ones drawn for both, and over seeds: together where both have the same seeds
    (equal seeds share batches and views), apart otherwise. p is twice the share of draws on the other side of zero, at
    least 2 / (draws + 1). One group says nothing about others: p is 1.
    """
    sizes = np.array(ours[0]["group_sizes"], float)
    assert all(list(r["group_sizes"]) == list(sizes) for r in (*ours, *theirs)), "scored on different test rows"
    a, b = (np.array([r["group_correct"] for r in found], float) for found in (ours, theirs))  # [S, G]
    mean = float((a.sum(1).mean() - b.sum(1).mean()) / sizes.sum())
    if len(sizes) < 2:
        return mean, -1.0, 1.0, 1.0
    rng = np.random.default_rng(0)
    drawn_a = rng.integers(0, len(a), (NUM_DRAWS, len(a)))
    together = [r["seed"] for r in ours] == [r["seed"] for r in theirs]
    drawn_b = drawn_a if together else rng.integers(0, len(b), (NUM_DRAWS, len(b)))
    groups = rng.integers(0, len(sizes), (NUM_DRAWS, len(sizes)))
    weights = np.stack([np.bincount(g, minlength=len(sizes)) for g in groups])  # [draws, G]
    total = np.maximum(weights @ sizes, 1)[:, None]
    gaps = [
        np.take_along_axis(weights @ x.T / total, drawn, axis=1).mean(1) for x, drawn in ((a, drawn_a), (b, drawn_b))
    ]
    draws = gaps[0] - gaps[1]
    low, high = np.percentile(draws, [2.5, 97.5])
    tail = min(int((draws <= 0).sum()), int((draws >= 0).sum()))
    return mean, float(low), float(high), min(1.0, 2 * (tail + 1) / (NUM_DRAWS + 1))


def summarise(records: Sequence[dict[str, Any]], probe: str = "linear") -> dict[str, Any]:
    """task -> modality -> method or control -> mean, low, high, seeds (accuracy; see ``interval``).

    A source that was not probed by ``probe`` (majority, pixels, ...) shows the one probe it has.
    """
    asked = {record["source"] for record in records if record["probe"] == probe}
    gathered: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for record in records:
        if record["probe"] == probe or record["source"] not in asked:
            gathered.setdefault((record["task"], record["modality"], record["source"]), []).append(record)
    summary: dict[str, Any] = {}
    for (task, modality, source), found in gathered.items():
        mean, low, high = interval(found)
        seeds = [record["seed"] for record in found if record["seed"] is not None]
        cell = {"mean": mean, "low": low, "high": high, "seeds": seeds}
        summary.setdefault(task, {}).setdefault(modality, {})[source] = cell
    return summary
