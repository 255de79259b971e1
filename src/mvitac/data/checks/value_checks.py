"""Checks of tasks with values: outliers, stuck sensors, test outside train, a shift in time."""

import numpy as np

from mvitac.data.checks.finding import Finding, judged, share
from mvitac.data.checks.image_stats import ImageStats
from mvitac.data.pack import Pack
from mvitac.data.spec import Target, ValueTask, Window
from mvitac.data.stamps import STAMPS, seconds
from mvitac.data.windows import places, recordings

STUCK_FRAMES = 10  # shortest constant stretch that is reported
BLOCK = 240  # rows of a long recording in which one shift is looked for, up to a third of them
CLEAR, GAIN, SHIFTED = 0.7, 0.05, 1 / 3
"""A block knows its shift if it correlates so much at some lag, and is shifted if that is so much more than at none. It is
reported if more than this share of them is (measured on the 33 grasps of docs/values.md)."""


def values(pack: Pack) -> list[Finding]:
    touches = _touches(pack)
    asked = [(task, t) for task in pack.spec.values for t in range(len(task.targets))]
    return [_finding(pack, task, task.targets[t], pack.values(task)[:, t], touches) for task, t in asked]


def _finding(pack: Pack, task: ValueTask, target: Target, found: np.ndarray, touches: list[np.ndarray]) -> Finding:
    item = f"values of {task.name}" + (f": {target.name}" if len(task.targets) > 1 else "")
    sides = {side: pack.rows(*splits, only=task.only, by=task.split) for side, splits in _SIDES.items()}
    measured = {side: rows[np.isfinite(found[rows])] for side, rows in sides.items()}
    if lacking := [side for side, rows in measured.items() if not len(rows)]:
        evidence = f"no row of {' and '.join(lacking)} has a value"
        broken = any(len(sides[side]) for side in lacking)  # else the pack has none such, to be scored alone
        return judged(item, evidence, "measure some or assign the splits again", broken=broken)
    rows = np.sort(np.concatenate(list(measured.values())))
    known = found[rows]
    low, middle, high = np.percentile(known, [0, 50, 100])
    evidence = [f"{len(rows)} rows, {low:.4g} to {high:.4g} {target.unit}, median {middle:.4g}"]
    if missing := sum(map(len, sides.values())) - len(rows):
        evidence.append(f"{share(missing, missing + len(rows))} rows of train, val and test have none")
    far = _outliers(rows, known, pack.own_ids)
    near = ~np.isin(rows, far[1])  # -1 is still a placeholder beside one -999
    checks = {
        "repair these cells, or leave them empty": far,
        "a placeholder or a saturated sensor: leave these cells empty": _placeholder(rows[near], known[near]),
        "a stuck or saturated sensor: leave these cells empty": _stuck(found, touches, pack.own_ids),
        "expect larger errors there, or split so that train covers test": _outside(
            found, pack.rows("train", only=task.only, by=task.split), measured["test"], target
        ),
    }
    wrong = {advice: note for advice, note in checks.items() if note[0]}
    evidence += [text for text, _ in wrong.values()]
    suspects = [row for _, suspicious in wrong.values() for row in suspicious]
    return judged(item, "; ".join(evidence), "; ".join(wrong), suspects, look=bool(wrong))


_SIDES = {"train": ("train", "val"), "test": ("test",)}
Note = tuple[str, list[int]]  # what is wrong ("" = nothing), and the rows to look at


def _touches(pack: Pack) -> list[np.ndarray]:
    """Rows of each touch in the order of time; empty if no column orders them."""
    try:
        return [*recordings(pack, places(pack, Window())[1], distinct=False)]
    except ValueError:
        return []


