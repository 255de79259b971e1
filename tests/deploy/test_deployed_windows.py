"""A model of windows in use: clips for ``embed`` and ``predict``, its artifact, its export, and live by time stamps."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import mvitac
from mvitac.cli.main import main
from mvitac.data.images import difference
from mvitac.data.pack import Pack
from mvitac.data.spec import Window
from mvitac.data.windows import windowed
from mvitac.datasets.pack import PackConfig
from mvitac.deploy.artifact import preprocessing
from mvitac.deploy.engine import Engine, frame_shapes
from mvitac.deploy.publish import publish
from mvitac.live.contact import LiveConfig
from mvitac.live.predictor import Live
from mvitac.live.streams import Stream
from mvitac.model import Model
from mvitac.recipes import recipe
from mvitac.training.loop import train
from support.faults import Clock, Rig
from support.toy import film


@pytest.fixture(scope="module")
def published(measured: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("windows")
    run = replace(recipe("smoke", PackConfig(path=measured.path, num_frames=2)), steps=2, eval_every=0)
    return publish(train(run, folder / "run", quiet=True), folder / "artifact")


@pytest.fixture(scope="module")
def model(published: Path) -> Model:
    return mvitac.load(published)


def test_a_clip_is_read_as_the_packs_window(model: Model, measured: Pack) -> None:
    """Rows 0 and 3 are the two frames of a touch: the window of row 3 shows row 3, then row 0."""
    touch, windows = measured.images["touch"], windowed(measured, Window(frames=2)).images["touch"]
    clip = np.stack([touch[0], touch[3]])
    wanted = model.features("touch", torch.from_numpy(windows[3:4]).permute(0, 3, 1, 2))
    assert not torch.allclose(model.embed(touch=clip[::-1].copy())["touch"], wanted)
    pictures = [Image.fromarray(frame) for frame in clip]
    tensors = torch.from_numpy(clip).permute(0, 3, 1, 2)
    for given in (clip, list(clip), pictures, tensors, clip[None], [clip], [pictures], windows[3:4], windows[3]):
        torch.testing.assert_close(model.embed(touch=given)["touch"], wanted)
    assert model.embed(touch=[clip, clip, clip])["touch"].shape[0] == 3
    said = model.predict(touch=np.stack([clip, clip]), vision=measured.images["vision"][[3, 3]])
    assert said["light"].shape == (2, 1) and said["pattern"].shape == (2, 3)


def test_other_than_clips_are_refused(model: Model) -> None:
    image = np.zeros((32, 32, 3), np.uint8)
    for given in (image, Image.fromarray(image), np.stack([image] * 3), [image]):
        with pytest.raises(ValueError, match=r"looks at 2 frames, got .*: give clips \[2, H"):
            model.embed(touch=given)


def test_each_frame_is_minus_the_first_one_of_its_touch(published: Path, measured: Pack) -> None:
    other = mvitac.load(published)
    other.spec = replace(other.spec, window=replace(other.spec.window, minus_first=True))
    touch = measured.images["touch"]
    clip, first = np.stack([touch[0], touch[3]]), touch[6]
    for ask, name in ((other.embed, "touch"), (other.predict, "pattern")):
        wanted = ask(touch=np.stack([difference(frame, first) for frame in clip]))[name]
        torch.testing.assert_close(ask(touch=clip, background=first)[name], wanted)
        assert not torch.allclose(ask(touch=clip)[name], wanted)
    assert "the background being the first frame of the touch" in preprocessing(other)["background"]
    other.spec = replace(other.spec, difference=True)
    with pytest.raises(ValueError, match="background cannot be used"):
        other.embed(touch=clip, background=first)


class Counter(Rig):
    """A sensor whose picture is its number of frames read; ``calls`` before 8 are the free sensor."""

    calls = 0

    def read(self) -> np.ndarray:
        self.calls += 1
        return np.full((32, 32, 3), 10 if self.calls <= 8 else 60 + self.calls, np.uint8)


class Seeing:
    """An engine of windows that keeps what it was shown: the level of each frame of touch."""

    def __init__(self, frames: int = 3, stride: float = 1.0, order: str = "frame", **window: Any) -> None:
        window = {"of": ["touch"], "minus_first": False, **window}
        self.window = {"frames": frames, "stride": stride, "order": order, **window}
        self.inputs = {"touch": (32, 32, 3 * frames)}
        self.classes, self.values, self.difference, self.seen = {}, {}, False, []

    def __call__(self, touch: np.ndarray) -> dict[str, np.ndarray]:
        assert touch.shape == (1, *self.inputs["touch"])
        self.seen.append((touch[0, 16, 16, ::3].astype(int)).tolist())
        return {}


def play(engine: Seeing, times: list[float], config: LiveConfig = LiveConfig(calibration=2)) -> list[list[int]]:
    """Frames at ``times`` (after eight free ones); what the engine saw, as frame numbers from 9 on."""
    clock = Clock()
    stream = Stream("touch", Counter(clock, 0), clock=clock)
    live = Live(engine, {"touch": [stream]}, config, clock=clock)  # type: ignore[arg-type]
    for time in [*(99 + k / 10 for k in range(8)), *times]:
        clock.now = time
        stream.pump()
        live.tick()
    return [[level - 60 for level in levels] for levels in engine.seen]


EVEN = [99.8 + k / 10 for k in range(6)]  # frames 9 to 14


def test_live_shows_this_frame_and_earlier_ones_of_the_touch() -> None:
    assert play(Seeing(), EVEN) == [[9, 9, 9], [10, 9, 9], [11, 10, 9], [12, 11, 10], [13, 12, 11], [14, 13, 12]]
    assert play(Seeing(frames=2, stride=2), EVEN)[-1] == [14, 12]
    assert play(Seeing(frames=2, stride=0.3, order="time"), EVEN)[-1] == [14, 11]  # in seconds


def test_dropped_frames_do_not_shift_a_window() -> None:
    """Without the frame at 100.0 the frames one and two steps back are still those of 0.1 and 0.2 s ago, or just older."""
    gap = [99.8, 99.9, 100.1, 100.2, 100.3]  # frames 9, 10, then 11 at the time of what would have been 12
    assert play(Seeing(), gap) == [[9, 9, 9], [10, 9, 9], [11, 10, 10], [12, 11, 10], [13, 12, 11]]
    jitter = [t + d for t, d in zip(EVEN, (0, 0.01, -0.01, 0.01, -0.01, 0.01), strict=True)]
    assert play(Seeing(), jitter) == play(Seeing(), EVEN)


def test_the_background_stands_for_the_first_frame() -> None:
    found = play(Seeing(frames=2, minus_first=True), EVEN)
    free, *later = (np.full((1, 1, 3), value, np.uint8) for value in (10, 60 + 14, 60 + 13))
    assert [level + 60 for level in found[-1]] == [difference(image, free)[0, 0, 0] for image in later]
    with pytest.raises(ValueError, match="background of touch alone"):
        play(Seeing(minus_first=True, of=["touch", "vision"]), [])


def test_a_stream_keeps_no_more_than_a_window_needs() -> None:
    clock = Clock()
    stream = Stream("touch", Counter(clock, 0, 64), clock=clock)
    stream.remember(0.5, 16)
    for k in range(100):
        clock.now = 99 + k / 10
        stream.pump()
    assert 6 <= len(stream._past) <= 7 and stream._past[0][1].shape == (16, 16, 3)


def test_exported_windows(published: Path, measured: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The plain pack is opened with the model's windows; live takes the frames of one sensor."""
    out = tmp_path / "export"
    assert main(["export", str(published), "--on", str(measured.path), "--out", str(out)]) == 0, capsys.readouterr().err
    engine, model = Engine(out, threads=1), mvitac.load(published)
    assert engine.inputs["touch"] == (32, 32, 6) and frame_shapes(engine)["touch"] == (32, 32, 3)
    assert engine.window and engine.window["order"] == "frame"
    images = {m: np.asarray(windowed(measured, Window(frames=2)).images[m][[3, 4]]) for m in ("vision", "touch")}
    np.testing.assert_allclose(engine(**images)["value_light"], model.predict(**images)["light"], rtol=1e-3, atol=1e-3)
    with pytest.raises(ValueError, match="touch: expected uint8"):
        engine(vision=images["vision"], touch=images["touch"][..., :3])
    for vision in (images["vision"][:1], images["vision"][:0]):
        with pytest.raises(ValueError, match=f"got {len(vision)} of vision and 2 of touch: give as many"):
            engine(vision=vision, touch=images["touch"])
    command = ["live", str(out), *film(measured, tmp_path, rest=4, num=10, fps=30)]
    capsys.readouterr()
    assert main([*command, "--calibration", "2", "--stale", "60"]) == 0
    assert next(json.loads(line) for line in capsys.readouterr().out.splitlines())["both"]["level"]["unit"] == "levels"
