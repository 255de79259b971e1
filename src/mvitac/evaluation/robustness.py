"""What features are worth when things are worse: few labels, noisy images, one modality missing at test time; or made to
look better, by a split that leaks.

All by the linear probe, as further records under their own probe names (``STRESSES``). Compare within one name only, but for
the two of ``LEAK``: their difference is what a split by frames adds to one by groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from mvitac.data.pack import Pack
from mvitac.data.spec import Task
from mvitac.evaluation.features import features
from mvitac.evaluation.probe import ProbeSplit, fit_probe, parts, probe_features, score_rows
from mvitac.model import Model

SHARES = {"1 % of labels": 0.01, "10 % of labels": 0.1}
"""Share of the labelled train rows and of the val rows a probe sees; at least one row of each class."""
NOISE = "noisy images"
NOISE_LEVELS = 20.0
"""Standard deviation of the noise on each 8-bit channel of test images."""
MISSING = {"vision": "vision missing", "touch": "touch missing"}
"""modality -> name; a probe on both modalities meets test rows whose features of this one are train's mean."""
DROPOUT = "modality dropout"
"""A probe on both that learned from every row three times, whole and with each modality missing; its scores with both
there, and under "modality dropout, vision missing" and the like."""
LEAK = {"unseen groups": False, "groups seen in training": True}
"""name -> whether half of every test group's rows are learned from, in place of as many rows of train; scored is the other
half both times, so that the same rows show what a split by frames or touches is worth in points."""
PREPARED = {lost: f"{DROPOUT}, {name}" for lost, name in MISSING.items()}
STRESSES = (*SHARES, NOISE, *MISSING.values(), DROPOUT, *PREPARED.values(), *LEAK)


def stress(model: Model, pack: Pack, tasks: Sequence[Task], modalities: Sequence[str]) -> list[dict[str, Any]]:
    """Records of every stress, task and modality that ``model`` has; the same draws of rows and noise for every model
    of one seed, so that differences are paired."""
    seed, records = model.run.seed, []
    noisy: dict[str, dict[int, np.ndarray]] = {}  # modality -> test row -> features of its noisy image
    for task, modality in ((task, modality) for task in tasks for modality in modalities):
        names = list(pack.spec.modalities) if modality == "both" else [modality]
        if not set(names) <= set(model.encoders):
            continue
        rows = parts(pack, task, modality)
        learned = np.concatenate([rows.train, rows.val])
        clean = {m: features(model, pack, m, np.concatenate([learned, rows.test])) for m in names}
        for m in names:
            known = noisy.setdefault(m, {})
            new = np.array([row for row in rows.test if int(row) not in known], np.int64)
            if len(new):
                known.update(zip(new.tolist(), _noisy_features(model, pack, m, new, seed), strict=True))

        def add(kind: str, result: dict[str, Any], task: Task = task, modality: str = modality) -> None:
            records.append({"task": task.name, "modality": modality, "probe": kind, **result})

        x = np.concatenate([clean[m] for m in names], axis=1)
        for kind, share in SHARES.items():
            keep, few = _few(rows, pack.labels(task.name), share, seed)
            add(kind, probe_features(x[keep], pack, task, few, "linear", seed))
        for kind, leaks in LEAK.items():
            keep, halved = _halved(rows, pack.column("group"), leaks, seed)
            if len(halved.test):
                add(kind, probe_features(x[keep], pack, task, halved, "linear", seed))

        num = len(learned)
        predict, extra = fit_probe(x[:num], pack, task, rows, "linear", seed)
        test = np.concatenate([np.stack([noisy[m][int(row)] for row in rows.test]) for m in names], axis=1)
        add(NOISE, {**score_rows(pack, task, rows.test, predict(test)), **extra})
        if modality != "both":
            continue
        blind = {lost: _without(lost, clean, num) for lost in MISSING}
        for lost, kind in MISSING.items():
            add(kind, {**score_rows(pack, task, rows.test, predict(blind[lost][num:])), **extra})
        whole = [x, *blind.values()]
        prepared = np.concatenate([z[: len(rows.train)] for z in whole] + [z[len(rows.train) : num] for z in whole])
        thrice = ProbeSplit(np.tile(rows.train, 3), np.tile(rows.val, 3), rows.test)
        predict, extra = fit_probe(prepared, pack, task, thrice, "linear", seed)
        for kind, z in zip((DROPOUT, *PREPARED.values()), whole, strict=True):
            add(kind, {**score_rows(pack, task, rows.test, predict(z[num:])), **extra})
    return records


