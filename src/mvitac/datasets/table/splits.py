"""Train/val/test splits: assign whole groups to splits, or validate a given split column."""

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvitac.data.spec import AnyTask
from mvitac.datasets.table.image_refs import Frame, ImageRef

BY_GROUP = "by-group"


def assign_splits(
    groups: Sequence[str], targets: Sequence[Sequence[int]], test_share: float, val_share: float, seed: int
) -> list[str]:
    """Split of each row: whole ``groups`` go to train, val and test, stratified by the classes of the first label.

    The first group of each class goes to train and each further group to the split with the largest deficit, so a class
    with one group is never tested. Groups without any label are "unlabelled" if other groups are labelled. ``targets``:
    class number of each row for each task (-1 = unlabelled); the shares are fractions of the groups.
    """
    votes: dict[str, Counter[int]] = {group: Counter() for group in groups}
    for i, group in enumerate(groups):
        votes[group].update([target[i] for target in targets[:1] if target[i] >= 0])
    known = {group for i, group in enumerate(groups) if not targets or any(target[i] >= 0 for target in targets)}
    strata: dict[int, list[str]] = defaultdict(list)
    for group in sorted(known):
        # Ties go to the smaller class number, so that the result does not depend on the order of rows.
        strata[min(votes[group], key=lambda c: (-votes[group][c], c), default=-1)].append(group)
    shares = {"train": 1 - test_share - val_share, "test": test_share, "val": val_share}
    rng = np.random.default_rng(seed)
    assigned: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for stratum in rng.permutation(sorted(strata)).tolist():
        for place, j in enumerate(rng.permutation(len(strata[stratum])).tolist()):
            lacks = {name: share * (len(assigned) + 1) - counts[name] for name, share in shares.items() if share > 0}
            choice = "train" if place == 0 else max(lacks, key=lambda name: lacks[name])
            assigned[strata[stratum][j]] = choice
            counts[choice] += 1
    return [assigned.get(group, "unlabelled") for group in groups]


def group_by_video(
    root: Path, numbers: Sequence[int], refs: Sequence[Sequence[ImageRef | None]]
) -> tuple[str, list[str]]:
    """What a group is ("video" or "row") and the group of each row, for rows that no column groups.

    Videos that occur in the same row are one group. A row of image files is its own group. ``refs`` has one reference
    per row for each image column.
    """
    rows = [[column[i] for column in refs] for i in range(len(numbers))]
    videos = [[os.path.relpath(ref.path, root) for ref in row if isinstance(ref, Frame)] for row in rows]
    parent: dict[str, str] = {}  # union-find
    for shown in videos:
        for video in shown[1:]:
            parent[_root(parent, video)] = _root(parent, shown[0])
    shown_in = zip(numbers, videos, strict=True)
    groups = [_root(parent, shown[0]) if shown else f"{number:06d}" for number, shown in shown_in]
    return "video" if any(videos) else "row", groups


def _root(parent: dict[str, str], name: str) -> str:
    """Return the representative of the set of ``name`` in a union-find structure."""
    while (other := parent.setdefault(name, name)) != name:
        name = other
    return name


def check_leak(where: str, split: str, what: str, values: Sequence[str], splits: Sequence[str]) -> None:
    """Raise ValueError if a value is in more than one split. Train and unlabelled are one: pre-training uses both."""
    sides: dict[str, set[str]] = defaultdict(set)
    for value, side in zip(values, splits, strict=True):
        sides[value].add("train" if side == "unlabelled" else side)
    if leaks := [value for value, found in sides.items() if len(found) > 1]:
        found = f"{leaks[0]!r} in {' and '.join(sorted(sides[leaks[0]]))}"
        told = f"{len(leaks)} of {len(sides)} {what} are in more than one split, e.g. {found}"
        advice = "give the group" if split == BY_GROUP else f"--data.split {BY_GROUP} assigns whole groups"
        raise ValueError(f"{where}: split {split!r} leaks: {told}; {advice}, or --data.allow-leak accepts it")


