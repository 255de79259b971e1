"""Live on a fake clock: contact, smoothing, ages, and every fault named and survived."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import re
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from av.error import FFmpegError
from PIL import Image
from rich.console import Console

from mvitac.cli.live import _engine, _print_touch, _run, sources, view
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.deploy.engine import Engine
from mvitac.deploy.search import neighbours
from mvitac.live.cameras import Camera, Ended, Folder, Simulated, source
from mvitac.live.contact import Contact, LiveConfig
from mvitac.live.display import Window, draw
from mvitac.live.predictor import Live, Reading
from mvitac.live.recorder import Recorder, finish
from mvitac.live.streams import CaptureThread, Stream
from mvitac.model import Model
from mvitac.report.value_figures import over_time
from mvitac.system.files import read_json, write_json
from support.faults import Clock, Rig, World, faulty
from support.films import film, shade


@pytest.fixture(scope="module")
def engine(onnx: Path) -> Engine:
    return Engine(onnx, threads=1)


def shown(loop: Live) -> str:
    """The terminal's picture, as text."""
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(view(loop))
    return console.export_text()


class Slow:
    """The engine, taking 4 ms of the fake clock."""

    def __init__(self, engine: Engine) -> None:
        self.engine, self.inputs, self.classes, self.meta = engine, engine.inputs, engine.classes, engine.meta
        self.values, self.difference, self.window = engine.values, engine.difference, engine.window
        self.clock: Clock | None = None

    def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
        assert self.clock
        self.clock.now += 0.004
        return self.engine(**images)


def test_a_touch_is_found_answered_and_ended(engine: Engine) -> None:
    world = World(engine)
    world.run(0.85)  # calibrates
    assert [e.what for e in world.heard] == ["calibrated"]
    world.run(30 - 0.85)
    assert world.live.num_touches == 10
    touch = world.live.last
    assert touch is not None and touch.end is not None
    assert touch.end - touch.start == pytest.approx(2.0, abs=0.25)
    for task, (name, confidence) in world.live.answers(touch).items():
        assert name in engine.classes[task] and 1 / len(engine.classes[task]) <= confidence <= 1
    assert world.live.num_predictions == pytest.approx(10 * 20, abs=12)


def test_an_answer_is_the_mean_of_its_touch(engine: Engine) -> None:
    said: list[np.ndarray] = []

    class Recorded(Slow):
        def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
            found = self.engine(**images)
            said.append(found["probability_pattern"][0])
            return found

    world = World(Recorded(engine))
    while world.live.last is None:
        world.run(0.1)
    mean = np.mean(said, axis=0)
    name, confidence = world.live.answers(world.live.last)["pattern"]
    assert confidence == pytest.approx(mean.max()) and name == engine.classes["pattern"][mean.argmax()]


def test_a_model_of_difference_images_sees_a_touch_minus_its_background(engine: Engine) -> None:
    """In contact the middle of the picture is 80 brighter than before: 40 above one half. What is recorded is as it came."""
    seen: list[np.ndarray] = []
    kept: list[np.ndarray] = []

    class Minus(Slow):
        def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
            seen.append(images["touch"][0].astype(float))
            return self.engine(**images)

    slow = Minus(engine)
    slow.difference = True
    world = World(slow, record=lambda images, columns: kept.append(images["touch"]))
    world.run(6)
    assert len(seen) > 20 and np.array_equal(kept[-1], world.rigs["touch"].picture)
    for touch in seen:
        assert touch[8:24, 8:24].mean() == pytest.approx(168, abs=1.5)
        assert touch[:8].mean() == pytest.approx(128, abs=1.5) and np.abs(touch[:8] - 128).max() <= 3


def test_age_is_from_capture_to_answer(engine: Engine) -> None:
    slow = Slow(engine)
    world = World(slow)
    slow.clock = world.clock
    world.run(12)
    age = world.live.summary()["age_ms"]
    assert age["p50"] == pytest.approx(4, abs=0.01) and age["max"] >= age["p99"] >= age["p50"]


def test_the_newest_frame_wins_and_the_rest_are_counted(engine: Engine) -> None:
    """Vision comes six times as fast as touch leads: five of six of its frames are never used."""
    world = World(engine)
    world.run(10, {"vision": 60.0, "touch": 10.0})
    vision, touch = (world.streams[m][0] for m in ("vision", "touch"))
    assert touch.num_dropped == 0
    assert vision.num_dropped == pytest.approx(500, abs=12)
    assert vision.num_frames == pytest.approx(600, abs=2)


