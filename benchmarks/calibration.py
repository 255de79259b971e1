"""False positives of ``intervals.paired_difference`` at p < .05, and misses of ``intervals.interval``: accuracy, then R2.

Two simulated methods have the same expected accuracy, several seeds each, and test groups that differ in difficulty and,
if they are unequal, in size. With one seed there is no p, and an interval covers other groups for this seed. Settings
differ in how much seeds vary: a standard deviation of .012 or .03 of accuracy, where the difference between the methods
varies by .1 from group to group.

Of values, a share of the variance is between groups. Errors have a part that shrinks towards the mean (ridge), one that a
group's rows share, and one of each row; their scale differs between groups by a log-normal factor.

    python -m benchmarks.calibration [--trials 800] [--json FILE]
"""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from mvitac.evaluation.intervals import interval, paired_difference
from mvitac.evaluation.value_scores import SUMS, r_squared
from mvitac.system.files import write_json
from mvitac.system.provenance import provenance

GROUPS = (4, 8, 29, 106, 240)
SEEDS = (1, 2, 3)
ACCURACY = (0.6, 0.9)
SEED_SD = (0.012, 0.03)
GROUP_SD = 0.1
"""Standard deviation over groups of the difference between two methods."""

R2 = (0.3, 0.9)
BETWEEN = (0.1, 0.7)
"""Share of the values' variance that is between groups."""
SCALE_SD = (0.3, 0.6)
"""Standard deviation over groups of the logarithm of the errors' scale; .6: one group in twenty has 3.2 times the usual."""


def group_sizes(num: int, equal: bool, rng: np.random.Generator) -> np.ndarray:
    """Rows of each group: 9, or log-normal from about 2 to 60."""
    return np.full(num, 9) if equal else np.ceil(4 * np.exp(rng.normal(0, 1, num))).astype(int) + 1


def records(rates: np.ndarray, sizes: np.ndarray, offsets: np.ndarray, rng: np.random.Generator) -> list[dict]:
    """Draw one record per seed from the expected accuracies ``rates`` [G] of the groups, shifted by ``offsets`` [S]."""
    return [
        {
            "group_sizes": sizes.tolist(),
            "group_correct": rng.binomial(sizes, np.clip(rates + offset, 0, 1)).tolist(),
            "seed": seed,
        }
        for seed, offset in enumerate(offsets)
    ]


def rates_of_error(
    num_groups: int, equal: bool, num_seeds: int, accuracy: float, seed_sd: float, trials: int
) -> dict[str, float | None]:
    """Fraction of trials in which equal methods differ at p < .05, and in which the interval misses the truth.

    With one seed, the truth is the accuracy of this seed over all groups, and there are no false positives because there is
    no p.
    """
    rng = np.random.default_rng(2)
    usual = accuracy + (0.15**2 + GROUP_SD**2 / 2) ** 0.5 * ndtri((np.arange(1000) + 0.5) / 1000)
    differs = misses = 0
    for _ in range(trials):
        sizes = group_sizes(num_groups, equal, rng)
        base = rng.normal(accuracy, 0.15, num_groups)
        methods = []
        for _ in range(2):
            offsets = rng.normal(0, seed_sd, num_seeds)
            rates = base + rng.normal(0, GROUP_SD / 2**0.5, num_groups)
            methods.append((records(rates, sizes, offsets, rng), offsets))
        (ours, shift), (theirs, _) = methods
        p = paired_difference(ours, theirs)[3]
        differs += p is not None and p < 0.05
        truth = np.clip(usual + (shift[0] if num_seeds == 1 else 0.0), 0, 1).mean()
        _, low, high = interval(ours)
        misses += not low <= truth <= high
    return {"p < .05": differs / trials if num_seeds > 1 else None, "outside interval": misses / trials}


