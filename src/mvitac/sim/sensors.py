"""Models of tactile sensors: colours, LED directions, printed dots, dirt and lens edge; set by eye, measured or random."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, cast

import numpy as np

RGB = tuple[float, float, float]
Pair = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Appearance of one type of tactile sensor. Colours are 8-bit levels; u, v are -1 to 1 over the picture."""

    name: str
    calibration: str = ""
    """A real gel (``measured.read``) in place of base, glow, tilt, response, saturation and shadow."""
    base: RGB = (0.0, 0.0, 0.0)  # level far from the glow, per channel
    glow: tuple[tuple[float, float, float, float, float], ...] = ()
    """Per channel (height in levels, centre u, centre v, width u, width v) of the soft bright spot of its LEDs."""
    tilt: tuple[Pair, ...] = ()  # linear change of level along (u, v), per channel
    response: tuple[Pair, ...] = ()
    """Change of level per unit slope along (x, y), per channel: the direction of its LED."""
    saturation: float = 75.0  # change of level at which the response saturates
    shadow: float = 0.35  # fraction of light that a ridge takes from the surface behind it, seen from the LED
    marker_pitch_mm: float = 0.0  # distance between printed dots; 0 = no dots
    marker_radius_mm: float = 0.0
    marker_jitter: float = 0.0  # standard deviation of a dot's position, as a fraction of the pitch
    marker_wear: float = 0.0  # 0: round, complete dots; 1: irregular, half worn off
    marker_angle_deg: float = 0.0
    dirt: float = 6.0  # expected number of specks on the gel
    scratches: float = 1.0  # expected number of scratches in the paint
    edge: float = 0.0  # visibility of the lens edge: a dark rim with a thin bright line inside
    noise: float = 1.5  # standard deviation of the camera noise in levels
    held_out: bool = False  # not used for training data; it tests transfer to a new sensor


def _dots(pitch_mm: float, radius_mm: float, **more: float) -> dict[str, Any]:
    return {f"marker_{name}": value for name, value in {"pitch_mm": pitch_mm, "radius_mm": radius_mm, **more}.items()}


SENSORS: dict[str, Sensor] = {
    s.name: s
    for s in (
        Sensor(
            name="mini",  # GelSight Mini without dots: teal rim, rose centre, blue above, olive below
            base=(30, 80, 90),
            glow=((98, 0.0, 0.1, 0.62, 0.58), (44, 0.0, -0.05, 0.62, 0.75), (68, 0.0, -0.15, 0.68, 0.56)),
            tilt=((3, 13), (-6, -3), (2, -16)),
            response=((90, 140), (-70, -20), (25, -150)),
            saturation=58,
            dirt=9,
            scratches=1.2,
            edge=0.85,
        ),
        Sensor(
            name="mini_dots",  # GelSight Mini with a printed grid of large round dots
            base=(42, 88, 96),
            glow=((84, 0.0, 0.1, 0.62, 0.55), (26, -0.1, -0.1, 0.7, 0.85), (66, 0.0, -0.2, 0.7, 0.55)),
            tilt=((2, 12), (-8, -6), (3, -18)),
            response=((95, 130), (-80, -25), (20, -150)),
            saturation=60,
            **_dots(1.9, 0.36, jitter=0.025, wear=0.2),
            dirt=8,
            edge=0.25,
        ),
        Sensor(
            name="classic",  # hand-made GelSight: pale, with small worn dots and pastel corners
            base=(122, 126, 128),
            glow=((26, -0.35, 0.25, 0.9, 0.8), (26, 0.1, 0.05, 0.9, 1.0), (24, 0.25, 0.0, 0.7, 0.6)),
            tilt=((6, 7), (4, 6), (-8, -13)),
            response=((85, 65), (12, -100), (-90, 60)),
            saturation=46,
            **_dots(1.7, 0.16, jitter=0.11, wear=0.85, angle_deg=14),
            shadow=0.15,
            dirt=16,
            scratches=2.0,
            edge=0.1,
            noise=2.2,
        ),
        Sensor(
            name="digit",  # DIGIT-like: three colours from three sides, strong falloff to the corners
            base=(84, 82, 90),
            glow=((46, -0.4, 0.4, 0.8, 0.8), (44, 0.45, 0.35, 0.8, 0.8), (50, 0.0, -0.5, 0.9, 0.7)),
            tilt=((-6, 5), (6, 4), (0, -8)),
            response=((-115, 65), (110, 60), (5, -125)),
            saturation=52,
            shadow=0.25,
            dirt=5,
            scratches=0.6,
            edge=0.5,
            noise=2.6,
        ),
        Sensor(
            name="slim",  # held out: warm light from two sides, white fill, a fine tilted grid
            base=(104, 96, 86),
            glow=((30, 0.35, -0.2, 0.8, 0.9), (28, 0.0, 0.2, 0.9, 0.7), (28, -0.35, 0.1, 0.8, 0.8)),
            tilt=((10, -5), (0, 6), (-10, 3)),
            response=((105, -45), (35, 95), (-100, -30)),
            saturation=50,
            **_dots(1.55, 0.2, jitter=0.06, wear=0.45, angle_deg=-27),
            dirt=8,
            scratches=1.5,
            edge=0.35,
            noise=2.0,
            held_out=True,
        ),
    )
}

