"""Re-grasping with touch: a policy that predicts the success of a grasp before it lifts, and how much touch helps it.

    mvitac pretrain --data grasps --out runs/grasps
    python examples/regrasp.py runs/grasps [--seeds 5] [--candidates 4] [--json FILE]

An episode is one object and a few candidate grasps in random order. The policy closes the fingers on the first
candidate (phase 'during': closed, not lifted) and predicts the probability of success. If it is at least .5, the policy
lifts. If not, it opens and tries the next candidate. If no candidate reaches .5, it lifts the one with the highest
probability. "Best of all" tries every candidate before it chooses.

The encoders are those of the run, frozen. The head is a logistic regression, trained on the grasps of the training
objects. Scores are on test objects, which neither encoders nor head have seen. For comparison: a random choice, an
oracle (the upper limit for these candidates), the mean imprint alone, and encoders with random weights.

Confidence intervals resample test objects and seeds (orders of the candidates). They are valid for this run's encoders
and this head, not for another pre-training.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tabulate import tabulate

import mvitac
from mvitac.data.pack import Pack
from mvitac.deploy.policy import ObservationEncoder
from mvitac.evaluation.classifiers import fit_linear
from mvitac.evaluation.intervals import interval, paired_difference
from mvitac.evaluation.probe import ProbeSplit, split_rows
from mvitac.model import Model, fresh
from mvitac.nn.encoders import SCRATCH
from mvitac.system.files import check_place, write_json

KEYS = {
    "vision": {"observation.images.camera": "vision"},
    "touch": {"observation.images.gel_left": "touch", "observation.images.gel_right": "touch"},
}
NEVER = float("inf")
"""A threshold that no probability reaches: all candidates are tried, and the best is lifted."""


def decide(p: np.ndarray, threshold: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the lifted candidate and the number of tried candidates, [E] each.

    ``p`` [E, K] are the success probabilities of the candidates, in the order in which they are tried.
    """
    sure = p >= threshold
    convinced = sure.any(1)
    lifted = np.where(convinced, sure.argmax(1), p.argmax(1))
    return lifted, np.where(convinced, lifted + 1, p.shape[1])


