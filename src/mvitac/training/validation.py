"""Evaluation during training: kNN accuracy, signs of collapse, and retrieval on held-out groups (split val)."""

from __future__ import annotations

import numpy as np
import torch

from mvitac.data.mixed_pack import MixedPack
from mvitac.data.pack import Pack
from mvitac.evaluation import diagnostics
from mvitac.evaluation.features import pack_features
from mvitac.model import Model
from mvitac.run import Run

NUM_EVAL_TRAIN, NUM_EVAL_VAL = 1024, 512


def evaluate(model: Model, pack: Pack, run: Run) -> dict[str, float]:
    """Scores as of ``evaluate_pack``; of a mix, those of each part, named "<part> <name>"."""
    if not isinstance(pack, MixedPack):
        return evaluate_pack(model, pack, run)
    parts = {name: evaluate_pack(model, pack.alone(name), run) for name in pack.parts}
    return {f"{part} {name}": value for part, values in parts.items() for name, value in values.items()}


@torch.no_grad()
def evaluate_pack(model: Model, pack: Pack, run: Run) -> dict[str, float]:
    """Scores on held-out groups (split val, never test). Only rows with both modalities are used.

    Without rows of val that are not trained on, the scores are computed on training rows, and there is no kNN accuracy.

    Returns:
        name -> value, e.g. "touch/knn category", "vision/rankme", "vision->touch R@5".
    """
    rng = np.random.default_rng(0)  # the same rows at every step and for every seed
    modalities = pack.spec.modalities
    train_rows = _sample(pack, pack.rows("train", "unlabelled", having=modalities), NUM_EVAL_TRAIN, rng)
    val_rows = np.setdiff1d(pack.rows("val", having=modalities), run.method.training_rows(pack))
    held_out = len(val_rows) > 1
    rows = _sample(pack, val_rows, NUM_EVAL_VAL, rng) if held_out else train_rows[:NUM_EVAL_VAL]
    z = {m: pack_features(model, pack, m, rows, bf16=run.bf16) for m in model.encoders if m in modalities}
    values: dict[str, float] = {}
    for modality, features in z.items():
        values[f"{modality}/std"] = diagnostics.spread(features)
        values[f"{modality}/rankme"] = diagnostics.rank_me(features)
    if held_out:
        values |= _knn(model, pack, run, train_rows, rows, z)
    if len(model.projectors) == len(z) == 2:
        values |= _shared_space(model, pack, run, rows, z)
    return values


def _sample(pack: Pack, rows: np.ndarray, num: int, rng: np.random.Generator) -> np.ndarray:
    rows = pack.near(rows, num)
    return np.sort(rng.choice(rows, min(num, len(rows)), replace=False))


def _knn(
    model: Model, pack: Pack, run: Run, train_rows: np.ndarray, rows: np.ndarray, z: dict[str, torch.Tensor]
) -> dict[str, float]:
    """kNN accuracy of each task on ``rows``, whose features are ``z``; neighbours are ``train_rows``."""
    values = {}
    bank = {m: pack_features(model, pack, m, train_rows, bf16=run.bf16) for m in z}
    for task in pack.spec.tasks:
        known = torch.from_numpy(pack.labels(task.name, "train"))[train_rows]
        asked = torch.from_numpy(pack.labels(task.name, "val"))[rows]
        labelled, scored = known >= 0, asked >= 0
        if labelled.any() and scored.any():
            for m in z:
                values[f"{m}/knn {task.name}"] = diagnostics.knn_accuracy(
                    bank[m][labelled], known[labelled], z[m][scored], asked[scored]
                )
    return values


def _shared_space(model: Model, pack: Pack, run: Run, rows: np.ndarray, z: dict[str, torch.Tensor]) -> dict[str, float]:
    """Alignment, uniformity and retrieval in the space shared by both modalities, on ``rows``, whose features are ``z``."""
    device = next(model.parameters()).device
    if run.augment.size != run.augment.eval_size:
        z = {m: pack_features(model, pack, m, rows, for_heads=True, bf16=run.bf16) for m in z}
    shared = {m: model.project(m, z[m].to(device)).cpu() for m in z}
    groups = torch.from_numpy(np.unique(pack.column("group")[rows], return_inverse=True)[1])
    values = {"alignment": diagnostics.alignment(shared["vision"], shared["touch"])}
    values["modality gap"] = diagnostics.modality_gap(shared["vision"], shared["touch"])
    for modality in shared:
        values[f"{modality}/uniformity"] = diagnostics.uniformity(shared[modality])
    for query, gallery in (("vision", "touch"), ("touch", "vision")):
        ranks = diagnostics.retrieval_ranks(shared[query], shared[gallery], groups)
        for name, value in diagnostics.recall_at(ranks, (1, 5)).items():
            values[f"{query}->{gallery} {name}"] = value
    values["chance R@5"] = min(1.0, 5 / (int(groups.max()) + 1))
    return values
