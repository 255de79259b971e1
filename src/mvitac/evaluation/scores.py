"""Scores of predictions: of one probe, pooled over folds, and summarised over seeds.

A record is one probe of one source on one task. ``intervals`` says how sure scores are.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from sklearn.metrics import confusion_matrix, precision_recall_fscore_support, roc_auc_score

from mvitac.evaluation.intervals import interval, num_groups_of
from mvitac.evaluation.value_scores import one_target, pool_values


def score(y: np.ndarray, probabilities: np.ndarray, groups: np.ndarray, num_classes: int) -> dict[str, Any]:
    """Score class probabilities [N, K] against labels ``y`` [N]; ``groups`` [N] are group numbers, for intervals.

    Returns accuracy, balanced accuracy, macro F1, AUROC (two classes only), the confusion matrix, the number of groups
    with rows of each class, and counts per group.
    """
    guess = probabilities.argmax(1)
    present = np.unique(y)
    no_division: dict[str, Any] = {"zero_division": 0}  # a class that is never predicted has precision 0
    _, recall, f1, _ = precision_recall_fscore_support(y, guess, labels=present, average="macro", **no_division)
    auroc = float(roc_auc_score(y, probabilities[:, 1])) if num_classes == len(present) == 2 else None
    whole = {"accuracy": float((guess == y).mean()), "balanced_accuracy": float(recall), "macro_f1": float(f1)}
    whole |= {"auroc": auroc, "confusion": confusion_matrix(y, guess, labels=range(num_classes)).tolist()}
    correct = np.bincount(groups, weights=guess == y).astype(int).tolist()
    by_group = {"num_test": len(y), "group_sizes": np.bincount(groups).tolist(), "group_correct": correct}
    return {**whole, "class_groups": [len(np.unique(groups[y == k])) for k in range(num_classes)], **by_group}


def pool(folds: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Pool the records of cross-validation folds, whose test groups differ, into records of all groups.

    Keeps only what every fold has scored. Scores are over all rows; AUROC is the mean over the folds that have it, since
    the probabilities of the folds' probes do not compare.
    """
    keys = ("source", "seed", "task", "modality", "probe")
    pooled = []
    for parts in grouped([record for records in folds for record in records], keys):
        if len(parts) < len(folds):
            continue
        whole = pool_values(parts) if "group_sums" in parts[0] else _pool_classes(parts)
        if leaks := leaks_in(parts):
            whole["leak"] = leaks
        if clipped := most_clipped(parts):
            whole["clipped"] = clipped
        pooled.append({**{key: parts[0][key] for key in keys}, **whole})
    return pooled


def grouped(records: Sequence[dict[str, Any]], keys: Sequence[str]) -> list[list[dict[str, Any]]]:
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for record in records:
        found.setdefault(tuple(record[key] for key in keys), []).append(record)
    return list(found.values())


