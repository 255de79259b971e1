"""Folds for small sets: every group is tested once, by probes fitted on the others.

Groups that a run learned from, by any row, image or name, also without labels, are always fitted on and never tested.
"""

import warnings
from collections.abc import Sequence

import numpy as np
from sklearn.model_selection import StratifiedGroupKFold

from mvitac.data.pack import Pack
from mvitac.data.row_hashes import known_images, row_hashes
from mvitac.data.spec import AnyTask, ValueTask
from mvitac.evaluation.leaks import KEYS, Source


def fold_splits(pack: Pack, task: AnyTask, num: int, learned: Sequence[Source]) -> list[np.ndarray]:
    """The split of every row [N] in each of ``num`` folds of a task: "test", "train", or "hidden" where it has no answer.

    Whole groups; classes, or quarters of the first value, are shared out as evenly as they allow. ValueError if fewer than
    ``num`` groups were not ``learned`` from.
    """
    known = pack.answered(task) & np.isin(pack.column(task.split), ("train", "val", "test"))
    ids, names = row_hashes(pack)
    of = {key: np.concatenate([np.zeros(0, np.uint64), *(getattr(source, key) for source in learned)]) for key in KEYS}
    copied = np.isin(ids, of["ids"]) | known_images(pack, np.arange(pack.num), of["images"]).any(axis=1)
    rows = np.flatnonzero(known & ~np.isin(names, np.concatenate([of["groups"], names[copied]])))
    groups = pack.column("group")[rows].astype(str)
    if (left := len(set(groups))) < num:
        free = f"{left} {pack.spec.group_by}s that no run learned from"
        raise ValueError(f"task {task.name!r} has {free}, too few for {num} folds")
    if isinstance(task, ValueTask):
        first = np.nan_to_num(pack.values(task)[rows, 0])
        strata = np.searchsorted(np.quantile(first, [0.25, 0.5, 0.75]), first)
    else:
        strata = pack.labels(task.name)[rows]
    if np.unique(strata, return_counts=True)[1].max() < num:  # none can be shared out
        strata = np.zeros(len(rows), int)
    found = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The least populated class")  # is shared out as far as it goes
        for _, test in StratifiedGroupKFold(num, shuffle=True, random_state=0).split(rows, strata, groups):
            split = np.where(known, "train", "hidden")
            split[rows[test]] = "test"
            found.append(split)
    return found
