"""Windows of 1, 2, 4 and 8 frames without training: pixels, motion and untrained trunks (docs/results/time.md).

    python examples/real_manifests.py DATA MANIFESTS
    python examples/time_windows.py MANIFESTS slip_gsmini OUT.json

All windows score the same rows in the same folds of objects. OUT.json keeps every finished score, so that a stopped script
continues where it was.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from mvitac.data.pack import Pack
from mvitac.datasets.folder import FolderConfig
from mvitac.evaluation.controls import thumbnails
from mvitac.evaluation.features import pack_features
from mvitac.evaluation.probe import probe_features, split_rows
from mvitac.evaluation.score_text import percent, with_interval
from mvitac.evaluation.scores import interval, paired_difference, pool
from mvitac.model import fresh
from mvitac.recipes import recipe
from mvitac.system.files import read_json, write_json

SETS: dict[str, dict[str, Any]] = {
    "slip_gsmini": {
        "options": {"touch": ("left", "right"), "labels": ("slip",), "touch_group": "experiment"},
        "columns": {"recording length": ("n_frames",), "place in the recording": ("seq",)},
        "folds": 3,
    },
    "slip_grasp": {
        "options": {
            "touch": ("touch",),
            "labels": ("success",),
            "touch_group": "grasp",
            "label_only": ("seq<=4",),
        },
        "columns": {"width": ("width_mm",), "width in sweep": ("width_in_sweep",)},
        "folds": 6,
    },
    "physiclear": {
        "options": {"touch": ("touch",), "labels": ("material", "hardness"), "touch_group": "video"},
        "columns": {"contact energy": ("contact_energy",)},
        "folds": 0,
    },
}
WINDOWS, SEEDS = (1, 2, 4, 8), (0, 1, 2)


def folds_of(pack: Pack, num: int) -> Iterator[Pack]:
    """``pack`` with the split of each fold (columns fold1, ...), or as it is."""
    for k in range(num):
        fold = copy.copy(pack)
        column = pa.array(pack.column(f"fold{k + 1}").astype(str))
        fold.table = pack.table.set_column(pack.table.schema.get_field_index("split"), "split", column)
        yield fold
    if not num:
        yield pack


def scored(pack: Pack, num_folds: int, about: dict[str, Any], x: np.ndarray) -> list[dict[str, Any]]:
    """Records of a linear probe on features ``x`` [rows, D] for each task, pooled over the folds."""
    folds = []
    for fold in folds_of(pack, num_folds):
        records = []
        for task in fold.spec.tasks:
            rows = split_rows(fold, task)
            found = probe_features(x[rows.all], fold, task, rows, "linear", about["seed"] or 0)
            records.append({**about, "task": task.name, "modality": "touch", "probe": "linear", **found})
        folds.append(records)
    return pool(folds)


def motion(pack: Pack) -> np.ndarray:
    """Mean absolute difference of each sensor's frame to the next one and to the oldest one of its window: [rows, F S]."""
    found = []
    for rows in np.array_split(np.arange(pack.num), max(1, pack.num // 256)):
        images = pack.images["touch"][rows].astype(np.float32)
        num, side = images.shape[:2]
        frames = images.reshape(num, side, side, pack.spec.frames("touch"), -1, 3)
        steps = np.diff(frames, axis=3)
        steps = np.concatenate([steps, frames[:, :, :, :1] - frames[:, :, :, -1:]], axis=3)
        found.append(abs(steps).mean((1, 2, 5)).reshape(num, -1))
    return np.concatenate(found)


def untrained(config: FolderConfig, pack: Pack, temporal: str, seed: int) -> np.ndarray:
    """Features [rows, D] of recipe `demo`'s trunk before training."""
    run = recipe("demo", config, phased=False)
    run = replace(run, seed=seed, encoder=replace(run.encoder, temporal=temporal))
    return pack_features(fresh(run, pack.spec, pack.size), pack, "touch", np.arange(pack.num)).numpy()


def cases(config: FolderConfig, columns: dict[str, tuple[str, ...]]) -> Iterator[tuple[str, int | None, Any]]:
    """Name, seed and features of everything that is scored; features are computed when called."""
    plain = config.open(quiet=True)
    for name, of in columns.items():
        yield name, None, lambda of=of: (plain, np.stack([plain.column(c).astype(float) for c in of], axis=1))
    for minus_first in (False, True):
        for frames in WINDOWS:
            options = replace(config, num_frames=frames, minus_first=minus_first, order="seq")
            pack = options.open(quiet=True)
            shown = f"{frames}{', minus first' * minus_first}"
            every = np.arange(pack.num)
            yield f"pixels {shown}", None, lambda p=pack, e=every: (p, thumbnails(p, "touch", e))
            if frames > 1 and not minus_first:
                yield f"motion {shown}", None, lambda p=pack: (p, motion(p))
            for temporal in ("stack", "mean") if frames > 1 else ("stack",):
                for seed in SEEDS:
                    name = f"untrained {temporal if frames > 1 else 'single'} {shown}"
                    yield name, seed, lambda o=options, p=pack, t=temporal, s=seed: (p, untrained(o, p, t, s))


def show(kept: dict[str, list[dict[str, Any]]], task: str) -> None:
    """Print every source with its interval, and its difference to the untrained trunk on single frames."""
    by_source: dict[str, list[dict[str, Any]]] = {}
    for record in (record for records in kept.values() for record in records if record["task"] == task):
        by_source.setdefault(record["source"], []).append(record)
    base = by_source["untrained single 1"]
    print(f"\n{task}: accuracy %, AUROC, difference to the untrained trunk on single frames and its p")
    for source, records in by_source.items():
        mean, low, high, p = paired_difference(records, base)
        auroc = [r["auroc"] for r in records if r["auroc"] is not None]
        rank = f"{np.mean(auroc):.2f}" if auroc else ""
        chance = "" if p is None else f" p {p:.3f}"
        beside = "" if records is base else f"{100 * mean:+.1f} [{percent(low)}, {percent(high)}]{chance}"
        print(f"{source:34} {with_interval(*interval(records)):22} {rank:5} {beside}")


def main(manifests: Path, name: str, out: Path) -> None:
    about = SETS[name]
    shared: dict[str, Any] = {"path": manifests / f"{name}.csv", "vision": "", "group": "object", "size": 72}
    config = FolderConfig(**shared, **about["options"], title=name)
    kept: dict[str, list[dict[str, Any]]] = read_json(out, "scores") if out.exists() else {}
    for source, seed, features in cases(config, about["columns"]):
        if (key := f"{source} seed {seed}") not in kept:
            pack, x = features()
            kept[key] = scored(pack, about["folds"], {"source": source, "seed": seed}, x)
            write_json(out, kept)
            print(key, *(f"{r['task']} {percent(r['accuracy'])}" for r in kept[key]), flush=True)
    for task in dict.fromkeys(record["task"] for records in kept.values() for record in records):
        show(kept, task)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
