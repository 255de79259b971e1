"""Retrieval across modalities: a touch finds the picture of its group in the space that both share, and back."""

from typing import Any

import numpy as np
import torch

from mvitac.data.pack import Pack
from mvitac.evaluation import diagnostics
from mvitac.evaluation.features import features
from mvitac.evaluation.probe import group_numbers
from mvitac.model import Model

MIN_GALLERY = 11  # least number of test groups; with fewer, the first five are half of all groups or more


def retrieved_rows(pack: Pack, *splits: str) -> np.ndarray:
    """Rows of ``splits`` with all modalities, of the phase that the first task is about."""
    return pack.rows(*splits, only=pack.spec.tasks[0].only if pack.spec.tasks else None, having=pack.spec.modalities)


def cross_modal(model: Model, pack: Pack) -> list[dict[str, Any]]:
    """Retrieval of groups across modalities among ``retrieved_rows``, one record per direction.

    A record has R@1, R@5, R@10, chance level R@5 and the hits at 5 of each group. There is none without a shared space,
    on data of one modality, or with fewer than ``MIN_GALLERY`` groups.
    """
    if len(model.projectors) < 2 or len(pack.spec.modalities) < 2:
        return []
    rows = retrieved_rows(pack, "test")
    groups = torch.from_numpy(group_numbers(pack, rows))
    if len(sizes := np.bincount(groups.numpy())) < MIN_GALLERY:
        return []
    device, records = next(model.parameters()).device, []
    x = {m: torch.from_numpy(features(model, pack, m, rows, for_heads=True)) for m in ("touch", "vision")}
    z = {m: model.project(m, each.to(device)).cpu() for m, each in x.items()}
    for query, gallery in (("vision", "touch"), ("touch", "vision")):
        ranks = diagnostics.retrieval_ranks(z[query], z[gallery], groups)
        hits = np.bincount(groups.numpy(), weights=(ranks < 5).numpy(), minlength=len(sizes)).astype(int)
        known = {"direction": f"{query} -> {gallery}", **diagnostics.recall_at(ranks)}
        known |= {"chance R@5": min(1.0, 5 / len(sizes)), "num_groups": len(sizes)}
        records.append({**known, "group_sizes": sizes.tolist(), "group_correct": hits.tolist()})
    return records
