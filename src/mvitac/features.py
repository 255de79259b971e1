"""Features of a pack's rows by a frozen model, computed once: kept in the cache by weights, data and rows."""

from __future__ import annotations

import numpy as np

from mvitac.model import Model, pack_features
from mvitac.pack import Pack
from mvitac.record import cache_dir, digest, write_atomic


def sample(rows: np.ndarray, num: int) -> np.ndarray:
    """At most ``num`` of ``rows``, in their order, the same ones at every call.

    By chance: packs take their classes in turn, and every n-th row would be of the same few.
    """
    return np.sort(np.random.default_rng(0).choice(rows, min(num, len(rows)), replace=False))


def features(model: Model, pack: Pack, modality: str, rows: np.ndarray, *, for_heads: bool = False) -> np.ndarray:
    """Features [len(rows), D] float32, computed once and cached by weights, data, rows and side (``Model.features``)."""
    device = next(model.parameters()).device
    sides = model.run.augment
    side = [sides.size] if for_heads and sides.size != sides.seen else []  # the usual one is in the weights' digest
    key = digest([model.weights_digest(), pack.digest, modality, digest(rows.tolist()), device.type, *side])
    path = cache_dir() / "features" / f"{key[:32]}.npy"
    if path.exists():
        try:
            return np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError):
            path.unlink()  # damaged: compute it again
    values = pack_features(model, pack, modality, rows, for_heads=for_heads).numpy()
    write_atomic(path, lambda file: np.save(file, values))
    return values