MEASURED: dict[str, Sensor] = {
    # The real frame has the dirt and the edge of its gel. Noise is that of two frames, averaged to 72 x 72 pixels.
    name: Sensor(name=name, calibration=name, dirt=0.0, scratches=0.0, noise=noise)
    for name, noise in (("gelsight", 0.6), ("gelsight_mini", 0.5))
}
"""Two real gels. They press only where they are named, so they change no other data."""

NAMED = SENSORS | MEASURED

MARGIN = 0.25  # how far a random sensor may lie outside the four known ones: this part of their range, on either side
_TAG = 0x5E5


@cache
def random_sensors(seed: int, num: int) -> tuple[Sensor, ...]:
    """Draw ``num`` sensors that no shop sells, to train on many instead of four.

    Every number is uniform over the range of the known sensors (held-out ones excluded), widened by ``MARGIN``. The LEDs
    of the three channels lie about 120 degrees apart, as in all known sensors; their order round the gel and the direction
    of the first are random. Half of the sensors have dots. Sensor i depends on (seed, i) only.

    Examples:
        >>> [sensor.name for sensor in random_sensors(0, 2)]
        ['random0000', 'random0001']
    """
    return tuple(_random_sensor(seed, number) for number in range(num))


def _random_sensor(seed: int, number: int) -> Sensor:
    rng, known = np.random.default_rng([_TAG, seed, number]), [s for s in SENSORS.values() if not s.held_out]

    def within(values: Iterable[float], *size: int) -> np.ndarray:
        low, high = min(values := list(values)), max(values)
        extra = MARGIN * (high - low)
        return rng.uniform(max(low - extra, 0.0) if low >= 0 else low - extra, high + extra, size)

    base = within((level for s in known for level in s.base), 3)
    # A dark channel has a high spot: the level at the centre varies much less than either.
    height = within((b + spot[0] for s in known for b, spot in zip(s.base, s.glow, strict=True)), 3) - base
    place = [within(column, 3) for column in np.array([spot for s in known for spot in s.glow]).T[1:]]
    tilt = np.stack([within((pair[axis] for s in known for pair in s.tilt), 3) for axis in (0, 1)], axis=1)
    strength = within((float(np.hypot(*pair)) for s in known for pair in s.response), 3)
    spread = np.arange(3) * 2 * np.pi / 3 + rng.uniform(-0.4, 0.4, 3)
    angle = rng.uniform(0, 2 * np.pi) + rng.choice((-1, 1)) * spread
    dots = [f.name for f in fields(Sensor) if f.name.startswith("marker_")] * int(rng.random() < 0.5)
    plain = ("saturation", "shadow", "dirt", "scratches", "edge", "noise")
    values: dict[str, Any] = {name: float(within(getattr(s, name) for s in known)) for name in plain}
    values |= {name: float(within(getattr(s, name) for s in known if s.marker_pitch_mm)) for name in dots}
    towards = strength[:, None] * np.c_[np.cos(angle), np.sin(angle)]
    pairs: Any = [np.stack([np.maximum(height, 10.0), *place], 1), tilt, towards]
    glow, tilts, response = (cast(Any, tuple(map(tuple, rows.tolist()))) for rows in pairs)
    base = tuple(base.tolist())
    return Sensor(name=f"random{number:04d}", base=base, glow=glow, tilt=tilts, response=response, **values)
