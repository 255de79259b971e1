"""Simulated materials and gel optics: what must hold whatever the generator's numbers are."""

import hashlib
import subprocess
import sys
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from mvitac.data.source import Sample
from mvitac.data.spec import DataSpec
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.registry import from_json, to_json
from mvitac.sim import gel
from mvitac.sim.gel import GEL_STIFFNESS, area_resize, contact, pressure, render
from mvitac.sim.materials import CLASSES, Instance, touch
from mvitac.sim.relief import KINDS, Relief, draw_tables, noise
from mvitac.sim.sensors import SENSORS, random_sensors

LIST = "import sys; from mvitac.sim.materials import touch; import hashlib; p = touch(3, 7, 2, 1, size=32); "
PRINT = "print(hashlib.sha256(p['vision'].tobytes() + p['touch'].tobytes()).hexdigest())"


def digest(pair: dict) -> str:
    return hashlib.sha256(pair["vision"].tobytes() + pair["touch"].tobytes()).hexdigest()


def bumps(seed: int = 0) -> np.ndarray:
    relief = np.random.default_rng(seed).normal(0, 0.2, (48, 64)).astype(np.float32)
    relief[:, :5] = -np.inf
    return relief


def test_an_item_depends_on_its_numbers_alone():
    first = digest(touch(3, 7, 2, 1, size=32))
    touch(3, 8, 2, 1, size=32)
    assert digest(touch(3, 7, 2, 1, size=32)) == first
    other = subprocess.run([sys.executable, "-c", LIST + PRINT], capture_output=True, text=True, check=True, timeout=60)
    assert other.stdout.strip() == first
    items = [(0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)]
    assert len({digest(touch(*item, size=32)) for item in items}) == len(items)