def test_old_frames_are_not_used(engine: Engine) -> None:
    world = World(engine)
    world.run(9)
    world.rigs["vision"].fault = "stalled"
    world.run(0.4)
    before = world.live.num_predictions, world.live.num_stale
    world.run(6)
    assert world.live.num_stale > before[1] + 40
    assert world.live.num_predictions <= before[0] + 3
    assert world.streams["vision"][0].fault == "stalled"
    world.rigs["vision"].fault = ""
    world.run(6)
    assert world.live.num_predictions > before[0] + 30


def test_a_touch_ends_with_its_stream(engine: Engine) -> None:
    """Rather than go on for as long as the sensor is silent."""
    for fault in ("stalled", "unplugged"):
        world = World(engine)
        world.run(2.5)
        assert world.live.touch is not None and "CONTACT" in shown(world.live)
        world.rigs["touch"].fault = fault
        world.run(1)
        assert world.live.touch is None and world.live.last is not None
        assert world.live.contact is None and "CONTACT" not in shown(world.live)


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
    assert world.live.tick() and not world.live.tick()
    assert world.live.num_predictions == before + 1


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


def test_minutes_of_faults(engine: Engine) -> None:
    """Each kind of fault on each stream. One a minute for an hour: MVITAC_MINUTES=60 pytest -s -k minutes_of_faults."""
    num, seconds = (int(os.environ["MVITAC_MINUTES"]), 60) if "MVITAC_MINUTES" in os.environ else (10, 30)
    world, made, memory = faulty(engine, num, seconds)
    traced, resident = ([at[i] for at in memory[2:]] for i in (0, 1))
    assert len(set(made)) == 10
    assert world.live.num_touches > num * (seconds - 15) / 3
    assert max(traced) - min(traced) < 64_000, memory
    assert max(resident) < 1.05 * resident[0], memory
    print(
        f"{num * seconds / 60:.0f} minutes, {len(made)} faults, {world.live.num_predictions} predictions in"
        f" {world.live.num_touches} touches; resident {resident[0] / 1e6:.1f} MB after 3 faults,"
        f" {max(resident) / 1e6:.1f} at most"
    )


def test_a_changed_resolution_calibrates_anew(engine: Engine) -> None:
    world = World(engine)
    world.run(9)
    world.rigs["touch"].fault = "resolution"
    world.run(0.3)
    assert world.live.contact is None
    world.run(12)
    assert world.live.contact is not None
    assert [e.what for e in world.heard].count("calibrated") == 2
    assert "changed from 32x32 to 16x16" in " ".join(e.text for e in world.heard)


@pytest.mark.parametrize("free", [7, 5])
def test_a_touch_while_calibrating_is_named(free: int) -> None:
    """Also one of exactly half of the frames, which once passed for noise and hid every later touch."""
    config = LiveConfig(calibration=10)
    contact, clock = Contact(config), Clock()
    rig = Rig(clock, 0)
    for t in (3.0,) * free + (4.5,) * (10 - free):
        clock.now = t
        contact(rig.read())
    assert contact.background is None and contact.uneasy
    clock.now = 3.0
    for _ in range(10):
        contact(rig.read())
    assert contact.background is not None and not contact.uneasy
    assert contact(rig.read()) is False
    clock.now = 4.5
    assert contact(rig.read()) is True


def test_the_background_follows_a_drifting_lamp() -> None:
    contact = Contact(LiveConfig(calibration=5))
    rng = np.random.default_rng(0)
    for i in range(2000):
        image = 100 + i * 0.02 + rng.normal(0, 1, (32, 32, 3))
        assert not contact(image.astype(np.uint8)), i
    assert contact((image + 20).astype(np.uint8))


def test_streams_must_fit_the_model(engine: Engine) -> None:
    streams = {m: [Stream(m, Rig(Clock(), 0))] for m in ("vision", "touch")}
    with pytest.raises(ValueError, match=r"takes 1 touch stream\(s\), 0 given"):
        Live(engine, {"vision": streams["vision"]})
    with pytest.raises(ValueError, match="no input for smell"):
        Live(engine, {**streams, "smell": streams["touch"]})


