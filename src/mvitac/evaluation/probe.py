"""What one model's frozen features are worth on one pack: linear probes, kNN and cross-modal retrieval.

Nothing is ever chosen on test: the regularisation is chosen on held-out groups of train. Shapes: features [N, D].
``evaluation/classifiers.py`` fits, ``evaluation/scores.py`` scores, ``evaluation/controls.py`` has what a score stands beside, ``evaluation/evaluate.py`` probes whole runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from mvitac.data.pack import Pack
from mvitac.data.spec import Task
from mvitac.evaluation import diagnostics
from mvitac.evaluation.classifiers import fit_knn, fit_linear, fit_paper, fit_papers, spread_out
from mvitac.evaluation.features import features
from mvitac.evaluation.scores import score
from mvitac.model import Model
from mvitac.registry import unknown
from mvitac.system.progress import tick

PROBES = ("linear", "paper", "knn")
"""linear: logistic regression, C chosen on validation groups. paper: dropout .2, Adam 1e-4, 60 epochs. knn: 20 nearest."""
Probe = Literal["linear", "paper", "knn"]
MIN_GALLERY = 11
"""Test groups below which retrieval is left out: the best five of so few are half of them or all."""


@dataclass(frozen=True)
class ProbeSplit:
    """Row numbers of one task: what a probe learns from, what it chooses on, what it is scored on."""

    train: np.ndarray
    val: np.ndarray
    test: np.ndarray


def parts(pack: Pack, task: Task, modality: str = "none") -> ProbeSplit:
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
            return ProbeSplit(train, train, test)
        train, val = train[~held], train[held]
    return ProbeSplit(train, val, test)


def probe_features(
    x: np.ndarray, pack: Pack, task: Task, rows: ProbeSplit, kind: str, seed: int, paper: Any = None
) -> dict[str, Any]:
    """One probe of ``kind`` on features ``x`` [train + val + test rows in this order, D]; ``paper`` is a trained one."""
    num = len(rows.train) + len(rows.val)
    predict, extra = fit_probe(x[:num], pack, task, rows, kind, seed, paper)
    return {**score_rows(pack, task, rows.test, predict(x[num:])), **extra}


def fit_probe(
    x: np.ndarray, pack: Pack, task: Task, rows: ProbeSplit, kind: str, seed: int, paper: Any = None
) -> tuple[Callable[[np.ndarray], np.ndarray], dict[str, Any]]:
    """A function from features [N, D] to class probabilities [N, K], learned from ``x`` [train + val rows, D], and what
    was chosen on the way (C of ``linear``)."""
    labels = pack.column(f"label_{task.name}").astype(int)
    y, y_val, num = labels[rows.train], labels[rows.val], len(task.classes)
    learn, choose = x[: len(y)], x[len(y) :]
    y_whole = np.concatenate([y, y_val])
    if len(np.unique(y)) < 2:
        return lambda z: np.eye(num)[np.full(len(z), y[0])], {}  # one class only: nothing to learn
    if kind == "linear":
        fitted, c = fit_linear(learn, y, choose, y_val)
        return lambda z: spread_out(fitted(z), np.unique(y_whole), num), {"C": c}
    if kind == "paper":
        return paper or fit_paper(x, y_whole, num, seed), {}
    if kind == "knn":
        return fit_knn(x, y_whole, num), {}
    raise unknown("probe", kind, PROBES)


def probe_model(
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

    records = probe_all(matrix, pack, tasks, modalities, probes, model.run.seed)
    whole = "both" if len(model.encoders) == 2 else next(iter(model.encoders))
    learned = {task.name: task.classes for task in model.spec.tasks if task.name in model.tasks}
    for task in (task for task in tasks if task.name in learned and whole in modalities):
        if set(task.classes) - set(learned[task.name]):
            continue  # it was not taught all that is asked here
        rows = parts(pack, task, whole).test
        z = {m: torch.from_numpy(features(model, pack, m, rows, for_heads=True)) for m in model.encoders}
        # Columns by their names: this pack may list the classes in another order, or fewer of them.
        columns = [learned[task.name].index(name) for name in task.classes]
        result = score_rows(pack, task, rows, model.classify(task.name, z).numpy()[:, columns])
        records.append({"task": task.name, "modality": whole, "probe": "own", **result})
    return records


def score_rows(pack: Pack, task: Task, rows: np.ndarray, probabilities: np.ndarray) -> dict[str, Any]:
    """Scores of class ``probabilities`` [len(rows), K] of pack ``rows``."""
    labels = pack.column(f"label_{task.name}").astype(int)[rows]
    groups = np.unique(pack.column("group")[rows].astype(str), return_inverse=True)[1]
    return score(labels, probabilities, groups, len(task.classes))


def probe_all(
    matrix: Any, pack: Pack, tasks: Sequence[Task], modalities: Sequence[str], probes: Sequence[str], seed: int
) -> list[dict[str, Any]]:
    """Every (task, modality, probe) on the features ``matrix(modality, rows)``; each is a tick of "probes"."""
    papers = _papers(matrix, pack, tasks, modalities, seed) if "paper" in probes else {}
    records = []
    for task in tasks:
        for modality in modalities:
            rows = parts(pack, task, modality)
            x = matrix(modality, np.concatenate([rows.train, rows.val, rows.test]))
            for kind in probes:
                result = probe_features(x, pack, task, rows, kind, seed, papers.get((task.name, modality)))
                tick("probes")
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


def cross_modal(model: Model, pack: Pack) -> list[dict[str, Any]]:
    """Retrieval over unseen groups in the shared space, both directions: R@1/5/10 with its chance and group hits at 5.

    Empty without a shared space, on data of one modality, or with fewer than ``MIN_GALLERY`` test groups.
    """
    if len(model.projectors) < 2 or len(pack.spec.modalities) < 2:
        return []
    only = pack.spec.tasks[0].only if pack.spec.tasks else None
    rows = pack.rows("test", only=only, having=pack.spec.modalities)
    if not len(rows):
        return []
    device = next(model.parameters()).device
    z = {
        m: model.project(m, torch.from_numpy(features(model, pack, m, rows, for_heads=True)).to(device)).cpu()
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
