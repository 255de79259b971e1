"""One encoder for simulation and all small real sets, against encoders of each set alone (docs/results/transfer.md).

    python examples/real_manifests.py DATA MANIFESTS
    python examples/one_encoder.py MANIFESTS OUT [--seeds 1] [--rows joint "simulation" ...] [--steps 5400]

Three folds of objects of every set. The encoder of a fold is pre-trained on simulated materials and on the training rows of
all sets in that fold, so it has seen no object that it is tested on. A stopped script continues where it was; OUT holds
the scores of one number of steps and one set of manifests.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from real_manifests import add_folds, read, write

import mvitac
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.datasets.folder import FolderConfig
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation.controls import thumbnails
from mvitac.evaluation.features import pack_features
from mvitac.evaluation.intervals import interval, paired_difference
from mvitac.evaluation.probe import probe_features, split_rows
from mvitac.evaluation.score_text import percent, with_interval
from mvitac.evaluation.scores import pool
from mvitac.model import Model, fresh
from mvitac.recipes import recipe
from mvitac.system.files import digest_file, read_json, write_json

FOLDS, SIDE = 3, 72
ROWS = ("simulation", "joint", "real", "in place", "joint then in place")  # methods of ``Encoders``
TARGETS = "pose=pose_z_mm:mm,pose_Rx_deg:deg,pose_Ry_deg:deg,shear_x_mm:mm,shear_y_mm:mm,shear_Rz_deg:deg"
LABELS = ("material", "hardness", "roughness", "bumpiness")
SETS: dict[
    str, dict[str, Any]
] = {  # "stratum" and "of" are not options: what spreads objects over folds, other sensors
    "physiclear": {"labels": LABELS, "group": "object", "touch_group": "video", "stratum": "material"},
    "slip_grasp": {"labels": ("success",), "group": "object", "touch_group": "grasp", "label_only": ("seq<=4",)},
    "vt60": {"labels": ("category",), "group": "object"},
    "slip_gsmini": {"labels": ("slip",), "group": "object", "touch_group": "experiment", "of": ("left", "right")},
    "wedge_force": {
        "values": ("force_n:N",),
        "group": "object",
        "touch_group": "recording",
        "only": ("force_n>=-1", "frame_kept=1"),
    },
    "tactip_shear": {"values": (TARGETS,), "only": ("sensor=franka",)},
}


def manifest_of(name: str, manifests: Path, out: Path) -> Path:
    """The set's manifest with columns fold1 ... fold3 of its own."""
    file = out / "manifests" / f"{name}.csv"
    if not file.exists():
        rows = read(manifests / f"{name}.csv")
        images = tuple(c for c in ("vision", "touch", "left", "right") if c in rows[0])
        rows = [{c: v for c, v in row.items() if not c.startswith("fold")} for row in rows]
        if "group" in SETS[name] and name not in ("vt60", "slip_gsmini"):
            add_folds(rows, FOLDS, by="object", stratum=SETS[name].get("stratum", "object"))
        elif "group" in SETS[name]:  # as they are in real.md
            for row, old in zip(rows, read(manifests / f"{name}.csv"), strict=True):
                row.update({f"fold{k}": old[f"fold{k}"] for k in range(1, FOLDS + 1)})
        if name == "physiclear":  # some of its objects are in slip_gsmini too: tested in the same fold
            other = {row["object"]: row for row in read(manifests / "slip_gsmini.csv")}
            for row in rows:
                same = other.get(row["object"], row)
                row.update({f"fold{k}": same[f"fold{k}"] for k in range(1, FOLDS + 1)})
        write(rows, file, manifests, images)
    return file


def packs_of(name: str, fold: int, manifests: Path, out: Path) -> list[Pack]:
    """The set in one fold; of two sensors one pack each. Touch images are those of one sensor in all sets."""
    options = {k: v for k, v in SETS[name].items() if k not in ("stratum", "of")}
    options["split"] = f"fold{fold}" if "group" in options else "split"
    packs = []
    for sensor in SETS[name].get("of", ("touch",)):
        folder = out / "packs" / f"fold{fold}" / (name if sensor == "touch" else f"{name}_{sensor}")
        if not (folder / "pack.json").exists():
            vision = "vision" if name in ("slip_grasp", "vt60") else ""
            config = FolderConfig(
                path=manifest_of(name, manifests, out), title=name, size=SIDE, touch=(sensor,), vision=vision, **options
            )
            build(config.source(), folder, size=SIDE)
        packs.append(PackConfig(path=folder).open(quiet=True))
    return packs


