"""Two clocks: logs and second cameras joined by time, and recordings without a table."""

import copy
import csv
import json
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mvitac.data.build import build
from mvitac.data.checks.examine import examine_source
from mvitac.data.checks.image_stats import look_at
from mvitac.data.checks.value_checks import time_shift
from mvitac.data.pack import Pack
from mvitac.data.stamps import seconds
from mvitac.datasets.folder import FolderConfig
from mvitac.datasets.table.clocks import times_of
from support.videos import film, picture, shade, write_video

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "wedge_force" / "manifest.csv"
START = 1_700_000_000.0


def packed(path: Path, out: Path, **options: Any) -> Pack:
    return build(FolderConfig(path=path, size=16, **options).source(), out, size=16, quiet=True)


def write_csv(file: Path, **columns: Any) -> Path:
    lines = [",".join(columns), *(",".join(map(str, cells)) for cells in zip(*columns.values(), strict=True))]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines))
    return file


def force(times: np.ndarray) -> np.ndarray:
    return 3 * times + 1


def recorded(root: Path, *, num: int = 3, shift: float = 0.0, ends: tuple[float, float] = (-0.1, 2.1)) -> Path:
    """Videos of 50 frames at 25 Hz, each with a force log at 100 Hz; Fz = 3 t + 1, label = the second."""
    for k in range(num):
        film(root / f"{k}/gel.mp4", 50, which=k)
        times = np.arange(*ends, 0.01) + 0.003
        write_csv(root / f"{k}/force.csv", stamp=times + shift, Fz=force(times), kind=(times >= 1).astype(int))
    return root


LOG: dict[str, Any] = {"touch": ("gel",), "log": ("force.csv:stamp",), "values": ("Fz:N",), "every": 1}


@pytest.mark.parametrize("how", ["linear", "nearest"])
def test_a_log_is_joined_by_time(tmp_path: Path, how: Any) -> None:
    pack = packed(recorded(tmp_path / "set"), tmp_path / "p", labels=("kind",), interpolate=how, **LOG)
    time, found = pack.column("time").astype(float), pack.values(pack.spec.values[0])[:, 0]
    assert pack.num == 150 and pack.spec.group_by == "recording" and set(pack.column("group")) == {"0", "1", "2"}
    near = np.round((time - 0.003) / 0.01) * 0.01 + 0.003
    assert np.allclose(found, force(time if how == "linear" else near), atol=1e-6)
    assert np.allclose(abs(found - force(time)).max(), 0 if how == "linear" else 0.009, atol=1e-6)
    assert (pack.column("label_kind") == (near >= 1)).all()  # a class is never between two others
    more: dict[str, Any] = {"controls": ("c=kind", "f=Fz"), "values": ("Fz:N", "x=kind:1")}
    named = packed(tmp_path / "set", tmp_path / "named", labels=("kind",), interpolate=how, **(LOG | more))
    for name in ("label_kind", "Fz"):
        assert (named.column(name) == pack.column(name)).all()
    assert set(named.column("kind").astype(float)) == {0, 1}
    for i in range(pack.num):
        frame = shade(int(pack.column("frame")[i]), int(pack.column("recording")[i]))
        assert abs(pack.images["touch"][i].mean() - frame) < 6
    assert "force.csv joined by stamp, its largest gap is 0.01 s" in pack.spec.notes
    for log in tmp_path.glob("set/*/force.csv"):  # a second sensor writes into it, in rows of its own
        head, *lines = log.read_text().split()
        both = [(f"{line},", f"{float(line.split(',')[0]) + 0.005},,,25") for line in lines]
        log.write_text("\n".join([f"{head},T", *(line for pair in both for line in pair)]))
    two = packed(tmp_path / "set", tmp_path / "two", labels=("kind",), interpolate=how, **LOG)
    assert (two.values(two.spec.values[0])[:, 0] == found).all()
    assert (two.column("label_kind") == pack.column("label_kind")).all()


