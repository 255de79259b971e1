"""The ball of Taxim's calibration, pressed into simulated sensors: the truth of a real press, by simulation alone."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from mvitac.sim.gel import F, axes_mm, relax, render
from mvitac.sim.measured import BALL_MM, MM
from mvitac.sim.sensors import Sensor

VERSION = 2  # stored in the pack. Increase it with every change of a pixel.
FIELD_MM = 480 * MM  # side of the picture: the height of Taxim's frames
DRIFT = 0.012  # of a channel's brightness since the gel at rest: standard deviation in the GelSight's frames
_TAG = 0xBA1


def depth_mm(radius_mm: float) -> float:
    """Return how deep the ball is in the gel when its contact has this radius, both in mm."""
    return BALL_MM - float(np.sqrt(BALL_MM**2 - radius_mm**2))


def imprint(pixels: int, x_mm: float, y_mm: float, radius_mm: float) -> F:
    """Return the imprint [pixels, pixels] in mm of the ball at (x, y) from the middle of the picture."""
    pixel = FIELD_MM / pixels
    x, y = axes_mm((pixels, pixels), pixel)
    away = (x - np.float32(x_mm)) ** 2 + (y - np.float32(y_mm)) ** 2
    indent = np.sqrt(np.maximum(BALL_MM**2 - away, 0)) - (BALL_MM - depth_mm(radius_mm))
    return relax(np.maximum(indent, 0).astype(np.float32), pixel_mm=pixel)


def press_ball(seed: int, number: int, *, size: int, sensors: Sequence[Sensor], background: bool) -> dict[str, Any]:
    """Simulate press ``number`` of the ball at a random place, with a contact of .8 to 1.97 mm radius.

    Returns "touch" and, if ``background``, "background", the same copy of the sensor before contact (uint8 [size, size,
    3]); "sensor", and in mm "contact_x_mm", "contact_y_mm" (right and down from the middle), "radius_mm", "depth_mm".
    """
    rng = np.random.default_rng([_TAG, seed, number])
    sensor = sensors[int(rng.random() * len(sensors))]
    radius, place = BALL_MM * float(rng.uniform(0.4, 0.985)), rng.uniform(-0.46, 0.46, 2) * FIELD_MM
    gain, unit = float(np.exp(rng.uniform(*np.log((0.5, 1.2))))), int(rng.integers(2**31))
    pressed = imprint(2 * size, float(place[0]), float(place[1]), radius)
    draw = partial(render, sensor=sensor, rng=rng, pixel_mm=FIELD_MM / (2 * size), size=size, unit=unit, gain=gain)
    made: dict[str, Any] = {"touch": np.clip(draw(pressed) * rng.normal(1.0, DRIFT, 3) + 0.5, 0, 255).astype(np.uint8)}
    if background:
        made["background"] = draw(np.zeros_like(pressed))
    known = {"contact_x_mm": float(place[0]), "contact_y_mm": float(place[1]), "radius_mm": radius}
    return {**made, "sensor": sensor.name, **known, "depth_mm": depth_mm(radius)}
