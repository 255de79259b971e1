"""The measured sensors against the real frames that they come from (package taxim)."""

import importlib.util

import numpy as np
import pytest

from mvitac.datasets.simulated import MaterialsConfig
from mvitac.sim import measured
from mvitac.sim.gel import relax, render
from mvitac.sim.sensors import MEASURED

PIXEL = 2 * measured.MM


def real(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames [N, 240, 320, 3] in RGB, places of the ball [N, 2] and radii [N] in mm from the middle."""
    with np.load(measured.folder(name) / "dataPack.npz") as pack:
        frames = pack["imgs"][::6, ..., ::-1].reshape(-1, 240, 2, 320, 2, 3).mean((2, 4))
        places = (pack["touch_center"][::6] - [319.5, 239.5]) * measured.MM
        return frames, places, pack["touch_radius"][::6] * measured.MM


@pytest.mark.parametrize("name", sorted(MEASURED))
def test_a_gel_at_rest_is_the_real_frame(name: str):
    flat = np.zeros((160, 200), np.float32)
    with np.load(measured.folder(name) / "dataPack.npz") as pack:
        frame = pack["f0"][80:400, 120:520, ::-1].reshape(160, 2, 200, 2, 3).mean((1, 3))
    assert np.abs(measured.read(name).light(flat, flat, PIXEL, np.zeros(2), 1.0) - frame).mean() < 0.5


def test_a_ball_looks_as_in_the_real_frames():
    """Inside the contact, levels are off by a third of what the press changes, and the wrong channel order is worse."""
    x, y = (np.arange(n) * PIXEL - (n - 1) * PIXEL / 2 for n in (320, 240))
    gel, errors = measured.read("gelsight"), []
    for frame, place, radius in zip(*real("gelsight"), strict=True):
        away = np.hypot(x[None] - place[0], y[:, None] - place[1])
        ball = np.sqrt(np.maximum(measured.BALL_MM**2 - away**2, 0)) - np.sqrt(measured.BALL_MM**2 - radius**2)
        gy, gx = np.gradient(relax(np.maximum(ball, 0).astype(np.float32), pixel_mm=PIXEL), PIXEL)
        pressed, rest, pits = (gel.light(gx * s, gy * s, PIXEL, np.zeros(2), 1.0) for s in (1, 0, -1))
        inside = away < radius
        errors.append([np.abs(frame - other)[inside].mean() for other in (pressed, pressed[..., ::-1], pits, rest)])
    off, swapped, pit, blank = np.mean(errors, axis=0)
    assert off < blank / 3 and blank < min(swapped, pit)


def test_copies_differ_and_a_larger_field_than_the_gel_is_no_error():
    blank, sensor = np.zeros((48, 48), np.float32), MEASURED["gelsight"]
    one, same, other = (render(blank, sensor, np.random.default_rng(0), pixel_mm=0.27, unit=u) for u in (1, 1, 2))
    assert (one == same).all() and np.abs(one.astype(int) - other).mean() > 2
    assert render(blank, MEASURED["gelsight_mini"], np.random.default_rng(0), pixel_mm=22 / 48, unit=1).std() > 5


def test_random_and_named_sensors_add_up():
    config = MaterialsConfig(num=40, size=16, makes=("gelsight", "digit"), sensors=3, sensors_per_press=5)
    names = {sample.columns["sensor"] for sample in config.source().read(0)}
    assert names == {"gelsight", "digit", "random0000", "random0001", "random0002"}
    assert not {s.name for s in MaterialsConfig().choice()} & set(MEASURED)  # default data never change


def test_without_taxim_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    config = MaterialsConfig(num=40, makes=("gelsight",))  # a run that names it can still be read
    with pytest.raises(ValueError, match=r"pip install 'mvitac\[taxim\]'"):
        config.source()