def episodes(objects: np.ndarray, candidates: int, seed: int) -> np.ndarray:
    """Divide the grasps of each object randomly into episodes of K = ``candidates`` grasps. No grasp is used twice.

    Args:
        objects: Object number of each grasp, [N].
        candidates: Grasps per episode.
        seed: Seed of the order.

    Returns:
        Indices of the grasps, [E, K].

    Raises:
        ValueError: An object has fewer than ``candidates`` grasps.
    """
    rng = np.random.default_rng(seed)
    hands = []
    for thing in np.unique(objects):
        own = rng.permutation(np.flatnonzero(objects == thing))
        if len(own) < candidates:
            raise ValueError(
                f"an object has {len(own)} grasps, fewer than {candidates} candidates: simulate more or ask for fewer"
            )
        hands.append(own[: len(own) // candidates * candidates].reshape(-1, candidates))
    return np.concatenate(hands)


def observe(pack: Pack, rows: np.ndarray) -> dict[str, torch.Tensor]:
    """Return the observation dict of pack rows, as a robot gives it to a policy: uint8 images [B, 3, S, S]."""
    vision, gels = (torch.from_numpy(pack.images[m][rows]).permute(0, 3, 1, 2) for m in ("vision", "touch"))
    return dict(zip([*KEYS["vision"], *KEYS["touch"]], (vision, gels[:, :3], gels[:, 3:]), strict=True))


@torch.no_grad()
def encode(model: Model, pack: Pack, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the features [N, D] of the policy's encoder on "vision" and "touch". Those on both are concatenated."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    encoders = {m: ObservationEncoder(model, keys).to(device).eval() for m, keys in KEYS.items()}
    chunks = np.array_split(rows, -(-len(rows) // 128))
    seen = [{k: x.to(device) for k, x in observe(pack, chunk).items()} for chunk in chunks]
    return {m: torch.cat([encoder(x).cpu() for x in seen]).numpy() for m, encoder in encoders.items()}


def predict(x: np.ndarray, y: np.ndarray, rows: ProbeSplit) -> np.ndarray:
    """Fit a head and return the success probability of the test rows, [num_test].

    ``x`` and ``y`` have all rows, in the order train, val, test.
    """
    val, test = len(rows.train), len(rows.train) + len(rows.val)
    head, _ = fit_linear(x[:val], y[:val], x[val:test], y[val:test])
    return head(x[test:])[:, 1]


def play(p: np.ndarray, y: np.ndarray, objects: np.ndarray, hands: np.ndarray, threshold: float) -> dict[str, Any]:
    """Play all episodes. Return episodes and successes per object and the mean number of tried grasps.

    The result is a record for ``mvitac.evaluation.intervals.interval``.
    """
    lifted, tried = decide(p[hands], threshold)
    thing, held = objects[hands[:, 0]], y[hands[np.arange(len(hands)), lifted]]
    num = int(objects.max()) + 1
    return {
        "group_sizes": np.bincount(thing, minlength=num).tolist(),
        "group_correct": np.bincount(thing, held, num).astype(int).tolist(),
        "tried": float(tried.mean()),
    }


def experiment(model: Model, pack: Pack, seeds: int, candidates: int) -> dict[str, Any]:
    """Return the success of every policy and the gain of touch, ready for JSON.

    "success": policy -> "again" or "best" -> mean, low, high, tried. "gain": pair of policies -> mean, low, high, p.
    """
    task = next((t for t in pack.spec.tasks if t.name == "success"), None)
    if task is None or not task.only or pack.spec.vision_channels != 3 or pack.spec.touch_channels != 6:
        raise ValueError(f"{pack.path} has no grasps with a camera and two gels: train a run with --data grasps")
    if seeds < 1 or candidates < 1:
        raise ValueError(f"seeds {seeds}, candidates {candidates}: each must be at least 1")
    rows = split_rows(pack, task, "both")
    every = np.concatenate([rows.train, rows.val, rows.test])
    labels = pack.labels("success")
    if len(set(labels[rows.train])) < 2:
        raise ValueError(f"{pack.path}: all training grasps have the same label: simulate more grasps")
    objects = np.unique(pack.column("group")[rows.test].astype(str), return_inverse=True)[1]
    hands = [episodes(objects, candidates, seed) for seed in range(seeds)]
    x = encode(model, pack, every)
    untrained = replace(model.run, encoder=model.run.encoder.changed(weights=SCRATCH))
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


def show(found: dict[str, Any]) -> None:
    """Print the results of ``experiment`` as a table."""
    title = "{objects} test objects, {episodes} episodes per seed, {seeds} seeds, {candidates} candidates".format(
        **found
    )
    rows = []
    for name, rules in found["success"].items():
        again, best = rules["again"], rules["best"]
        cells = [f"{100 * again['mean']:.1f}", _range(again), f"{again['tried']:.2f}", f"{100 * best['mean']:.1f}"]
        rows.append([name, *cells, _range(best)])
    heads = ["policy", "re-grasp", "95 %", "tried", "best of all", "95 %"]
    print(f"{title}: success in %", tabulate(rows, heads, disable_numparse=True), sep="\n")
    for name, gain in found["gain"].items():
        p = gain["p"]  # None with one seed
        p = "" if p is None else f", p {p:.3f}" if p >= 0.0005 else ", p < .001"
        print(f"re-grasp, {name}: {100 * gain['mean']:+.1f} points {_range(gain)}{p}")


def _range(cell: dict[str, float]) -> str:
    return f"[{100 * cell['low']:.1f}, {100 * cell['high']:.1f}]"


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", help="folder of a run trained with --data grasps")
    parser.add_argument("--seeds", type=int, default=5, help="number of random orders of the candidates")
    parser.add_argument("--candidates", type=int, default=4, help="candidate grasps per episode")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args(argv)
    try:
        if options.json:
            check_place(options.json)
        model = mvitac.load(options.run)
        found = experiment(model, model.run.data.open(), options.seeds, options.candidates)
    except ValueError as error:
        parser.error(str(error))
    show(found)
    if options.json:
        write_json(options.json, found)


if __name__ == "__main__":
    main()