def _pool_classes(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    sizes, correct = ([n for part in parts for n in part[key]] for key in ("group_sizes", "group_correct"))
    areas = [part["auroc"] for part in parts if part["auroc"] is not None]
    sums = {key: np.sum([part[key] for part in parts], axis=0) for key in ("confusion", "class_groups")}
    table, there = sums["confusion"], sums["confusion"].any(1)
    right = table.diagonal()[there]
    return {
        "balanced_accuracy": float((right / table.sum(1)[there]).mean()),
        "macro_f1": float((2 * right / (table.sum(1) + table.sum(0))[there]).mean()),
        "auroc": float(np.mean(areas)) if areas else None,
        "accuracy": sum(correct) / sum(sizes),
        **{key: value.tolist() for key, value in sums.items()},
        "num_test": sum(part["num_test"] for part in parts),
        "group_sizes": sizes,
        "group_correct": correct,
    }


def pool_retrieval(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Pool the retrieval records of folds into one for each source, seed and direction: means over all queries."""
    pooled = []
    for parts in grouped(records, ("source", "seed", "direction")):
        weights = [sum(part["group_sizes"]) for part in parts]
        rates = {k: float(np.average([p[k] for p in parts], weights=weights)) for k in parts[0] if "R@" in k}
        lists = {k: [n for part in parts for n in part[k]] for k in ("group_sizes", "group_correct")}
        whole = {**rates, **lists, "num_groups": len(lists["group_sizes"]), "leak": leaks_in(parts)}
        pooled.append({**parts[0], **whole})
    return pooled


def by_cell(records: Sequence[dict[str, Any]], probe: str) -> dict[tuple[str, str, str], list[dict[str, Any]]]:
    """Records of ``probe`` by task, modality and source.

    A source without that probe on a task (majority, pixels, the paper's probe of values) keeps its first one.
    """
    kept = {(record["source"], record["task"]): probe for record in records if record["probe"] == probe}
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for record in records:
        if record["probe"] == kept.setdefault((record["source"], record["task"]), record["probe"]):
            found.setdefault((record["task"], record["modality"], record["source"]), []).append(record)
    return found


def each_score(record: dict[str, Any]) -> list[float]:
    """The accuracy of a record, or the R2 of each target."""
    return [target["r2"] for target in record["targets"]] if "targets" in record else [record["accuracy"]]


def most_clipped(records: Sequence[dict[str, Any]]) -> list[int]:
    """The largest number of features that ridge clipped in test rows, and of how many; [] of records without ridge."""
    return max((record["clipped"] for record in records if "clipped" in record), default=[])


def leaks_in(records: Sequence[dict[str, Any]]) -> str:
    """The leaks of records (``evaluation.leaks``), without repetition; controls have none."""
    return "; ".join(dict.fromkeys(record["leak"] for record in records if record.get("leak")))


def summarise(records: Sequence[dict[str, Any]], probe: str = "linear") -> dict[str, Any]:
    """Scores as task -> modality -> method or control -> mean, low, high, seeds, number of test groups (``by_cell``).

    Where test classes are uneven (``is_uneven``), "balanced" is the balanced accuracy. Of values, the score is R2, and
    "targets" has the scores of each target (``targets_of``). With one test group R2 has no lower end: ``low`` is None, as
    JSON has no infinity. "clipped" is ``most_clipped`` of ridge regression.
    """
    summary: dict[str, Any] = {}
    for (task, modality, source), found in by_cell(records, probe).items():
        mean, low, high = interval(found)
        seeds = [record["seed"] for record in found if record["seed"] is not None]
        cell: dict[str, Any] = {"mean": mean, "low": low if math.isfinite(low) else None, "high": high}
        cell |= {"seeds": seeds, "groups": num_groups_of(found[0])}
        if "targets" in found[0]:
            cell["targets"] = targets_of(found)
        if is_uneven(found[0]):
            cell["balanced"] = float(np.mean([record["balanced_accuracy"] for record in found]))
        if clipped := most_clipped(found):
            cell["clipped"] = clipped
        if leaks := leaks_in(found):
            cell["leak"] = leaks
        summary.setdefault(task, {}).setdefault(modality, {})[source] = cell
    return summary


def is_uneven(record: dict[str, Any]) -> bool:
    """Whether the most frequent class of the test rows has more than 1.25 times its even share."""
    if "confusion" not in record:
        return False
    rows = np.sum(record["confusion"], axis=1)
    return bool(rows.max() > 1.25 * rows[rows > 0].mean())


def per_class(records: Sequence[dict[str, Any]], classes: Mapping[str, Sequence[str]], probe: str) -> dict[str, Any]:
    """Precision and recall of each class as task -> modality -> a list of ``classes``; over seeds, from the summed counts.

    Each has its name, "rows" and "groups" of test, and "scores": source -> [precision, recall]. Precision is None where a
    source never says the class, recall where no test row has it.
    """
    found: dict[str, Any] = {}
    for (task, modality, source), each in by_cell(records, probe).items():
        if "confusion" not in each[0]:
            continue
        counts = np.sum([record["confusion"] for record in each], axis=0)
        about = zip(classes[task], np.sum(each[0]["confusion"], axis=1).tolist(), each[0]["class_groups"], strict=True)
        new = [{"class": name, "rows": rows, "groups": groups, "scores": {}} for name, rows, groups in about]
        right, said, true = counts.diagonal(), counts.sum(0), counts.sum(1)
        for k, one in enumerate(found.setdefault(task, {}).setdefault(modality, new)):
            one["scores"][source] = [float(right[k] / n) if n else None for n in (said[k], true[k])]
    return found


def summarise_again(records: Sequence[dict[str, Any]], probe: str) -> dict[str, Any]:
    """``summarise`` by a further probe, of the tasks that have it. "own", a head trained with its encoders, stands alone."""
    tasks = {record["task"] for record in records if record["probe"] == probe}
    kept = (r for r in records if probe != "own" or r["probe"] == probe)
    return summarise([record for record in kept if record["task"] in tasks], probe)


def targets_of(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Scores of each target over runs: name, unit, mean, low and high of R2, and MAE and RMSE in the unit."""
    found = []
    for t, target in enumerate(records[0]["targets"]):
        mean, low, high = interval([one_target(record, t) for record in records])
        errors = {key: float(np.mean([record["targets"][t][key] for record in records])) for key in ("mae", "rmse")}
        about = {"name": target["name"], "unit": target["unit"]}
        found.append({**about, "mean": mean, "low": low if math.isfinite(low) else None, "high": high, **errors})
    return found
