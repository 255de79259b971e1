"""False positives of ``scores.paired_difference`` at p < .05, and misses of ``scores.interval``.

Two simulated methods have the same expected accuracy, several seeds each, and test groups that differ in difficulty.
The error rates depend on whether seeds or groups vary more, so the standard errors of both are printed.

    python -m benchmarks.calibration [--trials 400] [--seeds 3]
"""

from __future__ import annotations

import argparse

import numpy as np

from mvitac.evaluation.scores import interval, paired_difference

SETTINGS = (
    # test groups, rows per group, standard deviation over groups of the difference between the two methods,
    # standard deviation over seeds of each method
    (240, 5, 0.1, 0.012),
    (240, 5, 0.1, 0.02),
    (240, 5, 0.1, 0.03),
    (60, 20, 0.1, 0.02),
    (29, 8, 0.1, 0.03),
    (6, 9, 0.1, 0.04),
    (100, 100, 0.07, 0.03),
)


def records(rates: np.ndarray, rows: int, seed_sd: float, seeds: int, rng: np.random.Generator) -> list[dict]:
    """Draw one record per seed. ``rates`` are the expected accuracies of the groups."""
    return [
        {
            "group_sizes": [rows] * len(rates),
            "group_correct": rng.binomial(rows, np.clip(rates + rng.normal(0, seed_sd), 0, 1)).tolist(),
            "seed": seed,
        }
        for seed in range(seeds)
    ]


def main() -> None:
    """Print one line per setting."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=400, help="pairs of methods per setting")
    parser.add_argument("--seeds", type=int, default=3, help="seeds per method")
    options = parser.parse_args()
    print("groups rows seed sd | standard error: seeds, groups (points) | p < .05 | outside interval")
    for groups, rows, group_sd, seed_sd in SETTINGS:
        rng = np.random.default_rng(2)
        differs = misses = 0
        errors = []
        for _ in range(options.trials):
            base = rng.normal(0.6, 0.15, groups)
            ours, theirs = (
                records(base + rng.normal(0, group_sd / 2**0.5, groups), rows, seed_sd, options.seeds, rng)
                for _ in "ab"
            )
            differs += paired_difference(ours, theirs)[3] < 0.05
            _, low, high = interval(ours)
            misses += not low <= 0.6 <= high
            gaps = np.array([r["group_correct"] for r in ours], float) - [r["group_correct"] for r in theirs]
            gaps /= rows
            errors.append([gaps.mean(axis).std(ddof=1) / gaps.shape[1 - axis] ** 0.5 for axis in (1, 0)])
        seed_error, group_error = 100 * np.median(errors, axis=0)
        print(
            f"{groups:6} {rows:4} {seed_sd:7.3f} | {seed_error:5.2f} {group_error:5.2f} |"
            f" {differs / options.trials:5.3f} | {misses / options.trials:5.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