def test_what_is_simulated_is_asked_for() -> None:
    """All of it, where no source is given; else a forgotten camera would pass for a real one."""
    pair, gripper = {"vision": (32, 32, 3), "touch": (32, 32, 3)}, {"touch": (32, 32, 6)}
    assert sources(pair, None, ()) == {"vision": ("sim:0",), "touch": ("sim:0",)}
    assert sources(gripper, None, ()) == {"touch": ("sim:0", "sim:1")}
    assert sources(pair, "0", ("sim",)) == {"vision": ("0",), "touch": ("sim",)}
    with pytest.raises(ValueError, match="takes vision too: give --vision SOURCE"):
        sources(pair, None, ("2",))
    with pytest.raises(ValueError, match=r"takes touch too: .*--touch sim for a simulated one"):
        sources(pair, "0", ())
    with pytest.raises(ValueError, match="no input for vision: leave --vision out"):
        sources(gripper, "0", ("2", "4"))


@pytest.mark.parametrize("wrong", [{"neighbours": 0}, {"min_confidence": 7.0}, {"min_confidence": -0.1}])
def test_settings_that_cannot_be_are_refused_at_the_start(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="neighbours must be >= 1"):
        LiveConfig(**wrong)


def test_known_touches_are_compared_by_what_the_model_sees(tmp_path: Path) -> None:
    banks = {m: np.eye(3, dtype=np.float32) for m in ("vision", "touch")}
    index = SimpleNamespace(
        meta={"space": "shared"},
        banks=banks,
        table=pa.table({"id": ["a", "b", "c"]}),
        labels=lambda row: {"task": f"class {row}"},
        folder=tmp_path,
    )
    query = np.array([[0.1, 2.0, 0.0]], np.float32)
    for inputs, key in ((("vision",), "shared_vision"), (("vision", "touch"), "shared_touch")):
        assert neighbours(index, 2, inputs)({key: query}) == ["b (class 1)", "a (class 0)"]
    del banks["vision"]
    with pytest.raises(ValueError, match="holds no vision to compare with"):
        neighbours(index, 2, ("vision",))


def test_sources_by_name(tmp_path: Path) -> None:
    for i in range(3):
        Image.fromarray(np.full((4, 6, 3), 10 * i, np.uint8)).save(tmp_path / f"{i}.png")
    (tmp_path / "1.png").write_bytes(b"damaged")
    folder = source(f"{tmp_path}@15", "touch")
    assert isinstance(folder, Folder) and folder.fps == 15
    stream = Stream("touch", folder, clock=Clock())
    seen = []
    while not stream.ended:
        stream.pump()
        frame = stream.newest()
        seen.append(frame.image[0, 0, 0] if frame else None)
    assert seen == [0, 0, 20, 20] and stream.num_damaged == 1
    assert isinstance(source("sim:3", "vision"), Simulated)
    for text in ("nothing", "sim:x", f"{tmp_path}@fast"):
        with pytest.raises(ValueError, match="source"):
            source(text, "touch")
    with pytest.raises(ValueError, match=r"'gone@10': there is no gone here; give a camera number"):
        source("gone@10", "touch")
    missing = Stream("touch", source("97", "touch"), clock=Clock())
    missing.pump()
    assert missing.fault == "unplugged"


