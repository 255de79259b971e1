"""Flips of touch with their colours: against the simulator, where lamps and mirrored touches are known."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from mvitac.data.build import build
from mvitac.data.pack import Pack, Store
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Task
from mvitac.datasets.pack import PackConfig
from mvitac.recipes import recipe
from mvitac.run import Run
from mvitac.sim.gel import render
from mvitac.sim.sensors import SENSORS
from mvitac.training.loader import Feed
from mvitac.training.loop import train
from mvitac.training.views import make_views
from mvitac.transforms.gel_flip import MIN_ROWS, GelMirror, slope_colours
from mvitac.transforms.random_views import Augment, ViewAugment, plain_view
from support.toy import toy_pack

SIDE = 48
PIXEL_MM = 12.8 / SIDE
CPU = torch.device("cpu")
CLEAN = {name: replace(sensor, marker_pitch_mm=0, dirt=0, scratches=0, noise=0) for name, sensor in SENSORS.items()}
GELS = {"a": ("mini", "classic"), "b": ("digit", "mini_dots")}
"""sensor -> the two gels that a stacked image of it shows."""


def imprint(seed: int) -> np.ndarray:
    """Bumps of about a millimetre in a dome that is off the middle, [SIDE, SIDE] mm."""
    rng = np.random.default_rng(seed)
    bumps = gaussian_filter(rng.standard_normal((SIDE, SIDE)), 2.5)
    y, x = (np.mgrid[0:SIDE, 0:SIDE] - SIDE / 2 - rng.normal(0, 6, (2, 1, 1))) * PIXEL_MM
    return np.maximum(0.25 * bumps / bumps.std() + 0.8 - (x**2 + y**2) / 40, 0).astype(np.float32)


def picture(name: str, seed: int, **changes: Any) -> np.ndarray:
    return render(
        imprint(seed), replace(SENSORS[name], **changes), np.random.default_rng(seed), pixel_mm=PIXEL_MM, unit=seed
    )


@dataclass
class Gels(Source):
    """Touches of two stacked gels, of two sensors in turn; no camera."""

    num: int = 2 * MIN_ROWS
    gray: bool = False

    def spec(self) -> DataSpec:
        task = Task(name="odd", classes=("even", "odd"))
        return DataSpec(
            name="gels", vision_channels=0, touch_channels=6, tasks=(task,), group_by="item", licence="", source=""
        )

    def items(self) -> list[str]:
        return [f"item {i}" for i in range(self.num)]

    def fingerprint(self) -> dict[str, Any]:
        return {"num": self.num, "gray": self.gray}

    def read(self, item: int) -> list[Sample]:
        sensor = "ab"[item % 2]
        touch = np.concatenate([picture(name, 2 * item + i) for i, name in enumerate(GELS[sensor])], axis=2)
        if self.gray:
            touch = np.repeat(touch[:, :, :1], 6, axis=2)
        name = f"{item:03d}"
        columns = {"id": name, "group": name, "split": "train", "label_odd": item % 2, "sensor": sensor}
        return [Sample(vision=None, touch=touch, columns=columns)]


@pytest.fixture(scope="module")
def gels(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return build(Gels(), tmp_path_factory.mktemp("gels") / "pack", size=SIDE, quiet=True)


@pytest.fixture(scope="module")
def mirror(gels: Pack) -> GelMirror:
    return GelMirror(gels, CPU)


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def both(num: int) -> torch.Tensor:
    return torch.ones(num, 2, dtype=torch.bool)


def test_colours_of_exact_slopes() -> None:
    """Both colours, their proportion and that ink is no slope, to a per cent; the sign of the height stays open."""
    response, ink = np.array([[-100.0, 20], [30, 40], [60, -90]]), np.array([30.0, 50, 20])
    heights = np.stack([imprint(i) for i in range(32)])
    gy, gx = np.gradient(heights, PIXEL_MM, axis=(1, 2))
    dots = gaussian_filter(np.random.default_rng(0).standard_normal(heights.shape), (0, 1, 1))[..., None] * ink
    colours, mixtures, curl = slope_colours(np.stack([gx, gy], -1) @ response.T + dots)
    assert curl < 0.01
    factor = colours[0, 0] / response[0, 0]
    np.testing.assert_allclose(colours / factor, response, atol=2)
    np.testing.assert_allclose(mixtures.T @ colours, np.eye(2), atol=1e-6)
    assert np.abs(mixtures.T @ ink).max() < 0.03 * np.abs(mixtures.T @ response).max()


@pytest.mark.parametrize("name", SENSORS)
def test_colours_of_simulated_sensors(name: str) -> None:
    """From a few pictures of different copies, with dots, dirt, saturation and shadow: within 18 degrees of the lamps."""
    pictures = np.stack([picture(name, i) for i in range(MIN_ROWS)]).astype(float)
    colours, _, curl = slope_colours(pictures - pictures.mean(0))
    true = np.array(SENSORS[name].response, float)
    sign = np.sign(colours[:, 0] @ true[:, 0])
    assert cosine(sign * colours[:, 0], true[:, 0]) > 0.95
    assert cosine(sign * colours[:, 1], true[:, 1]) > 0.95
    assert curl < 0.15


@pytest.mark.parametrize("sensor", GELS)
def test_a_flip_with_colours_is_nearer_to_the_mirrored_touch(gels: Pack, mirror: GelMirror, sensor: str) -> None:
    """On touches that were not seen, of clean copies of the sensor: less than half of the plain flip's error."""
    rows = np.full(6, "ab".index(sensor))
    for gel, name in enumerate(GELS[sensor]):
        seen, true = (
            np.stack(
                [
                    render(touch, CLEAN[name], np.random.default_rng(0), pixel_mm=PIXEL_MM, unit=seed)
                    for seed in range(900, 906)
                    for touch in (imprint(seed)[:, ::step].copy(),)
                ]
            )
            for step in (1, -1)
        )
        images = torch.from_numpy(np.concatenate([seen, seen], axis=3)).permute(0, 3, 1, 2)
        flipped = mirror(images, rows, both(6))[:, 3 * gel : 3 * gel + 3].permute(0, 2, 3, 1).numpy()
        colour, plain = (np.sqrt(np.square(f.astype(float) - true).mean()) for f in (flipped, seen[:, :, ::-1]))
        assert colour < 0.5 * plain, (name, colour, plain)