def pretrain(out: Path, *options: str) -> Path:
    """Pre-train unless ``out`` has a finished run."""
    if not (out / "model.safetensors").exists():
        resume = ["--resume"] if (out / "run.json").exists() else []
        command = [
            sys.executable,
            "-m",
            "mvitac",
            "pretrain",
            "--recipe",
            "quick",
            "--out",
            str(out),
            "--eval-every",
            "0",
        ]
        subprocess.run([*command, *options, *resume], check=True)
    return out


class Encoders:
    """The model of a row of the table by set, fold and seed."""

    def __init__(self, manifests: Path, out: Path, steps: int, own_steps: int) -> None:
        self.manifests, self.out, self.steps, self.own_steps = manifests, out, steps, own_steps

    def _packs(self, fold: int) -> list[Path]:
        return [pack.path for name in SETS for pack in packs_of(name, fold, self.manifests, self.out)]

    def _parts(self, fold: int, *more: str) -> list[str]:
        return ["--data", "mix", "--data.temperature", ".5", "--data.parts", *more, *map(str, self._packs(fold))]

    def _own(self, name: str, fold: int, seed: int, out: Path, *more: str) -> Path:
        packs = [str(pack.path) for pack in packs_of(name, fold, self.manifests, self.out)]
        data = (
            ["--data", "mix", "--data.parts", *packs] if len(packs) > 1 else ["--data", "pack", "--data.path", *packs]
        )
        steps = ["--steps", str(self.own_steps), "--seed", str(seed)]
        return pretrain(out, *data, *steps, *more)

    def _many(self, name: str, seed: int, *data: str) -> Path:
        return pretrain(self.out / "runs" / name, *data, "--steps", str(self.steps), "--seed", str(seed))

    def simulation(self, name: str, fold: int, seed: int) -> Path:
        return self._many(f"simulation-seed{seed}", seed, "--data", "materials")

    def joint(self, name: str, fold: int, seed: int) -> Path:
        parts = self._parts(fold, f"sim={self.out / 'packs' / 'sim'}")
        return self._many(f"joint-fold{fold}-seed{seed}", seed, *parts)

    def real(self, name: str, fold: int, seed: int) -> Path:
        return self._many(f"real-fold{fold}-seed{seed}", seed, *self._parts(fold))

    def in_place(self, name: str, fold: int, seed: int) -> Path:
        return self._own(name, fold, seed, self.out / "runs" / f"in-place-{name}-fold{fold}-seed{seed}")

    def joint_then_in_place(self, name: str, fold: int, seed: int) -> Path:
        start = self.joint(name, fold, seed)
        out = self.out / "runs" / f"joint-in-place-{name}-fold{fold}-seed{seed}"
        return self._own(name, fold, seed, out, "--init", str(start), "--optim.lr", "3e-4")


def untrained(pack: Pack, seed: int) -> Model:
    return fresh(replace(recipe("quick", PackConfig(path=pack.path)), seed=seed), pack.spec, pack.size)


def joined(packs: list[Pack], modality: str, features: Callable[[Pack, np.ndarray], np.ndarray]) -> np.ndarray:
    """Features [rows, D] of one set; those of two sensors are joined."""
    every = np.arange(packs[0].num)
    return np.concatenate([features(pack, every) for pack in (packs if modality == "touch" else packs[:1])], axis=1)


def records_of(source: str, seed: int | None, packs: list[Pack], xs: dict[str, np.ndarray]) -> Iterator[dict[str, Any]]:
    pack = packs[0]
    for task in pack.spec.all_tasks:
        rows = split_rows(pack, task)
        for modality in [*xs, *(["both"] if len(xs) > 1 else [])]:
            x = np.concatenate([xs[m] for m in ([modality] if modality != "both" else xs)], axis=1)[rows.all]
            about = {"source": source, "seed": seed, "task": task.name, "modality": modality, "probe": "linear"}
            yield {**about, **probe_features(x, pack, task, rows, "linear", seed or 0)[0]}


