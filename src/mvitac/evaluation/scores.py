"""Scores of predictions, their confidence intervals, and differences between methods.

A record is one probe of one source on one task. ``score`` counts correct rows per test group. Every interval resamples
these groups and the seeds: rows within a group are near-copies, groups are independent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from sklearn.metrics import confusion_matrix, f1_score, recall_score, roc_auc_score

from mvitac.evaluation.leaks import leak_mark
from mvitac.evaluation.value_scores import mean_r2, pool_values

NUM_DRAWS = 2000
"""Number of bootstrap draws of every interval."""


def score(y: np.ndarray, probabilities: np.ndarray, groups: np.ndarray, num_classes: int) -> dict[str, Any]:
    """Score class probabilities [N, K] against labels ``y`` [N].

    Args:
        y: True labels.
        probabilities: Class probabilities.
        groups: Group number of each row, for intervals.
        num_classes: K.

    Returns:
        Accuracy, balanced accuracy, macro F1, AUROC (two classes only), the confusion matrix and counts per group.
    """
    guess = probabilities.argmax(1)
    present = np.unique(y)
    num_groups = int(groups.max()) + 1
    auroc = None
    no_division: dict[str, Any] = {"zero_division": 0}  # a class that is never predicted has precision 0
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
    """Pool the records of cross-validation folds, whose test groups differ, into records of all groups.

    Keeps only what every fold has scored. Accuracy, R2 and errors are over all rows.
    AUROC, F1 and balanced accuracy are means over the
    folds that have them, since the folds' probes were fitted separately.
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
        if "group_sums" in parts[0]:
            whole = pool_values(parts)
            if leaks := leaks_in(parts):
                whole["leak"] = leaks
            pooled.append({**{key: parts[0][key] for key in keys}, **whole})
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
        if leaks := leaks_in(parts):
            whole["leak"] = leaks
        pooled.append({**{key: parts[0][key] for key in keys}, **means, **whole})
    return pooled


def interval(records: Sequence[dict[str, Any]]) -> tuple[float, float, float]:
    """Mean accuracy (R2 of values) over runs and its 95 % interval, by a two-level bootstrap over test groups and seeds.

    Groups are drawn, not rows, since rows of a group are near-copies. With a single group the interval is 0 to 1.

    Args:
        records: One record per seed, all on the same test groups.

    Returns:
        Mean, lower end and upper end, in 0 .. 1.
    """
    records = _by_seed(records)
    num_groups = num_groups_of(records[0])
    mean = float(np.mean([mean_of(record) for record in records]))
    if num_groups < 2:
        return mean, least_of(records[0]), 1.0
    rng = np.random.default_rng(0)
    seeds = rng.integers(0, len(records), (NUM_DRAWS, len(records)))
    low, high = np.percentile(_draws(records, mean, seeds, _drawn_groups(num_groups, rng)), [2.5, 97.5])
    return mean, max(least_of(records[0]), float(low)), min(1.0, float(high))


def mean_of(record: dict[str, Any]) -> float:
    """The score that tables show: R2, mean over targets, or accuracy."""
    return record["r2"] if "group_sums" in record else sum(record["group_correct"]) / sum(record["group_sizes"])


def least_of(record: dict[str, Any]) -> float:
    """The lowest possible score of the record's kind."""
    return -math.inf if "group_sums" in record else 0.0


def num_groups_of(record: dict[str, Any]) -> int:
    """Number of test groups."""
    return len(record["group_sums"]["n"][0]) if "group_sums" in record else len(record["group_sizes"])


