"""Confidence intervals of scores, and differences between methods.

Every interval is over test groups and, if there are several, seeds: groups are independent, their rows near-copies.

Both levels' variances are added, and Student's t has the degrees of freedom of the sum (Satterthwaite 1946). This is too
narrow when a few seeds happen to agree, so an interval is never narrower than that over seeds alone. Intervals then hold
their level with few groups, few seeds and groups of unequal size (benchmarks/calibration.py), which a bootstrap does not.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import expit, logit, stdtr, stdtrit

from mvitac.evaluation.value_scores import r2_without_each_group

MIN_GROUPS = 10  # with fewer groups, an interval over them says too little for a verdict


def interval(records: Sequence[dict[str, Any]]) -> tuple[float, float, float]:
    """Mean accuracy (R2 of values) of ``records``, and the lower and upper end of its 95 % interval.

    There is one record per seed, all on the same test groups. With several it covers other groups and other seeds; with
    one, other groups for this one trained model. With a single group the interval is that of all possible scores.

    The interval of an accuracy is computed on the logit scale, which keeps it within 0 and 1, around
    (correct + 1) / (rows + 2). Its variance is at least that of independent rows: a few groups that are all right say
    little. That of R2 is computed on the scale of log(1 - R2), and is longer below than above R2, because the groups with
    the largest errors may not be among those tested. Its lower end is -inf if it is below 1 - 1000 (1 - R2).
    """
    sizes, correct = _counts(records)
    rows = sizes.sum()
    mean = float(correct.sum(1).mean() / rows)
    if len(sizes) < 2:
        return mean, least_of(records[0]), 1.0
    groups, seeds = _over_groups(correct.mean(0), sizes), _over_seeds(correct, sizes)
    if "group_sums" in records[0]:
        error = max(1 - mean, 1e-12)
        margin = _margin(_heavy_tailed(groups, correct.mean(0), sizes), seeds) / error
        below = margin + _skewness_term(groups, correct.mean(0), sizes) / error
        low = 1 - error * math.exp(below) if below < math.log(1000) else -math.inf
        return mean, low, 1 - error * math.exp(-margin)
    centre = (mean * rows + 1) / (rows + 2)
    per_point = centre * (1 - centre)  # derivative of a probability by its logit
    margin = _margin(_Variance(max(groups.value, per_point / rows), groups.freedom), seeds)
    low, high = expit(logit(centre) + np.array([-1, 1]) * margin / per_point)
    return mean, min(mean, float(low)), max(mean, float(high))


def least_of(record: dict[str, Any]) -> float:
    """The lowest possible score of the record's kind."""
    return -math.inf if "group_sums" in record else 0.0


def paired_difference(
    ours: Sequence[dict[str, Any]], theirs: Sequence[dict[str, Any]]
) -> tuple[float, float, float, float | None]:
    """Difference in accuracy (R2 of values) between two methods on the same test groups, ``ours`` - ``theirs``.

    There is one record per seed. Groups are paired. Equal seeds of both methods are, too: they share batches and views.

    Returns the mean difference, lower and upper end of its 95 % interval, and the two-sided p, at least ``least_p``. p is
    None if either method was trained with one seed: the variation between seeds is then unknown, and the interval leaves
    it out. With a single group p is 1.
    """
    ours, theirs = (sorted(r, key=lambda one: -1 if one.get("seed") is None else one["seed"]) for r in (ours, theirs))
    assert len({str(_sizes(r).tolist()) for r in (*ours, *theirs)}) == 1, "scored on different test rows"
    (sizes, a), (_, b) = _counts(ours), _counts(theirs)
    mean = float((a.sum(1).mean() - b.sum(1).mean()) / sizes.sum())
    most = 1.0 - least_of(ours[0])
    one_seed = any(len(records) == 1 and records[0]["seed"] is not None for records in (ours, theirs))
    if len(sizes) < 2:
        return mean, -most, most, None if one_seed else 1.0
    paired = [r["seed"] for r in ours] == [r["seed"] for r in theirs]
    seeds = _over_seeds(a - b, sizes) if paired else _over_seeds(a, sizes) + _over_seeds(b, sizes)
    margin, p = _margin_and_p(mean, _over_groups(a.mean(0) - b.mean(0), sizes), seeds, len(sizes))
    margin = margin if margin < 1000 else math.inf  # of R2, where the values of all groups but one are equal
    return mean, max(-most, mean - margin), min(most, mean + margin), None if one_seed else p


def mean_interval(values: np.ndarray, *, level: bool = False) -> tuple[float, float, float, float]:
    """Mean of ``values`` [seeds, groups], its 95 % interval over both (endless for one group), the p of a mean of 0.

    They are differences, or a ``level``, whose interval need not hold 0 where p is always above .05.
    """
    if values.shape[1] < 2:
        return float(values.mean()), -math.inf, math.inf, 1.0
    sizes, mean = np.ones(values.shape[1]), float(values.mean())
    groups, seeds = _over_groups(values.mean(0), sizes), _over_seeds(values, sizes)
    margin, p = _margin_and_p(mean, groups, seeds, len(sizes))
    margin = _margin(groups, seeds) if level else margin
    return mean, mean - margin, mean + margin, p


def least_p(num_groups: int) -> float:
    """Smallest p of ``paired_difference``: that of a sign test over the groups."""
    return 2.0 ** (1 - num_groups)


def num_groups_of(record: dict[str, Any]) -> int:
    return int(np.count_nonzero(_sizes(record)))


