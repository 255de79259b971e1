"""Windows of 1, 2, 4 and 8 frames, without training (docs/results/time.md).

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
from mvitac.evaluation.intervals import interval, paired_difference
from mvitac.evaluation.probe import probe_features, split_rows
from mvitac.evaluation.score_text import percent, with_interval
from mvitac.evaluation.scores import pool
from mvitac.model import fresh
from mvitac.recipes import recipe
from mvitac.system.files import digest_file, read_json, write_json

SETS: dict[str, dict[str, Any]] = {
    "slip_gsmini": {
        "options": {"touch": ("left", "right"), "labels": ("slip",), "touch_group": "experiment"},
        "columns": {
            "recording length": ("n_frames",),
            "place in the recording": ("seq",),
            "frames since the start": ("frame",),
        },
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
    "physiclear": {  # the split of docs/results/real.md, by group
        "options": {"touch": ("touch",), "labels": ("material", "hardness", "roughness"), "touch_group": "video"},
        "columns": {"contact energy": ("contact_energy",)},
        "folds": 0,
    },
}
WINDOWS, SEEDS = (1, 2, 4, 8), (0, 1, 2)
FIXED = {"slip_gsmini": 41}
"""Set -> the longest distance of two stored frames, in frames of the video, and so the shortest stride."""


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
            found = probe_features(x[rows.all], fold, task, rows, "linear", about["seed"] or 0)[0]
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
    """Features [rows, D] of recipe `quick`'s trunk before training."""
    run = recipe("quick", config, phased=False)
    run = replace(run, seed=seed, encoder=run.encoder.changed(temporal=temporal))
    return pack_features(fresh(run, pack.spec, pack.size), pack, "touch", np.arange(pack.num)).numpy()


def cases(
    config: FolderConfig, columns: dict[str, tuple[str, ...]], fixed: int
) -> Iterator[tuple[str, int | None, Any]]:
    """Name, seed and features of everything that is scored; features are computed when called.

    ``fixed``: also score windows whose frames are so many frames of the video apart; 0: do not.
    """
    plain = config.open(quiet=True)
    for name, of in columns.items():
        yield name, None, lambda of=of: (plain, np.stack([plain.column(c).astype(float) for c in of], axis=1))
    shown = [(minus_first, frames, 0) for minus_first in (True, False) for frames in WINDOWS]
    shown += [(minus_first, frames, fixed) for minus_first in (True, False) for frames in (2, 4) if fixed]
    for minus_first, frames, apart in shown:
        order: dict[str, Any] = {"order": "frame", "stride": float(apart)} if apart else {"order": "seq"}
        options = replace(config, num_frames=frames, minus_first=minus_first, **order)
        pack = options.open(quiet=True)
        name = f"{frames}{f', {apart} frames apart' if apart else ''}{', minus first' * minus_first}"
        yield f"pixels {name}", None, lambda p=pack: (p, thumbnails(p, "touch", np.arange(p.num)))
        for seed in SEEDS:
            yield f"untrained {name}", seed, lambda o=options, p=pack, s=seed: (p, untrained(o, p, "stack", s))
    for frames in WINDOWS[1:]:
        options = replace(config, num_frames=frames, order="seq")
        pack = options.open(quiet=True)
        yield f"motion {frames}", None, lambda p=pack: (p, motion(p))
        for seed in SEEDS:
            yield f"untrained, mean {frames}", seed, lambda o=options, p=pack, s=seed: (p, untrained(o, p, "mean", s))


def show(kept: dict[str, list[dict[str, Any]]], task: str) -> None:
    """Print every source with its interval, and its difference to the untrained trunk on single frames."""
    by_source: dict[str, list[dict[str, Any]]] = {}
    for record in (record for records in kept.values() for record in records):
        if record["task"] == task:
            by_source.setdefault(record["source"], []).append(record)
    if not (base := by_source.get("untrained 1")):
        return
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
    of = f"{name} {digest_file(shared['path'])[:12]}: "
    if other := [key for key in kept if not key.startswith(of)]:
        sys.exit(f"{out} holds scores of another set or manifest ({other[0]}): give another file")

    def score(source: str, seed: int | None, features: Any) -> None:
        if (key := f"{of}{source} seed {seed}") in kept:
            return
        pack, x = features()
        kept[key] = scored(pack, about["folds"], {"source": source, "seed": seed}, x)
        write_json(out, kept)
        print(key, *(percent(r["accuracy"]) for r in kept[key]), flush=True)

    def print_all() -> None:
        for task in config.labels:
            print(f"\n{task}: accuracy %, AUROC, difference to the untrained trunk on single frames and its p")
            show(kept, task)

    for case in cases(config, about["columns"], FIXED.get(name, 0)):
        score(*case)
    print_all()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3])) if len(sys.argv) > 3 else sys.exit(__doc__)