def paired_difference(
    ours: Sequence[dict[str, Any]], theirs: Sequence[dict[str, Any]]
) -> tuple[float, float, float, float]:
    """Difference in accuracy between two methods on the same test groups, by a paired bootstrap.

    Test groups are drawn jointly for both methods. Seeds are drawn jointly if both have the same seeds, which share
    batches and views, and independently otherwise.

    Args:
        ours: Records of one method, one per seed.
        theirs: Records of the method to subtract.

    Returns:
        Mean difference, lower and upper end of its 95 % interval, and the two-sided p: twice the fraction of draws on
        the other side of zero, at least ``least_p``. With a single group p is 1.
    """
    ours, theirs = _by_seed(ours), _by_seed(theirs)
    num_groups = num_groups_of(ours[0])
    assert len({_rows_of(record) for record in (*ours, *theirs)}) == 1, "scored on different test rows"
    means = [float(np.mean([mean_of(record) for record in found])) for found in (ours, theirs)]
    mean = means[0] - means[1]
    if num_groups < 2:
        return mean, -1.0, 1.0, 1.0
    rng = np.random.default_rng(0)
    drawn_ours = rng.integers(0, len(ours), (NUM_DRAWS, len(ours)))
    together = [r["seed"] for r in ours] == [r["seed"] for r in theirs]
    drawn_theirs = drawn_ours if together else rng.integers(0, len(theirs), (NUM_DRAWS, len(theirs)))
    weights = _drawn_groups(num_groups, rng)
    draws = _draws(ours, means[0], drawn_ours, weights) - _draws(theirs, means[1], drawn_theirs, weights)
    low, high = np.percentile(draws, [2.5, 97.5])
    tail = min(int((draws <= 0).sum()), int((draws >= 0).sum()))
    return mean, float(low), float(high), min(1.0, max(2 * (tail + 1) / (NUM_DRAWS + 1), least_p(num_groups)))


def _rows_of(record: dict[str, Any]) -> str:
    """Number of test rows of each group, and of each target."""
    return str(record["group_sums"]["n"] if "group_sums" in record else list(record["group_sizes"]))


def least_p(num_groups: int) -> float:
    """Smallest p of ``paired_difference``: limited by a sign test over the groups and by the number of draws."""
    return max(2 / (NUM_DRAWS + 1), 2.0 ** (1 - num_groups))