def _without(lost: str, clean: dict[str, np.ndarray], num: int) -> np.ndarray:
    """Features of both modalities [N, D], those of ``lost`` everywhere the mean of the first ``num`` rows."""
    return np.concatenate(
        [np.broadcast_to(z[:num].mean(0), z.shape) if m == lost else z for m, z in clean.items()], axis=1
    )


def _few(rows: ProbeSplit, labels: np.ndarray, share: float, seed: int) -> tuple[np.ndarray, ProbeSplit]:
    """Places to keep in [train, val, test], and the parts that are left: ``share`` of train and of val, all of test."""
    rng = np.random.default_rng([seed, round(1000 * share)])

    def some(part: np.ndarray) -> np.ndarray:
        order = rng.permutation(len(part))
        _, first = np.unique(labels[part[order]], return_index=True)  # one of each class, then whatever comes
        rest = np.setdiff1d(np.arange(len(part)), first)
        wanted = max(len(first), round(share * len(part)))
        return np.sort(order[np.concatenate([first, rest])[:wanted]])

    train, val = some(rows.train), some(rows.val)
    num_train, num_val = len(rows.train), len(rows.val)
    test = num_train + num_val + np.arange(len(rows.test))
    return np.concatenate([train, num_train + val, test]), ProbeSplit(rows.train[train], rows.val[val], rows.test)


def _halved(rows: ProbeSplit, groups: np.ndarray, leaks: bool, seed: int) -> tuple[np.ndarray, ProbeSplit]:
    """Places to keep in [train, val, test], and the parts that are left: half the rows of each test group are scored; the
    other half is learned from if it ``leaks``, in place of as many rows of train. A group of one row takes no part."""
    rng = np.random.default_rng([seed, 2])
    given, scored = [], []
    for name in np.unique(groups[rows.test]):
        mine = rng.permutation(np.flatnonzero(groups[rows.test] == name))
        half = len(mine) // 2
        given += mine[:half].tolist()
        scored += mine[half:].tolist() if half else []
    if len(given) > len(rows.train):  # no more than there are to replace
        given = rng.permutation(given)[: len(rows.train)].tolist()
    train = np.arange(len(rows.train))
    val, test = len(train) + np.arange(len(rows.val)), len(train) + len(rows.val)
    if leaks:
        train = np.concatenate([rng.permutation(train)[len(given) :], test + np.array(given, np.int64)])
    keep = np.concatenate([train, val, test + np.array(scored, np.int64)])
    everything = np.concatenate([rows.train, rows.val, rows.test])
    return keep, ProbeSplit(everything[train], rows.val, rows.test[scored])


def _noisy_features(model: Model, pack: Pack, modality: str, rows: np.ndarray, seed: int) -> np.ndarray:
    """Features [len(rows), D] of images with Gaussian noise, the same noise for the same (seed, row)."""
    device, found = next(model.parameters()).device, []
    for chunk in np.array_split(rows, max(1, len(rows) // 256)):
        images = np.stack([_noisy(pack.images[modality][row], seed, int(row)) for row in chunk])
        found.append(model.features(modality, torch.from_numpy(images).permute(0, 3, 1, 2).to(device)).cpu().numpy())
    return np.concatenate(found)


def _noisy(image: np.ndarray, seed: int, row: int) -> np.ndarray:
    noise = np.random.default_rng([seed, row]).normal(0, NOISE_LEVELS, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
