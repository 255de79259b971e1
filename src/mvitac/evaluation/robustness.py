"""Stress tests of features: few labels, noisy images, a modality missing at test time, and a split that leaks.

Each is scored by logistic regression (ridge for values) and recorded under its own probe name (``STRESSES``). Compare
scores within one name only. The exception is the pair in ``LEAK``: its difference is what a split by frames adds to a
split by groups.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch

from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask, Task, ValueTask
from mvitac.evaluation.features import features, sample
from mvitac.evaluation.probe import (
    ProbeSplit,
    fit_probe,
    names_in,
    probe_features,
    score_rows,
    seen_by,
    split_rows,
)
from mvitac.model import Model
from mvitac.transforms.denoise import denoise, noise_level

SHARES = {"1 % of labels": 0.01, "10 % of labels": 0.1}
"""Fraction of the labelled training and validation rows that a probe sees; at least one row per class, two of values."""
NOISE = "noisy images"
NOISE_LEVELS = 20.0  # standard deviation of the noise added to each 8-bit channel of test images
CLEANED = "noisy images, cleaned"
"""The same images, denoised (``transforms.denoise``), and their features given the mean and standard deviation of clean
ones. Level of noise and statistics come from noisy images of training rows, without labels."""
NOISED = ("noise in the probe", f"noise in the probe, {NOISE}")
"""A probe fitted on every row twice: as it is, and with noise that is then taken off. It is scored on clean and on noisy,
denoised test images."""
MISSING = {"vision": "vision missing", "touch": "touch missing"}
"""modality -> name. The probe uses both modalities; in test rows, features of this one are replaced by their mean."""
DROPOUT = "modality dropout"
"""A probe on both modalities, fitted on every row three times: whole, and with each modality missing. It is scored with
both present and, under names such as "modality dropout, vision missing", with one missing."""
LEAK = {"unseen groups": False, "groups seen in training": True}
"""name -> whether half of each test group's rows replace as many training rows. Both score the other half."""
PREPARED = {lost: f"{DROPOUT}, {name}" for lost, name in MISSING.items()}
STRESSES = (*SHARES, NOISE, CLEANED, *NOISED, *MISSING.values(), DROPOUT, *PREPARED.values(), *LEAK)

Scores = Iterator[tuple[str, dict[str, Any]]]  # (name of the stress, scores)


@dataclass(frozen=True)
class _Case:
    """One task and modality of a model, with clean features [train + val + test rows, D] by modality."""

    pack: Pack
    task: AnyTask
    rows: ProbeSplit
    clean: dict[str, np.ndarray]
    seed: int

    def joined(self) -> np.ndarray:
        return np.concatenate(list(self.clean.values()), axis=1)

    def fit(self, x: np.ndarray, rows: ProbeSplit) -> Callable[[np.ndarray], dict[str, Any]]:
        """Fit logistic regression, or ridge; returns a function from features of the test rows to scores."""
        predict, extra = fit_probe(x, self.pack, self.task, rows, "linear", self.seed)
        return lambda z: {**score_rows(self.pack, self.task, rows.test, predict(z)), **extra}

    def probe(self, keep: np.ndarray, rows: ProbeSplit) -> dict[str, Any]:
        return probe_features(self.joined()[keep], self.pack, self.task, rows, "linear", self.seed)