def test_files_that_cannot_be_read_are_named_at_once(tmp_path: Path) -> None:
    """Not taken for an unplugged camera, which may come back."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "no.mp4").write_text("no video")
    for name, message in (("empty", "holds no pictures"), ("no.mp4", "cannot be read as a video"), ("empty@0", "rate")):
        with pytest.raises(ValueError, match=message):
            source(str(tmp_path / name), "touch")


def test_opencv_is_asked_for_where_it_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for text in ("0", "serial:D20345"):
        with pytest.raises(ValueError, match=r"needs OpenCV: pip install -e '.\[live\]'"):
            source(text, "touch")


def test_a_video_is_read_to_its_end_without_opencv(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    file = source(str(film(tmp_path / "a.mp4", 3, rate=20)), "touch")
    file.open()
    frames = [file.read() for _ in range(3)]
    assert file.fps == 20 and not file.paced
    for i, frame in enumerate(frames):
        assert frame.shape == (48, 64, 3) and np.abs(frame.mean((0, 1)) - shade(i, 0)).max() < 3
    with pytest.raises(Ended):
        file.read()
    file.close()

    def damaged() -> Iterator[Any]:
        yield from ()
        raise FFmpegError(1, "a damaged part")

    file.frames = damaged()
    with pytest.raises(ValueError, match="a damaged part"):  # skipped, unlike a lost camera
        file.read()


def test_a_camera_is_asked_for_a_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    width, height, fps = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS
    rates = {(640, 480): 30.0, (320, 240): 60.0}

    class Device:
        """A camera of two modes, as a DIGIT is."""

        def __init__(self, target: int | str) -> None:
            self.mode: dict[int, float] = {width: 640, height: 480, fps: 30}

        def set(self, name: int, value: float) -> None:
            if name in (width, height):
                self.mode[name] = value if value in (640, 480, 320, 240) else self.mode[name]
            elif name == fps and value == rates[self.mode[width], self.mode[height]]:  # type: ignore[index]
                self.mode[fps] = value

        def get(self, name: int) -> float:
            return self.mode[name]

        def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
            return True

    monkeypatch.setattr(cv2, "VideoCapture", Device)
    fast = source("3@320x240@60", "touch")
    fast.open()
    assert fast.fps == 60 and isinstance(fast, Camera) and fast.capture.mode == {width: 320, height: 240, fps: 60}
    usual = source("/dev/video2", "touch")
    usual.open()
    assert usual.fps == 30 and isinstance(usual, Camera) and usual.which == "/dev/video2"
    for text in ("3@60", "3@333x240"):
        with pytest.raises(OSError, match="no such mode: it gives 640x"):
            source(text, "touch").open()


def test_no_error_of_a_driver_ends_a_stream() -> None:
    class Broken(Rig):
        def read(self) -> np.ndarray:
            if self.fault:
                raise RuntimeError("a driver's own kind of error")
            return super().read()

    clock = Clock()
    rig, heard = Broken(clock, 0), []
    stream = Stream("touch", rig, clock=clock, tell=heard.append)
    for rig.fault in ("", "broken", ""):
        clock.now += 2
        stream.pump()
    assert [e.what for e in heard] == ["unplugged", "back"] and "own kind of error" in heard[0].text


def test_a_device_that_is_back_is_not_stalled_before_its_first_frame() -> None:
    """Else "back" is never said, and the sensor is not calibrated again."""

    class Slow(Rig):
        def read(self) -> np.ndarray:
            if not self.fault:
                clock.now += 0.3  # the first frame after opening takes time, while another thread asks
                stream.check()
            return super().read()

    clock = Clock()
    rig, heard = Slow(clock, 0), []
    stream = Stream("touch", rig, clock=clock, tell=heard.append)
    for rig.fault in ("", "unplugged", ""):
        clock.now += 2
        stream.pump()
    assert [e.what for e in heard] == ["unplugged", "back"]


def test_a_video_is_read_as_rgb(tmp_path: Path) -> None:
    import cv2

    writer = cv2.VideoWriter(str(tmp_path / "red.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20, (32, 24))
    for _ in range(3):
        writer.write(np.full((24, 32, 3), (0, 0, 200), np.uint8))  # BGR: red
    writer.release()
    video = source(str(tmp_path / "red.avi"), "vision")
    video.open()
    assert video.fps == 20
    image = video.read()
    assert image.shape == (24, 32, 3) and image[..., 0].mean() > 150 and image[..., 2].mean() < 60
    video.close()


def test_the_simulated_sensor_rests_and_touches() -> None:
    sensor = Simulated("touch", 0, fps=2, size=32)
    sensor.open()
    frames = np.stack([sensor.read() for _ in range(18)]).astype(float)
    change = np.abs(frames - frames[0]).mean((1, 2, 3))
    assert (change[1:6] < 8).all()  # at rest: time to calibrate
    for held, free in ((slice(6, 10), slice(10, 12)), (slice(12, 16), slice(16, 18))):
        assert change[held].min() > 2 * change[1:6].max() and change[free].max() < 8


def test_the_simulated_sensor_is_calibrated_while_free() -> None:
    """Even where a third of the frames is dropped; else contact would be found the wrong way round."""
    sensor, contact = Simulated("touch", 0, fps=30, size=32), Contact(LiveConfig())
    sensor.open()
    found = [contact(image) for image in [sensor.read() for _ in range(180)][::3]]
    assert found == [None] * 29 + [False] + [True] * 20 + [False] * 10


def test_a_thread_pumps_until_the_end(tmp_path: Path) -> None:
    for i in range(5):
        Image.fromarray(np.full((4, 4, 3), i, np.uint8)).save(tmp_path / f"{i}.png")
    stream, woken = Stream("touch", Folder(tmp_path, fps=1e6)), []
    thread = CaptureThread(stream, lambda: woken.append(1))
    thread.start()
    thread.join(20)
    assert not thread.is_alive() and stream.ended and stream.num_frames == 5 and len(woken) == 6


def test_a_recording_is_a_pack(engine: Engine, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "pack", {"vision": 3, "touch": 3}, fps=5.0)
    kept: list[Any] = []

    def record(images: dict[str, np.ndarray], columns: dict[str, Any]) -> None:
        kept.append((columns["time"], images["touch"]))
        recorder(images, columns)

    world = World(engine, record=record)
    world.run(40)
    assert recorder.close() == pytest.approx(200, abs=4)
    pack = Pack(tmp_path / "pack")
    times = dict(kept)
    for row in (0, 77, pack.num - 1):
        assert np.array_equal(pack.images["touch"][row], times[pack.column("time")[row]])
    assert set(pack.column("split")) == {"unlabelled"}
    assert len(set(pack.column("group")[pack.column("contact")])) == world.live.num_touches
    with pytest.raises(ValueError, match="already exists"):
        Recorder(tmp_path / "pack", {"vision": 3, "touch": 3})


def test_a_gap_is_not_made_up_for(tmp_path: Path) -> None:
    """At most fps pairs a second: also at the start, and after a gap."""
    recorder = Recorder(tmp_path / "pack", {"touch": 3}, fps=1.0)
    image = np.zeros((16, 16, 3), np.uint8)
    for i in [*range(0, 70), *range(130, 200)]:  # 30 frames a second
        recorder({"touch": image}, {"time": i / 30, "contact": True, "touch_number": 1})
    kept = [columns["time"] for _, columns in recorder.waiting]
    assert kept == pytest.approx([0, 1, 2, 130 / 30, 160 / 30, 190 / 30])


def test_a_rate_that_cannot_be_recorded(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="more than 0"):
        Recorder(tmp_path / "out", {"touch": 3}, fps=0.0)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_ends_the_recording_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, write: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    said: list[str] = []
    recorder = Recorder(tmp_path / "out", {"touch": 3}, fps=1.0, tell=said.append)
    image = np.zeros((16, 16, 3), np.uint8)
    for i in range(200):
        if i == 100:
            monkeypatch.setattr("mvitac.live.recorder.write_atomic", full)
        recorder({"touch": image}, {"time": float(i), "contact": True, "touch_number": 1})
    assert len(said) == 1 and re.search("recording stopped, prediction goes on: .*No space left", said[0])
    with pytest.raises(OSError, match="No space"):
        recorder.close()
    monkeypatch.undo()
    assert recorder.close() == Pack(tmp_path / "out").num == 128  # as many as were kept until then


def test_a_recording_survives_a_crash(tmp_path: Path) -> None:
    out = tmp_path / "recording"
    recorder = Recorder(out, {"touch": 3}, fps=1.0)
    image = np.zeros((16, 16, 3), np.uint8)
    for i in range(130):
        recorder({"touch": image + i}, {"time": float(i), "contact": i % 2 == 0, "touch_number": i // 2})
    del recorder  # killed: two of three parts are on disk
    with pytest.raises(ValueError, match="not finished: `mvitac live --finish"):
        Recorder(out, {"touch": 3})
    assert main(["live", "--finish", str(out)]) == 0
    pack = Pack(out)
    assert pack.num == 128
    assert np.array_equal(pack.images["touch"][:, 0, 0, 0], pack.column("time").astype(float))
    with pytest.raises(ValueError, match="no unfinished recording"):
        finish(tmp_path / "other")


def test_a_recording_that_nothing_came_of_is_not_in_the_way(tmp_path: Path) -> None:
    out = tmp_path / "recording"
    Recorder(out, {"touch": 3})  # killed before its first part
    assert finish(out) == 0 and not list(tmp_path.iterdir())
    assert Recorder(out, {"touch": 3}).close() == 0 and not list(tmp_path.iterdir())


@pytest.mark.parametrize("modalities", [("vision", "touch"), ("touch",)])
def test_the_picture_shows_frames_contact_and_answers(engine: Engine, modalities: tuple[str, ...]) -> None:
    class Part:
        """The engine, of some of its inputs."""

        inputs, classes, difference = {m: engine.inputs[m] for m in modalities}, engine.classes, False
        values, window = engine.values, engine.window

        def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
            zeros = {m: np.zeros((1, *shape), np.uint8) for m, shape in engine.inputs.items()}
            return engine(**{**zeros, **images})

    world = World(engine)
    world.live = Live(Part(), {m: world.streams[m] for m in modalities}, LiveConfig(calibration=8), clock=world.clock)  # type: ignore[arg-type]
    empty = draw(world.live)
    while not world.live.num_predictions:
        world.run(0.1)
    world.rigs["vision"].fault = "unplugged"
    world.run(0.1)
    picture = draw(world.live)
    assert picture.dtype == np.uint8 and picture.shape == empty.shape == (256 + 24 * 4, 512, 3)
    for i, modality in enumerate(modalities):
        frame = Image.fromarray(world.rigs[modality].picture).resize((248, 248), Image.Resampling.BICUBIC)
        assert np.array_equal(picture[4:252, 256 * i + 4 : 256 * i + 252], np.asarray(frame))
        assert tuple(picture[0, 256 * i + 9]) == ((60, 170, 90) if modality == "touch" else (200, 60, 50))
    shown = (picture[256 + 24 : 256 + 48, 256:] == 130).all(2).any(0).sum()  # the bar of the first answer
    _, confidence = next(iter(world.live.answers(world.live.touch).values()))
    assert shown >= round(confidence * (256 - 60)) > 0
    assert not (empty[256 + 24 :, 256:] == 130).all(2).any()


def test_a_window_or_why_not(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["live", "any", "--window"]) == 2
    said = capsys.readouterr().err
    assert "there is no display" in said and said.count("\n") == 1
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(cv2, "currentUIFramework", lambda: "")
    with pytest.raises(ValueError, match=r"has no windows .*install opencv-python in its place"):
        Window()
    shown: list[np.ndarray] = []
    keys = iter([-1, ord("q"), -1])
    monkeypatch.setattr(cv2, "currentUIFramework", lambda: "GTK3")
    monkeypatch.setattr(cv2, "namedWindow", lambda title: None)
    monkeypatch.setattr(cv2, "imshow", lambda title, image: shown.append(image))
    monkeypatch.setattr(cv2, "waitKey", lambda wait: next(keys))
    monkeypatch.setattr(cv2, "getWindowProperty", lambda title, name: float(len(shown) < 3))
    window = Window()
    picture = np.zeros((4, 6, 3), np.uint8)
    picture[..., 0] = 200
    assert window.show(picture) and not window.show(picture) and not window.show(picture)
    assert (shown[0] == (0, 0, 200)).all()  # red, as OpenCV orders it


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

    def exported(model: Model, pack: Pack, out: Path, **options: Any) -> None:
        made.append(model.classes["pattern"])
        shutil.copytree(onnx, out)

    monkeypatch.setattr("mvitac.deploy.export.export", exported)
    monkeypatch.setattr(
        "mvitac.deploy.publish.own_data", lambda model, instead: None
    )  # that of an artifact is not opened
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path / "cache"))
    for model in (artifact, other, artifact):
        assert _engine(str(model), 1, Console(quiet=True)).classes.keys() == {"pattern", "bright"}
    assert made == [("columns", "rows", "checks"), ("checks", "rows", "columns")]


def test_classes_are_not_plotted_over_time(onnx: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live", str(onnx), "--plot", "force.png"]) == 2
    assert "predicts classes only: leave it out" in capsys.readouterr().err


def test_live_command_on_folders(onnx: Path, pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Threads, files and the terminal view together; ends when the files do."""
    for m in ("vision", "touch"):
        (tmp_path / m).mkdir()
        for i in range(24):
            image = pack.images[m][0] if i < 12 else 255 - pack.images[m][0]
            Image.fromarray(image ^ np.uint8(i % 2)).save(tmp_path / m / f"{i:03d}.png")
    command = ["live", str(onnx), "--vision", f"{tmp_path / 'vision'}@20", "--touch", f"{tmp_path / 'touch'}@20"]
    assert main([*command, "--calibration", "2", "--stale", "60", "--json", str(tmp_path / "s.json")]) == 0
    summary = json.loads((tmp_path / "s.json").read_text())
    assert summary["streams"]["touch"]["frames"] == 24 and summary["events"]["ended"] == 2
    shown = capsys.readouterr().out
    assert "has no more frames" in shown and "touch: 24 frames" in shown
    assert summary["touches"] >= 1 and "touch 1 (" in shown  # also of a touch that the end of the files cut short
    assert main([*command, "--json", str(tmp_path)]) == 2 and "is a folder" in capsys.readouterr().err
    for wrong in (["--stale", "0"], ["--seconds", "-1"]):
        assert main([*command, *wrong]) == 2 and "more than 0" in capsys.readouterr().err


