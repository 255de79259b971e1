"""Which rows learn, choose and score: whole groups dealt to splits, and splits given by a table held to account."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np

from mvitac.pack import SPLITS
from mvitac.registry import unknown
from mvitac.spec import Task

BY_GROUP = "by-group"


def deal(
    groups: Sequence[str], targets: Sequence[Sequence[int]], test_share: float, val_share: float, seed: int
) -> list[str]:
    """A split per row, whole groups dealt to train, val and test, stratified over the first label's classes.

    The first group of every class goes to train, every next one to the split that lacks most: a class of one group is
    never tested. Groups without any label are "unlabelled" where others have some.
    """
    votes: dict[str, Counter[int]] = {group: Counter() for group in groups}
    known: set[str] = set()
    for i, group in enumerate(groups):
        votes[group].update([target[i] for target in targets[:1] if target[i] >= 0])
        if not targets or any(target[i] >= 0 for target in targets):
            known.add(group)
    strata: dict[int, list[str]] = defaultdict(list)
    for group in sorted(known):
        # Ties go to the smaller class number, so that the dealing does not depend on the order of rows.
        strata[min(votes[group], key=lambda c: (-votes[group][c], c), default=-1)].append(group)
    shares = {"train": 1 - test_share - val_share, "test": test_share, "val": val_share}
    rng = np.random.default_rng(seed)
    dealt: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for stratum in rng.permutation(sorted(strata)).tolist():
        for place, j in enumerate(rng.permutation(len(strata[stratum])).tolist()):
            lacks = {name: share * (len(dealt) + 1) - counts[name] for name, share in shares.items() if share > 0}
            choice = "train" if place == 0 else max(lacks, key=lambda name: lacks[name])
            dealt[strata[stratum][j]] = choice
            counts[choice] += 1
    return [dealt.get(group, "unlabelled") for group in groups]


def check_split_names(where: str, column: str, numbers: Sequence[int], splits: Sequence[str]) -> None:
    for number, split in zip(numbers, splits, strict=True):
        if split not in SPLITS:
            near = {"validation": "val", "valid": "val", "dev": "val", "eval": "val", "training": "train"}
            near |= {"testing": "test", "unseen": "test", "unlabeled": "unlabelled"}
            wanted = near.get(split.lower()) or (split.lower() if split.lower() in SPLITS else None)
            hint = f"; write {wanted!r} instead" if wanted else f"; or split={BY_GROUP} ignores the column"
            raise ValueError(f"{where} row {number}: {unknown(f'split in column {column!r}', split, SPLITS)}{hint}")


def check_leak(where: str, split: str, what: str, values: Sequence[str], splits: Sequence[str]) -> None:
    """Refuse a value that is on two sides; train and unlabelled are one side, as pre-training sees both."""
    sides: dict[str, set[str]] = defaultdict(set)
    for value, side in zip(values, splits, strict=True):
        sides[value].add("train" if side == "unlabelled" else side)
    leaks = [value for value, found in sides.items() if len(found) > 1]
    if leaks:
        advice = "give the group that holds them together" if split == BY_GROUP else f"split={BY_GROUP} splits by group"
        raise ValueError(
            f"{where}: split {split!r} leaks: {len(leaks)} of {len(sides)} {what} are on two sides, e.g. {leaks[0]!r}"
            f" in {' and '.join(sorted(sides[leaks[0]]))}; {advice}, or allow_leak accepts it"
        )


def check_sides(
    where: str, split: str, splits: Sequence[str], tasks: Sequence[Task], targets: Sequence[Sequence[int]], num: int
) -> None:
    """Something to pre-train on; for every task something to learn from and to be scored on."""
    counts = Counter(splits)
    what = f"dealing {num} groups" if split == BY_GROUP else f"column {split!r}"
    if not counts["train"] + counts["unlabelled"]:
        raise ValueError(f"{where}: {what} gives no rows of train or unlabelled: nothing to pre-train on")
    for task, target in zip(tasks, targets, strict=True):
        for side in ("train", "test"):
            if not any(label >= 0 and s == side for label, s in zip(target, splits, strict=True)):
                hint = (
                    "more groups or another share are needed" if split == BY_GROUP else "a probe needs train and test"
                )
                raise ValueError(f"{where}: {what} gives label {task.name!r} no labelled rows in {side}: {hint}")
