"""Copies across splits: identical pixels, and near-copies by the correlation of what is not in every picture."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from mvitac.data.checks.finding import Finding, share
from mvitac.data.checks.image_stats import ImageStats
from mvitac.data.checks.table_checks import sides_of
from mvitac.data.pack import Pack

NEAR = 0.975
"""Correlation of two residual thumbnails from which they count as near-copies, whatever the data."""
NEAR_AT_LEAST = 0.85
"""The same for data whose groups are much less alike than that."""
FAINT = 2.0
"""Standard deviation in grey levels below which a residual shows nothing but noise and is not compared."""
BLUR = 5
"""Side in thumbnail pixels of the blur that is taken off."""
MAX_ASKED, MAX_SEARCHED = 2000, 40_000


def exact_copies(pack: Pack, looks: dict[str, ImageStats]) -> Finding:
    """Rows of two sides with the same pixels; inside one side they are counted, but do no harm to a test."""
    sides = sides_of(pack.column("split").astype(str))
    notes, rows, inside = [], [], []
    for name, one in looks.items():
        _, first, numbers, counts = np.unique(one.exact, return_index=True, return_inverse=True, return_counts=True)
        if repeated := int(((counts[numbers] > 1) & one.seen).sum()):
            inside.append(f"{name}: {share(repeated, pack.num)} rows share their pixels with another")
        different = sides != sides[first[numbers]]
        across = np.flatnonzero(np.isin(numbers, numbers[different]) & one.seen)
        if len(across):
            across = across[np.argsort(numbers[across], kind="stable")]
            notes.append(f"{name}: {share(len(across), pack.num)} rows have a copy on another side")
            rows += across.tolist()
    if notes:
        return Finding(
            item="identical images across splits",
            verdict="broken",
            evidence="; ".join(notes),
            advice="remove the copies, or put them in one group so that they stay on one side",
            rows=tuple(rows),
        )
    evidence = "none" + (f" (inside one side: {'; '.join(inside)})" if inside else "")
    return Finding(item="identical images across splits", verdict="ok", evidence=evidence)


def near_copies(pack: Pack, looks: dict[str, ImageStats]) -> Finding:
    """Rows of test and val that nearly repeat a row of another side.

    A thumbnail's brightness minus the median thumbnail of its sensor (a gel's background, a fixed camera's scene) minus
    its own blur (lamps that drift) is what sets it apart; two of these that correlate above ``NEAR`` show the same
    thing. The bar lies halfway between 1 and the most alike rows of two *groups inside train*; the share of those that
    reach it as well says how much is the nature of the data, such as frames without contact.
    """
    sides = sides_of(pack.column("split").astype(str))
    sensors = pack.column("sensor").astype(str) if "sensor" in pack.table.column_names else np.full(pack.num, "")
    groups = pack.column("group").astype(str)
    notes, rows, worst, compared = [], [], False, False
    for name, one in looks.items():
        held_out = one.has & (sides != "train")
        if not held_out.any() or not (one.has & ~held_out).any():
            notes.append(f"{name}: all on one side")
            continue
        unit, clear = residuals(one, sensors)
        exact = one.exact
        asked = _some(np.flatnonzero(clear & (sides != "train")), MAX_ASKED)
        bank = _some(np.flatnonzero(clear & (sides == "train")), MAX_SEARCHED)
        if not len(asked) or not len(bank):
            notes.append(f"{name}: too faint to compare")
            continue
        compared = True
        best, value = _nearest(unit, asked, bank)
        _, natural = _nearest(unit, _some(bank, 500), bank, apart=groups)
        near = float(np.clip((1 + natural.max()) / 2, NEAR_AT_LEAST, NEAR)) if natural.max() > -1 else NEAR
        base = float((natural >= near).mean())
        hit = (value >= near) & (exact[asked] != exact[bank[best]])
        notes.append(
            f"{name}: {share(int(hit.sum()), len(asked))} of held-out rows nearly repeat one of train"
            f" ({100 * base:.1f} % between groups of train)"
        )
        worst |= hit.mean() > 0.01 or (hit.sum() >= 3 and hit.mean() > 3 * base)
        order = np.argsort(-value[hit])
        for a, b in zip(asked[hit][order], bank[best][hit][order], strict=True):
            rows += [a, b]
    return Finding(
        item="near-copies across splits",
        verdict="look" if worst else "ok" if compared else "not checkable",
        evidence="; ".join(notes),
        advice="look at the sheet (pairs side by side); if they are one contact or one scene, group them"
        if worst
        else "",
        rows=tuple(rows) if worst else (),
    )


def residuals(one: ImageStats, sensors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [N, F * F] of what sets each thumbnail apart, and which of them [N] show more than noise."""
    light = one.fine.astype(np.float32)
    for sensor in np.unique(sensors[one.has]):
        mine = (sensors == sensor) & one.has
        light[mine] -= np.median(light[mine][_some(np.arange(int(mine.sum())), 2000)], axis=0)
    light -= uniform_filter1d(uniform_filter1d(light, BLUR, axis=1), BLUR, axis=2)
    light = light.reshape(len(light), -1)
    light -= light.mean(axis=1, keepdims=True)
    clear = one.has & (light.std(axis=1) > FAINT)
    return light / np.maximum(np.linalg.norm(light, axis=1, keepdims=True), 1e-6), clear


def _some(rows: np.ndarray, num: int) -> np.ndarray:
    """At most ``num`` of ``rows``, evenly spread."""
    return rows if len(rows) <= num else rows[np.linspace(0, len(rows) - 1, num).astype(int)]


def _nearest(
    unit: np.ndarray, asked: np.ndarray, bank: np.ndarray, apart: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Place in ``bank`` and correlation of each asked row's nearest; with ``apart``, among other values of it only."""
    best, value = np.zeros(len(asked), int), np.full(len(asked), -1.0)
    for start in range(0, len(asked), 256):
        at = slice(start, start + 256)
        similar = unit[asked[at]] @ unit[bank].T
        if apart is not None:
            similar[apart[asked[at]][:, None] == apart[bank][None, :]] = -1
        best[at] = similar.argmax(1)
        value[at] = similar.max(1)
    return best, value