# -- values -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measuring(value_onnx: Path) -> Engine:
    return Engine(value_onnx, threads=1)


def test_a_value_is_that_of_the_newest_frame_with_the_spread_of_its_range(measuring: Engine) -> None:
    given = iter([1.0, 5.0, 3.0, 3.0, 3.0])

    class Rising(Slow):
        """Says 1, 5, 3, 3, ... levels; errors are 0.25 below 2 levels and 0.5 from there."""

        def __init__(self) -> None:
            super().__init__(measuring)
            self.values = {"light": [{"name": "level", "unit": "N", "edges": [2.0], "spread": [0.25, 0.5]}]}

        def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
            return {**self.engine(**images), "value_light": np.array([[next(given, 3.0)]], np.float32)}

    world, found = World(Rising()), []
    while world.live.num_predictions < 3:
        before = world.live.num_predictions
        world.run(0.05)  # one frame
        if world.live.num_predictions > before:
            (reading,) = world.live.readings(world.live.touch)["light"]
            found.append((reading.value, reading.spread, reading.low, reading.high))
    assert found == [(1.0, 0.25, 1.0, 1.0), (5.0, 0.5, 1.0, 5.0), (3.0, 0.5, 1.0, 5.0)]
    assert str(reading) == "3.0 N +- 0.5" and reading.over_touch() == "1.0 to 5.0 N +- 0.5"
    said = json.loads(json.dumps(world.live.prediction()))
    assert said["light"] == {"level": {"value": 3.0, "unit": "N", "spread": 0.5}} and said["contact"] is True
    assert said["pattern"]["class"] in measuring.classes["pattern"]
    assert "level      3.0 N +- 0.5" in shown(world.live)
    while world.live.touch:
        world.run(0.1)
    assert world.live.prediction() == {"touch": 1, "contact": False}