def test_nothing_is_extrapolated_and_what_is_left_out_is_counted(tmp_path: Path) -> None:
    root = recorded(tmp_path / "set", ends=(0.5, 1.5))
    lines = (root / "0/force.csv").read_text().splitlines()
    (root / "0/force.csv").write_text("\n".join(lines[:40] + lines[60:]))  # no measurement from .893 to 1.093 s
    pack = packed(root, tmp_path / "p", **LOG)
    time, own = pack.column("time").astype(float), pack.column("recording")
    assert time.min() >= 0.503 and time.max() <= 1.493 and not ((time > 0.893) & (time < 1.093) & (own == "0")).any()
    assert ((time > 0.893) & (time < 1.093) & (own == "1")).sum() == 5
    (note,) = pack.spec.notes
    lost = f"{150 - pack.num} of 150 rows left out: no measurement within .* before and after"
    assert re.fullmatch(rf"force\.csv joined by stamp, its largest gap is 0\.21 s; {lost}", note)
    time = (wide := packed(root, tmp_path / "w", **LOG, tolerance=0.2)).column("time").astype(float)
    assert ((time > 0.893) & (time < 1.093)).sum() == 15
    assert np.allclose(wide.values(wide.spec.values[0])[:, 0], force(time), atol=1e-6)


def test_a_clock_that_is_off_is_named_and_set_right(tmp_path: Path) -> None:
    root = recorded(tmp_path / "set", shift=START)
    with pytest.raises(ValueError, match=r"force\.csv has no time within 0\.02 s .*, 0\.000 to 1\.960 s, but 16999"):
        packed(root, tmp_path / "no", **LOG)
    pack = packed(root, tmp_path / "p", **{**LOG, "log": (f"force.csv:stamp-{START:.0f}",)})
    assert np.allclose(pack.values(pack.spec.values[0])[:, 0], force(pack.column("time").astype(float)), atol=1e-4)
    for k in range(3):  # stamps of the images, but for rounding, and further apart than the tolerance
        write_csv(root / f"{k}/late.csv", stamp=0.04 * np.arange(50) + 0.35, Fz=np.arange(50))
    assert packed(root, tmp_path / "late", **{**LOG, "log": ("late.csv:stamp-0.35",)}).num == 150


def test_times_of_frames_may_stand_beside_the_video(tmp_path: Path) -> None:
    """One log for all, in ns since 1970, and the times of the frames in a file, in other words as dates."""
    times = START + 0.05 * np.arange(50)
    for k, name in enumerate(("a", "b")):
        film(tmp_path / f"set/{name}.mp4", 50, which=k)
    dates = [str(np.datetime64(round(t * 1e6), "us")) + "+00:00" for t in times]
    write_csv(tmp_path / "set/a_timestamps.csv", stamp=dates)
    (tmp_path / "set/b_timestamps.txt").write_text("\n".join(f"{t + 5:.3f}" for t in times))
    log = START + np.r_[-1:3:0.01, 4.5:9:0.01]  # nothing between the two
    write_csv(tmp_path / "logs.csv", ns=(log * 1e9).astype(int), Fz=force(log - START))
    pack = packed(tmp_path / "set", tmp_path / "p", log=("../logs.csv:ns",), values=("Fz:N",))
    frame, late = pack.column("frame").astype(int), 5 * (pack.column("recording") == "b")
    assert pack.num == 20 and np.allclose(pack.values(pack.spec.values[0])[:, 0], force(0.05 * frame + late), atol=1e-3)
    assert "its largest gap is 0.01 s" in pack.spec.notes[0]