def stress(model: Model, pack: Pack, tasks: Sequence[AnyTask], modalities: Sequence[str]) -> list[dict[str, Any]]:
    """Records of every stress for each task and each modality that ``model`` has an encoder for.

    Rows and noise are drawn alike for all models of one seed, so that differences are paired.
    """
    seed, records = model.seed, []
    known: dict[tuple[str, float], dict[int, np.ndarray]] = {}  # -> row -> features of its noisy, denoised image
    levels = {m: _added_noise(pack, m, seed) for m in model.encoders if m in pack.spec.modalities}

    def noisy(modality: str, rows: np.ndarray, level: float = 0.0) -> np.ndarray:
        mine = known.setdefault((modality, level), {})
        if len(new := np.array([row for row in rows if int(row) not in mine], np.int64)):
            mine.update(zip(new.tolist(), _noisy_features(model, pack, modality, new, seed, level), strict=True))
        return np.stack([mine[int(row)] for row in rows])

    def cleaned(case: _Case, modality: str) -> np.ndarray:
        z, seen = (noisy(modality, rows, levels[modality]) for rows in (case.rows.test, sample(case.rows.train, 256)))
        clean = case.clean[modality][: len(case.rows.fitted)]
        return (z - seen.mean(0)) / (seen.std(0) + 1e-6) * clean.std(0) + clean.mean(0)

    for task, modality in product(tasks, modalities):
        names = names_in(modality, pack)
        if not set(names) <= set(model.encoders) or not seen_by(pack, task, [modality]):
            continue
        rows = split_rows(pack, task, modality)
        case = _Case(pack, task, rows, {m: features(model, pack, m, rows.all) for m in names}, seed)
        worse = {
            NOISE: np.concatenate([noisy(m, rows.test) for m in names], axis=1),
            CLEANED: np.concatenate([cleaned(case, m) for m in names], axis=1),
        }
        denoised = np.concatenate([noisy(m, rows.all, levels[m]) for m in names], axis=1)
        versions = [dict(zip(NOISED, (case.joined(), denoised), strict=True)), _missing(case)]
        for scores in (
            _fewer_or_leaked(case),
            _worse_images(case, worse),
            *(_versions(case, v) for v in versions if v),
        ):
            for kind, result in scores:
                records.append({"task": task.name, "modality": modality, "probe": kind, **result})
    return records


def few_labels(x: np.ndarray, pack: Pack, task: AnyTask, rows: ProbeSplit, share: float, seed: int) -> dict[str, Any]:
    """Scores of the linear probe on features ``x`` of ``rows.all``, fitted with ``share`` of the labels (``SHARES``)."""
    case = _Case(pack, task, rows, {"": x}, seed)
    return case.probe(*_few(rows, _strata(case), share, seed))


def _fewer_or_leaked(case: _Case) -> Scores:
    """Few labels, and the two splits of ``LEAK``."""
    for kind, share in SHARES.items():
        yield kind, case.probe(*_few(case.rows, _strata(case), share, case.seed))
    for kind, leaks in LEAK.items():
        # One half for all seeds: of values, others could lack other measurements, and seeds must share their test rows.
        seed = 0 if isinstance(case.task, ValueTask) else case.seed
        keep, halved = _halved(case.rows, case.pack.column("group"), leaks, seed)
        if len(halved.test):
            yield kind, case.probe(keep, halved)


def _strata(case: _Case) -> np.ndarray:
    """What few labels keep one row of, for each row of the pack: its class, or which values it has and whether they are low.

    So every target keeps a row, and a single one two different values.
    """
    if isinstance(case.task, Task):
        return case.pack.labels(case.task.name)
    values = case.pack.values(case.task)
    low = (values < np.nanmedian(values[case.rows.train], axis=0)).any(axis=1)
    return np.unique(np.column_stack([np.isnan(values), low]), axis=0, return_inverse=True)[1]


def _worse_images(case: _Case, worse: dict[str, np.ndarray]) -> Scores:
    """Features of ``worse`` test images, and for a probe on both modalities one of them missing."""
    num = len(case.rows.fitted)
    score = case.fit(case.joined()[:num], case.rows)
    for kind, z in worse.items():
        yield kind, score(z)
    if len(case.clean) == 2:
        for lost, kind in MISSING.items():
            yield kind, score(_without(lost, case.clean, num)[num:])


def _missing(case: _Case) -> dict[str, np.ndarray]:
    """Features [N, D] of all rows for modality dropout, by name: whole, and without each of two modalities."""
    if len(case.clean) < 2:
        return {}
    num = len(case.rows.fitted)
    return {DROPOUT: case.joined(), **{kind: _without(lost, case.clean, num) for lost, kind in PREPARED.items()}}