@pytest.mark.parametrize(("spread", "text"), [(0.04, "3.16 N"), (0.4, "3.2 N"), (12.0, "3 N"), (0.0, "3.162 N")])
def test_a_value_has_as_many_digits_as_its_spread_allows(spread: float, text: str) -> None:
    assert str(Reading("force_n", "N", 3.1622, spread, 3.0, 4.0)).startswith(text + " +- ")


def test_a_range_whose_ends_print_alike_is_one_number() -> None:
    ends = [Reading("force_n", "N", 3.1, 2.0, low, 3.2).over_touch() for low in (1.4, 2.9)]
    assert ends == ["1 to 3 N +- 2", "3 N +- 2"]


def test_the_picture_and_the_line_of_a_touch_have_values(measuring: Engine) -> None:
    world = World(measuring)
    assert draw(world.live).shape == (256 + 24 * (4 + 3), 512, 3)  # level, and level and weight
    while world.live.last is None:
        world.run(0.5)
    console = Console(width=300, file=io.StringIO())
    assert _print_touch(world.live, console, 0) == 1
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert re.search(r"weight: -?[\d.]+ (to -?[\d.]+ )?N \+- [\d.]+", text) and "level: " in text


def test_predictions_are_written_line_by_line(value_onnx: Path, measured: Pack, tmp_path: Path) -> None:
    for m in ("vision", "touch"):
        (tmp_path / m).mkdir()
        for i in range(12):
            image = measured.images[m][0] if i < 5 else 255 - measured.images[m][0]
            Image.fromarray(image ^ np.uint8(i % 2)).save(tmp_path / m / f"{i:03d}.png")
    command = ["live", str(value_onnx), "--vision", f"{tmp_path / 'vision'}@30", "--touch", f"{tmp_path / 'touch'}@30"]
    options = ["--calibration", "2", "--stale", "60", "--predictions", str(tmp_path / "p.jsonl")]
    assert main([*command, *options, "--plot", str(tmp_path / "p.png")]) == 0
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    lines = [json.loads(line) for line in (tmp_path / "p.jsonl").read_text().splitlines()]
    assert len(lines) > 3 and all(line["both"]["weight"]["unit"] == "N" for line in lines)
    assert [line["time"] for line in lines] == sorted({line["time"] for line in lines})
    assert all(line["both"]["weight"]["spread"] > 0 for line in lines)
    assert main([*command, "--predictions", str(tmp_path)]) == 2
    assert main([*command, "--plot", str(tmp_path)]) == 2


