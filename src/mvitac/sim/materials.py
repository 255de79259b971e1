"""Simulated materials: a camera picture and a tactile picture of the same surface, with labels.

A class gives ranges; an instance is one object with its own relief, colour and physics; a touch is one press of it with its
own pose, force, sensor, lamp and background. Split by instance.

The generator was designed by one rule (docs/simulator.md). Therefore:
- "soft" is a threshold on the instance's stiffness, not on its class. Soft objects fold along curves and have lumpy outlines
  and rolled edges; hard ones crack along straight lines and have corners. Number and size of marks carry no information.
- "rough" is the sign of the height skewness: raised peaks or sunk pits. Pictures of both have the same spectrum.
- Force, LED gain, sensor, lamp, tint, amplitude, background and clutter vary much more than the labels' effects.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvitac.sim import gel
from mvitac.sim.gel import GEL_STIFFNESS, F, area_resize, grid
from mvitac.sim.relief import Relief, draw_tables, fractal, marks
from mvitac.sim.sensors import SENSORS, Sensor

VERSION = 1  # stored in the pack. Increase it with every change of a pixel.
SOFT_BELOW = 0.12  # stiffness in N/mm^3 below which an instance is labelled soft
Place = NDArray[np.float64]  # (x, y), in mm unless said otherwise
_TAG = 0x3A7
_TOUCH_MM = 12.8  # width of the gel's field of view
_CAMERA_MM = 90.0  # width of the camera's field of view at zoom 1


@dataclass(frozen=True)
class Material:
    """Ranges of one class. `sight` and `feel` are relief kinds at camera and gel scale."""

    name: str
    sight: str
    feel: str
    colour: tuple[float, float, float]  # mean reflectance; instances vary widely around it
    gloss: tuple[float, float] = (0.0, 0.3)
    soft: float = 0.5  # fraction of soft instances (thin sheets on foam, panels on rubber, ...)
    rough: float = 0.5


# Some classes are similar on purpose: laminate looks like wood and feels like plastic; concrete and sand look alike, and so
# do glass, plastic and paper; concrete and brick feel alike, and so do glass, metal and tile. One sense is not enough.
MATERIALS: tuple[Material, ...] = (
    Material("concrete", "blotch", "pores", (0.52, 0.51, 0.49), soft=0.3, rough=0.5),
    Material("rock", "facets", "facets", (0.47, 0.45, 0.43), soft=0.28, rough=0.66),
    Material("sand", "blotch", "grains", (0.62, 0.55, 0.44), soft=0.68, rough=0.6),
    Material("gravel", "pebbles", "pebbles", (0.5, 0.48, 0.46), soft=0.35, rough=0.7),
    Material("soil", "grains", "blotch", (0.34, 0.26, 0.19), soft=0.72, rough=0.6),
    Material("brick", "brick", "pores", (0.55, 0.32, 0.25), soft=0.3, rough=0.62),
    Material("tile", "tiles", "plain", (0.6, 0.6, 0.58), gloss=(0.2, 0.8), soft=0.3, rough=0.32),
    Material("glass", "plain", "plain", (0.42, 0.5, 0.5), gloss=(0.4, 1.0), soft=0.28, rough=0.3),
    Material("metal", "brushed", "plain", (0.55, 0.56, 0.58), gloss=(0.3, 1.0), soft=0.28, rough=0.34),
    Material("plastic", "plain", "emboss", (0.5, 0.45, 0.45), gloss=(0.2, 0.8), soft=0.5, rough=0.36),
    Material("laminate", "wood", "emboss", (0.52, 0.38, 0.26), gloss=(0.1, 0.6), soft=0.4, rough=0.36),
    Material("wood", "wood", "wood", (0.54, 0.4, 0.27), soft=0.36, rough=0.5),
    Material("bark", "fissures", "fissures", (0.36, 0.3, 0.24), soft=0.42, rough=0.7),
    Material("grass", "blades", "blades", (0.34, 0.45, 0.22), soft=0.72, rough=0.55),
    Material("leaf", "veins", "veins", (0.3, 0.45, 0.2), gloss=(0.0, 0.5), soft=0.7, rough=0.42),
    Material("paper", "plain", "fibres", (0.66, 0.64, 0.58), soft=0.6, rough=0.4),
    Material("leather", "crackle", "crackle", (0.4, 0.27, 0.2), gloss=(0.1, 0.6), soft=0.7, rough=0.4),
    Material("rubber", "studs", "studs", (0.3, 0.3, 0.31), gloss=(0.0, 0.4), soft=0.7, rough=0.46),
    Material("cloth", "weave", "weave", (0.48, 0.42, 0.46), soft=0.72, rough=0.5),
    Material("knit", "rib", "rib", (0.46, 0.44, 0.5), soft=0.74, rough=0.56),
)
CLASSES: tuple[str, ...] = tuple(m.name for m in MATERIALS)


class Instance:
    """One object: what both its pictures share. Lengths in mm, stiffness in N/mm^3."""

    def __init__(self, seed: int, category: int, instance: int) -> None:
        """Draw the object, which depends on the three numbers only."""
        rng, m = np.random.default_rng([_TAG, seed, category, instance]), MATERIALS[category]
        self.soft, self.rough = rng.random() < m.soft, rng.random() < m.rough
        decades = rng.uniform(0.1, 0.6) if self.soft else -rng.uniform(0.1, 1.6)
        asperity = rng.uniform(0.3, 0.85) * (1 if self.rough else -1)
        wavelength = np.exp(rng.uniform(*np.log((0.9, 2.4))))  # mm
        shared: Any = {"anisotropy": rng.uniform(1.0, 1.3), "irregularity": rng.uniform(0.1, 0.6)}
        ratio = rng.uniform(6.0, 9.0)
        shared |= {"asperity": asperity, "tables": draw_tables(rng)}
        self.sight = Relief(kind=m.sight, wavelength_mm=wavelength * ratio, **shared)
        self.feel = Relief(kind=m.feel, wavelength_mm=wavelength, **shared)
        self.stiffness: float = SOFT_BELOW * 10**-decades
        mean = np.asarray(m.colour, np.float32)
        colour = np.clip(mean * np.exp(rng.normal(0, 0.28)) * np.exp(rng.normal(0, 0.12, 3)), 0.08, 0.85)
        self.colour = colour.astype(np.float32)
        self.amplitude_mm = float(np.exp(rng.uniform(*np.log((0.05, 0.13)))))
        self.gloss = rng.uniform(*m.gloss)
        # The second colour follows the relief with either sign.
        self.ink = np.clip(colour * np.exp(rng.normal(0, 0.25, 3)), 0.05, 0.9).astype(np.float32)
        self.contrast = rng.uniform(-0.6, 0.6)

    @property
    def curl(self) -> float:
        """Whether marks and outlines are folds (1) or cracks (0), continuously."""
        return float(np.clip(0.5 - 2.6 * np.log10(self.stiffness / SOFT_BELOW), 0.0, 1.0))


def touch(
    seed: int,
    category: int,
    instance: int,
    touch: int,
    *,
    size: int,
    background: bool = False,
    measured: bool = False,
    sensors: Sequence[Sensor] = (),
    through: int = 0,
) -> dict[str, Any]:
    """Simulate one pair, given the numbers of the data set, class, instance and touch.

    Args:
        background: Also return "background", the same copy of the sensor before contact.
        measured: Also return depth, position and size of the contact (`gel.contact`).
        sensors: Sensors to choose from; all else is the same. Default: all that are not held out.
        through: 0, or the number of a further sensor that is pressed on the same spot with the same force. It differs
            from those of smaller numbers; the camera takes another picture.

    Returns:
        "vision" and "touch" (uint8 [size, size, 3]), "category", "soft", "rough" and the latents.
    """
    thing = Instance(seed, category, instance)
    # One random stream per picture, so that they are independent; pixel noise is drawn last in each.
    pose, eye, finger = np.random.default_rng([_TAG, seed, category, instance, touch]).spawn(3)
    angle, place = pose.uniform(0, 2 * np.pi), pose.uniform(-400, 400, 2)
    choice = sensors or [s for s in SENSORS.values() if not s.held_out]
    if not 0 <= through < len(choice):
        raise ValueError(f"through {through}: there are {len(choice)} sensors for one spot, give a smaller number")
    again = np.random.default_rng([_TAG, seed, category, instance, touch, 0, through]) if through else None
    turn = angle + finger.normal(0, 0.1)
    return {
        "vision": _look(thing, again or eye, angle + (again or eye).normal(0, 0.1), place, size),
        "category": category,
        "soft": int(thing.soft),
        "rough": int(thing.rough),
        **_feel(thing, finger, turn, place, size, choice, background, measured, through, again),
        "stiffness": thing.stiffness,
        "amplitude_mm": thing.amplitude_mm,
        **{name: getattr(thing.feel, name) for name in ("wavelength_mm", "anisotropy", "irregularity", "asperity")},
        "gloss": thing.gloss,
        "angle_rad": angle,
    }


def turn(x: F, y: F, angle: float, place: Place) -> tuple[F, F]:
    """Turn x, y [n, n] by ``angle`` in radians, then shift them by ``place`` (x, y) in mm."""
    cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    return cos * x + sin * y + np.float32(place[0]), cos * y - sin * x + np.float32(place[1])


def outline(x: F, y: F, rng: np.random.Generator, radius: float, curl: float) -> F:
    """Return the approximate distance in mm [n, n] inside an outline (< 0 outside): corners for curl 0, lobes for curl 1."""
    cx, cy = rng.normal(0, 0.22 * radius, 2)
    x, y = x - np.float32(cx), y - np.float32(cy)
    sides, turn = int(rng.integers(3, 6)), rng.uniform(0, 2 * np.pi)
    phases, heights = rng.uniform(0, 2 * np.pi, 3), rng.normal(0, 1, 3)
    inside = np.full(x.shape, np.float32(4 * radius))
    for k in range(sides):
        a = turn + 2 * np.pi * (k + rng.uniform(-0.18, 0.18)) / sides
        inside = np.minimum(inside, np.float32(radius * 0.82) - np.float32(np.cos(a)) * x - np.float32(np.sin(a)) * y)
    if curl > 0:
        theta = np.arctan2(y, x)
        waves = ((k + 2, h, p) for k, (h, p) in enumerate(zip(heights, phases, strict=True)))
        lobes = sum(h / (k - 0.5) * np.cos(k * theta + p) for k, h, p in waves)
        round_ = np.float32(radius) * (1 + np.float32(0.3) * lobes) - np.hypot(x, y)
        inside = np.float32(1 - curl) * inside + np.float32(curl) * round_
    return inside.astype(np.float32)


def _look(thing: Instance, rng: np.random.Generator, angle: float, place: Place, size: int) -> NDArray[np.uint8]:
    x, y, pixel = grid(size, _CAMERA_MM * np.exp(rng.uniform(-0.25, 0.25)))
    width, curl = float(x.shape[0] * pixel), thing.curl
    inside = outline(x, y, rng, rng.uniform(0.42, 0.62) * width, curl)
    texture = thing.sight(*turn(x, y, angle, place))
    lines = marks(x, y, rng, curl=curl, extent_mm=width, count=int(rng.integers(2, 4)))
    steep = np.float32(np.exp(rng.uniform(*np.log((0.05, 0.11)))) * thing.sight.wavelength_mm)
    bevel = np.float32(0.06 * width)
    edge = np.clip(inside / bevel, 0, 1)
    form = np.float32(0.7) * bevel * (np.sqrt(edge * (2 - edge)) if curl > 0.5 else edge)  # rounded or chamfered
    height = steep * texture + np.float32(0.012 * width) * lines + form

    # Light comes from above (within 60 degrees); otherwise peaks and pits would look the same.
    lamp, rise = rng.uniform(-np.pi / 3, np.pi / 3), rng.uniform(0.45, 0.8)
    light = np.cos(rise) * np.sin(lamp), -np.cos(rise) * np.cos(lamp), np.sin(rise)
    skin = _shade(thing, height, texture, light, rng.uniform(0.25, 0.5), pixel)
    table = _table(x, y, rng, width, pixel)
    body = np.clip(inside / np.float32(pixel) + 0.5, 0, 1)
    away = tuple(round(-part * 0.035 * width / pixel) for part in (light[1], light[0]))
    table *= (1 - np.float32(0.5) * np.roll(body, away, axis=(0, 1)))[..., None]  # shadow of the object
    picture = table + body[..., None] * (skin - table)

    tint = np.exp(rng.normal(0, 0.12, 3) + rng.normal(0.0, 0.25)).astype(np.float32)
    slant, drop, grain = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.35), rng.uniform(1, 5)
    ramp = (np.float32(np.cos(slant)) * x + np.float32(np.sin(slant)) * y) / np.float32(width)
    vignette = 1 - np.float32(0.5 / width**2) * (x * x + y * y)
    picture = area_resize(picture * tint * ((1 + np.float32(drop) * ramp) * vignette)[..., None], size, size)
    picture = 255 * np.clip(picture, 0, 1.2) ** np.float32(0.8)
    picture = picture + rng.standard_normal(picture.shape, np.float32) * np.float32(grain)
    return np.clip(picture + 0.5, 0, 255).astype(np.uint8)


def _shade(thing: Instance, height: F, texture: F, light: tuple[float, ...], ambient: float, pixel: float) -> F:
    """Shade a height map [n, n] mm with light from direction `light`: colour [n, n, 3], Lambert plus Phong highlight."""
    lx, ly, lz = (np.float32(part) for part in light)
    gy, gx = np.gradient(height, np.float32(pixel))
    normal, across = 1 / np.sqrt(1 + gx * gx + gy * gy), lx * gx + ly * gy
    diffuse = np.maximum((lz - across) * normal, 0)
    shine = np.maximum((lz - np.float32(0.55) * across) * normal, 0) ** 18 * np.float32(0.6 * thing.gloss)
    mix = np.clip(np.float32(0.5 * thing.contrast) * texture + np.float32(0.5), 0, 1)[..., None]
    skin = thing.colour * mix + thing.ink * (1 - mix)
    return skin * (np.float32(ambient) + np.float32(1 - ambient) / lz * diffuse)[..., None] + shine[..., None]


def _table(x: F, y: F, rng: np.random.Generator, width: float, pixel: float) -> F:
    """Draw the background [n, n, 3]: a patterned table, and objects with straight and with curved outlines."""
    ground, second = rng.uniform(0.12, 0.7, (2, 3)).astype(np.float32)
    table = rng.standard_normal((64, 64), np.float32)
    stretch, scale, slanted = rng.uniform(1, 5), width * rng.uniform(0.04, 0.15), rng.uniform(0, np.pi)
    u, v = turn(x, y, slanted, rng.uniform(0, 999, 2))
    pattern = fractal(u / np.float32(scale * stretch), v / np.float32(scale), table, 3)
    mix = np.clip(np.float32(rng.uniform(0, 0.35)) * pattern + 0.5, 0, 1)[..., None]
    picture = ground * mix + second * (1 - mix)
    for _ in range(int(rng.integers(1, 4))):
        cx, cy = rng.uniform(-0.5, 0.5, 2) * width
        radius, bend = rng.uniform(0.08, 0.25) * width, float(rng.integers(2))
        inside = outline(x - np.float32(cx), y - np.float32(cy), rng, radius, bend)
        cover = np.clip(inside / np.float32(pixel) + 0.5, 0, 1)
        picture = picture + cover[..., None] * (rng.uniform(0.1, 0.7, 3).astype(np.float32) - picture)
    return picture


def _feel(
    thing: Instance,
    rng: np.random.Generator,
    angle: float,
    place: Place,
    size: int,
    choice: Sequence[Sensor],
    background: bool,
    measured: bool,
    through: int,
    again: np.random.Generator | None,
) -> dict[str, Any]:
    """Press the object into a gel: "touch" and, if requested, "background" (uint8 [size, size, 3]), sensor and force.
    The further sensor number `through` has a copy, LED gain and noise of its own, drawn from `again`."""
    sensor = choice[(int(rng.random() * len(choice)) + through) % len(choice)]
    force = float(np.exp(rng.uniform(*np.log((2.0, 12.0)))))
    gain, dome = float(np.exp(rng.uniform(*np.log((0.5, 1.2))))), float(rng.uniform(18.0, 40.0))
    tilt, shear = rng.normal(0, 0.04, 2).astype(np.float32), rng.normal(0, 0.25, 2)
    x, y, pixel = grid(size, _TOUCH_MM)
    u, v = turn(x, y, angle, place)
    curl = thing.curl
    # Soft objects deform, which would make their imprints shallower, so their relief is higher.
    yielding = GEL_STIFFNESS / thing.stiffness
    relief = np.float32(thing.amplitude_mm * (1 + yielding) * np.exp(rng.normal(0, 0.15))) * thing.feel(u, v)
    depth = np.float32(0.14 * (1 + yielding) * np.exp(rng.normal(0, 0.25)))
    relief = relief + depth * marks(x, y, rng, curl=curl, extent_mm=_TOUCH_MM, count=int(rng.integers(2, 4)))
    beyond = np.maximum(-outline(x, y, rng, rng.uniform(0.45, 0.75) * _TOUCH_MM, curl), 0)
    roll = np.float32(0.2 + 1.5 * curl)
    fall = np.where(beyond < roll, beyond * beyond / (2 * roll), beyond - roll / 2)
    relief = relief - np.float32(1 + yielding) * fall
    # Soft objects bulge, otherwise the width of the contact would reveal them.
    bulge = np.float32(yielding * rng.uniform(0.6, 1.2) / (2 * dome))
    relief = relief + tilt[0] * x + tilt[1] * y - bulge * (x * x + y * y)
    physics: Any = {"force_n": force, "stiffness": thing.stiffness, "pixel_mm": pixel, "dome_radius_mm": dome}
    pressed = gel.pressure(relief, **physics)
    if again is not None:
        rng, gain = again, float(np.exp(again.uniform(*np.log((0.5, 1.2)))))
    unit = int(rng.integers(2**31))
    draw = partial(gel.render, sensor=sensor, rng=rng, pixel_mm=pixel, size=size, unit=unit, gain=gain)
    imprint = gel.imprint(pressed, pixel_mm=pixel)
    made: dict[str, Any] = {"touch": draw(imprint, shear_mm=(float(shear[0]), float(shear[1])))}
    if background:  # rendered last, so that other pictures do not change
        made["background"] = draw(np.zeros_like(imprint))
    made |= {"sensor": sensor.name, "force_n": force}
    return made | (gel.contact(pressed, pixel_mm=pixel) if measured else {})
