"""Live on a fake clock: contact, smoothing, ages, and every fault named and survived."""

import errno
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from mvitac.cli.live import _engine, _say_uncropped, sources
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.deploy.engine import Engine
from mvitac.live.cameras import Camera, Ended, Folder, Simulated, source
from mvitac.live.contact import Contact, LiveConfig
from mvitac.live.predictor import Live
from mvitac.live.recorder import Recorder, finish
from mvitac.live.streams import Event, Stream
from mvitac.model import Model
from mvitac.system.files import read_json, write_json
from support.faults import NAMES, Clock, Rig, World
from support.toy import film
from support.videos import numbered, read_number, write_video


class Other(Engine):
    """An opened engine, some of whose attributes are changed."""

    def __init__(self, engine: Engine, **changes: Any) -> None:
        self.__dict__ = vars(engine) | changes


def test_a_touch_is_found_answered_and_ended(engine: Engine) -> None:
    world = World(engine)
    world.run(0.85)  # calibrates
    assert [e.what for e in world.heard] == ["calibrated"]
    world.run(30 - 0.85)
    assert world.live.num_touches == 10
    touch = world.live.last
    assert touch is not None and touch.num_frames == pytest.approx(20, abs=2)
    for task, (name, confidence) in world.live.answers(touch).items():
        assert name in engine.classes[task] and 1 / len(engine.classes[task]) <= confidence <= 1
    assert world.live.num_predictions == pytest.approx(10 * 20, abs=12)


def test_a_model_of_difference_images_sees_a_touch_minus_its_background(engine: Engine) -> None:
    """In contact the middle of the picture is 80 brighter than before: 40 above one half. What is recorded is as it came."""
    seen: list[np.ndarray] = []
    kept: list[np.ndarray] = []

    class Seeing(Other):
        def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
            seen.append(images["touch"][0].astype(float))
            return super().__call__(**images)

    world = World(Seeing(engine, difference=True), record=lambda images, columns: kept.append(images["touch"]))
    world.run(6)
    assert len(seen) > 20 and np.array_equal(kept[-1], world.rigs["touch"].picture)
    for touch in seen:
        assert touch[8:24, 8:24].mean() == pytest.approx(168, abs=1.5)
        assert touch[:8].mean() == pytest.approx(128, abs=1.5) and np.abs(touch[:8] - 128).max() <= 3


def test_the_newest_frame_wins_and_the_rest_are_counted(engine: Engine) -> None:
    """Vision comes six times as fast as touch leads: five of six of its frames are never used."""

    class Slow(Other):
        def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
            world.clock.now += 0.004
            return super().__call__(**images)

    world = World(Slow(engine))
    world.run(10, {"vision": 60.0, "touch": 10.0})
    age = world.live.summary()["age_ms"]  # from capture to answer
    assert age["p50"] == pytest.approx(4, abs=0.01) and age["max"] >= age["p99"] >= age["p50"]
    vision, touch = (world.streams[m][0] for m in ("vision", "touch"))
    assert touch.num_dropped == 0
    assert vision.num_dropped == pytest.approx(500, abs=12) and vision.num_frames == pytest.approx(600, abs=2)


def test_old_frames_are_not_used(engine: Engine) -> None:
    world = World(engine)
    world.run(9)
    world.rigs["vision"].fault = "stalled"
    world.run(0.4)
    before = world.live.num_predictions, world.live.num_stale
    world.run(6)
    assert world.live.num_stale > before[1] + 40 and world.live.num_predictions <= before[0] + 3
    assert world.streams["vision"][0].fault == "stalled"
    world.rigs["vision"].fault = ""
    world.run(6)
    assert world.live.num_predictions > before[0] + 30


def test_a_touch_ends_with_its_stream(engine: Engine) -> None:
    """Rather than go on for as long as the sensor is silent."""
    for name, fault in (("touch", "stalled"), ("touch", "unplugged"), ("vision", "unplugged")):
        world = World(engine)
        world.run(2.5)
        assert world.live.touch is not None and world.live.contact
        world.rigs[name].fault = fault
        world.run(1)
        assert world.live.touch is None and world.live.last is not None and world.live.contact is None
        assert world.live.num_touches == 1  # with the touch sensor's next images, none begins


