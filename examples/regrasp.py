"""Lift, or open and grasp again? A policy that looks and feels before it lifts, and what its success gains by touch.

    mvitac pretrain --data grasps --out runs/grasps
    python examples/regrasp.py runs/grasps [--seeds 5] [--candidates 4] [--json FILE]

One episode is one thing and a few candidate grasps of it, in an order that a seed draws. The policy closes its fingers on
the first ('during': closed, not lifted), predicts success, lifts if that is likelier than failure, and else opens and takes
the next; if none convinces, it goes back to the most promising. Its encoders are the run's, frozen; its head is a logistic
regression on the grasps of the training objects. Scored on objects that neither has seen. "Best of all" closes on every
candidate before it chooses. A choice by chance, an oracle, the mean imprint alone and encoders with random weights stand
beside it; the oracle is the most that any choice among these candidates can do.

Intervals resample test objects and seeds (orders of the candidates); they hold for this run's encoders and this head, not
for another pre-training.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

import mvitac
from mvitac.data.pack import Pack
from mvitac.deploy.policy import ObservationEncoder
from mvitac.evaluation.classifiers import fit_linear
from mvitac.evaluation.probe import ProbeSplit, split_rows
from mvitac.evaluation.scores import interval, paired_difference
from mvitac.model import Model, fresh
from mvitac.nn.encoders import SCRATCH
from mvitac.system.files import check_place, write_json

KEYS = {
    "vision": {"observation.images.camera": "vision"},
    "touch": {"observation.images.gel_left": "touch", "observation.images.gel_right": "touch"},
}
NEVER = float("inf")
"""A threshold no probability reaches: every candidate is tried, the most promising lifted."""


def decide(p: np.ndarray, threshold: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Which candidate is lifted and how many were tried, [E] each, given success probabilities ``p`` [E, K] in order."""
    sure = p >= threshold
    convinced = sure.any(1)
    lifted = np.where(convinced, sure.argmax(1), p.argmax(1))
    return lifted, np.where(convinced, lifted + 1, p.shape[1])