def test_values_over_time_are_drawn_with_their_error_and_touches_apart() -> None:
    def line(time: float, touch: int, force: float) -> dict[str, Any]:
        values = {"force_n": {"force_n": {"value": force, "unit": "N", "spread": 0.5}}}
        return {"time": time, "touch": touch, "contact": True, "soft": {"class": "hard", "confidence": 0.9}, **values}

    (axes,) = over_time([line(1.0, 1, 2.0), line(1.5, 1, 3.0), line(4.0, 2, 1.0), {"time": 5.0, "touch": 2}]).axes
    drawn = [curve.get_xydata().tolist() for curve in axes.lines]  # type: ignore[union-attr]
    assert drawn == [[[1.0, 2.0], [1.5, 3.0]], [[4.0, 1.0]]]
    band = axes.collections[0].get_paths()[0].vertices
    assert {1.5, 2.5, 3.5} == set(band[:, 1].tolist()) and axes.get_ylabel() == "force_n, N"  # type: ignore[union-attr, call-overload, index]
    with pytest.raises(ValueError, match="no values to draw"):
        over_time([{"time": 5.0, "touch": 2, "soft": {"class": "hard", "confidence": 0.9}}])


# -- the terminal -------------------------------------------------------------------------------------------------------


def touched(known: list[str]) -> SimpleNamespace:
    """A loop whose first touch has ended, with answers to two tasks."""
    touch = SimpleNamespace(number=1, start=0.0, end=2.1, known=known)
    answers = {"category": ("rubber", 0.23), "soft": ("soft", 0.8149)}
    return SimpleNamespace(
        last=touch,
        answers=lambda touch: answers,
        readings=lambda touch: {},
        clock=lambda: 0.0,
        config=LiveConfig(),
        engine=SimpleNamespace(classes={"category": ("rubber", "knit", "cloth"), "soft": ("hard", "soft")}),
    )