def check_sides(
    where: str, split: str, splits: Sequence[str], tasks: Sequence[AnyTask], targets: Sequence[Sequence[int]], num: int
) -> None:
    """Check that there are rows to pre-train on and, for each task, labelled rows in train and test."""
    counts = Counter(splits)
    what = f"assigning {num} groups" if split == BY_GROUP else f"column {split!r}"
    more = "give more groups" if split == BY_GROUP else f"--data.split {BY_GROUP} assigns whole groups"
    if not counts["train"] + counts["unlabelled"]:
        raise ValueError(f"{where}: {what} gives no rows of train or unlabelled: nothing to pre-train on")
    for task, target in zip(tasks, targets, strict=True):
        for side in ("train", "test"):
            if not any(label >= 0 and s == side for label, s in zip(target, splits, strict=True)):
                raise ValueError(f"{where}: {what} gives {task.name!r} no rows in {side}: {more}")


def folds(groups: Sequence[str], strata: Sequence[str], num: int, val_every: int = 2) -> dict[str, list[str]]:
    """Return columns fold1 ... fold<num>, each a split per row; each group is in test in exactly one fold.

    Groups are assigned in turn, stratum by stratum, so that each fold has its share of each stratum. Of the groups tested
    in the next fold, every ``val_every``-th is in val.
    """
    home = dict(zip(reversed(groups), reversed(strata), strict=True))
    shuffled = np.random.default_rng(0).permutation(sorted(home)).tolist()
    order = {name: i for i, name in enumerate(sorted(shuffled, key=lambda name: home[name]))}  # stable: still shuffled
    columns: dict[str, list[str]] = {}
    for fold in range(num):
        sides = {}
        for name, place in order.items():
            away = (place % num - fold) % num
            sides[name] = "test" if away == 0 else "val" if away == 1 and place // num % val_every == 0 else "train"
        columns[f"fold{fold + 1}"] = [sides[group] for group in groups]
    return columns


def add_folds(rows: Sequence[dict[str, str]], strata: Sequence[str], num: int, val_every: int = 2) -> None:
    """Add the columns of ``folds`` to ``rows``, with their column object as the group."""
    for column, splits in folds([row["object"] for row in rows], strata, num, val_every).items():
        for row, split in zip(rows, splits, strict=True):
            row[column] = split


SCALE = 1_000_000  # fractions are integers in millionths, so that the result is the same on every machine


def stratify(counts: np.ndarray, shares: tuple[float, ...], seed: int) -> np.ndarray:
    """Assign groups to splits so that each split gets its share of the rows and of the groups of each class.

    Starts from a random assignment and moves one group, or exchanges two, as long as that lowers the sum of squared
    differences from ``shares``. Rows and groups count equally: the number of rows limits the precision of a score, the
    number of groups its confidence interval. A class with a single group does not count. ``counts`` [G, C] is the
    number of rows of each group in each class. Returns int64 [G], the index in ``shares`` of each group's split.
    """
    if not (num := len(counts)):
        return np.zeros(0, np.int64)
    counts = counts[:, (counts > 0).sum(0) > 1].astype(np.float64)
    has = (counts > 0).astype(np.float64)
    parts = np.concatenate([m / m.sum(0) for m in (counts, has, np.ones((num, 1)))], axis=1)  # [G, F] columns of sum 1
    weight = np.rint(parts * SCALE).astype(np.int64)
    target = np.rint(np.array(shares)[:, None] * weight.sum(0)).astype(np.int64)  # [S, F]
    side = np.random.default_rng(seed).choice(len(shares), num, p=np.array(shares) / sum(shares))
    while True:
        over = np.stack([weight[side == s].sum(0) for s in range(len(shares))]) - target  # [S, F]
        now = (over**2).sum(1)  # [S]
        # Moving g from its side to s changes only the cost of these two.
        leave = ((over[side] - weight) ** 2).sum(1) - now[side]  # [G]
        enter = ((over[None] + weight[:, None]) ** 2).sum(2) - now  # [G, S]
        gain = leave[:, None] + enter
        gain[np.arange(num), side] = 0
        if gain.min() < 0:
            group, to = divmod(int(gain.argmin()), len(shares))
            side[group] = to
            continue
        change = weight[None] - weight[:, None]  # [G, G, F]: change of g's side if h replaces g
        one = ((over[side][:, None] + change) ** 2).sum(2) - now[side][:, None]
        gain = one + one.T
        gain[side[:, None] == side] = 0
        if gain.min() >= 0:
            return side
        g, h = divmod(int(gain.argmin()), num)
        side[g], side[h] = side[h], side[g]