def test_two_cameras_out_of_step_are_paired_by_time(tmp_path: Path) -> None:
    for k in range(3):
        film(tmp_path / f"set/{k}/gel.mp4", 50, which=k, rate=25)
        film(tmp_path / f"set/{k}/camera.mp4", 18, which=k + 1, rate=10)
    film(tmp_path / "set/0/wrist.mp4", 5)  # not asked for
    names: dict[str, Any] = {"touch": ("gel",), "vision": "camera", "every": 2}
    pack = packed(tmp_path / "set", tmp_path / "p", tolerance=0.05, **names)
    time, which = pack.column("time").astype(float), pack.column("recording")
    for i in range(pack.num):
        k = int(which[i][0])
        assert abs(pack.images["touch"][i].mean() - shade(round(25 * time[i]), k)) < 6
        nearest = min(range(18), key=lambda frame: abs(frame / 10 - time[i]))
        assert abs(nearest / 10 - time[i]) <= 0.05 and abs(pack.images["vision"][i].mean() - shade(nearest, k + 1)) < 6
    assert "gel and camera are paired by time, at most 0.04 s apart; 9 frames without a partner" in pack.spec.notes[0]
    assert pack.num == 3 * 22
    write_csv(tmp_path / "set/1/gel_timestamps.csv", time=100 + np.arange(50) / 25)  # the other camera's begin at 0
    says = r"set: 1 has no frame .* camera 0\.000 to 1\.700 s; gel 100\.000 to 101\.960 s"
    with pytest.raises(ValueError, match=says):
        packed(tmp_path / "set", tmp_path / "q", tolerance=0.05, **names)


def test_a_list_of_another_camera_is_a_log(tmp_path: Path) -> None:
    def pictures(folder: str, modality: str, times: np.ndarray, **columns: list[int]) -> Path:
        names = [f"{i}.png" for i in range(len(times))]
        for i, name in enumerate(names):
            picture(tmp_path / folder / name, 5 * i)
        return write_csv(tmp_path / folder / "list.csv", **{modality: names}, time=times, **columns)

    gel = pictures("gel", "touch", np.arange(30) / 30, take=[i // 10 for i in range(30)])
    pictures("cam", "vision", np.arange(15) / 15 + 0.01)
    pack = packed(gel, tmp_path / "p", group="take", log=("../cam/list.csv:time",), tolerance=0.03)
    red = {m: pack.images[m][:, 0, 0, 0].astype(int) // 5 for m in ("touch", "vision")}
    assert pack.num == 30 and (abs(red["touch"] / 30 - red["vision"] / 15 - 0.01) <= 0.03).all()


def spoil(*rows: int, **cells: Callable[[str], str]) -> Callable[[Path], None]:
    """Change cells of the first recording's log in ``rows`` (from 1; default: all)."""

    def change(root: Path) -> None:
        with (file := root / "0/force.csv").open(newline="") as stream:
            lines = list(csv.DictReader(stream))
        for i, line in enumerate(lines, 1):
            line |= {name: made(line[name]) for name, made in cells.items() if i in (rows or (i,))}
        write_csv(file, **{name: [line[name] for line in lines] for name in lines[0]})

    return change


def own_times(name: str, *lines: object) -> Callable[[Path], None]:
    return lambda root: (root / "0" / f"gel_timestamps.{name}").write_text("\n".join(map(str, lines))) and None


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda root: (root / "0/force.csv").rename(root / "force.csv"), r"would be the log of 2 recordings"),
        (spoil(stamp=lambda cell: str(round(1000 * float(cell)) + 97)), r"stamps are 10 s apart, .*: are they seconds"),
        (spoil(36, Fz=lambda _: "1 N"), r"row 36: Fz is '1 N': give a finite number"),
        (spoil(36, stamp=lambda _: "then"), r"force\.csv, column stamp: 'then' is no time: give seconds"),
        (own_times("txt", *range(30), 20, *range(31, 50)), r"gel_timestamps\.txt: time 31 is before the one above it"),
        (own_times("txt", *range(49), float("nan")), r"gel_timestamps\.txt: 'nan' is no time"),
        (
            lambda root: (root / "0/gel_timestamps.txt").symlink_to("none"),
            r"No such file or directory: .*gel_timestamps\.txt",
        ),
        (lambda root: os.mkfifo(root / "0/gel_timestamps.txt"), r"gel_timestamps\.txt is neither a file nor a folder"),
        (own_times("csv", "time", *[1.5] * 50), r"gel_timestamps\.csv: all 50 times are 1\.5 s: a clock that stands"),
        (spoil(stamp=lambda _: "0.3"), r"force\.csv, column stamp: all \d+ times are 0\.3 s: a clock that stands"),
        (own_times("csv", *range(51)), r"gel_timestamps\.csv: unknown column 'time'"),
        (own_times("txt", *range(49)), r"gel_timestamps\.txt has 49 times, gel\.mp4 has 50 frames"),
        (
            lambda root: [own_times(kind, "time", *range(50))(root) for kind in ("txt", "csv")],
            r"gel_timestamps\.txt and gel_timestamps\.csv both have the times of gel\.mp4",
        ),
    ],
)
def test_logs_that_would_give_wrong_numbers(tmp_path: Path, change: Callable[[Path], None], says: str) -> None:
    change(recorded(tmp_path / "set", num=2))
    with pytest.raises((ValueError, OSError), match=says):
        packed(tmp_path / "set", tmp_path / "p", **LOG)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"log": ("force.csv",)}, r"log 'force\.csv': write FILE:COLUMN"),
        ({"log": ("force:stamp",)}, r"force cannot be read as a table: it is no file of \.csv"),
        ({"log": ("force.csv:stamp",), "labels": ("gel",)}, "column 'gel' holds images, not text or numbers"),
        ({"log": ("back.csv:t",)}, r"back\.csv: the clock goes back after row 2: mend it"),
        ({"log": ("twice.csv:t-1",)}, r"has a column 't-1', which reads as 't' and a shift: rename it"),
        ({"log": ("pipe.csv:stamp",)}, r"pipe\.csv cannot be read as a table: it is no file of"),
        ({"log": ("force.csv:stamp", "force.csv:stamp")}, r"both have a column 'Fz': rename one"),
    ],
)
def test_logs_that_cannot_be_joined(tmp_path: Path, options: dict[str, Any], says: str) -> None:
    root = recorded(tmp_path / "set", num=1)
    os.mkfifo(root / "0/pipe.csv")  # reading it would wait for ever
    write_csv(root / "0/twice.csv", **{"t": [0, 1], "t-1": [1, 2]})
    write_csv(root / "0/back.csv", t=[0, 1, 0.4, 1.4], x=[0, 1, 2, 3])
    with pytest.raises(ValueError, match=says):
        packed(root, tmp_path / "p", **{**LOG, **options})