def score(source: str, seed: int | None, name: str, encoders: Encoders) -> list[dict[str, Any]]:
    """Scores of one row of the table on one set, pooled over its folds."""
    folds = []
    for fold in range(1, FOLDS + 1) if "group" in SETS[name] else (1,):
        packs = packs_of(name, fold, encoders.manifests, encoders.out)
        found: dict[str, np.ndarray] = {}
        for m in packs[0].spec.modalities:
            if source == "pixels":
                found[m] = joined(packs, m, lambda pack, rows, m=m: thumbnails(pack, m, rows))
                continue
            if source == "untrained":
                model = untrained(packs[0], seed or 0)
            else:
                model = mvitac.load(getattr(encoders, source.replace(" ", "_"))(name, fold, seed or 0))
            found[m] = joined(
                packs, m, lambda pack, rows, m=m, model=model: pack_features(model, pack, m, rows).numpy()
            )
        folds.append(list(records_of(source, seed, packs, found)))
    return pool(folds)


def lead(record: dict[str, Any]) -> float:
    return record["accuracy"] if "accuracy" in record else record["r2"]


def show(kept: dict[str, list[dict[str, Any]]]) -> None:
    """Print, for every set, task and modality, each row with its interval and its difference to the untrained trunk."""
    cells: dict[tuple[str, ...], dict[str, list[dict[str, Any]]]] = {}
    for key, records in kept.items():
        for r in records:
            cell = (key.split(":")[0], r["task"], r["modality"])
            cells.setdefault(cell, {}).setdefault(r["source"], []).append(r)
    for cell, by_source in cells.items():
        print("\n" + ", ".join(cell))
        for source, records in by_source.items():
            text = f"{source:22} {with_interval(*interval(records)):24}"
            if source != "untrained" and (base := by_source.get("untrained")):
                mean, low, high, p = paired_difference(records, base)
                text += f"{100 * mean:+.1f} [{percent(low)}, {percent(high)}]" + ("" if p is None else f" p {p:.3f}")
            print(text + f"  ({len(records)} seeds)", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("manifests", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=1, help="seeds of every row, from 0 on")
    parser.add_argument("--rows", nargs="+", default=["simulation", "joint", "in place"], choices=ROWS)
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=list(SETS))
    parser.add_argument("--steps", type=int, default=1350, help="steps of rows that are trained on several sets")
    parser.add_argument("--own-steps", type=int, default=300, help="steps of rows that are trained on one set")
    args = parser.parse_args()
    if not args.manifests.is_dir():
        parser.error(f"{args.manifests} is not there: write the manifests by examples/real_manifests.py")
    files = {file.stem: digest_file(file) for file in sorted(args.manifests.glob("*.csv"))}
    asked = {"steps": args.steps, "own_steps": args.own_steps, "manifests": files}
    if (known := args.out / "asked.json").exists() and read_json(known, "settings") != asked:
        parser.error(f"{args.out} holds runs of other steps or manifests ({known.name}): give another OUT")
    args.out.mkdir(parents=True, exist_ok=True)
    write_json(known, asked)
    if not (args.out / "packs" / "sim").exists():
        data = recipe("quick").data
        build(data.source(), args.out / "packs" / "sim", size=data.size)
    encoders, file = Encoders(args.manifests, args.out, args.steps, args.own_steps), args.out / "scores.json"
    kept: dict[str, list[dict[str, Any]]] = read_json(file, "scores") if file.exists() else {}
    shown: dict[str, list[dict[str, Any]]] = {}
    for seed in range(args.seeds):
        for source in ["untrained", *(["pixels"] if not seed else []), *args.rows]:
            for name in args.sets:
                if (key := f"{name}: {source} seed {seed}") not in kept:
                    kept[key] = score(source, None if source == "pixels" else seed, name, encoders)
                    write_json(file, kept)
                    print(key, *(f"{r['task']} {r['modality']} {percent(lead(r))}" for r in kept[key]), flush=True)
                shown[key] = kept[key]
    show(shown)


if __name__ == "__main__":
    main()