def episodes(objects: np.ndarray, candidates: int, seed: int) -> np.ndarray:
    """Positions [E, K] of grasps: each object's are shuffled and dealt out in hands of ``candidates``, none twice.

    ``objects`` [N] are the grasps' object numbers. ValueError if an object has too few grasps for one hand.
    """
    rng = np.random.default_rng(seed)
    hands = []
    for thing in np.unique(objects):
        own = rng.permutation(np.flatnonzero(objects == thing))
        if len(own) < candidates:
            raise ValueError(
                f"an object has {len(own)} grasps, {candidates} candidates asked: simulate more, or ask fewer"
            )
        hands.append(own[: len(own) // candidates * candidates].reshape(-1, candidates))
    return np.concatenate(hands)


def observe(pack: Pack, rows: np.ndarray) -> dict[str, torch.Tensor]:
    """The observation dict of pack rows, as a robot would hand it to its policy: uint8 images [B, 3, S, S]."""
    vision, gels = (torch.from_numpy(pack.images[m][rows]).permute(0, 3, 1, 2) for m in ("vision", "touch"))
    return dict(zip([*KEYS["vision"], *KEYS["touch"]], (vision, gels[:, :3], gels[:, 3:]), strict=True))


@torch.no_grad()
def encode(model: Model, pack: Pack, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Features [N, D] of the policy's encoder on "vision" and "touch"; what it gives on both is these side by side."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    encoders = {m: ObservationEncoder(model, keys).to(device).eval() for m, keys in KEYS.items()}
    chunks = np.array_split(rows, -(-len(rows) // 128))
    seen = [{k: x.to(device) for k, x in observe(pack, chunk).items()} for chunk in chunks]
    return {m: torch.cat([encoder(x).cpu() for x in seen]).numpy() for m, encoder in encoders.items()}


def predict(x: np.ndarray, y: np.ndarray, rows: ProbeSplit) -> np.ndarray:
    """Success probability [num_test] of the test rows, from ``x`` and ``y`` of all rows: train, val, test in this order."""
    val, test = len(rows.train), len(rows.train) + len(rows.val)
    head, _ = fit_linear(x[:val], y[:val], x[val:test], y[val:test])
    return head(x[test:])[:, 1]


def play(p: np.ndarray, y: np.ndarray, objects: np.ndarray, hands: np.ndarray, threshold: float) -> dict[str, Any]:
    """Episodes and held lifts by object, and the mean number of grasps: a record for ``evaluation.scores.interval``."""
    lifted, tried = decide(p[hands], threshold)
    thing, held = objects[hands[:, 0]], y[hands[np.arange(len(hands)), lifted]]
    num = int(objects.max()) + 1
    return {
        "group_sizes": np.bincount(thing, minlength=num).tolist(),
        "group_correct": np.bincount(thing, held, num).astype(int).tolist(),
        "tried": float(tried.mean()),
    }


def experiment(model: Model, pack: Pack, seeds: int, candidates: int) -> dict[str, Any]:
    """Success of every policy, JSON-ready: name -> "again" and "best" -> mean, low, high, tried; and the gain of touch."""
    task = next((t for t in pack.spec.tasks if t.name == "success"), None)
    if task is None or not task.only or pack.spec.vision_channels != 3 or pack.spec.touch_channels != 6:
        raise ValueError(f"{pack.path} holds no grasps with a camera and two gels: train a run with --data grasps")
    if seeds < 1 or candidates < 1:
        raise ValueError(f"seeds {seeds}, candidates {candidates}: give at least 1 of each")
    rows = split_rows(pack, task, "both")
    every = np.concatenate([rows.train, rows.val, rows.test])
    labels = pack.labels("success")
    if len(set(labels[rows.train])) < 2:
        raise ValueError(f"{pack.path}: all training grasps ended alike, nothing can be learned: simulate more")
    objects = np.unique(pack.column("group")[rows.test].astype(str), return_inverse=True)[1]
    hands = [episodes(objects, candidates, seed) for seed in range(seeds)]
    x = encode(model, pack, every)
    untrained = replace(model.run, encoder=replace(model.run.encoder, weights=SCRATCH))
    random = encode(fresh(untrained, model.spec, model.stored), pack, every)
    x |= {"both": np.hstack([x["vision"], x["touch"]]), "random weights, both": np.hstack(list(random.values()))}
    x |= {name: np.stack([pack.column(c)[every] for c in columns], 1) for name, columns in pack.spec.controls.items()}
    known = {name: predict(values, labels[every], rows) for name, values in x.items()}
    y = labels[rows.test]
    played: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for seed in range(seeds):
        chance = np.random.default_rng([seed, 1]).random(len(y))
        for name, p in {
            "first grasp": np.full(len(y), np.inf),
            "chance": chance,
            **known,
            "oracle": y.astype(float),
        }.items():
            both = played.setdefault(name, {"again": [], "best": []})
            for rule, threshold in (("again", 0.5), ("best", NEVER)):
                both[rule].append({"seed": seed, **play(p, y, objects, hands[seed], threshold)})
    results = {name: {rule: _summary(found) for rule, found in both.items()} for name, both in played.items()}
    gains = {
        f"{ours} - {theirs}": dict(
            zip(
                ("mean", "low", "high", "p"),
                paired_difference(played[ours]["again"], played[theirs]["again"]),
                strict=True,
            )
        )
        for ours, theirs in (
            ("both", "vision"),
            ("both", "touch"),
            ("both", "random weights, both"),
            ("both", "first grasp"),
        )
    }
    facts = {
        "seeds": seeds,
        "candidates": candidates,
        "objects": int(objects.max()) + 1,
        "episodes": sum(played["both"]["again"][0]["group_sizes"]),
        "train_grasps": len(rows.train) + len(rows.val),
        "pack": pack.digest,
        "weights": model.weights_digest(),
    }
    return {**facts, "success": results, "gain": gains}


def _summary(records: list[dict[str, Any]]) -> dict[str, float]:
    mean, low, high = interval(records)
    return {"mean": mean, "low": low, "high": high, "tried": float(np.mean([r["tried"] for r in records]))}


def show(found: dict[str, Any], console: Console) -> None:
    title = "{objects} unseen objects, {episodes} episodes a seed, {seeds} seeds, {candidates} candidates".format(
        **found
    )
    table = Table(title=f"{title}: lifts that held, %", title_justify="left")
    for column in ("decides by", "re-grasp", "95 %", "tried", "best of all", "95 %"):
        table.add_column(column, justify="left" if column == "decides by" else "right")
    for name, rules in found["success"].items():
        again, best = rules["again"], rules["best"]
        cells = [f"{100 * again['mean']:.1f}", _range(again), f"{again['tried']:.2f}", f"{100 * best['mean']:.1f}"]
        table.add_row(name, *cells, _range(best))
    console.print(table)
    for name, gain in found["gain"].items():
        console.print(
            f"re-grasp, {name}: {100 * gain['mean']:+.1f} points {_range(gain)}, p {gain['p']:.3f}", highlight=False
        )


def _range(cell: dict[str, float]) -> str:
    return rf"\[{100 * cell['low']:.1f}, {100 * cell['high']:.1f}]"


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", help="folder of a run trained on grasps")
    parser.add_argument("--seeds", type=int, default=5, help="orders of the candidates to draw")
    parser.add_argument("--candidates", type=int, default=4, help="grasps that an episode may try")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args(argv)
    try:
        if options.json:
            check_place(options.json)
        model = mvitac.load(options.run)
        found = experiment(model, model.run.data.open(), options.seeds, options.candidates)
    except ValueError as error:
        parser.error(str(error))
    show(found, Console())
    if options.json:
        write_json(options.json, found)


if __name__ == "__main__":
    main()
