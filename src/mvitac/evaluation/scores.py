"""What predictions are worth: scores by test group, their intervals, and differences between methods on the same groups.

A record is one probe of one source on one task: ``score`` writes its ``group_sizes`` and ``group_correct``, and every
interval resamples those groups (near-copies of one another inside, independent of one another outside) and the seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from sklearn.metrics import confusion_matrix, f1_score, recall_score, roc_auc_score

NUM_DRAWS = 2000
"""Bootstrap draws behind every interval."""


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


def pool(folds: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Records of cross-validation folds, whose test groups differ, as records of all groups together.

    Only what every fold has scored. Accuracy is that of all rows; AUROC, F1 and balanced accuracy, which cannot be taken
    over probes fitted apart, are means over the folds that have them.
    """
    keys = ("source", "seed", "task", "modality", "probe")
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for records in folds:
        for record in records:
            found.setdefault(tuple(record[key] for key in keys), []).append(record)
    pooled = []
    for parts in found.values():
        if len(parts) < len(folds):
            continue
        sizes, correct = ([n for part in parts for n in part[key]] for key in ("group_sizes", "group_correct"))
        means = {}
        for key in ("balanced_accuracy", "macro_f1", "auroc"):
            values = [part[key] for part in parts if part[key] is not None]
            means[key] = float(np.mean(values)) if values else None
        whole = {
            "accuracy": sum(correct) / sum(sizes),
            "confusion": np.sum([part["confusion"] for part in parts], axis=0).tolist(),
            "num_test": sum(part["num_test"] for part in parts),
            "group_sizes": sizes,
            "group_correct": correct,
        }
        pooled.append({**{key: parts[0][key] for key in keys}, **means, **whole})
    return pooled


def interval(records: Sequence[dict[str, Any]]) -> tuple[float, float, float]:
    """Mean accuracy over runs and its 95 % interval, by a two-level bootstrap over test groups and over seeds.

    All records must score the same test groups. Groups (not rows) are drawn, since rows of a group are near-copies.
    One group says nothing about others: its interval is all of 0 to 1.
    """
    sizes = np.array(records[0]["group_sizes"], float)
    correct = np.array([r["group_correct"] for r in records], float)  # [S, G]
    mean = float(correct.sum(1).mean() / sizes.sum())
    if len(sizes) < 2:
        return mean, 0.0, 1.0
    rng = np.random.default_rng(0)
    seeds = rng.integers(0, len(correct), (NUM_DRAWS, len(correct)))
    low, high = np.percentile(_means(correct, sizes, seeds, _drawn_groups(len(sizes), rng)), [2.5, 97.5])
    return mean, max(0.0, float(low)), min(1.0, float(high))


def paired_difference(
    ours: Sequence[dict[str, Any]], theirs: Sequence[dict[str, Any]]
) -> tuple[float, float, float, float]:
    """Accuracy of ``ours`` minus that of ``theirs`` over the same test groups: mean, 95 % interval, two-sided p.

    Bootstrap over test groups, the same ones drawn for both, and over seeds: together where both have the same seeds
    (equal seeds share batches and views), apart otherwise. p is twice the share of draws on the other side of zero, and no
    less than ``least_p``. One group says nothing about others: p is 1.
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
    weights = _drawn_groups(len(sizes), rng)
    draws = _means(a, sizes, drawn_a, weights) - _means(b, sizes, drawn_b, weights)
    low, high = np.percentile(draws, [2.5, 97.5])
    tail = min(int((draws <= 0).sum()), int((draws >= 0).sum()))
    return mean, float(low), float(high), min(1.0, max(2 * (tail + 1) / (NUM_DRAWS + 1), least_p(len(sizes))))


def least_p(num_groups: int) -> float:
    """The least p that ``paired_difference`` can say: that of a sign test over the groups, and of its draws."""
    return max(2 / (NUM_DRAWS + 1), 2.0 ** (1 - num_groups))


def _drawn_groups(num: int, rng: np.random.Generator) -> np.ndarray:
    """[draws, G]: how often each group is drawn."""
    return np.stack([np.bincount(g, minlength=num) for g in rng.integers(0, num, (NUM_DRAWS, num))])


def _means(correct: np.ndarray, sizes: np.ndarray, seeds: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[draws]: accuracy over the drawn groups (``weights``) and ``seeds``, of ``correct`` [S, G] of ``sizes`` [G] rows.

    Means of n things drawn with replacement vary by (n - 1) / n of what means of n other things would: little for 240
    groups, a third for 3 seeds. So each level's deviations are stretched by sqrt(n / (n - 1)) (Davison and Hinkley 1997,
    section 3.8).
    """
    num_seeds, num_groups = correct.shape
    per_seed = weights @ correct.T / np.maximum(weights @ sizes, 1)[:, None]  # [draws, S]
    all_seeds = per_seed.mean(1)
    over_seeds = np.take_along_axis(per_seed, seeds, axis=1).mean(1) - all_seeds
    over_groups = all_seeds - correct.sum() / num_seeds / sizes.sum()
    stretched = over_groups * (num_groups / (num_groups - 1)) ** 0.5
    if num_seeds > 1:
        stretched += over_seeds * (num_seeds / (num_seeds - 1)) ** 0.5
    return correct.sum() / num_seeds / sizes.sum() + stretched


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
