"""Events in time: thresholds, leads and alarms by hand; thresholds that never see test rows; through probe and report."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Event, Task
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs, stored_result
from mvitac.evaluation.events import choose_threshold, group_folds, lead_of, pool_events, score_event, shares
from mvitac.evaluation.probe import ProbeSplit, probe_features, split_rows
from mvitac.evaluation.scores import event_of, pool, summarise
from mvitac.recipes import recipe
from mvitac.training.loop import train

LENGTH = 8


class Grips(Source):
    """24 recordings of 8 objects, 8 frames each, 4 ticks apart. Every second object slips: it gets brighter from frame 4 on.

    Recordings 1, 4, 7, ... of those that slip are labelled frame by frame, the others as a whole.
    """

    def spec(self) -> DataSpec:
        task = Task(name="slip", classes=("holds", "slips"))
        return DataSpec(
            name="grips", vision_channels=0, touch_channels=3, tasks=(task,), group_by="object", licence="", source=""
        )

    def items(self) -> list[str]:
        return [str(i) for i in range(24)]

    def samples_per_item(self) -> list[int]:
        return [LENGTH] * 24

    def fingerprint(self) -> dict[str, Any]:
        return {"grips": 1}

    def read(self, item: int) -> list[Sample]:
        rng, thing = np.random.default_rng([3, item]), item // 3
        split = ("train", "train", "train", "train", "val", "val", "test", "test")[thing]
        found = []
        for f in range(LENGTH):
            level = 60 + 100 * (thing % 2 and f >= 4)
            image = np.clip(rng.normal(level, 12, (16, 16, 3)), 0, 255).astype(np.uint8)
            slips = thing % 2 and (f >= 4 if item % 3 == 1 else 1)
            columns = {"id": f"{item}-{f}", "group": f"o{thing}", "touch_group": f"r{item:02d}", "split": split}
            found.append(
                Sample(vision=None, touch=image, columns={**columns, "frame": 4 * f, "label_slip": int(slips)})
            )
        return found


@pytest.fixture(scope="module")
def grips(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return build(Grips(), tmp_path_factory.mktemp("grips") / "pack", size=16, workers=1, quiet=True)


def slip(pack: Pack, **options: Any) -> Task:
    return replace(pack.spec.tasks[0], event=Event(happens="slips", **options))


def as_probabilities(scores: np.ndarray) -> np.ndarray:
    return np.stack([1 - scores, scores], axis=1)


def test_the_threshold_is_the_lowest_that_keeps_the_rate() -> None:
    highest = [0.1, 0.9, 0.3, 0.7, 0.5, 0.2, 0.4, 0.8, 0.6, 0.0]
    assert choose_threshold(highest, 0.0) == 0.9
    assert choose_threshold(highest, 0.1) == 0.8 and choose_threshold(highest, 0.3) == 0.6
    assert choose_threshold(highest, 0.29) == 0.7  # three of ten would be more
    for share in (0.0, 0.1, 0.25, 0.5, 0.99):
        assert np.mean(np.array(highest) > choose_threshold(highest, share)) <= share


def recording(name: str, onset: float | None, alarm: float | None, group: str = "a") -> dict[str, Any]:
    return {
        "recording": name,
        "group": group,
        "onset": onset,
        "alarm": alarm,
        "highest": 0.5 + 0.5 * (alarm is not None),
    }


def test_leads_are_medians_over_recordings_with_an_exact_interval() -> None:
    event = {
        "recordings": [recording(f"r{i}", 100.0, 100.0 - lead) for i, lead in enumerate((50, 10, 90, 30, 70, -20))]
    }
    event["recordings"] += [recording("missed", 100.0, None), recording("held", None, 3.0)]
    assert lead_of([event]) == {"median": 40.0, "low": -20.0, "high": 90.0}  # 1 - 2 / 2^6 = 97 % of the time
    few = {"recordings": event["recordings"][:5]}
    assert lead_of([few]) == {"median": 50.0, "low": None, "high": None}  # 1 - 2 / 2^5 = 94 % would be too little
    many = {"recordings": [recording(f"r{i}", float(i), 0.0) for i in range(1, 18)]}  # 17: ranks 5 and 13 (tables)
    assert lead_of([many]) == {"median": 9.0, "low": 5.0, "high": 13.0}
    other = {
        "recordings": [{**r, "alarm": None if r["alarm"] is None else r["alarm"] - 8} for r in event["recordings"]]
    }
    assert lead_of([event, other])["median"] == 44.0  # a recording counts once: the mean of its seeds
    assert lead_of([{"recordings": [recording("missed", 1.0, None)]}])["median"] is None


def test_alarms_and_onsets_by_hand(grips: Pack) -> None:
    task, rows = slip(grips, fps=25, false_alarms=0.5), split_rows(grips, grips.spec.tasks[0])
    frame = grips.column("frame")
    # Of the recordings without slip that were not scored by their own probe, half stay below .4, half reach .6.
    number = grips.touch_groups[rows.fitted]
    held = as_probabilities(np.where(number % 2 == 0, 0.6, 0.4))
    test = rows.test
    score = np.where(frame[test] >= 12, 0.7, 0.2)  # above from the fourth frame on
    names = grips.column("touch_group")[test]
    score[names == "r18"] = 0.6  # r18, r19, r20 hold: one only reaches the threshold, two raise an alarm
    score[names == "r22"] = 0.1  # r21, r22, r23 slip, r22 from frame 4 on
    found = score_event(grips, task, rows.fitted, held, test, as_probabilities(score))
    assert found["threshold"] == 0.6 and found["unit"] == "ms" and found["class"] == "slips"
    each = {r["recording"]: (r["onset"], r["alarm"]) for r in found["recordings"]}
    end, half, first = 28 * 40.0, 16 * 40.0, 12 * 40.0  # frames are 40 ms
    assert each["r18"] == (None, None) and each["r19"] == each["r20"] == (None, first)
    assert each["r21"] == each["r23"] == (end, first) and each["r22"] == (half, None)
    assert [s["group_correct"] for s in shares([found], with_it=True)] == [[0, 2]]
    assert [s["group_sizes"] for s in shares([found], with_it=False)] == [[3, 0]]
    summary = event_of([found])
    assert summary["detected"]["mean"] == pytest.approx(2 / 3) and summary["false_alarms"]["mean"] == pytest.approx(
        2 / 3
    )
    assert summary["lead"]["median"] == end - first and summary["auroc"] == pytest.approx((2 + 0.5 * 4 + 0 * 3) / 9)
    clocked = slip(grips, clock="at", fps=1000)
    later = copy.copy(grips)
    later.table = grips.table.append_column("at", pa.array(frame * 3.0))
    assert score_event(later, clocked, rows.fitted, held, test, as_probabilities(score))["recordings"][3]["onset"] == 84
    frames = score_event(grips, slip(grips), rows.fitted, held, test, as_probabilities(score))
    assert frames["unit"] == "frames" and frames["recordings"][3]["onset"] == 28


def test_rows_are_put_in_order_of_time(grips: Pack) -> None:
    task, rows = slip(grips), split_rows(grips, grips.spec.tasks[0])
    mixed = np.random.default_rng(0).permutation(rows.test)
    score = 0.1 + grips.column("frame") / 100
    held = np.full((len(rows.fitted), 2), 0.25)
    straight, other = (
        score_event(grips, task, rows.fitted, held, r, as_probabilities(score[r])) for r in (rows.test, mixed)
    )
    assert straight["recordings"] == other["recordings"]
    assert {r["alarm"] for r in straight["recordings"]} == {16.0}  # .25 is reached at 15
    assert all(trace["times"] == sorted(trace["times"]) for trace in other["traces"])


def test_thresholds_come_from_probes_that_did_not_see_the_group(grips: Pack) -> None:
    """Features that name the group: a probe knows its own groups for certain, and nothing of others."""
    task, rows = slip(grips, false_alarms=0.0), split_rows(grips, grips.spec.tasks[0])
    x = 5.0 * np.eye(8)[np.unique(grips.column("group"), return_inverse=True)[1]]
    record = probe_features(x[rows.all], grips, task, rows, "linear", 0)
    own, _ = probe_threshold(grips, task, rows, x)
    assert own < 0.45 and record["event"]["threshold"] > 0.55
    far = np.concatenate([x[rows.fitted], 9 + x[rows.test]])
    assert probe_features(far, grips, task, rows, "linear", 0)["event"]["threshold"] == record["event"]["threshold"]


def probe_threshold(pack: Pack, task: Task, rows: ProbeSplit, x: np.ndarray) -> tuple[float, Any]:
    """The threshold if the fitted rows scored themselves."""
    from mvitac.evaluation.probe import fit_probe

    predict, _ = fit_probe(x[rows.fitted], pack, task, rows, "linear", 0)
    found = score_event(pack, task, rows.fitted, predict(x[rows.fitted]), rows.test, predict(x[rows.test]))
    return found["threshold"], predict


def test_folds_hold_out_every_row_once_with_its_whole_group() -> None:
    groups = np.array([f"g{i % 7}" for i in range(50)])
    seen = np.zeros(50, int)
    for fitted, val, held in group_folds(groups):
        assert not set(groups[held]) & set(groups[np.concatenate([fitted, val])])
        assert not set(groups[val]) & set(groups[fitted])
        assert len(fitted) + len(val) + len(held) == 50
        seen[held] += 1
    assert (seen == 1).all()


def test_folds_of_cross_validation_are_pooled_over_their_recordings() -> None:
    parts = [
        {
            "class": "slips",
            "unit": "ms",
            "threshold": 0.4,
            "recordings": [recording("a", 9.0, 1.0), recording("b", None, None)],
        },
        {
            "class": "slips",
            "unit": "ms",
            "threshold": 0.6,
            "recordings": [recording("c", 9.0, None, "b"), recording("d", None, 2.0, "b")],
        },
    ]
    whole = pool_events(parts)
    assert [r["recording"] for r in whole["recordings"]] == ["a", "b", "c", "d"] and whole["threshold"] is None
    summary = event_of([whole])
    assert summary["detected"]["mean"] == summary["false_alarms"]["mean"] == 0.5 and summary["lead"]["median"] == 8.0


@pytest.fixture(scope="module")
def scored(grips: Pack, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    run = recipe("smoke", PackConfig(path=grips.path))
    run = replace(run, augment=replace(run.augment, size=16), steps=2, eval_every=0, batch_size=8)
    out = train(run, tmp_path_factory.mktemp("event") / "run", quiet=True)
    return out, probe_runs([out], ProbeConfig(event=("slip=slips",), fps=25))


def test_a_probe_scores_the_event_of_runs_and_controls(grips: Pack, scored: tuple[Path, dict[str, Any]]) -> None:
    out, result = scored
    cells = result["summary"]["slip"]["touch"]
    assert {"mvitac", "untrained", "pixels", "border"} <= {source for source, cell in cells.items() if "event" in cell}
    event = cells["pixels"]["event"]
    assert event["detected"]["num"] == event["false_alarms"]["num"] == 3
    assert event["detected"]["mean"] == 1.0 and event["lead"]["median"] == 480.0  # bright from 640 ms on, of 1120
    assert stored_result([out], grips) == result  # the report reads it back
    plain = probe_runs([out], ProbeConfig(controls=False))
    assert "event" not in plain["records"][0] and "event" not in plain["summary"]["slip"]["touch"]["mvitac"]
    asked = next(r for r in result["records"] if r["source"] == "mvitac")
    assert plain["records"][0] == {key: value for key, value in asked.items() if key != "event"}
    folds = pool([[asked], [asked]])
    assert len(folds[0]["event"]["recordings"]) == 12 and "event" in summarise(folds)["slip"]["touch"]["mvitac"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"event": ("slip",)}, "event 'slip': give a task and its class"),
        ({"event": ("slap=slips",)}, "unknown task with classes 'slap'"),
        ({"event": ("slip=slides",)}, "unknown class of task 'slip' 'slides'"),
        ({"fps": 25.0}, "fps is for events"),
        ({"clock": "frame"}, "clock is for events"),
        ({"event": ("slip=slips",), "clock": "when"}, "unknown column 'when'"),
        ({"event": ("slip=slips",), "fps": 0.0}, r"fps 0\.0: give"),
        ({"event": ("slip=slips",), "false_alarms": 1.0}, r"false_alarms 1\.0: give a share"),
    ],
)
def test_events_that_cannot_be_asked(scored: tuple[Path, Any], options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        probe_runs([scored[0]], ProbeConfig(controls=False, **options))


def changed(pack: Pack, column: str, values: np.ndarray) -> Pack:
    other = copy.copy(pack)
    for name in ("_answers", "touch_groups"):
        other.__dict__.pop(name, None)
    other.table = pack.table.set_column(pack.table.schema.get_field_index(column), column, pa.array(values))
    return other


def test_events_that_cannot_be_scored(
    grips: Pack, scored: tuple[Path, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(pack: Pack) -> str:
        with pytest.raises(ValueError, match=r"event|frames") as error:
            probe_runs([scored[0]], ProbeConfig(controls=False, event=("slip=slips",)), pack, allow_leak=True)
        return str(error.value)

    split, label = grips.column("split"), grips.column("label_slip")
    assert "no recording in test is without it, among 6" in fails(
        changed(grips, "label_slip", np.where(split == "test", 1, label))
    )
    assert "no recording in test is with it" in fails(changed(grips, "label_slip", np.where(split == "test", 0, label)))
    assert "2 objects in train and val are too few" in fails(
        changed(grips, "group", np.where(split == "test", "a", np.where(split == "val", "b", "c")))
    )
    unordered = copy.copy(grips)
    unordered.table = grips.table.drop_columns(["frame"])
    assert "none of the columns frame, seq, time" in fails(unordered)
    assert main(["probe", str(scored[0]), "--event", "slip=slides"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