@pytest.mark.parametrize("terminal", [True, False])
def test_a_touch_is_told_without_breaking_a_word(terminal: bool) -> None:
    console = Console(width=80, force_terminal=terminal, file=io.StringIO(), color_system=None)
    known = ["14-0007-02 (leaf, soft, rough)", "06-0007-01 (tile, hard, rough)", "10-0002-04 (laminate, soft)"]
    assert _print_touch(touched(known), console, 0) == 1  # type: ignore[arg-type]
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    told = "touch 1 (2.1 s): category: rubber (23 %, unsure); hard/soft: soft (81 %); like: " + "; ".join(known)
    assert " ".join(line.rstrip() for line in lines) == told
    assert max(map(len, lines)) <= 80 if terminal else len(lines) == 1


def test_a_low_terminal_is_left_clean(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is drawn that is higher than the terminal: what scrolls out of it cannot be erased."""
    idle = {"ended": True, "fault": "", "num_frames": 0, "num_dropped": 0, "rate": lambda: 0.0}
    loop = touched([])
    loop.all = [SimpleNamespace(name=f"touch {i}", **idle) for i in range(12)]
    loop.streams, loop.touch, loop.last, loop.answers = {}, None, None, lambda touch: {}
    loop.state, loop.summary, loop.finish = lambda s: "waiting", lambda: {"age_ms": {"p50": None}}, lambda: None
    monkeypatch.setattr("mvitac.cli.live._capture", lambda *a: contextlib.nullcontext(threading.Event()))
    console = Console(width=80, height=6, force_terminal=True, file=io.StringIO())
    _run(loop, console, None, None)  # type: ignore[arg-type]
    drawn = re.split(r"\x1b\[\d*[AK]", console.file.getvalue())  # type: ignore[attr-defined]
    assert "touch 3" in "".join(drawn) and max(part.count("\n") for part in drawn) < 6