def test_rows_with_one_stamp_are_counted(tmp_path: Path) -> None:
    root = recorded(tmp_path / "set", num=2)
    spoil(36, stamp=lambda _: "0.34")(root)
    spoil(37, 38, stamp=lambda _: "0.29")(root)
    own_times("txt", *(round(0.04 * i, 1) for i in range(50)))(root)
    pack = packed(root, tmp_path / "p", **LOG)
    note = next(note for note in pack.spec.notes if "joined" in note)
    assert "of its rows have the stamp of another, of which one counts, and 1 of these say something else" in note
    for i in np.flatnonzero(pack.column("recording") == "0"):  # frames of one stamp are themselves
        assert abs(pack.images["touch"][i].mean() - shade(int(pack.column("frame")[i]), 0)) < 6


def test_stamps_are_seconds_whatever_their_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    times = START + np.array([0.25, 3.5])
    for scale in (1, 1e3, 1e6, 1e9):
        assert np.allclose(seconds([f"{t * scale:.0f}" if scale > 1 else str(t) for t in times], ""), times, atol=1e-3)
    assert np.isnan(seconds(["", "1"], "")[0]) and seconds(["1.5"], "")[0] == 1.5
    monkeypatch.setenv("TZ", "America/New_York")  # a date without an offset is the same on every computer
    time.tzset()
    assert np.allclose(seconds(["2023-11-14T22:13:20.25", "2023-11-14T17:13:23.5-05:00"], ""), times)
    monkeypatch.undo()
    time.tzset()


