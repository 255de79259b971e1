"""Which rows each step learns from, and in which order: a function of (seed, epoch)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np
import torch

from mvitac.data.pack import Pack
from mvitac.run import Run
from mvitac.system.distributed import World


def training_rows(run: Run, pack: Pack) -> np.ndarray:
    """Pack rows to pre-train on; a method that learns from labels sees only rows that carry one it needs."""
    rows = pack.rows("train", "unlabelled", having=pack.spec.modalities)  # a pair with a hole in it is no pair
    tasks = run.method.labels_needed(pack.spec)
    if not tasks:
        return rows
    labels = {task: pack.labels(task, "train")[rows] >= 0 for task in tasks}
    for task, there in labels.items():
        if not there.any():
            raise ValueError(f"task {task!r} has no labelled rows to train on: choose a self-supervised --method")
    return rows[np.logical_or.reduce(list(labels.values()))]


def mix(*numbers: int) -> int:
    """One 63-bit seed from several numbers, by numpy's SeedSequence."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> 1)


def batches(
    run: Run,
    pack: Pack,
    rows: np.ndarray,
    start: int,
    num_steps: int,
    world: World | None = None,
    expect: Callable[[np.ndarray], None] | None = None,
) -> Iterator[np.ndarray]:
    """Pack rows of each step from ``start`` on; an epoch's order depends on (seed, epoch) alone, and where a pack comes in
    shards on how many processes take part. ``expect`` (``Pack.expect``) is then told what this process will read."""
    world = world or World()
    per_epoch, share = run.steps_per_epoch(len(rows)), run.batch_size // world.size
    touch_groups = pack.touch_groups[rows] if run.sampler == "one-per-touch" else None
    shards = pack.shards[rows]

    @lru_cache(2)
    def epoch_batches(epoch: int) -> np.ndarray:
        """[per_epoch, batch_size]"""
        seed, num = mix(run.seed, 1, epoch), per_epoch * run.batch_size
        if not pack.window:
            return rows[epoch_order(len(rows), touch_groups, seed)[:num]].reshape(per_epoch, -1)
        lanes = shard_order(shards, touch_groups, pack.window, world.size, num, seed)
        return rows[lanes.reshape(world.size, per_epoch, share).swapaxes(0, 1).reshape(per_epoch, -1)]

    def own(step: int) -> np.ndarray:
        return epoch_batches(step // per_epoch)[step % per_epoch, share * world.rank : share * (world.rank + 1)]

    num_ahead = min(-(-pack.window * np.bincount(shards).max() // share), per_epoch)
    try:
        for step in range(start, num_steps):
            if expect and pack.window:
                expect(np.concatenate([own(s) for s in range(step, min(step + num_ahead, num_steps))]))
            yield epoch_batches(step // per_epoch)[step % per_epoch]
    finally:
        if expect:
            expect(rows[:0])


def epoch_order(num: int, groups: np.ndarray | None, seed: int) -> np.ndarray:
    """A permutation of 0..num-1; with ``groups``, all first rows of every group come first, then all second ones, ...

    so that any stretch not longer than the number of groups holds hardly two rows of one group.
    """
    rng = np.random.default_rng(seed)
    order = rng.permutation(num)
    if groups is None:
        return order
    _, inverse, counts = np.unique(groups[order], return_inverse=True, return_counts=True)
    by_group = np.argsort(inverse, kind="stable")
    occurrence = np.empty(num, np.int64)
    occurrence[by_group] = np.arange(num) - np.repeat(np.cumsum(counts) - counts, counts)
    return order[np.argsort(occurrence, kind="stable")]


def shard_order(
    shards: np.ndarray, groups: np.ndarray | None, window: int, num_lanes: int, num: int, seed: int
) -> np.ndarray:
    """[num_lanes, num / num_lanes] of 0..N-1, each at most once: the shards (``shards`` [N] is each row's) in a random
    sequence, cut into one lane per process; within a lane rows are mixed as by ``epoch_order``, ``window`` shards at a time.

    So a process reads its own shards one after another and needs few at a time; only one that is cut is read by two.
    """
    place = np.random.default_rng(seed).permutation(shards.max() + 1)[shards]
    lanes = np.argsort(place, kind="stable")[:num].reshape(num_lanes, -1)
    for number, lane in enumerate(lanes):
        held = np.unique(place[lane])
        windows = np.array_split(held, -(-len(held) // window))
        firsts = np.searchsorted(place[lane], [some[0] for some in windows])
        for i, rows in enumerate(np.split(lane, firsts[1:])):  # views of the lane
            rows[:] = rows[epoch_order(len(rows), None if groups is None else groups[rows], mix(seed, number, i))]
    return lanes


def partners(pack: Pack, rows: np.ndarray, generator: torch.Generator) -> np.ndarray:
    """For each of ``rows`` a random other row of its touch group in the same split, and shard if the pack comes in such,
    or itself if it is alone there."""
    groups, split, shards = pack.touch_groups, pack.column("split"), pack.shards
    whole = np.logical_and.reduce([pack.has(modality) for modality in pack.spec.modalities])
    draws = torch.rand(len(rows), generator=generator).numpy()
    found = rows.copy()
    for i, row in enumerate(rows):
        others = pack.rows_of(int(groups[row]))
        others = others[(others != row) & (split[others] == split[row]) & whole[others]]
        others = others[shards[others] == shards[row]]
        if len(others):
            found[i] = others[int(draws[i] * len(others))]
    return found