def value_records(
    y: np.ndarray, group: np.ndarray, errors: np.ndarray, factors: np.ndarray, rng: np.random.Generator
) -> list[dict]:
    """One record per seed of predictions of ``y`` [N], whose ``errors`` [N] seeds share in part, times ``factors`` [S]."""
    found = []
    for seed, factor in enumerate(factors):
        error = factor * errors[0] + factor * errors[1] * rng.normal(size=len(y))
        terms = (np.ones(len(y)), abs(error), error**2, y, y**2)
        sums = {name: [np.bincount(group, term).tolist()] for name, term in zip(SUMS, terms, strict=True)}
        r2 = float(r_squared({name: np.sum(each) for name, each in sums.items()}))
        found.append({"group_sums": sums, "r2": r2, "seed": seed})
    return found


def value_rates_of_error(
    num_groups: int, equal: bool, num_seeds: int, r2: float, between: float, scale_sd: float, trials: int
) -> dict[str, float | None]:
    """As ``rates_of_error``, of R2. Seeds differ by 3 % of the error."""
    rng, differs, misses = np.random.default_rng(2), 0, 0
    for _ in range(trials):
        sizes = group_sizes(num_groups, equal, rng)
        group, rows = np.repeat(np.arange(num_groups), sizes), int(sizes.sum())
        shapes = (num_groups, num_groups, rows)
        y = between**0.5 * rng.normal(size=num_groups)[group] + (1 - between) ** 0.5 * rng.normal(size=rows)
        common, methods = [rng.normal(size=each) for each in shapes], []
        for _ in range(2):
            scale, shared, own = (0.7 * a + 0.51**0.5 * rng.normal(size=len(a)) for a in common)
            scale = ((1 - r2) * r2) ** 0.5 * np.exp(scale_sd * scale - scale_sd**2)[group]
            errors = -(1 - r2) * y + scale * (0.3**0.5 * shared[group] + 0.448**0.5 * own), scale * 0.252**0.5
            factors = np.exp(rng.normal(0, 0.03, num_seeds) - 0.03**2)
            methods.append((value_records(y, group, errors, factors, rng), factors))
        (ours, factors), (theirs, _) = methods
        p = paired_difference(ours, theirs)[3]
        differs += p is not None and p < 0.05
        truth = 1 - (1 - r2) * (factors[0] ** 2 if num_seeds == 1 else 1)
        _, low, high = interval(ours)
        misses += not low <= truth <= high
    return {"p < .05": differs / trials if num_seeds > 1 else None, "outside interval": misses / trials}


def main() -> None:
    """Print one line per setting."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=800, help="pairs of methods per setting")
    parser.add_argument("--json", type=Path, help="also write the rates to this file")
    options = parser.parse_args()
    found: dict[str, list[dict[str, Any]]] = {"accuracy": [], "r2": []}
    kinds = (
        ("accuracy", rates_of_error, SEEDS, ("accuracy", "seed sd"), product(ACCURACY, SEED_SD)),
        ("r2", value_rates_of_error, (1, 3), ("r2", "between groups", "scale sd"), product(R2, BETWEEN, SCALE_SD)),
    )
    for kind, rates_of, seeds, names, settings in kinds:
        print(f"groups sizes   seeds {', '.join(names)} | p < .05 | outside interval")
        for setting, num_seeds, equal, num_groups in product(list(settings), seeds, (True, False), GROUPS):
            rates = rates_of(num_groups, equal, num_seeds, *setting, options.trials)
            sizes = "equal" if equal else "unequal"
            about = {"groups": num_groups, "sizes": sizes, "seeds": num_seeds, **dict(zip(names, setting, strict=True))}
            found[kind].append(about | rates)
            p = "   -   " if rates["p < .05"] is None else f"{rates['p < .05']:7.3f}"
            told = f"{num_groups:6} {sizes:7} {num_seeds:5} {', '.join(map(str, setting))}"
            print(f"{told} | {p} | {rates['outside interval']:.3f}", flush=True)
    if options.json:
        write_json(options.json, {"trials": options.trials, "rates": found, **provenance()})


if __name__ == "__main__":
    main()