def test_a_table_of_videos_takes_the_times_beside_them_and_elements_of_lists_from_a_log(tmp_path: Path) -> None:
    """The camera ran at half the rate that its file says."""
    for k in range(3):
        film(tmp_path / f"{k}/gel.mp4", 50, which=k)
        (tmp_path / f"{k}/gel_timestamps.txt").write_bytes(b"0.0 \xe9")
        with pytest.raises(ValueError, match=r"gel_timestamps\.txt: .* is no time"):
            times_of(tmp_path / f"{k}/gel.mp4")
        (tmp_path / f"{k}/gel_timestamps.txt").write_text("\n".join(str(0.08 * i) for i in range(50)))
        rows = [{"stamp": t, "wrench": [0, force(t)]} for t in np.arange(-1, 5, 0.01).tolist()]
        (tmp_path / f"{k}/force.jsonl").write_text("\n".join(map(json.dumps, rows)))
    cells = [(f"{k}/gel.mp4", i, k) for k in range(3) for i in range(50)]
    write_csv(tmp_path / "m.csv", **dict(zip(("touch", "frame", "take"), zip(*cells, strict=True), strict=True)))
    options: dict[str, Any] = {"log": ("force.jsonl:stamp",), "values": ("wrench[1]:N",), "group": "take"}
    pack = packed(tmp_path / "m.csv", tmp_path / "p", **options)
    expected = force(0.08 * pack.column("frame").astype(int))
    assert np.allclose(pack.values(pack.spec.values[0])[:, 0], expected, atol=1e-6)
    with (tmp_path / "2/force.jsonl").open("a") as log:
        log.write('\n{"stamp": 5.01, "wrench": []}\n{"stamp": 5.02, "wrench": [0]}')
    with pytest.raises(ValueError, match=r"2/force.jsonl row 602: wrench\[1\] does not exist: wrench has 1 numbers"):
        FolderConfig(path=tmp_path / "m.csv", size=16, **options).source()
    (tmp_path / "2/force.jsonl").write_text('{"stamp": 0, "wrench": [[1, 2], [3, 4]]}')
    with pytest.raises(ValueError, match=r"2/force.jsonl row 1: wrench has lists in a list"):
        FolderConfig(path=tmp_path / "m.csv", size=16, **options).source()


def test_videos_without_labels_are_data(tmp_path: Path) -> None:
    """All to train on but a little val: of few videos their ends, of many every tenth."""
    for k in range(3):
        film(tmp_path / f"few/{k}.mp4", 50, which=k)
    pack = packed(tmp_path / "few", tmp_path / "p")
    split, frame, group = pack.column("split"), pack.column("frame").astype(int), pack.column("group")
    assert pack.num == 30 and not pack.spec.all_tasks and set(frame) == set(range(0, 50, 5))
    assert ((split == "val") == (frame == 45)).all() and set(split) == {"train", "val"}
    assert not set(group[split == "val"]) & set(group[split == "train"])
    for k in range(20):
        film(tmp_path / f"many/{k:02d}.mp4", 6)
    pack = packed(tmp_path / "many", tmp_path / "q", pictures="vision", every=3)
    assert pack.spec.modalities == ("vision",) and pack.num == 40
    assert set(pack.column("group")[pack.column("split") == "val"]) == {"09", "19"}


def test_images_without_labels_are_one_recording(tmp_path: Path) -> None:
    for i in range(20):
        picture(tmp_path / f"digit/frame_{i}.png", 10 * i)
    pack = packed(tmp_path / "digit", tmp_path / "p")
    assert pack.images["touch"][:, 0, 0, 0].tolist() == [10 * i for i in range(20)]  # 2 before 10
    assert pack.column("split").tolist() == ["train"] * 18 + ["val"] * 2 and "time" not in pack.table.column_names
    for i in range(20):
        (tmp_path / f"digit/frame_{i}.png").rename(tmp_path / f"digit/{START + i / 10:.1f}.png")
    times = START + np.arange(-1, 4, 0.05)
    write_csv(tmp_path / "force.csv", t=times, Fz=force(times - START))
    joined = packed(tmp_path / "digit", tmp_path / "q", log=("../force.csv:t",), only=("Fz>=2.5",), every=1)
    assert joined.images["touch"][:, 0, 0, 0].tolist() == [10 * i for i in range(5, 20)]


