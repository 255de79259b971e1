"""Events in time, such as slip: how early the probe of single frames raises an alarm, and how often for nothing.

A frame's score is the probability of the event's class. A recording (touch group) raises an alarm at its first frame whose
score is above a threshold. The threshold is chosen on recordings of train and val without the event, each scored by a probe
that was fitted on other groups, so that at most the stated share of them raises an alarm. Test rows have no part in it.

The onset is the first frame labelled with the class. Where the whole recording has that label, the onset is not known, and
the recording's last frame stands for it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import binom

from mvitac.data.pack import Pack
from mvitac.data.spec import Event, Task
from mvitac.data.windows import places
from mvitac.registry import unknown

NUM_FOLDS = 5
NUM_TRACES = 4  # recordings of each kind whose scores a record keeps for the report


def with_event(task: Task, event: Event) -> Task:
    """``task`` with ``event``, which must be one of its classes."""
    if event.happens not in task.classes:
        raise unknown(f"class of task {task.name!r}", event.happens, task.classes)
    return replace(task, event=event)


def check_event(pack: Pack, task: Task, fitted: np.ndarray, test: np.ndarray) -> None:
    """Check that the event of ``task`` can be scored on pack rows ``test`` by probes of rows ``fitted``.

    ValueError if frames have no order, there are fewer than three groups to fit on, or test has no recording with the
    event, or train or test has none without it.
    """
    assert task.event
    _times(pack, task.event)
    num = len(np.unique(pack.column("group")[fitted].astype(str)))
    if num < 3:
        raise ValueError(
            f"event {task.event.happens!r}: {num} {pack.spec.group_by}s in train and val are too few to choose a threshold"
            " on groups that the probe has not seen: at least 3 are needed"
        )
    for where, rows in (("train and val", fitted), ("test", test)):
        found = [r["onset"] is not None for r, _ in _recordings(pack, task, rows, np.zeros(len(rows)))]
        missing = "without" if all(found) else "with" if not any(found) and where == "test" else ""
        if missing:
            raise ValueError(
                f"event {task.event.happens!r}: no recording in {where} is {missing} it, among {len(found)}: name"
                " the column of the recording with --touch-group when the data is packed, or split the groups otherwise"
            )


def group_folds(groups: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Row numbers (train, val, held out) of up to five folds of whole ``groups`` [N]; each row is held out once."""
    names = np.random.default_rng(0).permutation(np.unique(groups))
    num = min(NUM_FOLDS, len(names))
    fold = {name: i % num for i, name in enumerate(names)}
    number = np.array([fold[group] for group in groups])
    for k in range(num):
        held, val = number == k, number == (k + 1) % num
        yield np.flatnonzero(~held & ~val), np.flatnonzero(val), np.flatnonzero(held)


def score_event(
    pack: Pack, task: Task, fitted: np.ndarray, held: np.ndarray, test: np.ndarray, predicted: np.ndarray
) -> dict[str, Any]:
    """Score the event of ``task`` on pack rows ``test``, with class probabilities ``predicted`` [len(test), K].

    ``held`` [len(fitted), K] are those of train and val, each row's by a probe that was fitted on other groups. Returns
    "threshold", "unit" of times, "recordings" (their name, group, onset, first alarm and highest score; None = there is
    none), and "traces": times and scores of some of them, drawn at random.
    """
    assert task.event
    k = task.classes.index(task.event.happens)
    known = _recordings(pack, task, fitted, held[:, k])
    threshold = choose_threshold([r["highest"] for r, _ in known if r["onset"] is None], task.event.false_alarms)
    found, traces = [], []
    for about, (times, scores) in _recordings(pack, task, test, predicted[:, k]):
        above = np.flatnonzero(scores > threshold)
        found.append({**about, "alarm": float(times[above[0]]) if len(above) else None})
        traces.append({**found[-1], "times": times.tolist(), "scores": [float(f"{score:.4g}") for score in scores]})
    drawn = np.random.default_rng(0).permutation(len(traces))
    each = ([traces[i] for i in drawn if (traces[i]["onset"] is not None) == with_it] for with_it in (True, False))
    about = {"class": task.event.happens, "false_alarms": task.event.false_alarms, "threshold": threshold}
    unit = _times(pack, task.event)[1]
    return {**about, "unit": unit, "recordings": found, "traces": [t for kind in each for t in kind[:NUM_TRACES]]}


