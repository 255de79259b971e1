"""Checks of the images, by thumbnails [N, S, S, 3] of ``ImageStats``. They compare rows of one dataset with each other."""

from functools import partial

import numpy as np

from mvitac.data.checks.finding import Finding, judged, share
from mvitac.data.checks.image_stats import ImageStats
from mvitac.data.pack import Pack
from mvitac.data.spec import listed

ORDER_COLUMNS = ("seq", "frame", "step", "time")  # columns that give the order of the rows of a group
MAX_LAG = 5
BLOCK = 48  # frames per measurement of the offset in a long sequence


def constant_frames(pack: Pack, looks: dict[str, ImageStats]) -> Finding:
    """Find constant images: a closed shutter, a failed decode, floats 0 to 1 stored as bytes."""
    found = {name: np.flatnonzero(one.has & ~one.seen) for name, one in looks.items()}
    rows = np.unique(np.concatenate(list(found.values()))).tolist()
    notes = [f"{m}: {share(len(r), pack.num)}, first {pack.column('id')[r[0]]}" for m, r in found.items() if len(r)]
    evidence = "; ".join(notes) or f"none among {pack.num} rows"
    advice = "look whether the sensor or the decoder failed, and leave these rows out"
    return judged("constant frames", evidence, advice, rows, look=bool(rows), broken=len(rows) > 0.05 * pack.num)


def red_and_blue(pack: Pack, looks: dict[str, ImageStats]) -> Finding:
    """Find a minority of images stored as BGR: their red minus blue mirrors that of the others.

    With d = R - B of every thumbnail [N, S * S], swapping channels turns d into -d. Along the first principal direction
    of d (not centred), a mixture therefore has two clusters that mirror each other around zero, with a gap between them.
    If colours vary from scene to scene there is no gap, and the check cannot decide; nor can it if all images are BGR.
    """
    notes, rows, compared = [], [], False
    for name, one in looks.items():
        if len(usable := np.flatnonzero(one.seen & ~one.gray)) < 8:
            notes.append(f"{name}: no colour to compare")
            continue
        usable = usable[np.linspace(0, len(usable) - 1, min(len(usable), 20_000)).astype(int)]
        swapped, decided, note = _mirrored(one.thumbs[usable].astype(np.float32))
        compared |= decided
        if swapped.any():
            rows += (mine := usable[swapped]).tolist()
            groups = listed(np.unique(pack.column("group")[mine].astype(str)).tolist(), 3)
            note = f"{share(len(mine), len(usable))} have red and blue mirrored, of {pack.spec.group_by} {groups}"
        notes.append(f"{name}: {note}")
    if not compared:
        return Finding("red and blue swapped", "not checkable", "; ".join(notes))
    advice = "see them (--sheet FILE.png); if they are BGR (OpenCV's order), reverse their channels when reading"
    return judged("red and blue swapped", "; ".join(notes), advice, rows, look=bool(rows))


def _mirrored(thumbs: np.ndarray) -> tuple[np.ndarray, bool, str]:
    """Return which of ``thumbs`` float32 [N, S, S, 3] are mirrored in d, whether that could be decided, and a note."""
    none = np.zeros(len(thumbs), bool)
    d = (thumbs[..., 0] - thumbs[..., 2]).reshape(len(thumbs), -1)
    p = d @ np.linalg.eigh(d.T @ d)[1][:, -1]
    p = p if np.sign(p).sum() >= 0 else -p
    typical = float(np.median(np.abs(p)))
    strength = typical / d.shape[1] ** 0.5  # grey levels of R - B per pixel
    between = float((np.abs(p) < typical / 3).mean())
    usual, other = p > typical / 2, p < -typical / 2
    if strength < 3 or between > 0.08:
        return none, False, f"colours vary too much to tell ({100 * between:.0f} % between the two orders)"
    if not other.any():
        return none, True, "all in one order"
    a, b = d[usual].mean(0), d[other].mean(0)
    alike = float(-(a @ b) / (np.linalg.norm(a) * np.linalg.norm(b)))
    even = thumbs[..., 1] + 0.5 * (thumbs[..., 0] + thumbs[..., 2])  # does not change when R and B are swapped
    apart = float(np.abs(even[other].mean(0) - even[usual].mean(0)).mean() / 2)
    if alike < 0.8 or apart > 30:
        return none, True, f"two kinds of colour, but no mirror images ({alike:.2f})"
    return other, True, ""