def test_a_frame_that_comes_while_others_are_taken_is_used_once(engine: Engine) -> None:
    world = World(engine)
    world.run(2.5)
    [stream] = world.streams["touch"]
    newest, before = stream.newest, world.live.num_predictions

    def meanwhile(*, take: bool = True) -> Any:
        if take:
            stream.newest = newest  # type: ignore[method-assign]
            stream.pump()
        return newest(take=take)

    stream.pump()
    stream.newest = meanwhile  # type: ignore[method-assign]
    assert world.live.tick() and not world.live.tick() and world.live.num_predictions == before + 1


def test_a_background_is_forgotten_between_frames(engine: Engine) -> None:
    """Not by the thread that noticed, while another compares a frame with it."""
    world = World(engine)
    world.run(2)
    contact = world.live.contacts["touch"]
    world.rigs["touch"].fault = "resolution"
    world.streams["touch"][0].pump()  # as the capture thread does
    assert contact.background is not None
    world.live.tick()
    assert contact.background is None and world.live.contact is None
    kept: list[Any] = []
    world.live.record = lambda images, columns: kept.append(columns)
    world.run(0.5)
    assert world.live.contact is None and not kept  # whether it is touched is not known, so that it is no rest


def test_minutes_of_faults(engine: Engine) -> None:
    """Each kind of fault on each stream. One a minute for an hour: MVITAC_MINUTES=60 pytest -s -k minutes_of_faults."""
    num, seconds = (int(os.environ["MVITAC_MINUTES"]), 60) if "MVITAC_MINUTES" in os.environ else (10, 30)
    world, made, memory = World(engine), set(), []
    world.run(9)
    del world.heard[:]  # that it is calibrated
    tracemalloc.start()
    try:
        for i in range(num):
            fault, stream = [*NAMES][i % 5], ("touch", "vision")[i // 5 % 2]
            broken = 0.15 if fault == "damaged" else 4
            world.run(seconds / 2)
            world.rigs[stream].fault = fault
            world.run(broken)
            world.rigs[stream].fault = ""
            world.run(seconds / 2 - broken)
            said = [e.what for e in world.heard if e.stream == stream and e.what in sum(NAMES.values(), ())]
            assert tuple(dict.fromkeys(said)) == tuple(dict.fromkeys(NAMES[fault])), (i, fault, stream, said)
            assert not (others := [e.what for e in world.heard if e.stream != stream]), (i, fault, stream, others)
            made.add((fault, stream))
            del world.heard[:]
            memory.append((tracemalloc.get_traced_memory()[0], int(Path("/proc/self/statm").read_text().split()[1])))
    finally:
        tracemalloc.stop()
    assert len(made) == 10 and world.live.num_touches > num * (seconds - 15) / 3
    traced, resident = zip(*memory[2:], strict=True)
    assert max(traced) - min(traced) < 64_000, memory
    assert max(resident) < 1.05 * resident[0], memory


@pytest.mark.parametrize("free", [7, 5])
def test_a_touch_while_calibrating_is_named(free: int) -> None:
    """Also one of exactly half of the frames, which once passed for noise and hid every later touch."""
    contact, clock = Contact(LiveConfig(calibration=10)), Clock()
    rig = Rig(clock, 0)
    for t in (3.0,) * free + (4.5,) * (10 - free):
        clock.now = t
        contact(rig.read())
    assert contact.background is None and contact.uneasy
    clock.now = 3.0
    for _ in range(10):
        contact(rig.read())
    assert contact.background is not None and not contact.uneasy and contact(rig.read()) is False
    clock.now = 4.5
    assert contact(rig.read()) is True


def test_a_sensor_that_starts_in_contact_is_compared_with_a_given_image(engine: Engine) -> None:
    """And with ``always`` it is predicted from even without: each frame for itself, until a touch is found."""
    for free, touches in (((), 0), (1, 1)):
        world = World(engine, always=not free, free=[Rig(Clock(), 2).read()] if free else [])
        world.clock.now = 100.1  # in contact for 1.9 s
        world.run(0.65)
        assert world.live.num_touches == touches and world.live.num_predictions == 7
        said = world.live.prediction()
        assert said["contact"] is (True if free else None) and said["touch"] == touches
        assert world.live.answer and world.live.answer.num_frames == (7 if free else 1)


def test_the_background_follows_a_drifting_lamp_but_a_given_one_stays_however_slow_the_press() -> None:
    contact, rng = Contact(LiveConfig(calibration=5)), np.random.default_rng(0)
    given = Contact(LiveConfig(), 32, free=np.full((32, 32, 3), 100, np.uint8))
    for i in range(2000):
        image = (100 + i * 0.02 + rng.normal(0, 1, (32, 32, 3))).astype(np.uint8)
        assert not contact(image), i
        touched = given(image)
    assert contact(image + np.uint8(20))
    assert touched and given.picture is not None and (given.picture == 100).all()


def test_what_is_simulated_is_asked_for() -> None:
    """All of it, where no source is given; else a forgotten camera would pass for a real one."""
    pair, gripper = {"vision": (32, 32, 3), "touch": (32, 32, 3)}, {"touch": (32, 32, 6)}
    assert sources(gripper, None, ()) == {"touch": ("sim:0", "sim:1")}
    assert sources(pair, "0", ("sim",)) == {"vision": ("0",), "touch": ("sim",)}
    for given, says in (((None, ("2",)), "vision too: give --vision"), (("0", ()), "touch too: give --touch")):
        with pytest.raises(ValueError, match=f"takes {says} SOURCE"):
            sources(pair, *given)
    with pytest.raises(ValueError, match="no input for vision: leave --vision out"):
        sources(gripper, "0", ("2", "4"))


def test_a_source_that_is_used_whole_is_named(engine: Engine, capsys: pytest.CaptureFixture[str]) -> None:
    """Where the model's data showed a part: else it predicts from what it never saw."""
    for text, warns in (("0", True), ("0#4:0:9:9", False), ("sim:1", False)):
        _say_uncropped(Other(engine, crop={"touch": "4:0:9:9"}), {"touch": (text,)})
        assert ("the model learned from 4:0:9:9: add" in capsys.readouterr().err) == warns


def test_sources_by_name(tmp_path: Path) -> None:
    for i in range(3):
        Image.fromarray(np.full((4, 6, 3), 10 * i, np.uint8)).save(tmp_path / f"{i}.png")
    (tmp_path / "1.png").write_bytes(b"damaged")
    folder = source(f"{tmp_path}@15", "touch")
    assert isinstance(folder, Folder) and folder.times.tolist() == [0, 1 / 15, 2 / 15]
    stream, seen = Stream("touch", folder, clock=Clock()), []
    while not stream.ended:
        stream.pump()
        frame = stream.newest()
        seen.append(frame.image[0, 0, 0] if frame else None)
    assert seen == [0, 0, 20, 20] and stream.num_damaged == 1 and isinstance(source("sim:3", "vision"), Simulated)
    stream.take(buffer := np.full((4, 6, 3), 7, np.uint8))
    buffer[:] = 8  # as a driver that has one
    assert (last := stream.newest()) and (last.image == 7).all()
    wrong = {"nothing": "'nothing': give a video", "sim:-3": "'-3' is no seed", "0#0:0:-5:9": "give the part as"}
    for text, says in (wrong | {f"{tmp_path}@fast": "'fast' is no"}).items():
        with pytest.raises(ValueError, match=says):
            source(text, "touch")
    missing = Stream("touch", source("97", "touch"), clock=Clock())
    missing.pump()
    assert missing.fault == "unplugged"


def test_a_video_is_read_to_its_end_without_opencv(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    write_video(tmp_path / "a.mp4", 3, lambda number: numbered(number, "touch"))
    file = source(str(tmp_path / "a.mp4"), "touch")
    file.open()
    frames = [file.read() for _ in range(3)]
    assert file.times.tolist() == pytest.approx([0, 0.04, 0.08])
    assert [read_number(frame) for frame in frames] == [(number, "touch") for number in range(3)]  # RGB
    with pytest.raises(Ended):
        file.read()
    file.close()
    file.open()
    file.next = None
    with pytest.raises(ValueError, match="cannot be decoded"):  # skipped, unlike a lost camera
        file.read()


def test_a_camera_is_asked_for_a_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    width, height, fps = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS
    rates = {(640, 480): 30.0, (320, 240): 60.0}

    class Device(dict[int, float]):
        """A camera of two modes, as a DIGIT is."""

        def __init__(self, target: int | str) -> None:
            super().__init__({width: 640, height: 480, fps: 30})

        def set(self, name: int, value: float) -> None:
            known = name in (width, height) and value in (640, 480, 320, 240)
            if known or (name == fps and value == rates[self[width], self[height]]):  # type: ignore[index]
                self[name] = value

        def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
            return True

    monkeypatch.setattr(cv2, "VideoCapture", Device)
    fast = source("3@320x240@60", "touch")
    fast.open()
    assert isinstance(fast, Camera) and fast.capture == {width: 320, height: 240, fps: 60}
    usual = source("/dev/video2", "touch")
    usual.open()
    assert isinstance(usual, Camera) and usual.which == "/dev/video2"
    for text in ("3@60", "3@333x240"):
        with pytest.raises(OSError, match="no such mode: it gives 640x"):
            source(text, "touch").open()
    with pytest.raises(OSError, match=r"no camera with serial \*\* is"):
        source("serial:**", "touch").open()
    with pytest.raises(ValueError, match="give the camera's serial number after serial:"):
        source("serial:@320x240", "touch")


def heard(rig: type[Rig], clock: Clock) -> list[Event]:
    sensor, said = rig(clock, 0), []
    sensor.stream = stream = Stream("touch", sensor, clock=clock)
    stream.tell = said.append
    for sensor.fault in ("", "unplugged", ""):
        clock.now += 2
        stream.pump()
    return said


def test_no_error_of_a_driver_ends_a_stream() -> None:
    class Broken(Rig):
        def read(self) -> np.ndarray:
            if self.fault:
                raise RuntimeError("a driver's own kind of error")
            return super().read()

    lost, back = heard(Broken, Clock())
    assert (lost.what, back.what) == ("unplugged", "back") and "own kind of error" in lost.text
    assert back.text == "touch is back"


def test_a_device_that_is_back_is_not_stalled_before_its_first_frame() -> None:
    """Else "back" is never said, and the sensor is not calibrated again."""

    class Slow(Rig):
        stream: Stream

        def read(self) -> np.ndarray:
            if not self.fault:
                self.clock.now += 0.3  # the first frame after opening takes time, while another thread asks
                self.stream.check()
            return super().read()

    assert [event.what for event in heard(Slow, Clock())] == ["unplugged", "back"]


def test_the_simulated_sensor_is_calibrated_while_free() -> None:
    """Even where a third of the frames is dropped; else contact would be found the wrong way round."""
    sensor, contact = Simulated("touch", 0, fps=30, size=32), Contact(LiveConfig())
    sensor.open()
    found = [contact(image) for image in [sensor.read() for _ in range(180)][::3]]
    assert found == [None] * 29 + [False] + [True] * 20 + [False] * 10


@pytest.mark.parametrize("given", [False, True])
def test_a_press_that_changes_colours_alone_begins_and_ends(given: bool) -> None:
    """Also against one noisy image without contact: its own noise once kept the touch from ending."""
    rng, rest = np.random.default_rng(0), np.array([90.0, 120, 100])
    press = np.array([130.0, 99.6, 100])  # as bright
    frames = [(rest if i < 40 else press if i < 60 else rest) + rng.normal(0, 2, (48, 48, 3)) for i in range(90)]
    images = [image.astype(np.uint8) for image in frames]
    contact = Contact(LiveConfig(), free=images[0] if given else None)
    assert [bool(contact(image)) for image in images[1:]] == [False] * 39 + [True] * 20 + [False] * 30


def test_a_recording_is_a_pack(engine: Engine, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "pack", fps=5.0)  # also of a sensor that is faster
    kept: list[Any] = []

    def record(images: dict[str, np.ndarray], columns: dict[str, Any]) -> None:
        kept.append((columns["time"], images["touch"]))
        recorder(images, columns)

    world = World(engine, record=record)
    world.run(40)
    assert recorder.close() == pytest.approx(200, abs=4)
    pack, times = Pack(tmp_path / "pack"), dict(kept)
    for row in (0, 77, pack.num - 1):
        assert np.array_equal(pack.images["touch"][row], times[pack.column("time")[row]])
    assert set(pack.column("split")) == {"unlabelled"}
    assert len(set(pack.column("group")[pack.column("contact")])) == world.live.num_touches
    with pytest.raises(ValueError, match="already exists"):
        Recorder(tmp_path / "pack")


def test_a_full_disk_ends_the_recording_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, write: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    said: list[str] = []
    recorder, image = Recorder(tmp_path / "out", fps=1.0, tell=said.append), np.zeros((16, 16, 3), np.uint8)
    for i in range(200):
        if i == 100:
            monkeypatch.setattr("mvitac.live.recorder.write_atomic", full)
        recorder({"touch": image}, {"time": float(i), "contact": True, "touch_number": 1})
    assert len(said) == 1 and re.search("recording stopped, prediction goes on: .*No space left", said[0])
    monkeypatch.setattr("mvitac.live.recorder.build", lambda *given, **options: full(tmp_path, None))
    with pytest.raises(ValueError, match=r"No space.*: 64 pairs are kept in .*out\.spool, make room .* python -c"):
        recorder.close()
    monkeypatch.undo()
    assert recorder.close() == Pack(tmp_path / "out").num == 128 and len(said) == 1  # as many as were kept until then


def test_a_recording_survives_a_crash(tmp_path: Path) -> None:
    out = tmp_path / 'it\'s "q" \u00f6'
    recorder, image = Recorder(out, fps=1.0), np.zeros((16, 16, 3), np.uint8)
    for i in range(130):
        image[:] = i  # as a camera does that has one buffer
        recorder({"touch": image}, {"time": float(i), "contact": i % 2 == 0, "touch_number": i // 2})
    with pytest.raises(ValueError, match=r"\(9, 9, 3\).* after .*\(16, 16, 3\)"):
        recorder({"touch": image[:9, :9]}, {"time": 130.0})
    del recorder  # killed: two of three parts are on disk
    with pytest.raises(ValueError, match="crashed and is finished by python -c") as refused:
        Recorder(out)
    exec(shlex.split(str(refused.value).partition("finished by ")[2])[2])
    pack = Pack(out)
    assert pack.num == 128 and np.array_equal(pack.images["touch"][:, 0, 0, 0], pack.column("time").astype(float))


def test_a_running_recording_is_not_finished_by_another(tmp_path: Path) -> None:
    """Nor is a folder taken for a spool that holds anything else."""
    recorder = Recorder(tmp_path / "out")
    code = f"from mvitac.live.recorder import finish; finish({str(tmp_path / 'out')!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "out is still being recorded: stop that first" in done.stderr and recorder.spool.exists()
    (recorder.spool / "thesis.tex").touch()
    with pytest.raises(ValueError, match=r"thesis\.tex is of no recording: take it out of there"):
        recorder.close()
    assert (recorder.spool / "thesis.tex").exists()


def test_a_recording_that_was_moved_away_ends(tmp_path: Path) -> None:
    said: list[str] = []
    recorder, image = Recorder(tmp_path / "out", fps=1.0, tell=said.append), np.zeros((16, 16, 3), np.uint8)
    for i in range(200):
        if i == 100:
            recorder.spool.rename(tmp_path / "moved")
        recorder({"touch": image}, {"time": float(i), "contact": True, "touch_number": 1})
    assert said == [f"recording stopped, prediction goes on: {recorder.spool}: No such file or directory"]
    with pytest.raises(ValueError, match="put it back where it was, and finish it by"):
        recorder.close()
    (tmp_path / "moved").rename(recorder.spool)
    assert finish(tmp_path / "out") == 64


def test_a_recording_that_nothing_came_of_is_not_in_the_way(tmp_path: Path) -> None:
    Recorder(out := tmp_path / "recording")  # killed before its first part
    assert finish(out) == 0 and not list(tmp_path.iterdir())
    assert Recorder(out).close() == 0 and not list(tmp_path.iterdir())


def test_each_artifact_of_a_run_is_exported_for_itself(
    artifact: Path, onnx: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once: their weights are the same, their probes are not."""
    other = shutil.copytree(artifact, tmp_path / "other")
    manifest = read_json(other / "artifact.json", "a description")
    for question in manifest["probes"]:
        question["classes"].reverse()
    write_json(other / "artifact.json", manifest, sealed=True)
    made: list[tuple[str, ...]] = []

    def exported(model: Model, pack: Pack, out: Path, config: Any) -> None:
        made.append(model.classes["pattern"])
        shutil.copytree(onnx, out)

    monkeypatch.setattr("mvitac.deploy.export.export", exported)
    monkeypatch.setattr("mvitac.deploy.publish.own_data", lambda *_, **__: None)  # that of an artifact is not opened
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path / "cache"))
    for model in (artifact, other, artifact):
        assert _engine(str(model), 1).classes.keys() == {"pattern", "bright"}
    assert made == [("columns", "rows", "checks"), ("checks", "rows", "columns")]
    with pytest.raises(ValueError, match="no input for depth: leave --depth out"):
        _engine(str(artifact), 1, ("depth",))


def test_a_run_is_exported_again_for_other_data(
    smoke_run: Path, onnx: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its weights are the same, but labels and units of its data, or its windows, are not."""
    made: list[Path] = []
    monkeypatch.setattr("mvitac.deploy.export.export", lambda m, p, out, c: made.append(shutil.copytree(onnx, out)))
    monkeypatch.setattr("mvitac.deploy.publish.with_probes", lambda model, data: model)
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path / "cache"))
    other = SimpleNamespace(digest="0" * 64, spec=pack.spec)
    for data in (pack, other, SimpleNamespace(digest=pack.digest, spec=replace(pack.spec, notes=("in mN",))), pack):
        monkeypatch.setattr("mvitac.deploy.publish.own_data", lambda *_, data=data, **__: data)
        _engine(str(smoke_run), 1)
    assert len(made) == 3


def test_a_recording_is_kept_when_the_summary_cannot_be_written(
    onnx: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mvitac.cli.live.write_json", lambda path, value: path.open("w").write(value))
    places = ["--record", str(tmp_path / "r"), "--json", str(tmp_path / "new" / "s.json")]
    assert main(["live", str(onnx), "--always", "--seconds", "2", *places]) == 2
    assert "No such file" in capsys.readouterr().err and Pack(tmp_path / "r").num > 0
    (tmp_path / "free.png").write_bytes(b"")
    background = ["--background", str(tmp_path / "free.png"), "--calibration", "9"]
    assert main(["live", str(onnx), *background]) == 2 and "has no effect beside" in capsys.readouterr().err


def test_live_command_on_folders(onnx: Path, pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Threads, files and lines of JSON together; ends when the files do."""
    command = ["live", str(onnx), *film(pack, tmp_path, rest=12, num=24, fps=20)]
    assert main([*command, "--calibration", "2", "--stale", "60", "--json", str(tmp_path / "s.json")]) == 0
    summary = json.loads((tmp_path / "s.json").read_text())
    assert summary["streams"]["touch"]["frames"] == 24 and summary["events"]["ended"] == 2
    said, faults = capsys.readouterr()
    lines = [json.loads(line) for line in said.splitlines()]
    assert "has no more frames" in faults and '"frames": 24' in faults
    assert len(lines) >= summary["predictions"] >= 1 and all(line["time"] < 60 for line in lines)
    assert main([*command, "--calibration", "25"]) == 0
    assert "contact was never known: no 25 frames without it" in capsys.readouterr().err
    touched = [line for line in lines if line["contact"]]
    assert touched[0]["touch"] == 1 and touched[0]["pattern"]["class"] in ("columns", "rows", "checks")
    assert [line["time"] for line in lines] == sorted({line["time"] for line in lines})
    assert main([*command, "--json", str(tmp_path)]) == 2 and "is a folder" in capsys.readouterr().err
    for option in ("--seconds", "--stale"):
        assert main([*command, option, "0"]) == 2 and f"{option[2:]} 0.0: give" in capsys.readouterr().err
    refused = ["--record", str(tmp_path / "r"), "--background", *[str(tmp_path / "touch" / "000.png")] * 2]
    assert main([*command, *refused]) == 2 and "2 background(s) for 1 touch" in capsys.readouterr().err
    assert not list(tmp_path.glob("r.*"))  # nothing is in the way of the next try


def test_what_was_recorded_is_kept_when_stdout_is_full(
    onnx: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines, place = iter(range(40)), os.open(os.devnull, os.O_WRONLY)

    def write(text: str) -> None:
        if next(lines, None) is None:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("sys.stdout", Mock(write=write, fileno=lambda: place))
    words = ["--always", "--calibration", "2", "--record", str(tmp_path / "r"), "--json", str(tmp_path / "s.json")]
    assert main(["live", str(onnx), *words]) == 2 and Pack(tmp_path / "r").num > 0 and (tmp_path / "s.json").is_file()
    assert "stdout: No space left on device" in capsys.readouterr().err


def test_sigterm_ends_it_as_ctrl_c_does(
    onnx: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    step, num = Live.step, iter(range(1000))

    def until_killed(self: Live) -> Any:
        if next(num) == 20:
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self)

    monkeypatch.setattr(Live, "step", until_killed)
    before = signal.getsignal(signal.SIGTERM)
    words = ["--vision", "sim#0:0:64:60", "--touch", "sim", "--always", "--calibration", "2"]
    assert main(["live", str(onnx), *words, "--record", str(tmp_path / "r")]) == 0
    assert "stopped" in (said := capsys.readouterr().err) and "summary: " in said
    assert (pack := Pack(tmp_path / "r")).num > 0 and pack.spec.crop == {"vision": "0:0:64:60"}
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_value_is_that_of_the_newest_frame_with_the_spread_of_its_range(value_onnx: Path) -> None:
    measuring, given = Engine(value_onnx, threads=1), iter([1.0, 5.0])

    class Rising(Other):
        """Says 1, 5, 3, 3, ... levels; errors are 0.25 below 2 levels and 0.5 from there."""

        def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
            return {**super().__call__(**images), "value_light": np.array([[next(given, 3.0)]], np.float32)}

    values = {"light": [{"name": "level", "unit": "N", "edges": [2.0], "spread": [0.25, 0.5]}]}
    world, found = World(Rising(measuring, values=values)), []
    while world.live.num_predictions < 3:
        before = world.live.num_predictions
        world.run(0.05)  # one frame
        if world.live.num_predictions > before:
            said = json.loads(json.dumps(world.live.prediction()))
            found.append(said["light"]["level"])
    assert found == [{"value": v, "unit": "N", "spread": s} for v, s in ((1.0, 0.25), (5.0, 0.5), (3.0, 0.5))]
    assert said["contact"] is True and said["pattern"]["class"] in measuring.classes["pattern"]
    while world.live.touch:
        world.run(0.1)
    assert world.live.prediction() == {"touch": 1, "contact": False}