def _by_seed(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """``records`` ordered by seed, because the draws depend on the order."""
    return sorted(records, key=lambda record: -1 if record.get("seed") is None else record["seed"])


def _drawn_groups(num: int, rng: np.random.Generator) -> np.ndarray:
    """How often each group is drawn, [draws, G]."""
    return np.stack([np.bincount(g, minlength=num) for g in rng.integers(0, num, (NUM_DRAWS, num))])


def _draws(records: Sequence[dict[str, Any]], mean: float, seeds: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean score over seeds of each draw, [draws].

    A bootstrap of n items underestimates their variance by the factor (n - 1) / n: little for 240 groups, a third for 3
    seeds. So each level's deviations are scaled by sqrt(n / (n - 1)) (Davison and Hinkley 1997, section 3.8).

    Args:
        records: One record per seed.
        mean: Their mean score.
        seeds: Seeds of each draw, [draws, S].
        weights: How often each draw has each group, [draws, G].
    """
    per_seed = np.stack([_weighted(record, weights) for record in records], axis=1)  # [draws, S]
    all_seeds, num_groups, num_seeds = per_seed.mean(1), weights.shape[1], len(records)
    over_seeds = np.take_along_axis(per_seed, seeds, axis=1).mean(1) - all_seeds
    stretched = (all_seeds - mean) * (num_groups / (num_groups - 1)) ** 0.5
    if num_seeds > 1:
        stretched += over_seeds * (num_seeds / (num_seeds - 1)) ** 0.5
    return mean + stretched


def _weighted(record: dict[str, Any], weights: np.ndarray) -> np.ndarray:
    """Score of one record in each draw, [draws]."""
    if "group_sums" in record:
        return mean_r2(record, weights)
    sizes, correct = np.array(record["group_sizes"], float), np.array(record["group_correct"], float)
    return weights @ correct / np.maximum(weights @ sizes, 1)


Cell = tuple[str, str, str]
"""(task, modality, source)."""


def by_cell(records: Sequence[dict[str, Any]], probe: str) -> dict[Cell, list[dict[str, Any]]]:
    """Records of ``probe`` grouped by cell. A source without that probe (majority, pixels, ...) keeps the one it has."""
    asked = {record["source"] for record in records if record["probe"] == probe}
    found: dict[Cell, list[dict[str, Any]]] = {}
    for record in records:
        if record["probe"] == probe or record["source"] not in asked:
            found.setdefault((record["task"], record["modality"], record["source"]), []).append(record)
    return found


def leaks_in(records: Sequence[dict[str, Any]]) -> str:
    """The leaks of records (``evaluation.leaks``), without repetition; controls and records of 0.1.0 have none."""
    return "; ".join(dict.fromkeys(record["leak"] for record in records if record.get("leak")))


def summarise(records: Sequence[dict[str, Any]], probe: str = "linear") -> dict[str, Any]:
    """Accuracy as task -> modality -> method or control -> mean, low, high, seeds, number of test groups (``by_cell``)."""
    summary: dict[str, Any] = {}
    for (task, modality, source), found in by_cell(records, probe).items():
        mean, low, high = interval(found)
        seeds = [record["seed"] for record in found if record["seed"] is not None]
        cell: dict[str, Any] = {"mean": mean, "low": low, "high": high, "seeds": seeds}
        cell["groups"] = num_groups_of(found[0])
        if leaks := leaks_in(found):
            cell["leak"] = leaks
        summary.setdefault(task, {}).setdefault(modality, {})[source] = cell
    return summary


# -- as text ----------------------------------------------------------------------------------------------------------

MODALITY_ORDER = ("none", "touch", "vision", "both")


def percent(value: float) -> str:
    """A score in 0 .. 1 as text in percent, with one decimal. Every page, table, figure and card uses this."""
    return f"{100 * value:.1f}"


def with_interval(mean: float, low: float, high: float, leak: str = "") -> str:
    """A score and its 95 % interval, such as '57.6 [55.1, 60.2]', with LEAK if there is one (``evaluation.leaks``)."""
    return f"{percent(mean)} [{percent(low)}, {percent(high)}]{leak_mark(leak)}"


def resampled(group_by: str, num_seeds: int) -> str:
    """What the 95 % intervals of ``num_seeds`` runs cover."""
    if num_seeds > 1:
        return f"bootstrap over test {group_by}s and seeds"
    return f"bootstrap over test {group_by}s; one seed, so they leave out the variation between seeds"


def tested_on(task: dict[str, Any], group_by: str) -> str:
    """The test groups of one task's summary, such as '24 test instances'; one group allows no interval."""
    num = max(cell["groups"] for cells in task.values() for cell in cells.values())
    return f"{num} test {group_by}s" if num > 1 else f"1 test {group_by}, so no interval"


def columns_of(task: dict[str, Any]) -> list[str]:
    """The modalities of one task's summary in reading order, without "none" (majority and the like)."""
    return [m for m in MODALITY_ORDER if m in task and m != "none"]


def sources_of(task: dict[str, Any]) -> list[str]:
    """Methods in order of appearance, then controls from the strongest idea to the weakest."""
    last = ("imagenet", "untrained", "pixels", "border")
    found = list(dict.fromkeys(source for modality in task.values() for source in modality))
    fixed = list(task.get("none", {}))
    own = [s for s in found if s not in last and s not in fixed]
    return [*own, *(s for s in last if s in found), *sorted(fixed, key=lambda s: s == "majority")]


def cell_text(task: dict[str, Any], source: str, modality: str) -> str:
    """The score of one source, or '' if it has none. Controls without features appear in every column."""
    value = task.get(modality, {}).get(source) or task.get("none", {}).get(source)
    return with_interval(value["mean"], value["low"], value["high"], value.get("leak", "")) if value else ""
