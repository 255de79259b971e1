"""Force on unseen objects without training: pixels, simple columns and untrained trunks (docs/results/force.md).

    python examples/force.py DATA/wedge_force/manifest.csv

The data is that of github.com/GelSight-lab/EstimateModulus as a manifest: one row per video frame with columns touch, frame,
object, recording, force_n and width_m. Each object is tested once, by probes fitted on the other seven.
"""

from __future__ import annotations

import copy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mvitac.data.pack import Pack
from mvitac.datasets.folder import FolderConfig
from mvitac.evaluation.controls import borders, thumbnails
from mvitac.evaluation.features import pack_features
from mvitac.evaluation.intervals import interval
from mvitac.evaluation.probe import probe_features, split_rows
from mvitac.evaluation.score_text import percent, with_interval
from mvitac.evaluation.scores import pool
from mvitac.model import fresh
from mvitac.nn.encoders import Encoders
from mvitac.recipes import recipe


def left_out(pack: Pack, name: str, x: np.ndarray, kind: str = "linear") -> None:
    """Print R2 of a probe on ``x`` [rows, D], pooled over leaving out each object, and each object's own."""
    group, folds = pack.column("group").astype(str), []
    objects = np.unique(group).tolist()
    for i, tested in enumerate(objects):  # the next object chooses the regularisation
        split = np.select([group == tested, group == objects[(i + 1) % len(objects)]], ["test", "val"], "train")
        fold = copy.copy(pack)
        fold.table = pack.table.set_column(pack.table.schema.get_field_index("split"), "split", pa.array(split))
        task = fold.spec.values[0]
        rows = split_rows(fold, task)
        about = {"source": name, "seed": 0, "task": task.name, "modality": "touch", "probe": kind}
        folds.append([{**about, **probe_features(x[rows.all], fold, task, rows, kind, 0)[0]}])
    (whole,) = pool(folds)
    apart = " ".join(percent(fold[0]["r2"]) for fold in folds)
    print(
        f"{name:32} R2 {with_interval(*interval([whole]))}  MAE {whole['targets'][0]['mae']:.2f} N  ({apart})",
        flush=True,
    )


def energy(pack: Pack) -> np.ndarray:
    """Mean absolute difference to the first frame [rows, 1], of images stored minus that frame."""
    chunks = np.array_split(np.arange(pack.num), max(1, pack.num // 256))
    return np.concatenate([abs(pack.images["touch"][c].astype(float) - 128).mean((1, 2, 3)) for c in chunks])[:, None]


def main(manifest: Path) -> None:
    options = {
        "touch": ("touch",),
        "vision": "",
        "values": ("force_n:N",),
        "group": "object",
        "touch_group": "recording",
    }
    config = FolderConfig(path=manifest, only=("force_n>=-1",), controls=("width=width_m",), size=128, **options)
    for minus_first in (False, True):
        pack = replace(config, minus_first=minus_first).open()
        every = np.arange(pack.num)
        shown = "minus first frame" if minus_first else "raw"
        left_out(pack, f"pixels, {shown}", thumbnails(pack, "touch", every))
        left_out(pack, f"border, {shown}", borders(pack, "touch", every))
        for trunk in ("resnet10t", "resnet18"):
            run = recipe("quick", config, phased=False)
            augment = replace(run.augment, size=96, whole=128)
            run = replace(run, encoder=Encoders().changed(trunk=trunk, weights="scratch"), augment=augment)
            z = pack_features(fresh(run, pack.spec, pack.size), pack, "touch", every).numpy()
            left_out(pack, f"untrained {trunk}, {shown}", z)
    width, moved = pack.column("width_m").astype(float)[:, None], energy(pack)
    for kind in ("linear", "curve"):
        left_out(pack, f"width, {kind}", width, kind)
        left_out(pack, f"mean difference, {kind}", moved, kind)
    left_out(pack, "width and mean difference, curve", np.concatenate([width, moved], axis=1), "curve")


if __name__ == "__main__":
    main(Path(sys.argv[1])) if len(sys.argv) > 1 else sys.exit(__doc__)
