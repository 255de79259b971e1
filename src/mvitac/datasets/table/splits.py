"""Which rows learn, choose and score: whole groups dealt to splits, and splits given by a table held to account."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from mvitac.data.pack import SPLITS
from mvitac.data.spec import Task
from mvitac.datasets.table.image_refs import Frame, ImageRef
from mvitac.registry import unknown

BY_GROUP = "by-group"


def assign_splits(
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


def by_video(root: Path, numbers: Sequence[int], places: Iterable[Sequence[ImageRef | None]]) -> tuple[str, list[str]]:
    """What a group is where no column names it, and every row's: frames of one video are one group, and so are videos that
    a row shows side by side; a row of single images is alone. ``places`` has a list per image column."""
    columns = list(places)
    videos = [
        [os.path.relpath(place.path, root) for column in columns if isinstance(place := column[i], Frame)]
        for i in range(len(numbers))
    ]
    beside: dict[str, str] = {}

    def first(video: str) -> str:
        while (other := beside.setdefault(video, video)) != video:
            video = other
        return video

    for shown in videos:
        for video in shown[1:]:
            beside[first(video)] = first(shown[0])
    groups = [first(shown[0]) if shown else f"{number:06d}" for number, shown in zip(numbers, videos, strict=True)]
    return "video" if any(videos) else "row", groups


def meant(name: str) -> str | None:
    """The split that is usually meant by ``name``, if any."""
    near = {"validation": "val", "valid": "val", "dev": "val", "eval": "val", "training": "train"}
    near |= {"testing": "test", "unseen": "test", "unlabeled": "unlabelled", **{split: split for split in SPLITS}}
    return near.get(name.lower())


def check_split_names(where: str, column: str, numbers: Sequence[int], splits: Sequence[str]) -> None:
    for number, split in zip(numbers, splits, strict=True):
        if split not in SPLITS:
            wanted = meant(split)
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


def folds(groups: Sequence[str], strata: Sequence[str], num: int, val_every: int = 2) -> dict[str, list[str]]:
    """Columns fold1 ... fold<num> with a split per row: every group is test in one of them.

    Groups are dealt in turn, stratum by stratum, so that each fold has its share of every stratum; of the next fold's
    groups every ``val_every``-th is val.
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


SCALE = 1_000_000
"""Shares are counted in millionths, as integers, so that the dealing is the same on every machine."""


def stratify(counts: np.ndarray, shares: tuple[float, ...], seed: int) -> np.ndarray:
    """Side number [G] of each group, given its rows of each class, ``counts`` [G, C].

    From a dealing drawn by ``seed`` one group is moved, or two are exchanged, as long as that brings the sides nearer to
    their ``shares`` of each class's rows and of each class's groups (sum of squared differences). Groups decide how far an
    interval is from useless, rows how far a score is from noise: both count the same. A class of a single group cannot be
    shared out and does not count.
    """
    num = len(counts)
    if not num:
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
        # Moving g from its side to s changes the cost of these two only.
        leave = ((over[side] - weight) ** 2).sum(1) - now[side]  # [G]
        enter = ((over[None] + weight[:, None]) ** 2).sum(2) - now  # [G, S]
        gain = leave[:, None] + enter
        gain[np.arange(num), side] = 0
        if gain.min() < 0:
            group, to = divmod(int(gain.argmin()), len(shares))
            side[group] = to
            continue
        change = weight[None] - weight[:, None]  # [G, G, F]: what g's side gains if g gives way to h
        one = ((over[side][:, None] + change) ** 2).sum(2) - now[side][:, None]
        gain = one + one.T
        gain[side[:, None] == side] = 0
        if gain.min() >= 0:
            return side
        g, h = divmod(int(gain.argmin()), num)
        side[g], side[h] = side[h], side[g]
