"""Duplicates across splits: identical pixels, and near-duplicates by correlation of residual thumbnails."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from mvitac.data.checks.finding import Finding, judged, share
from mvitac.data.checks.image_stats import ImageStats
from mvitac.data.checks.table_checks import sides_of
from mvitac.data.pack import Pack

NEAR = 0.975  # upper limit of the correlation threshold for near-duplicates
NEAR_AT_LEAST = 0.85  # lower limit of the threshold, for datasets whose groups differ a lot
FAINT = 2.0  # standard deviation in grey levels below which a residual is noise and is not compared
BLUR = 5  # width of the blur that is subtracted, in thumbnail pixels
MAX_ASKED, MAX_SEARCHED = 2000, 40_000


def exact_copies(pack: Pack, looks: dict[str, ImageStats]) -> Finding:
    """Find identical images in different splits. Copies within a split are counted only."""
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
            notes.append(f"{name}: {share(len(across), pack.num)} rows have a copy in another split")
            rows += across.tolist()
    item = "identical images across splits"
    evidence = "; ".join(notes) or "none" + (f" (inside one split: {'; '.join(inside)})" if inside else "")
    advice = "remove the copies, or put them in one group so that they stay in one split"
    return judged(item, evidence, advice, rows, look=False, broken=bool(notes))


def near_copies(pack: Pack, looks: dict[str, ImageStats]) -> Finding:
    """Find rows of val and test that are nearly identical to a row of train.

    Each thumbnail is reduced to its residual (see ``residuals``); two rows are near-duplicates if these correlate by at
    least a threshold. The threshold is halfway between 1 and the most similar rows of two *groups inside train*, at most
    ``NEAR``. The fraction of train rows above it measures how similar rows of this dataset are by nature, for example
    frames without contact.
    """
    sides = sides_of(pack.column("split").astype(str))
    groups = pack.column("group").astype(str)
    notes, rows, suspicious, compared = [], [], False, False
    for name, one in looks.items():
        held_out = one.has & (sides != "train")
        if not held_out.any() or not (one.has & ~held_out).any():
            notes.append(f"{name}: all in one split")
            continue
        unit, clear = residuals(one, pack.sensors)
        asked = _some(np.flatnonzero(clear & (sides != "train")), MAX_ASKED)
        bank = _some(np.flatnonzero(clear & (sides == "train")), MAX_SEARCHED)
        if not len(asked) or not len(bank):
            notes.append(f"{name}: too faint to compare")
            continue
        compared = True
        pairs, base = _near_pairs(unit, asked, bank, groups, one.exact)
        rate = len(pairs) / len(asked)
        notes.append(
            f"{name}: {share(len(pairs), len(asked))} of held-out rows nearly repeat one of train"
            f" ({100 * base:.1f} % between groups of train)"
        )
        suspicious |= rate > 0.01 or (len(pairs) >= 3 and rate > 3 * base)
        rows += pairs.ravel().tolist()
    item, evidence = "near-copies across splits", "; ".join(notes)
    if not compared:
        return Finding(item, "not checkable", evidence)
    advice = "look at the sheet (pairs side by side); if they are one contact or one scene, group them"
    return judged(item, evidence, advice, rows, look=suspicious)


def _near_pairs(
    unit: np.ndarray, asked: np.ndarray, bank: np.ndarray, groups: np.ndarray, exact: np.ndarray
) -> tuple[np.ndarray, float]:
    """Pairs of rows [n, 2] that are near-duplicates, one of ``asked`` and one of ``bank``, the most similar first.

    Exact copies are left out. Also returns how common near-duplicates are between groups of ``bank``.
    """
    best, value = _nearest(unit, asked, bank)
    _, natural = _nearest(unit, _some(bank, 500), bank, apart=groups)
    near = float(np.clip((1 + natural.max()) / 2, NEAR_AT_LEAST, NEAR)) if natural.max() > -1 else NEAR
    hit = (value >= near) & (exact[asked] != exact[bank[best]])
    order = np.argsort(-value[hit])
    return np.stack([asked[hit][order], bank[best][hit][order]], axis=1), float((natural >= near).mean())


def residuals(one: ImageStats, sensors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors [N, F * F] of what is specific to each thumbnail, and which [N] are more than noise.

    A residual is the brightness minus the median thumbnail of the sensor (a gel's background, a fixed camera's scene),
    minus its own blur (lamps that drift).
    """
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
    return rows if len(rows) <= num else rows[np.linspace(0, len(rows) - 1, num).astype(int)]


def _nearest(
    unit: np.ndarray, asked: np.ndarray, bank: np.ndarray, apart: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return each asked row's nearest in ``bank`` (index, correlation); with ``apart``, only among other values of it."""
    best, value = np.zeros(len(asked), int), np.full(len(asked), -1.0)
    for start in range(0, len(asked), 256):
        at = slice(start, start + 256)
        similar = unit[asked[at]] @ unit[bank].T
        if apart is not None:
            similar[apart[asked[at]][:, None] == apart[bank][None, :]] = -1
        best[at] = similar.argmax(1)
        value[at] = similar.max(1)
    return best, value
