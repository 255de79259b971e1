"""Rows of each step, in an order that is a function of (seed, epoch)."""

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np
import torch

from mvitac.data.pack import Pack
from mvitac.data.several import MixedPack
from mvitac.data.windows import places
from mvitac.run import Run
from mvitac.system.distributed import World

Order = Callable[[int, np.ndarray | None, int], np.ndarray]
"""(number of rows, their touch groups, seed) -> an order of the rows."""


def combine_seeds(*numbers: int) -> int:
    """Combine several numbers into one 63-bit seed, by numpy's SeedSequence."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> 1)


class Batches:
    """Pack rows of each step. The order of an epoch depends on (seed, epoch)."""

    def __init__(self, run: Run, pack: Pack, rows: np.ndarray) -> None:
        self.rows, self.seed, self.shape = rows, run.seed, (run.steps_per_epoch(len(rows)), run.batch_size)
        self.touch_groups = pack.touch_groups[rows] if run.sampler != "shuffle" else None
        self.order: Order = partial(epoch_order, spread=run.sampler == "spread")
        weighted = isinstance(pack, MixedPack) and bool(pack.weights)
        self._epoch = lru_cache(2)(PartOrder(self, pack).epoch if weighted else self._pass)  # type: ignore[arg-type]

    def __getitem__(self, step: int) -> np.ndarray:
        """Rows [batch_size] of step ``step``, counted from 0."""
        return self._epoch(step // self.shape[0])[step % self.shape[0]]

    def _pass(self, epoch: int) -> np.ndarray:
        order = self.order(len(self.rows), self.touch_groups, combine_seeds(self.seed, 1, epoch))
        return self.rows[order[: self.shape[0] * self.shape[1]]].reshape(self.shape)


class PartOrder:
    """Rows of each epoch of a mix whose parts are drawn by weight.

    An epoch draws as many rows as it has room for, each of a random part, by weight: the next row of that part's endless
    sequence, which is pass after pass over its rows, each pass in another order. All of it is a function of (seed, epoch);
    earlier draws are counted from the first epoch on.
    """

    def __init__(self, batches: Batches, pack: MixedPack) -> None:
        self.seed, self.order, self.shape, rows = batches.seed, batches.order, batches.shape, batches.rows
        self.part_of = pack.part_of
        self.rows = [rows[pack.part_of[rows] == number] for number in range(len(pack.parts))]
        self.touch_groups = [None if batches.touch_groups is None else pack.touch_groups[own] for own in self.rows]
        self.shares = pack.shares(rows)
        self.num = self.shape[0] * self.shape[1]  # draws of an epoch
        self.before = [np.zeros(len(self.rows), np.int64)]  # draws of each part before each epoch

    def epoch(self, number: int) -> np.ndarray:
        """Rows [per_epoch, batch_size] of epoch ``number``."""
        for earlier in range(len(self.before) - 1, number + 1):
            counts = np.random.default_rng(combine_seeds(self.seed, 2, earlier)).multinomial(self.num, self.shares)
            self.before.append(self.before[-1] + counts)
        first, last = self.before[number : number + 2]
        parts = np.repeat(np.arange(len(self.rows)), last - first)
        parts = np.random.default_rng(combine_seeds(self.seed, 3, number)).permutation(parts)
        drawn = np.empty(self.num, np.int64)
        for part in np.unique(parts).tolist():
            drawn[parts == part] = self._sequence(part, int(first[part]), int(last[part]))
        return self._separate_repeats(drawn.reshape(self.shape))

    def _separate_repeats(self, drawn: np.ndarray) -> np.ndarray:
        """Exchange what a batch holds twice, where a pass ends, for a row of the same part in the nearest batch."""
        for number, batch in enumerate(drawn):
            for place in np.setdiff1d(np.arange(len(batch)), np.unique(batch, return_index=True)[1]):
                same = np.argwhere(self.part_of[drawn] == self.part_of[batch[place]])
                for other in same[np.argsort(abs(same[:, 0] - number), kind="stable")]:
                    if drawn[*other] not in batch and batch[place] not in drawn[other[0]]:
                        batch[place], drawn[*other] = drawn[*other], batch[place]
                        break
        return drawn

    def _sequence(self, part: int, start: int, end: int) -> np.ndarray:
        """Rows ``start`` to ``end`` of the endless sequence of ``part``."""
        rows, groups = self.rows[part], self.touch_groups[part]
        passes = range(start // len(rows), -(-end // len(rows)))
        orders = [rows[self.order(len(rows), groups, combine_seeds(self.seed, 4, part, number))] for number in passes]
        skipped = passes.start * len(rows)
        return np.concatenate(orders)[start - skipped : end - skipped]


def check_mix(run: Run, pack: Pack, rows: np.ndarray, world: World) -> None:
    """ValueError unless each part of a mix has the rows that a batch asks of it, and batches can be embedded as asked."""
    if not isinstance(pack, MixedPack):
        return
    sizes = np.bincount(pack.part_of[rows], minlength=len(pack.parts))
    for name, size, share in zip(pack.parts, sizes.tolist(), pack.shares(rows).tolist(), strict=True):
        if not size:
            raise ValueError(f"method {run.method.name!r} learns from no row of part {name}: leave it out")
        if size < share * run.batch_size - 1e-6:
            asked = f"{share * run.batch_size:.0f} of a batch of {run.batch_size}"
            raise ValueError(f"part {name} has {size} rows to train on, for {asked}: a row would be its own negative")
    present = np.stack([pack.has(modality)[rows] for modality in pack.spec.modalities])
    if (present == present[:, :1]).all():
        return
    if world.size > 1 or run.chunk:
        raise ValueError("parts that lack a modality support neither several processes nor --chunk: leave them out")
    if run.batch_size < 3:
        raise ValueError(f"batch_size {run.batch_size}: parts that lack a modality need at least 3")


def epoch_order(num: int, groups: np.ndarray | None, seed: int, *, spread: bool = False) -> np.ndarray:
    """A random permutation of 0..num-1.

    With ``groups`` [num], one row of each group comes first, then a second row of each group, and so on. Any sequence not
    longer than the number of groups then has hardly two rows of one group. With ``spread``, and where groups differ in
    size, as the largest would fill the last batches, rows of a group are far apart instead: c of them lie 1 / c of the
    length apart, give or take a fifth of that, around the end too.
    """
    rng = np.random.default_rng(seed)
    order = rng.permutation(num)
    if groups is None:
        return order
    _, inverse, counts = np.unique(groups[order], return_inverse=True, return_counts=True)
    occurrence = np.empty(num, np.int64)  # how often the row's group came before
    occurrence[np.argsort(inverse, kind="stable")] = np.arange(num) - np.repeat(np.cumsum(counts) - counts, counts)
    if not spread and counts.min() == counts.max():
        return order[np.argsort(occurrence, kind="stable")]
    start, jitter = rng.random(len(counts)), rng.uniform(-0.1, 0.1, num)
    return order[np.argsort((occurrence + start[inverse] + jitter) / counts[inverse] % 1)]


def draw_positives(
    pack: Pack, rows: np.ndarray, generator: torch.Generator, *, within: float = 0.0, other_sensor: bool = False
) -> np.ndarray:
    """For each of ``rows`` a random other row of the same touch group and split, else the row itself.

    With ``within``, its distance in time is at most that; with ``other_sensor``, it is of the same press and another sensor.
    """
    of = "presses" if other_sensor else "touch_groups"
    groups, split = getattr(pack, of), pack.column("split")
    place = places(pack, pack.spec.window)[1] if within else np.zeros(0)
    draws, found = torch.rand(len(rows), generator=generator).numpy(), rows.copy()
    for i, row in enumerate(rows):
        others = pack.rows_of(int(groups[row]), of)
        others = others[(others != row) & (split[others] == split[row]) & pack.whole[others]]
        if within:
            others = others[abs(place[others] - place[row]) <= within + 1e-9]
        if other_sensor:
            others = others[pack.sensors[others] != pack.sensors[row]]
        if len(others):
            found[i] = others[int(draws[i] * len(others))]
    return found