def time_offset(pack: Pack, looks: dict[str, ImageStats]) -> Finding:
    """Find a lag between motion in vision and in touch, by cross-correlation within ordered groups."""
    item = "time offset between streams"
    cannot = partial(Finding, item, "not checkable")
    column = next((name for name in ORDER_COLUMNS if name in pack.table.column_names), None)
    if len(pack.spec.modalities) < 2 or column is None:
        missing = f"no column {', '.join(ORDER_COLUMNS)} gives the order of rows"
        return cannot("one modality only" if column else missing)
    try:
        when = pack.column(column).astype(float)
    except ValueError:
        return cannot(f"column {column} holds no numbers")
    if len(curves := motion_correlations(pack, looks, when)) < 3:
        return cannot(f"{len(curves)} ordered sequences of {2 * MAX_LAG + 2} rows or more, 3 are needed")
    mean, error = curves.mean(0), curves.std(0, ddof=1) / len(curves) ** 0.5
    lag = (best := int(mean.argmax())) - MAX_LAG
    if mean[best] < 0.3 or mean[best] < 3 * error[best]:  # streams of other recordings gave up to .25
        return cannot(f"motion in vision and touch is unrelated (at best r = {mean[best]:.2f} at lag {lag})")
    gain = curves[:, best] - curves[:, MAX_LAG]
    certain = lag != 0 and gain.mean() > 3 * gain.std(ddof=1) / len(gain) ** 0.5 and gain.mean() > 0.05
    evidence = f"r = {mean[MAX_LAG]:.2f} at lag 0, best {mean[best]:.2f} at lag {lag} over {len(curves)} sequences"
    evidence += f": {'touch' if lag > 0 else 'vision'} comes {abs(lag)} rows late" * bool(certain)
    advice = "pair by timestamps if there are any, or shift one stream; motion that precedes contact can also do this"
    return judged(item, evidence, advice, look=bool(certain))


def motion_correlations(pack: Pack, looks: dict[str, ImageStats], when: np.ndarray) -> np.ndarray:
    """Return [sequences, 2 * MAX_LAG + 1]: correlation of motion in vision with motion in touch, by lag of touch."""
    light = {m: next(one for one in looks.values() if one.modality == m).light for m in ("vision", "touch")}
    groups, curves, both = pack.touch_groups, [], pack.has("vision") & pack.has("touch")
    order = np.lexsort((when, groups))
    for rows in np.split(order, np.flatnonzero(np.diff(groups[order])) + 1):
        rows = rows[np.isfinite(when[rows]) & both[rows]]
        for block in np.array_split(rows, max(1, len(rows) // BLOCK)):
            if len(block) < 2 * MAX_LAG + 3:
                continue
            energy = [np.log1p(np.abs(np.diff(light[m][block], axis=0)).mean((1, 2))) for m in ("vision", "touch")]
            if min(e.std() for e in energy) < 1e-3:
                continue  # a still camera, or repeated frames
            z = [(e - e.mean()) / e.std() for e in energy]
            n, lags = len(z[0]), range(-MAX_LAG, MAX_LAG + 1)
            pairs = ((z[0][max(0, -k) : n - max(0, k)], z[1][max(0, k) : n + min(0, k)]) for k in lags)
            curves.append([float(np.mean(a * b)) for a, b in pairs])
    return np.array(curves).reshape(-1, 2 * MAX_LAG + 1)
