"""False positives of ``scores.paired_difference`` at p < .05, and misses of ``scores.interval``.

Two simulated methods have the same expected accuracy, several seeds each, and test groups that differ in difficulty and,
if they are unequal, in size. With one seed there is no p, and an interval covers other groups for this seed. Settings
differ in how much seeds vary: a standard deviation of .012 or .03 of accuracy, where the difference between the methods
varies by .1 from group to group.

    python -m benchmarks.calibration [--trials 800] [--json FILE]
"""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from mvitac.evaluation.scores import interval, paired_difference
from mvitac.system.files import write_json
from mvitac.system.provenance import provenance

GROUPS = (4, 8, 29, 106, 240)
SEEDS = (1, 2, 3)
ACCURACY = (0.6, 0.9)
SEED_SD = (0.012, 0.03)
GROUP_SD = 0.1
"""Standard deviation over groups of the difference between two methods."""


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


def main() -> None:
    """Print one line per setting."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=800, help="pairs of methods per setting")
    parser.add_argument("--json", type=Path, help="also write the rates to this file")
    options = parser.parse_args()
    print("groups sizes   seeds accuracy seed sd | p < .05 | outside interval")
    found: list[dict[str, Any]] = []
    for accuracy, num_seeds, equal, num_groups, seed_sd in product(ACCURACY, SEEDS, (True, False), GROUPS, SEED_SD):
        rates = rates_of_error(num_groups, equal, num_seeds, accuracy, seed_sd, options.trials)
        sizes = "equal" if equal else "unequal"
        setting = {"groups": num_groups, "sizes": sizes, "seeds": num_seeds, "accuracy": accuracy, "seed sd": seed_sd}
        found.append(setting | rates)
        p = "   -   " if rates["p < .05"] is None else f"{rates['p < .05']:7.3f}"
        print(
            f"{num_groups:6} {sizes:7} {num_seeds:5} {accuracy:8} {seed_sd:7.3f} | {p} | {rates['outside interval']:.3f}",
            flush=True,
        )
    if options.json:
        write_json(options.json, {"trials": options.trials, "rates": found, **provenance()})


if __name__ == "__main__":
    main()