def pressing(root: Path, num: int, seconds: float) -> Path:
    """Videos at 25 Hz of a gel with presses at random times, and the force (the depth squared, and noise) at 100 Hz."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 48))
    for k in range(num):
        middles = np.arange(0.8, seconds, 1.4) + rng.uniform(-0.4, 0.4, len(np.arange(0.8, seconds, 1.4)))
        depth = lambda t, m=middles: np.exp(-(((t[:, None] - m) / 0.25) ** 2)).max(1)  # noqa: E731
        shown = depth(np.arange(round(25 * seconds)) / 25)
        place = rng.uniform(-0.5, 0.5, 2)

        def frame(i: int, shown: np.ndarray = shown, place: np.ndarray = place) -> np.ndarray:
            mark = 120 * shown[i] * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 0.1)
            noise = np.random.default_rng(i).normal(0, 3, (48, 64))
            return np.repeat((90 + mark + noise).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)

        write_video(root / f"{k}/gel.mp4", len(shown), frame, rate=25)
        times = np.arange(-1, seconds + 1, 0.01)
        write_csv(root / f"{k}/force.csv", stamp=times, Fz=8 * depth(times) ** 2 + rng.normal(0, 0.1, len(times)))
    return root


@pytest.mark.parametrize(("num", "seconds", "every"), [(6, 3.0, 1), (6, 9.0, 5), (3, 30.0, 2)])
def test_the_check_finds_a_shift_and_its_size(tmp_path: Path, num: int, seconds: float, every: int) -> None:
    root = pressing(tmp_path / "set", num, seconds)
    for shift in (0.0, 0.5, -0.5):
        log = {"log": (f"force.csv:stamp{shift:+}",), "every": every, "tolerance": 0.05}
        config = FolderConfig(path=root, size=32, test_share=0.4, **{**LOG, **log})
        findings = examine_source(config.source(), size=32, quiet=True)
        (found,) = [one for one in findings if one.item == "time shift between images and values"]
        assert found.verdict == ("look" if shift else "ok"), found
        if shift:
            told = re.search(r"values come [\d.]+ rows \(([\d.]+) s\) (late|early)", found.evidence)
            assert told and told[2] == ("late" if shift > 0 else "early")
            assert abs(float(told[1]) - 0.5) <= max(0.04, every / 50 + 0.001), found


@pytest.mark.skipif(not REAL.is_file(), reason="wedge_force is not beside the project")
def test_the_check_finds_shifts_of_real_grasps(tmp_path: Path) -> None:
    """33 grasps of a GelSight Wedge at 30 Hz with force: as recorded, shifted alike, and each by its own shift."""
    pack = packed(REAL, tmp_path / "p", vision="", values=("force_n:N",), group="object", touch_group="recording")
    looks, time, force = look_at(pack), pack.column("time").astype(float), pack.values(pack.spec.values[0])[:, 0]
    rng, place = np.random.default_rng(0), pack.table.schema.get_field_index("force_n")
    told = {}
    for shift in (0.0, 0.03, -0.2, 0.5, -0.5, 1.0, "own"):
        late = np.full(pack.num, np.nan)
        for number in range(33):
            rows = pack.rows_of(number)
            by = rng.uniform(-0.5, 0.5) if shift == "own" else float(shift)
            late[rows] = np.interp(time[rows] - by, time[rows], force[rows], np.nan, np.nan)
        (moved := copy.copy(pack)).__dict__.pop("_answers", None)  # kept values
        moved.table = pack.table.set_column(place, "force_n", pa.array(late))
        found = time_shift(moved, looks)
        size = re.search(r"values come ([\d.]+) rows .* (late|early)", found.evidence)
        told[shift] = found.verdict, size and (1 if size[2] == "late" else -1) * float(size[1])
    assert [verdict for verdict, _ in told.values()] == ["ok", "ok", "look", "look", "look", "look", "look"]
    assert all(abs(told[shift][1] - 30 * shift) <= 1 for shift in (-0.2, 0.5, -0.5, 1.0)), told