def _versions(case: _Case, versions: dict[str, np.ndarray]) -> Scores:
    """Scores on each version of the test rows' features; the probe is fitted on all versions of the other rows."""
    rows, num, split = case.rows, len(case.rows.fitted), len(case.rows.train)
    parts = [z[:split] for z in versions.values()] + [z[split:num] for z in versions.values()]
    times = len(versions)
    score = case.fit(np.concatenate(parts), ProbeSplit(np.tile(rows.train, times), np.tile(rows.val, times), rows.test))
    for kind, z in versions.items():
        yield kind, score(z[num:])


def _without(lost: str, clean: dict[str, np.ndarray], num: int) -> np.ndarray:
    """Features of both modalities [N, D], those of ``lost`` replaced by the mean of its first ``num`` rows."""
    means = {m: np.broadcast_to(z[:num].mean(0), z.shape) if m == lost else z for m, z in clean.items()}
    return np.concatenate([*means.values()], axis=1)


def _few(rows: ProbeSplit, labels: np.ndarray, share: float, seed: int) -> tuple[np.ndarray, ProbeSplit]:
    """Keep ``share`` of the training and validation rows, and all test rows: positions, and these rows by split."""
    rng = np.random.default_rng([seed, round(1000 * share)])

    def some(part: np.ndarray) -> np.ndarray:
        order = rng.permutation(len(part))
        _, first = np.unique(labels[part[order]], return_index=True)  # one of each class, then any
        rest = np.setdiff1d(np.arange(len(part)), first)
        wanted = max(len(first), round(share * len(part)))
        return np.sort(order[np.concatenate([first, rest])[:wanted]])

    train, val = some(rows.train), some(rows.val)
    num_train, num_val = len(rows.train), len(rows.val)
    test = num_train + num_val + np.arange(len(rows.test))
    return np.concatenate([train, num_train + val, test]), ProbeSplit(rows.train[train], rows.val[val], rows.test)


def _halved(rows: ProbeSplit, groups: np.ndarray, leaks: bool, seed: int) -> tuple[np.ndarray, ProbeSplit]:
    """Score half the rows of each test group; if ``leaks``, the other half replaces as many training rows.

    Groups of one row are left out. Returns as ``_few``.
    """
    rng = np.random.default_rng([seed, 2])
    given, scored = [], []
    for name in np.unique(groups[rows.test]):
        mine = rng.permutation(np.flatnonzero(groups[rows.test] == name))
        half = len(mine) // 2
        given += mine[:half].tolist()
        scored += mine[half:].tolist() if half else []
    if len(given) > len(rows.train):  # no more than can be replaced
        given = rng.permutation(given)[: len(rows.train)].tolist()
    train = np.arange(len(rows.train))
    val, test = len(train) + np.arange(len(rows.val)), len(train) + len(rows.val)
    if leaks:
        train = np.concatenate([rng.permutation(train)[len(given) :], test + np.array(given, np.int64)])
    keep = np.concatenate([train, val, test + np.array(scored, np.int64)])
    return keep, ProbeSplit(rows.all[train], rows.val, rows.test[scored])


def _added_noise(pack: Pack, modality: str, seed: int) -> float:
    """The noise of ``NOISE_LEVELS`` as an estimate from 64 noisy and 64 other images of training rows."""
    rows = sample(pack.rows("train", having=(modality,)), 128)
    noisy = np.stack([_noisy(pack.images[modality][row], seed, int(row)) for row in rows[::2]])
    return max(0.0, noise_level(noisy) ** 2 - noise_level(pack.images[modality][rows[1::2]]) ** 2) ** 0.5


def _noisy_features(
    model: Model, pack: Pack, modality: str, rows: np.ndarray, seed: int, level: float = 0.0
) -> np.ndarray:
    """Features [len(rows), D] of images with Gaussian noise, the same for the same (seed, row), denoised by ``level``."""
    device, found = next(model.parameters()).device, []
    for chunk in np.array_split(rows, max(1, len(rows) // 256)):
        images = denoise(np.stack([_noisy(pack.images[modality][row], seed, int(row)) for row in chunk]), level)
        found.append(model.features(modality, torch.from_numpy(images).permute(0, 3, 1, 2).to(device)).cpu().numpy())
    return np.concatenate(found)


def _noisy(image: np.ndarray, seed: int, row: int) -> np.ndarray:
    noise = np.random.default_rng([seed, row]).normal(0, NOISE_LEVELS, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
