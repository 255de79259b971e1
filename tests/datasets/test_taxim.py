"""Real and simulated presses of one ball: what the labels say is where the picture changes."""

import math
from pathlib import Path

import numpy as np
import pytest

from mvitac.data.build import build
from mvitac.data.several import JoinedPack
from mvitac.datasets import taxim
from mvitac.datasets.taxim import TaximConfig
from mvitac.sim.ball import FIELD_MM


@pytest.mark.parametrize(
    ("options", "num", "within_mm"),
    [
        ({"makes": ("gelsight",)}, 48, 0.45),
        ({"makes": ("gelsight_mini",)}, 24, 0.45),
        ({"num": 30, "makes": ("gelsight", "gelsight_mini", "mini")}, 30, 0.3),
    ],
)
def test_the_picture_changes_where_the_label_says(options: dict, num: int, within_mm: float):
    source = TaximConfig(difference=True, size=96, **options).source()
    rows = [source.read(i)[0] for i in range(len(source.items()))]
    found, true = [], []
    for row in rows:
        change = np.abs(row.touch.astype(float) - 128).sum(2)
        change[change < change.max() / 3] = 0
        side = len(change)
        at = (np.arange(side) - (side - 1) / 2) * FIELD_MM / side
        found.append([(change.sum(axis) * at).sum() / change.sum() for axis in (0, 1)])
        true.append([row.columns["contact_x_mm"], row.columns["contact_y_mm"]])
    inside = np.abs(true).max(1) < 5  # the rest is cut by the rim
    assert len(rows) == num and inside.mean() > 0.5
    assert np.abs(np.subtract(found, true))[inside].mean() < within_mm


def test_real_frames_are_only_scored_and_depth_is_known_of_one_ball(tmp_path: Path):
    sources = [TaximConfig(num=num, sensors=3 * (num > 0), workers=1).source() for num in (40, 0)]
    learned, real = (build(one, tmp_path / str(i), size=32, workers=1) for i, one in enumerate(sources))
    assert {"train", "val", "test"} == {*learned.column("split")} and {*real.column("split")} == {"test"}
    sensor, depth = real.column("sensor"), real.column("depth_mm")
    assert np.isnan(depth).tolist() == (sensor == "gelsight_mini").tolist()
    assert depth[0] == pytest.approx(2 - np.sqrt(4 - (63 * 0.0295) ** 2))
    assert len({*real.column("group")[sensor == "gelsight_mini"]}) == 3
    assert [task.name for task in JoinedPack(learned, real).spec.all_tasks] == ["place", "radius", "depth"]


@pytest.mark.parametrize("radius", [-1, 80, math.nan])
def test_a_damaged_calibration_is_named(radius: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    whole = {"imgs": np.zeros((2, 480, 640, 3), np.uint8), "f0": np.zeros((480, 640, 3), np.uint8)}
    np.savez(tmp_path / "dataPack.npz", **whole, touch_center=np.full((2, 2), 99), touch_radius=np.array([60, radius]))
    monkeypatch.setattr("mvitac.datasets.taxim.measured.folder", lambda make: tmp_path)
    taxim._pack.cache_clear()
    with pytest.raises(ValueError, match=r"dataPack.npz is damaged \(not for each image a circle"):
        TaximConfig(makes=("gelsight",)).source().items()
    (tmp_path / "dataPack.npz").write_bytes(b"PK\3\4")
    with pytest.raises(ValueError, match=r"dataPack.npz is damaged"):
        TaximConfig(makes=("gelsight",)).source().items()


def test_real_frames_of_a_sensor_that_has_none_are_an_error():
    with pytest.raises(ValueError, match="digit: real frames are of gelsight and gelsight_mini"):
        TaximConfig(makes=("digit",)).source()