def test_mirrored_twice_is_the_touch_itself(gels: Pack, mirror: GelMirror) -> None:
    rows = np.arange(8)
    images = Feed(gels, CPU)("touch", rows)
    twice = mirror(mirror(images, rows, both(8)), rows, both(8))
    assert (twice.int() - images.int()).abs().float().mean() < 1.0
    assert not torch.equal(mirror(images, rows, both(8)), images.flip(-1))


def test_gels_and_rows_are_mirrored_by_themselves(gels: Pack, mirror: GelMirror) -> None:
    rows = np.array([0, 1, 2, 5])
    images = Feed(gels, CPU)("touch", rows)
    before = images.clone()
    which = torch.tensor([[True, False], [False, True], [False, False], [True, True]])
    made = mirror(images, rows, which)
    assert torch.equal(images, before)
    for i, row in enumerate(rows):
        alone = mirror(images[i : i + 1], np.array([row]), both(1))[0]
        for gel in range(2):
            part = slice(3 * gel, 3 * gel + 3)
            assert torch.equal(made[i, part], (alone if which[i, gel] else images[i])[part])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_mirrors_as_the_cpu_does(gels: Pack, mirror: GelMirror) -> None:
    rows, device = np.arange(8), torch.device("cuda")
    images = Feed(gels, CPU)("touch", rows)
    there = GelMirror(gels, device)(images.to(device), rows, both(8)).cpu()
    assert (there.int() - mirror(images, rows, both(8)).int()).abs().max() <= 1


