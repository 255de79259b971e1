"""Scores of predicted values: R2, mean absolute error and root mean squared error in the target's unit.

Like accuracy, R2 is computed from sums over each test group, so that intervals can leave groups out (``intervals``).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mvitac.data.spec import Target

SUMS = ("n", "error", "squared_error", "value", "squared_value")
"""What a record keeps of each test group and target: ``[T][G]`` sums over its measured rows."""
NUM_RANGES = 8
NUM_POINTS = 200


def score_values(y: np.ndarray, predicted: np.ndarray, groups: np.ndarray, targets: Sequence[Target]) -> dict[str, Any]:
    """Score predictions [N, T] against measured values ``y`` [N, T] in the units of ``targets``; NaN = not measured.

    ``groups`` [N] are group numbers, for intervals. Returns "r2" (mean over targets), "targets" (R2, MAE and RMSE of each,
    with "ranges": error by range of the true value), "group_sums" (``SUMS``), and "points": up to 200 pairs of true and
    predicted value per target, drawn at random.
    """
    num_groups = int(groups.max()) + 1
    sums: dict[str, list[list[float]]] = {name: [] for name in SUMS}
    scored, points = [], []
    drawn = np.sort(np.random.default_rng(0).permutation(len(y))[:NUM_POINTS])
    for t, target in enumerate(targets):
        have = ~np.isnan(y[:, t])
        true, error, group = y[have, t], predicted[have, t] - y[have, t], groups[have]
        for name, term in zip(SUMS, (np.ones(len(true)), abs(error), error**2, true, true**2), strict=True):
            sums[name].append(np.bincount(group, weights=term, minlength=num_groups).tolist())
        r2 = float(r_squared({name: np.array(sums[name][-1]).sum() for name in SUMS}))
        errors = {"r2": r2, "mae": float(abs(error).mean()), "rmse": float((error**2).mean() ** 0.5)}
        scored.append({"name": target.name, "unit": target.unit, **errors, "ranges": error_by_range(true, error)})
        points.append([[float(f"{v:.5g}") for v in (y[i, t], predicted[i, t])] for i in drawn[have[drawn]]])
    return _record(scored, int((~np.isnan(y)).any(1).sum()), sums, points)


def _record(targets: list[dict[str, Any]], num_test: int, sums: dict[str, Any], points: list[Any]) -> dict[str, Any]:
    r2 = float(np.mean([target["r2"] for target in targets]))
    return {"r2": r2, "targets": targets, "num_test": num_test, "group_sums": sums, "points": points}


def pool_values(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Pool the records of cross-validation folds, whose test groups differ, into the scores of all groups together."""
    num = len(parts[0]["targets"])
    sums = {name: [[x for part in parts for x in part["group_sums"][name][t]] for t in range(num)] for name in SUMS}
    points = [[pair for part in parts for pair in part["points"][t]] for t in range(num)]
    targets = []
    for t, target in enumerate(parts[0]["targets"]):
        total = {name: float(np.sum(sums[name][t])) for name in SUMS}
        true, guess = np.array(points[t], float).T
        mae, rmse = total["error"] / total["n"], (total["squared_error"] / total["n"]) ** 0.5
        errors = {"r2": float(r_squared(total)), "mae": mae, "rmse": rmse}
        named = {name: target[name] for name in ("name", "unit")}
        targets.append({**named, **errors, "ranges": error_by_range(true, guess - true)})
    return _record(targets, sum(part["num_test"] for part in parts), sums, points)


def one_target(record: dict[str, Any], t: int) -> dict[str, Any]:
    sums = {name: [found[t]] for name, found in record["group_sums"].items()}
    target = record["targets"][t]
    points = {"points": [record["points"][t]]} if "points" in record else {}
    return {**record, "r2": target["r2"], "targets": [target], "group_sums": sums, **points}


def r_squared(sums: dict[str, Any], of: dict[str, Any] | None = None) -> Any:
    """R2 from ``SUMS`` (numbers or arrays): 1 - squared error / squared deviation from the mean of the same rows.

    Of a part, the deviation counts as at least a millionth of that of all rows, ``of``: it may be none.
    """
    least = np.finfo(float).eps * sums["squared_value"] + 1e-130  # less is rounding
    least = least if of is None else np.maximum(least, 1e-6 * _spread(of))
    return 1 - sums["squared_error"] / np.maximum(_spread(sums), least)


def _spread(sums: dict[str, Any]) -> Any:
    return sums["squared_value"] - sums["value"] ** 2 / np.maximum(sums["n"], 1)


def error_by_range(true: np.ndarray, error: np.ndarray, num: int = NUM_RANGES) -> list[dict[str, float]]:
    """MAE, RMSE, bias and count in up to ``num`` ranges of the true value, each with as many rows."""
    edges = np.unique(np.quantile(true, np.linspace(0, 1, num + 1)))
    place = np.clip(np.searchsorted(edges, true, side="right") - 1, 0, max(0, len(edges) - 2))
    found = []
    for k in np.unique(place):
        own = error[place == k]
        ends = {"low": float(edges[k]), "high": float(edges[min(k + 1, len(edges) - 1)])}
        sizes = {"mae": float(abs(own).mean()), "rmse": float((own**2).mean() ** 0.5), "bias": float(own.mean())}
        found.append({**ends, **sizes, "n": len(own)})
    return found


def r2_without_each_group(record: dict[str, Any]) -> np.ndarray:
    """R2, mean over targets, of the rows outside group 0, 1, ...: [G]."""
    sums = {name: np.array(record["group_sums"][name], float) for name in SUMS}  # [T, G]
    whole = {name: each.sum(1, keepdims=True) for name, each in sums.items()}
    return r_squared({name: whole[name] - each for name, each in sums.items()}, whole).mean(0)