def choose_threshold(highest: Sequence[float], share: float) -> float:
    """The lowest score that at most ``share`` of recordings without the event exceed, from their highest scores."""
    return float(np.sort(highest)[::-1][int(share * len(highest) + 1e-9)])


def pool_events(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Pool the events of cross-validation folds, whose test recordings differ. Each fold has its own threshold."""
    recordings = [recording for part in parts for recording in part["recordings"]]
    return {**parts[0], "threshold": None, "traces": [], "recordings": recordings}


def shares(events: Sequence[dict[str, Any]], *, with_it: bool) -> list[dict[str, Any]]:
    """Recordings and alarms per group, of recordings with the event or without it, as ``intervals.interval`` takes them."""
    names = sorted({recording["group"] for event in events for recording in event["recordings"]})
    found = []
    for event in events:
        mine = [r for r in event["recordings"] if (r["onset"] is not None) == with_it]
        place = np.array([names.index(r["group"]) for r in mine], int)
        alarms = np.array([r["alarm"] is not None for r in mine], float)
        sizes, alarmed = (np.bincount(place, weights=w, minlength=len(names)) for w in (None, alarms))
        found.append({"group_sizes": sizes.tolist(), "group_correct": alarmed.astype(int).tolist()})
    return found


def lead_of(events: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Median time from alarm to onset over the recordings that raised one, a mean over seeds each; negative = late.

    "low" and "high" are its exact 95 % interval over recordings (order statistics), None below six recordings.
    """
    leads: dict[str, list[float]] = {}
    for recording in (recording for event in events for recording in event["recordings"]):
        if recording["onset"] is not None and recording["alarm"] is not None:
            leads.setdefault(recording["recording"], []).append(recording["onset"] - recording["alarm"])
    each = np.sort([np.mean(found) for found in leads.values()])
    if not len(each):
        return {"median": None, "low": None, "high": None}
    out = int(binom.ppf(0.025, len(each), 0.5))  # this many may lie outside at each end
    low, high = (float(each[out - 1]), float(each[-out])) if out else (None, None)
    return {"median": float(np.median(each)), "low": low, "high": high}


def _times(pack: Pack, event: Event) -> tuple[np.ndarray, str]:
    """Time of each row [N] and its unit: ms, or what the clock counts if no rate is given."""
    name, place = places(pack, replace(pack.spec.window, order=event.clock or pack.spec.window.order))
    if event.fps or name == "time":
        return place * 1000 / (event.fps or 1), "ms"
    return place, {"frame": "frames", "seq": "frames"}.get(name, name)


def _recordings(
    pack: Pack, task: Task, rows: np.ndarray, scores: np.ndarray
) -> list[tuple[dict[str, Any], tuple[np.ndarray, np.ndarray]]]:
    """Each recording of ``rows``: its name, group, onset and highest score; and times and scores of its frames."""
    assert task.event
    happens = pack.labels(task.name)[rows] == task.classes.index(task.event.happens)
    times, groups, recording = _times(pack, task.event)[0][rows], pack.column("group")[rows], pack.touch_groups[rows]
    named = pack.column("touch_group" if "touch_group" in pack.table.column_names else "group")[rows]
    found = []
    for number in np.unique(recording):
        mine = np.flatnonzero(recording == number)
        mine = mine[np.argsort(times[mine], kind="stable")]
        onset = None
        if happens[mine].any():
            onset = float(times[mine[-1]] if happens[mine[0]] else times[mine][happens[mine]][0])
        about = {"recording": str(named[mine[0]]), "group": str(groups[mine[0]]), "onset": onset}
        found.append(({**about, "highest": float(scores[mine].max())}, (times[mine], scores[mine])))
    return found