def colour_run(pack: Pack, **touch: Any) -> Run:
    run = recipe("smoke", PackConfig(path=pack.path))
    always = ViewAugment(scale=(1.0, 1.0), grayscale=0.0, **touch)
    return replace(run, augment=Augment(size=SIDE, whole=SIDE, gel_flip="colour", touch=always), steps=2, batch_size=8)


def test_views_are_flipped_with_their_colours(gels: Pack, mirror: GelMirror) -> None:
    """With whole-image crops a view is the mirrored image itself, at the probability asked for, gel by gel if asked."""
    rows, feed = np.arange(64), Feed(gels, CPU)
    images = feed("touch", rows)
    kept, mirrored = (plain_view(i, SIDE).split(3, dim=1) for i in (images, mirror(images, rows, both(64))))
    for touch in ({"flip": 1.0}, {"flip": 0.3}, {"flip": 0.5, "independent_sensors": True}):
        run = colour_run(gels, **touch)
        made = make_views(run, gels, rows, 2, torch.Generator().manual_seed(1), CPU, feed, mirror).images["touch"]
        flips = []
        for view in made:
            for gel, part in enumerate(view.split(3, dim=1)):
                flipped = (part - mirrored[gel]).abs().flatten(1).amax(1) < 1e-5
                assert (flipped | ((part - kept[gel]).abs().flatten(1).amax(1) < 1e-5)).all()
                flips.append(flipped)
        assert float(torch.stack(flips).float().mean()) == pytest.approx(touch["flip"], abs=0.1)
        assert torch.equal(flips[0], flips[1]) != ("independent_sensors" in touch)
        assert torch.equal(flips[0], flips[2]) == (touch["flip"] == 1)


@pytest.mark.parametrize("store", ["raw", "jpeg"])
def test_training_flips_with_colours_and_says_so(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gels = build(Gels(), tmp_path / "pack", size=SIDE, quiet=True, store=store)
    calls = []
    real = GelMirror.__call__
    monkeypatch.setattr(GelMirror, "__call__", lambda self, *args: calls.append(len(args[1])) or real(self, *args))
    out = train(colour_run(gels, flip=0.5), tmp_path / "run", quiet=True)
    assert calls == [8] * 4  # two steps of two views
    assert json.loads((out / "run.json").read_text())["run"]["augment"]["gel_flip"] == "colour"


def test_what_cannot_be_flipped_so_is_told(tmp_path: Path) -> None:
    def refused(pack: Pack, match: str) -> None:
        with pytest.raises(ValueError, match=match):
            train(colour_run(pack, flip=0.5), tmp_path / "run", quiet=True)
        assert not (tmp_path / "run").exists()

    few = build(Gels(num=2 * MIN_ROWS - 1), tmp_path / "few", size=SIDE, quiet=True)
    refused(few, rf"sensor 'b' has {MIN_ROWS - 1} training rows .* give --augment.gel-flip plain")
    gray = build(Gels(gray=True), tmp_path / "gray", size=SIDE, quiet=True)
    refused(gray, r"sensor 'a': colours do not follow slopes .*\(curl 0\.\d+\): give --augment.gel-flip plain")
    blind = toy_pack(tmp_path / "blind", size=SIDE, touch_channels=0)
    refused(blind, "'toy' has no touch to flip: give --augment.gel-flip plain")


def test_one_signal_is_not_two_slopes() -> None:
    """Stripes obey any law about how things change along them."""
    stripes = np.sin(np.arange(SIDE) + np.arange(8)[:, None])[:, None, :, None] * np.full((SIDE, 1, 3), 60.0)
    with pytest.raises(ValueError, match="do not follow slopes"):
        slope_colours(stripes)
    with pytest.raises(ValueError, match="do not follow slopes"):
        slope_colours(np.zeros((8, SIDE, SIDE, 3)))