def _sizes(record: dict[str, Any]) -> np.ndarray:
    """Rows of each group, [G]; of values, the measured ones of all targets."""
    return np.array(record["group_sums"]["n"]).sum(0) if "group_sums" in record else np.array(record["group_sizes"])


def _counts(records: Sequence[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Rows [G] and correct rows [S, G] of the groups that have any."""
    sizes = _sizes(records[0]).astype(float)
    there = sizes > 0
    correct = [_shares(record, sizes) if "group_sums" in record else record["group_correct"] for record in records]
    return sizes[there], np.array(correct, float)[:, there]


def _shares(record: dict[str, Any], sizes: np.ndarray) -> np.ndarray:
    """Each group's share in R2, times the number of rows: [G], with sum R2 * rows. It comes from R2 without the group
    (the jackknife). For an accuracy the same formula gives the correct rows."""
    if np.count_nonzero(sizes) < 2:
        return record["r2"] * sizes
    shares = sizes * record["r2"] + (sizes.sum() - sizes) * (record["r2"] - r2_without_each_group(record))
    return shares - sizes * (shares.sum() / sizes.sum() - record["r2"])


@dataclass(frozen=True)
class _Variance:
    """An estimated variance of a mean, and its degrees of freedom."""

    value: float
    freedom: float

    def __add__(self, other: "_Variance") -> "_Variance":
        """The variance of a sum of independent terms, with Satterthwaite's degrees of freedom."""
        total, parts = self.value + other.value, [part for part in (self, other) if part.value]
        return _Variance(total, total**2 / sum(p.value**2 / p.freedom for p in parts) if parts else self.freedom)


def _over_groups(correct: np.ndarray, sizes: np.ndarray) -> _Variance:
    """Variance of sum(correct) / sum(sizes) over groups, from [G] and [G]. Unbiased, with Bell and McCaffrey's (2002)
    degrees of freedom, if groups vary alike: G - 1, fewer if sizes differ."""
    w = sizes / sizes.sum()
    squares = float(w @ w)
    share = w * w / np.maximum(1 - 2 * w + squares, 1e-12)
    residuals = correct / sizes - correct.sum() / sizes.sum()
    # freedom = trace(B)^2 / trace(B^2) of the quadratic form B of the rates; B is not built, as there may be many groups
    zero, one, two = (float((share * w**power).sum()) for power in range(3))
    off = (squares * zero) ** 2 + 2 * zero * two - 4 * squares * zero * one + 2 * one**2
    trace = off + float((share**2 * (1 + 2 * squares - 4 * w)).sum())
    known = trace > squares**2 / len(sizes)  # else rounding is all that is left of it, as one group is nearly all
    return _Variance(float(share @ residuals**2), max(1.0, squares**2 / trace) if known else 1.0)


def _skewness_term(variance: _Variance, shares: np.ndarray, sizes: np.ndarray) -> float:
    """What is added to the interval's lower half, as squared errors have a long upper tail.

    It is the term of Johnson's (1978) modified t at the normal 97.5 % point z = 1.96, where (1 + 2 z^2) / 6 = 1.45. The
    skewness is estimated, and at least that of the square of a normal error, the root of 8.
    """
    w, num = sizes / sizes.sum(), len(sizes)
    deviations = sizes * shares.sum() / sizes.sum() - shares
    cube = float((deviations**2).mean()) ** 1.5
    skewness = float((deviations**3).mean()) / cube * (num * (num - 1)) ** 0.5 / max(num - 2, 1) if cube else 0.0
    return 1.45 * max(8**0.5, skewness) * (variance.value * float(w @ w)) ** 0.5


def _heavy_tailed(variance: _Variance, shares: np.ndarray, sizes: np.ndarray) -> _Variance:
    """``variance`` over groups with fewer degrees of freedom, as squared errors have heavier tails than counts: a sample
    variance varies with the excess kurtosis k as 1 + k (G - 1) / 2G. k is estimated, and at least 1."""
    deviations = shares - sizes * shares.sum() / sizes.sum()
    square = float((deviations**2).mean())
    excess = float((deviations**4).mean()) / square**2 - 3 if square else 0.0
    return _Variance(variance.value, 1 / (1 / variance.freedom + max(1.0, excess) / (2 * len(sizes))))


def _over_seeds(correct: np.ndarray, sizes: np.ndarray) -> _Variance:
    """Variance of the mean accuracy over seeds, from [S, G] and [G]; 0 for one seed."""
    means = correct.sum(1) / sizes.sum()
    return _Variance(float(means.var(ddof=1)) / len(means), len(means) - 1) if len(means) > 1 else _Variance(0.0, 1)


def _margin(groups: _Variance, seeds: _Variance) -> float:
    return max(float(stdtrit(v.freedom, 0.975)) * v.value**0.5 for v in (groups + seeds, seeds))


def _margin_and_p(mean: float, groups: _Variance, seeds: _Variance, num_groups: int) -> tuple[float, float]:
    """``_margin`` and p of a mean that 0 is compared with: where p is always above .05, the interval has 0 in it. Two
    groups of equal gaps would otherwise give an interval of no width."""
    p = max(_p(mean, groups + seeds), _p(mean, seeds) if seeds.value else 0, least_p(num_groups))
    return max(_margin(groups, seeds), abs(mean) if least_p(num_groups) > 0.05 else 0), p


def _p(mean: float, variance: _Variance) -> float:
    if not variance.value:
        return float(mean == 0)
    return 2 * float(stdtr(variance.freedom, -abs(mean) / variance.value**0.5))