@pytest.mark.parametrize("size", [16, 72, 256])
def test_a_size_changes_the_pixels_and_not_the_scene(size):
    pair, small = touch(0, 11, 0, 0, size=size), touch(0, 11, 0, 0, size=64)
    for name in ("vision", "touch"):
        assert pair[name].shape == (size, size, 3) and pair[name].dtype == np.uint8
        coarse = [p[name].reshape(8, p[name].shape[0] // 8, 8, -1, 3).mean((1, 3)) for p in (pair, small)]
        assert np.abs(coarse[0] - coarse[1]).mean() < 8
    assert {k: v for k, v in pair.items() if np.isscalar(v)} == {k: v for k, v in small.items() if np.isscalar(v)}


def test_the_held_out_sensor_is_never_drawn_otherwise():
    seen = {touch(0, c, 0, 0, size=16)["sensor"] for c in range(len(CLASSES))}
    assert len(seen) >= 3 and all(not SENSORS[name].held_out for name in seen)
    pair = touch(0, 0, 0, 0, size=16, sensors=[SENSORS["slim"]])
    assert SENSORS[pair["sensor"]].held_out and (pair["vision"] == touch(0, 0, 0, 0, size=16)["vision"]).all()


def test_difference_images_are_of_the_same_sensor_before_contact():
    plain, differing = (MaterialsConfig(num=60, size=32, difference=d).source() for d in (False, True))
    assert from_json(DataSpec, to_json(differing.spec())) == differing.spec() == replace(plain.spec(), difference=True)
    assert differing.fingerprint() != plain.fingerprint()
    reached = []
    for item in (0, 23, 47):
        a, b = plain.read(item)[0], differing.read(item)[0]
        assert isinstance(a, Sample) and isinstance(b, Sample) and a.columns == b.columns
        assert a.vision is not None and a.touch is not None and b.touch is not None
        assert np.array_equal(a.vision, b.vision)
        drawn = touch(0, item % 20, 0, item // 20, size=32, background=True)
        assert np.array_equal(drawn["touch"], a.touch), "drawing the background changes no other picture"
        assert np.abs(2.0 * b.touch - 256 + drawn["background"] - a.touch).max() <= 1
        reached.append([np.abs(a.touch - np.median(a.touch)).mean(), np.abs(b.touch - 128.0).mean()])
    whole, differing_only = np.mean(reached, axis=0)
    assert 4 < differing_only < whole / 2  # the imprint is there; lamps, dots and dirt are gone


def test_labels_are_balanced_and_not_the_category_again():
    things = [[Instance(0, c, i) for i in range(60)] for c in range(len(CLASSES))]
    for label in ("soft", "rough"):
        share = np.array([[getattr(thing, label) for thing in row] for row in things]).mean(1)
        assert 0.4 <= share.mean() <= 0.6 and share.min() > 0.05 and share.max() < 0.95
        assert np.maximum(share, 1 - share).mean() <= 0.8  # who knows the class knows the label this often


@pytest.mark.parametrize(("force", "stiffness", "dome"), [*product((0.01, 1.0, 20.0), (0.02, 1e3), (None, 20.0))])
def test_pressure_integrates_to_the_force(force, stiffness, dome):
    p = pressure(bumps(), force_n=force, stiffness=stiffness, pixel_mm=0.2, dome_radius_mm=dome)
    assert p.min() >= 0 and p.sum(dtype=np.float64) * 0.2**2 == pytest.approx(force, rel=0.01)


def test_contact_is_that_of_the_closed_form():
    """A paraboloid in Winkler springs: depth d, area 2 pi R d; a tilt of a moves the centre by R a."""
    x = (np.arange(301) - 150) * 0.1

    def pressed(relief: np.ndarray, force: float = 1.5) -> dict[str, float]:
        known = {"force_n": force, "stiffness": 1e9, "pixel_mm": 0.1, "dome_radius_mm": 20.0}
        return contact(pressure(relief.astype(np.float32), **known), pixel_mm=0.1)

    depth, flat = np.sqrt(1.5 / (np.pi * GEL_STIFFNESS * 20.0)), pressed(np.zeros((301, 301)))
    assert flat["depth_mm"] == pytest.approx(depth, rel=0.01)
    assert flat["patch_mm2"] == pytest.approx(2 * np.pi * 20.0 * depth, rel=0.02)
    assert (flat["contact_x_mm"], flat["contact_y_mm"]) == pytest.approx((0, 0), abs=1e-6)
    tilted = pressed(np.tile(0.1 * x, (301, 1)))
    assert (tilted["contact_x_mm"], tilted["contact_y_mm"]) == pytest.approx((2.0, 0), abs=0.02)
    lifted = pressed(bumps(), 0.0)
    assert lifted["depth_mm"] == lifted["patch_mm2"] == 0 and np.isnan(lifted["contact_x_mm"])


def test_measuring_the_contact_changes_no_picture():
    plain, measured = MaterialsConfig(num=40, size=32), MaterialsConfig(num=40, size=32, contact=True)
    assert measured.source().fingerprint() != plain.source().fingerprint()
    ((one,), (other,)) = (config.source().read(7) for config in (plain, measured))
    assert np.array_equal(one.touch, other.touch) and np.array_equal(one.vision, other.vision)
    new = {target.name: target.unit for task in measured.source().spec().values[1:] for target in task.targets}
    assert new == {"depth_mm": "mm", "contact_x_mm": "mm", "contact_y_mm": "mm", "patch_mm2": "mm2"}
    assert other.columns.keys() - one.columns.keys() == set(new) and {**other.columns, **one.columns} == other.columns


@pytest.mark.parametrize("sensor", [*SENSORS.values()], ids=lambda s: s.name)
def test_opposite_slopes_change_the_colour_oppositely(sensor):
    bare = replace(sensor, shadow=0.0, marker_pitch_mm=0.0, noise=0.0)
    x = np.linspace(-1, 1, 96, dtype=np.float32)
    ridge = 0.3 * np.exp(-((x / 0.3) ** 2))[None] * np.exp(-((x / 0.3) ** 2))[:, None]
    shapes = [h.astype(np.float32) for h in (ridge, -ridge, 0 * ridge)]
    levels = [render(h, bare, np.random.default_rng(0), pixel_mm=0.1, unit=1).astype(float) for h in shapes]
    up, down = levels[0] - levels[2], levels[1] - levels[2]
    assert np.abs(up).max() > 10
    assert np.abs(up + down).max() <= 3  # odd in slope, up to rounding and the paint's grain
    assert np.abs(up.mean((0, 1))).max() < 1  # a symmetric bump leaves the mean colour


@pytest.mark.parametrize("kind", [*KINDS])
def test_every_relief_has_unit_height_and_the_skewness_asked_for(kind):
    axis = np.arange(96, dtype=np.float32) * 0.15
    x, y = np.meshgrid(axis, axis)
    tables = draw_tables(np.random.default_rng(0))
    for asperity in (-0.7, 0.7):
        height = Relief(kind=kind, wavelength_mm=1.5, asperity=asperity, tables=tables)(x, y)
        assert height.std() == pytest.approx(1, abs=0.3)
        assert np.sign(((height - height.mean()) ** 3).mean()) == np.sign(asperity)


def test_the_fast_lattice_is_the_plain_formula_bit_for_bit():
    """The generator is frozen: whoever makes it faster may not change a pixel."""
    table = draw_tables(np.random.default_rng(1))[0]
    u, v = np.random.default_rng(2).uniform(-200, 200, (2, 90, 70)).astype(np.float32)
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - np.floor(u), v - np.floor(v)
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)

    def corner(di: int, dj: int) -> np.ndarray:
        return table[(i + di) % 64, (j + dj) % 64]

    near = corner(0, 0) + a * (corner(1, 0) - corner(0, 0))
    assert (noise(u, v, table) == near + b * ((corner(0, 1) + a * (corner(1, 1) - corner(0, 1))) - near)).all()


def test_halving_is_the_area_average_bit_for_bit():
    picture = np.random.default_rng(0).normal(80, 60, (48, 64, 3)).astype(np.float32)
    rows, columns = gel._area_weights(48, 24), gel._area_weights(64, 32)
    general = np.einsum("hH,HWc->hWc", rows, picture).transpose(0, 2, 1).dot(columns.T).transpose(0, 2, 1)
    assert (area_resize(picture, 24, 32) == general).all()


def test_random_sensors_lie_round_the_known_ones_and_not_on_the_held_out_one():
    drawn = random_sensors(0, 300)
    assert random_sensors(0, 2) == drawn[:2] != random_sensors(1, 2)  # a function of (seed, number)
    assert len({s.base for s in drawn}) == 300 and not any(s.held_out for s in drawn)
    known = [s for s in SENSORS.values() if not s.held_out]
    for name in ("saturation", "shadow", "dirt", "scratches", "edge", "noise"):
        values, theirs = ([getattr(s, name) for s in some] for some in (known, drawn))
        margin = 0.25 * (max(values) - min(values))
        assert min(values) - margin <= min(theirs) < max(theirs) <= max(values) + margin
    assert 0.4 < np.mean([s.marker_pitch_mm > 0 for s in drawn]) < 0.6
    angles = np.array([[np.arctan2(y, x) for x, y in s.response] for s in drawn])
    apart = np.sort(np.mod(angles - angles[:, :1], 2 * np.pi)[:, 1:], axis=1)
    assert (np.abs(apart - [2 * np.pi / 3, 4 * np.pi / 3]) <= 0.8).all()  # LEDs from three sides, in either order
    assert 0.4 < (np.mod(angles[:, 1] - angles[:, 0], 2 * np.pi) < np.pi).mean() < 0.6
    slim = np.array(SENSORS["slim"].response)
    nearest = min(np.linalg.norm(np.array(s.response) - slim) / np.linalg.norm(slim) for s in drawn)
    assert nearest > 0.05  # no copy of it among the first 300


def test_one_press_through_two_sensors_shares_the_imprint_alone():
    """The same forces and place; another sensor, copy, camera picture."""
    known = [s for s in SENSORS.values() if not s.held_out]
    first, second = (touch(0, 4, 1, 0, size=48, sensors=known, through=number) for number in (0, 1))
    assert digest(first) == digest(touch(0, 4, 1, 0, size=48))  # the first is the press as always
    assert first["force_n"] == second["force_n"] and first["angle_rad"] == second["angle_rad"]
    assert len({touch(0, 4, 1, 0, size=16, through=number)["sensor"] for number in range(4)}) == 4
    one = [replace(known[0], name=name) for name in ("a", "b")]  # alike, so what differs is copy, gain and noise

    def shape(made: dict) -> np.ndarray:
        levels = made["touch"].astype(float) - made["background"]
        return (levels - levels.mean((0, 1))).ravel()

    options = {"size": 48, "sensors": one, "background": True}
    here, again = (shape(touch(0, 4, 1, 0, through=number, **options)) for number in (0, 1))
    assert np.corrcoef(here, again)[0, 1] > 0.8 > 0.4 > np.corrcoef(here, shape(touch(0, 4, 1, 1, **options)))[0, 1]
    with pytest.raises(ValueError, match="there are 4 sensors"):
        touch(0, 4, 1, 0, size=48, through=4)


def test_packs_say_which_sensor_pressed():
    plain = MaterialsConfig(num=40, size=16)
    for options in ({"makes": ("digit",)}, {"sensors": 7}, {"sensors_per_press": 2}):
        assert replace(plain, **options).place() != plain.place()
    two = replace(plain, makes=("mini", "digit"), sensors_per_press=2).source()
    rows = [sample.columns for item in range(4) for sample in two.read(item)]
    of_presses = [{row["sensor"] for row in rows if row["press"] == press} for press in {row["press"] for row in rows}]
    assert of_presses == [{"mini", "digit"}] * 4
    assert len({row["id"] for row in rows}) == 8 == sum(two.samples_per_item()[:4])
    assert replace(plain, sensors=7).source().read(0)[0].columns["sensor"].startswith("random000")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"makes": ("mimi",)}, "unknown sensor 'mimi'.*did you mean 'mini'"),
        ({"sensors": 5, "held_out_sensor": True}, "leave out makes and sensors"),
        ({"held_out_sensor": True, "sensors_per_press": 2}, "give 1 to 1"),
    ],
)
def test_impossible_sensors_are_errors(options: dict, says: str):
    with pytest.raises(ValueError, match=says):
        MaterialsConfig(num=40, **options)
