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
    sides = sides_of(pack.column("split").astype(str))
    notes, rows = [], []
    for name, one in looks.items():
        _, first, numbers = np.unique(one.exact, return_index=True, return_inverse=True)
        if len(across := np.flatnonzero(np.isin(numbers, numbers[sides != sides[first[numbers]]]) & one.seen)):
            notes.append(f"{name}: {share(len(across), pack.num)} rows have a copy in another split")
            rows += across[np.argsort(numbers[across], kind="stable")].tolist()
    advice = "remove the copies, or put them in one group so that they stay in one split"
    found = "; ".join(notes) or "none"
    return judged("identical images across splits", found, advice, rows, look=False, broken=bool(notes))


def near_copies(pack: Pack, looks: dict[str, ImageStats]) -> Finding:
    """Find rows of val and test that are nearly identical to a row of train.

    Two rows are near-duplicates if their ``Residuals`` correlate by at least a threshold. It is halfway between 1 and
    the most similar rows of two *groups inside train*, at most ``NEAR``. The fraction of train rows above it measures
    how similar rows of this dataset are by nature, for example frames without contact.
    """
    sides, groups = sides_of(pack.column("split").astype(str)), pack.column("group").astype(str)
    notes, rows, suspicious, compared = [], [], False, False
    for name, one in looks.items():
        held_out = one.has & (sides != "train")
        if not held_out.any() or not (one.has & ~held_out).any():
            notes.append(f"{name}: all in one split")
            continue
        residuals = Residuals(one, pack.sensors)
        asked = _some(np.flatnonzero(residuals.clear & (sides != "train")), MAX_ASKED)
        bank = _some(np.flatnonzero(residuals.clear & (sides == "train")), MAX_SEARCHED)
        if not len(asked) or not len(bank):
            notes.append(f"{name}: too faint to compare")
            continue
        compared = True
        pairs, base = _near_pairs(residuals, asked, bank, groups, one.exact)
        rate = len(pairs) / len(asked)
        repeat = "of the held-out rows that are clear enough to compare nearly repeat one of train"
        notes.append(f"{name}: {share(len(pairs), len(asked))} {repeat} ({100 * base:.1f} % between groups of train)")
        suspicious |= rate > 0.01 or (len(pairs) >= 3 and rate > 3 * base)
        rows += pairs.ravel().tolist()
    item, evidence = "near-copies across splits", "; ".join(notes)
    if not compared:
        return Finding(item, "not checkable", evidence)
    advice = "see the pairs (--sheet FILE.png); if they are one contact or one scene, group them"
    return judged(item, evidence, advice, rows, look=suspicious)


class Residuals:
    """Brightness of thumbnails minus the sensor's median (gel background, fixed scene), minus its blur (unsteady lamps)."""

    def __init__(self, one: ImageStats, sensors: np.ndarray) -> None:
        self.sensors = sensors
        self.sharp = _sharp(one.fine)
        self.backgrounds = np.zeros((sensors.max() + 1, self.sharp.shape[1]), np.float32)
        self.clear = one.has.copy()  # bool [N], those that are more than noise
        for sensor in np.unique(sensors[one.has]):
            mine = np.flatnonzero((sensors == sensor) & one.has)
            self.backgrounds[sensor] = _sharp(np.median(one.fine[_some(mine, 2000)], axis=0)[None])[0]
            self.clear[mine] = (self.sharp[mine] - self.backgrounds[sensor]).std(axis=1) > FAINT

    def units(self, rows: np.ndarray, sensor: int) -> np.ndarray:
        """Unit vectors of ``rows`` as if ``sensor`` had seen them: a copy may be said to be of another one, or of none."""
        found = self.sharp[rows] - self.backgrounds[sensor]
        return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6)

    def nearest(self, asked: np.ndarray, bank: np.ndarray, apart: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return each asked row's nearest of ``bank``, and their correlation.

        With ``apart``, among other values of it and of the row's own sensor: what another pack holds may be copies.
        """
        best, value = np.zeros(len(asked), int), np.full(len(asked), -1.0)
        for sensor in np.unique(self.sensors[bank]):
            mine = bank[self.sensors[bank] == sensor]
            known = self.units(mine, sensor).T
            for start in range(0, len(asked), 256):
                at = slice(start, start + 256)
                similar = self.units(asked[at], sensor) @ known
                if apart is not None:
                    other = self.sensors[asked[at]] != sensor
                    similar[(apart[asked[at]][:, None] == apart[mine][None, :]) | other[:, None]] = -1
                most = similar.max(1)
                best[at] = np.where(most > value[at], mine[similar.argmax(1)], best[at])
                value[at] = np.maximum(most, value[at])
        return best, value


def _sharp(images: np.ndarray) -> np.ndarray:
    """[N, F, F] minus their blur and mean: [N, F * F]."""
    light = images.astype(np.float32)
    light -= uniform_filter1d(uniform_filter1d(light, BLUR, axis=1), BLUR, axis=2)
    light = light.reshape(len(light), -1)
    return light - light.mean(axis=1, keepdims=True)


def _near_pairs(
    residuals: Residuals, asked: np.ndarray, bank: np.ndarray, groups: np.ndarray, exact: np.ndarray
) -> tuple[np.ndarray, float]:
    """Pairs of rows [n, 2] that are near-duplicates, one of ``asked`` and one of ``bank``, the most similar first.
    Exact copies are left out. Also returns how common near-duplicates are between groups of ``bank``."""
    best, value = residuals.nearest(asked, bank, apart=None)
    _, natural = residuals.nearest(_some(bank, 500), bank, apart=groups)
    near = float(np.clip((1 + natural.max()) / 2, NEAR_AT_LEAST, NEAR)) if natural.max() > -1 else NEAR
    hit = (value >= near) & (exact[asked] != exact[best])
    order = np.argsort(-value[hit])
    return np.stack([asked[hit][order], best[hit][order]], axis=1), float((natural >= near).mean())


def _some(rows: np.ndarray, num: int) -> np.ndarray:
    return rows if len(rows) <= num else rows[np.linspace(0, len(rows) - 1, num).astype(int)]
