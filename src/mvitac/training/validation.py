"""How a run is doing while it trains: kNN accuracy, signs of collapse and retrieval on held-out groups (split val)."""

from __future__ import annotations

import numpy as np
import torch

from mvitac.data.pack import Pack
from mvitac.evaluation import diagnostics
from mvitac.evaluation.features import pack_features
from mvitac.model import Model
from mvitac.run import Run

NUM_EVAL_TRAIN, NUM_EVAL_VAL = 1024, 512


@torch.no_grad()
def evaluate(model: Model, pack: Pack, run: Run) -> dict[str, float]:
    """kNN accuracy of each task and the collapse panel on held-out groups (split val); never looks at test.

    Without a val split the panel is over training rows and there is no kNN score. Only rows with both modalities count.
    """
    rng = np.random.default_rng(0)  # the same rows at every step and for every seed

    def some(rows: np.ndarray, num: int) -> np.ndarray:
        rows = pack.near(rows, num)
        return np.sort(rng.choice(rows, min(num, len(rows)), replace=False))

    whole = pack.spec.modalities
    train_rows = some(pack.rows("train", "unlabelled", having=whole), NUM_EVAL_TRAIN)
    val_rows = pack.rows("val", having=whole)
    held_out = len(val_rows) > 1
    panel_rows = some(val_rows, NUM_EVAL_VAL) if held_out else train_rows[:NUM_EVAL_VAL]
    z = {m: pack_features(model, pack, m, panel_rows, bf16=run.bf16) for m in model.encoders}
    values: dict[str, float] = {}
    for modality, features in z.items():
        values[f"{modality}/std"] = diagnostics.spread(features)
        values[f"{modality}/rankme"] = diagnostics.rank_me(features)
    if held_out:
        bank = {m: pack_features(model, pack, m, train_rows, bf16=run.bf16) for m in model.encoders}
        for task in pack.spec.tasks:
            known, asked = (torch.from_numpy(pack.labels(task.name, split)) for split in ("train", "val"))
            keep_bank, keep = known[train_rows] >= 0, asked[panel_rows] >= 0
            if not (keep_bank.any() and keep.any()):
                continue
            for modality in z:
                values[f"{modality}/knn {task.name}"] = diagnostics.knn_accuracy(
                    bank[modality][keep_bank],
                    known[train_rows][keep_bank],
                    z[modality][keep],
                    asked[panel_rows][keep],
                )
    if len(model.projectors) == 2:
        device = next(model.parameters()).device
        if run.augment.size != run.augment.eval_size:
            z = {m: pack_features(model, pack, m, panel_rows, for_heads=True, bf16=run.bf16) for m in z}
        shared = {m: model.project(m, z[m].to(device)).cpu() for m in z}
        groups = torch.from_numpy(np.unique(pack.column("group")[panel_rows], return_inverse=True)[1])
        values["alignment"] = diagnostics.alignment(shared["vision"], shared["touch"])
        values["modality gap"] = diagnostics.modality_gap(shared["vision"], shared["touch"])
        for modality in shared:
            values[f"{modality}/uniformity"] = diagnostics.uniformity(shared[modality])
        for query, gallery in (("vision", "touch"), ("touch", "vision")):
            ranks = diagnostics.retrieval_ranks(shared[query], shared[gallery], groups)
            for name, value in diagnostics.recall_at(ranks, (1, 5)).items():
                values[f"{query}->{gallery} {name}"] = value
        values["chance R@5"] = min(1.0, 5 / (int(groups.max()) + 1))
    return values
