"""R2 of pose and shear by how deep the tap was, by a run's own head (docs/results/pose.md).

    python examples/pose_by_depth.py RUN/seed0 RUN/seed1 RUN/seed2

The runs are of a supervised row of examples/pose.toml. R2 of a range of depths is 1 - its squared errors over the squared
distances of its values to the mean of all test taps, so that ranges can be compared.
"""

from __future__ import annotations

import sys

import numpy as np
import torch

import mvitac
from mvitac.evaluation.features import features
from mvitac.evaluation.probe import split_rows

DEPTHS = ((0.0, 1.5), (1.5, 3.0), (3.0, 4.5), (4.5, np.inf))  # mm


def main(runs: list[str]) -> None:
    errors = []
    for run in runs:
        model = mvitac.load(run)
        pack = model.open_data()
        if (task := next((task for task in pack.spec.values if task.name == "same"), None)) is None:
            sys.exit(f"{run}: its data has no task same: give runs of a supervised row of examples/pose.toml")
        rows = split_rows(pack, task, "touch").test
        z = torch.from_numpy(features(model, pack, "touch", rows, for_heads=True))
        values = pack.values(task)[rows]
        errors.append(model.answer("same", {"touch": z}).numpy() - values)
    squared, absolute = np.mean(np.square(errors), axis=0), np.mean(np.abs(errors), axis=0)  # over runs
    print("R2, then mean absolute error, of", ", ".join(target.name for target in task.targets))
    for low, high in (*DEPTHS, (0.0, np.inf)):
        mine = (values[:, 0] >= low) & (values[:, 0] < high)
        r2 = 1 - squared[mine].sum(0) / np.square(values[mine] - values.mean(0)).sum(0)
        shown = " ".join(f"{x:6.2f}" for x in r2), " ".join(f"{x:5.2f}" for x in absolute[mine].mean(0))
        print(f"{low:.1f} to {high:.1f} mm, {mine.sum():4} taps  {shown[0]}   {shown[1]}")


if __name__ == "__main__":
    main(sys.argv[1:]) if len(sys.argv) > 1 else sys.exit(__doc__)
