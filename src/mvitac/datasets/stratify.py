"""Dealing whole groups to the sides of a split so that each gets its share of every class, as well as groups allow."""

from __future__ import annotations

import numpy as np

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