def _outliers(rows: np.ndarray, known: np.ndarray, ids: np.ndarray) -> Note:
    """At most 5 % of the values, beyond a gap twice as wide as the range of the others: such as -999 for "not measured"."""
    far, num = np.zeros(len(known), bool), max(1, len(known) // 20)
    for side in (known, -known):
        ordered = np.sort(side)
        inside, outside = ordered[-num - 1 : -1], ordered[-num:]
        apart = outside[(outside - inside > 2 * (inside - ordered[num])) & (inside > ordered[num])]
        far |= side >= apart.min(initial=np.inf)
    if not far.any():
        return "", []
    usual = f"(the others are {known[~far].min():.4g} to {known[~far].max():.4g})"
    return f"{int(far.sum())} outliers, e.g. {known[far][0]:.4g} in row {ids[rows[far][0]]} {usual}", rows[far].tolist()


def _placeholder(rows: np.ndarray, known: np.ndarray) -> Note:
    """The lowest or the highest value in over 5 % of the rows, where hardly another one repeats: such as -1 among forces."""
    values, counts = np.unique(known, return_counts=True)
    distinct = len(values) - 1 > 0.8 * (len(known) - counts.max())
    if not distinct or counts.argmax() not in (0, len(values) - 1) or counts.max() <= max(3, len(known) / 20):
        return "", []
    at = np.flatnonzero(known == (value := values[counts.argmax()]))
    return (f"{share(len(at), len(known))} rows have {value:.4g} exactly", rows[at].tolist()) if value else ("", [])


def _stuck(found: np.ndarray, touches: list[np.ndarray], ids: np.ndarray) -> Note:
    """Stretches of one recording with the same value other than 0, which is what no contact measures."""
    parts: list[np.ndarray] = []
    for rows in (rows[np.isfinite(found[rows])] for rows in touches):
        parts += np.split(rows, np.flatnonzero(np.diff(found[rows])) + 1)
    short = [len(part) for part in parts if 0 < len(part) < STUCK_FRAMES]
    stretches = [part for part in parts if len(part) >= STUCK_FRAMES and found[part[0]] != 0]
    # Coarse numbers, such as a gripper's width, and those given once per press repeat themselves anyway.
    if not stretches or sum(short) > 1.1 * len(short) or sum(map(len, stretches)) > 0.5 * sum(map(len, parts)):
        return "", []
    longest = max(stretches, key=len)
    text = f"{len(stretches)} constant stretches, the longest {len(longest)} frames of {found[longest[0]]:.4g}"
    return f"{text} from row {ids[longest[0]]}", [int(part[0]) for part in stretches]


def _outside(found: np.ndarray, rows: np.ndarray, test: np.ndarray, target: Target) -> Note:
    if not len(train := found[rows][np.isfinite(found[rows])]):
        return "", []
    margin = 0.05 * (train.max() - train.min())
    beyond = test[(found[test] < train.min() - margin) | (found[test] > train.max() + margin)]
    if len(beyond) <= 0.01 * len(test):
        return "", []
    text = f"{share(len(beyond), len(test))} test rows are outside train ({train.min():.4g} to {train.max():.4g}"
    return f"{text} {target.unit})", beyond.tolist()


def time_shift(pack: Pack, looks: dict[str, ImageStats]) -> Finding:
    """Find values that are late or early: |frame - first frame| of a touch, correlated with each value by lag."""
    item = "time shift between images and values"
    if not (touches := _touches(pack)):
        return Finding(item, "not checkable", "no column that orders the rows")
    modality, change = pack.spec.modalities[-1], np.zeros(pack.num)
    for light in (look.light for look in looks.values() if look.modality == modality):
        for rows in touches:
            change[rows] += abs(light[rows] - light[rows[0]]).mean((1, 2))
    change[~pack.has(modality)] = np.nan
    clock = next((seconds(pack.column(c).astype(str), c) for c in STAMPS if c in pack.table.column_names), None)
    notes, suspects = [], []
    for task in pack.spec.values:
        for t, target in enumerate(task.targets):
            blocks = (block for rows in touches for block in np.array_split(rows, -(-len(rows) // BLOCK)))
            found = [_shift(change, pack.values(task)[:, t], block) for block in blocks]
            sign = np.sign(sum(curve[abs(curve).argmax()] for _, curve in found)) or 1.0
            known = [(rows, sign * curve) for rows, curve in found if (sign * curve).max() >= CLEAR]
            late = [(rows, _lag(c)) for rows, c in known if c.max() - c[len(c) // 2] > GAIN]
            if not known:
                continue
            lag = float(np.median([lag for _, lag in late])) if late else 0
            note = f"{target.name}: {len(late)} of {len(known)} sequences fit better shifted"
            if len(late) > SHIFTED * len(known):
                steps = [np.median(np.diff(clock[rows])) for rows, _ in late] if clock is not None else [np.nan]
                time = f" ({abs(lag) * np.median(steps):.2g} s)" * bool(np.isfinite(steps).all())
                spread = [lag for _, lag in late]
                note += f", where values come {abs(lag):g} rows{time} {'late' if lag > 0 else 'early'}"
                note += f" (median; {min(spread)} to {max(spread)})"
                suspects += [int(rows[0]) for rows, _ in late]
            notes.append(note)
    if not notes:
        return Finding(item, "not checkable", f"no value follows |frame - first frame| of {modality}")
    advice = "join by better time stamps, or shift the log: --log FILE:COLUMN-SECONDS if it is late, +SECONDS if early"
    return judged(item, "; ".join(notes), advice, suspects, look=bool(suspects))


def _lag(curve: np.ndarray) -> int:
    """Return the smallest lag with a peak as high as any: regular presses fit again one press later."""
    peak = (curve >= np.r_[-1, curve[:-1]]) & (curve >= np.r_[curve[1:], -1])
    lags = np.flatnonzero(peak & (curve >= curve.max() - 0.02)) - len(curve) // 2
    return int(lags[abs(lags).argmin()])


def _shift(change: np.ndarray, value: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``rows`` and the correlation of ``change`` with a ``value`` that is k rows late, k from -L to L."""
    longest, curve = len(rows) // 3, []
    for lag in range(-longest, longest + 1):
        a, b = change[rows[max(0, -lag) : len(rows) - max(0, lag)]], value[rows[max(0, lag) : len(rows) + min(0, lag)]]
        both = np.isfinite(a) & np.isfinite(b)
        still = both.sum() < 16 or min(np.ptp(a[both]), np.ptp(b[both])) < 1e-6
        curve.append(0.0 if still else np.corrcoef(a[both], b[both])[0, 1])
    return rows, np.array(curve)
