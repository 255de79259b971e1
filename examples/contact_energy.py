"""Values of simulated touches by their contact energy alone, one number per image (docs/results/force.md).

    mvitac data pack --data materials --contact --out packs/sim
    python examples/contact_energy.py packs/sim

The energy is the mean absolute difference to the median image of the touch's sensor. Probes that score less than its curve
show nothing about touch images.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mvitac.datasets.pack import PackConfig
from mvitac.evaluation.intervals import interval
from mvitac.evaluation.probe import probe_features, split_rows
from mvitac.evaluation.score_text import with_interval


def main(path: Path) -> None:
    pack = PackConfig(path=path).open()
    energy = np.zeros((pack.num, 1))
    for sensor in range(len(pack.sensor_names)):
        rows = np.flatnonzero(pack.sensors == sensor)
        images = pack.images["touch"][rows].astype(np.float32)
        energy[rows, 0] = abs(images - np.median(images[::10], axis=0)).mean((1, 2, 3))
    for task in pack.spec.values:
        rows = split_rows(pack, task)
        for kind in ("linear", "curve"):
            about = {"source": "contact energy", "seed": 0, "task": task.name, "modality": "touch", "probe": kind}
            record = {**about, **probe_features(energy[rows.all], pack, task, rows, kind, 0)[0]}
            errors = ", ".join(f"{t['name']} {t['mae']:.2f} {t['unit']}" for t in record["targets"])
            print(f"{task.name:10} {kind:8} R2 {with_interval(*interval([record]))}  MAE {errors}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1])) if len(sys.argv) > 1 else sys.exit(__doc__)
