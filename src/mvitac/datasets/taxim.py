"""``--data taxim``: presses of one ball into two real gels, and into simulated ones.

``pip install taxim`` (MIT) brings 48 frames of a GelSight and 24 of a GelSight Mini with the circle of each contact, in
pixels of .0295 mm: calib/<sensor>/dataPack.npz with f0 (the gel at rest), imgs [N, 480, 640, 3] BGR, touch_center [N, 2],
touch_radius [N]. The middle 480 x 480 pixels are read, 14.2 mm.

The ball of the GelSight has a radius of 2 mm (github.com/Robo-Touch/Taxim, Basics/sensorParams.py), so depth is known, too.
That of the Mini is not published, and its circles were drawn by hand, up to 0.8 mm from the visible centre.
"""

import math
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from typing import Any, ClassVar
from zipfile import BadZipFile

import numpy as np

from mvitac.data.images import difference
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec
from mvitac.datasets.simulated import LICENCE, PressConfig, value_task
from mvitac.sim import ball, measured
from mvitac.sim.measured import BALL_MM, MM
from mvitac.sim.sensors import MEASURED
from mvitac.system.files import brief

VERSION = 1
TASKS = {"place": ("contact_x_mm", "contact_y_mm"), "radius": ("radius_mm",), "depth": ("depth_mm",)}
MINI_PRESSES = (0, 13, 18)
"""Frames of the Mini at which the ball is set down anew; the others move on from the frame before. Seen in the frames."""


@dataclass(frozen=True, kw_only=True)
class TaximConfig(PressConfig):
    """72 real presses of a ball into a GelSight and a GelSight Mini, all in test; or --num simulated ones, to learn on."""

    name: ClassVar[str] = "taxim"
    phased: ClassVar[bool | None] = False
    least: ClassVar[int] = 0

    num: int = 0
    """Number of simulated presses of the same ball. 0 = the real frames, of --makes or of both gels."""

    def source(self) -> Source:
        for name in ("sensors", "seed", "held_out_sensor") * (not self.num):
            if getattr(self, name) != getattr(TaximConfig, name):
                raise ValueError(f"{name} is of simulated presses: give num, too")
        if not self.num and (others := {*self.makes} - {*MEASURED}):
            raise ValueError(f"{', '.join(sorted(others))}: real frames are of {' and '.join(MEASURED)}; else give num")
        (self if self.num else replace(self, makes=tuple(MEASURED))).check_installed()
        return Taxim(self)


class Taxim(Source):
    """Item i is frame or simulated press i. Every press is a group, except that the Mini's 24 frames are of three."""

    def __init__(self, config: TaximConfig) -> None:
        self.config = config

    def spec(self) -> DataSpec:
        real = not self.config.num
        return DataSpec(
            name="taxim" if real else "taxim, simulated",
            vision_channels=0,
            touch_channels=3,
            tasks=(),
            values=tuple(value_task(name, columns) for name, columns in TASKS.items()),
            group_by="contact",
            licence="MIT" if real else LICENCE,
            source="package taxim" if real else f"mvitac.sim.ball version {ball.VERSION}",
            difference=self.config.difference,
            notes=("circles of gelsight_mini were drawn by hand, up to 0.8 mm from the visible centre",) * real,
        )

    def items(self) -> list[str]:
        return [f"{i:05d}" for i in range(self.config.num)] or ["-".join(map(str, item)) for item in self._frames()]

    def fingerprint(self) -> dict[str, Any]:
        if self.config.num:
            return self.config._fingerprint(ball.VERSION)
        used = {"makes": list(self.config.makes), "difference": self.config.difference}
        return {"reader": "taxim", "version": VERSION, "package": version("taxim"), **used}

    def read(self, item: int) -> list[Sample]:
        config = self.config
        if config.num:
            look: Any = {"size": config.size, "sensors": config.choice(), "background": config.difference}
            made = ball.press_ball(config.seed, item, **look)
            group, split = f"{item:05d}", ("test", "val", *["train"] * 8)[item % 10]
        else:
            made, split = _frame(*self._frames()[item]), "test"
            group = made.pop("press")
        touch, rest = made.pop("touch"), made.pop("background", None)
        columns = {"id": self.items()[item], "group": group, "touch_group": group, "split": split, **made}
        return [Sample(vision=None, touch=difference(touch, rest) if config.difference else touch, columns=columns)]

    def _frames(self) -> list[tuple[str, int]]:
        return [(make, i) for make in self.config.makes or MEASURED for i in range(len(_pack(make)["imgs"]))]


@cache
def _pack(make: str) -> dict[str, np.ndarray]:
    """The arrays of one sensor, with images in RGB and cut to the middle: imgs [N, 480, 480, 3], f0 [480, 480, 3]."""
    file = measured.folder(make) / "dataPack.npz"
    try:
        with file.open("rb") as opened, np.load(opened) as pack:
            images = {name: np.ascontiguousarray(pack[name][..., 80:560, ::-1]) for name in ("imgs", "f0")}
            centre, radius = (pack[name].astype(float) for name in ("touch_center", "touch_radius"))
        same = images["imgs"].shape == (len(radius), 480, 480, 3) == (len(centre), *images["f0"].shape)
        inside = (centre >= 0) & (centre < (640, 480)) & ((radius > 0) & (radius < BALL_MM / MM))[:, None]
        if not (same and len(radius) and inside.all()):
            raise ValueError("not for each image a circle that the ball can leave there")
    except (OSError, EOFError, LookupError, ValueError, BadZipFile) as error:
        raise ValueError(f"{file} is damaged ({brief(error)}): install taxim again") from None
    return images | {"touch_center": centre, "touch_radius": radius}


def _frame(make: str, i: int) -> dict[str, Any]:
    pack, mini = _pack(make), make == "gelsight_mini"
    x, y = (pack["touch_center"][i] - (319.5, 239.5)) * MM
    radius = float(pack["touch_radius"][i] * MM)
    press = max(start for start in MINI_PRESSES if start <= i) if mini else i
    known = {"contact_x_mm": float(x), "contact_y_mm": float(y), "radius_mm": radius}
    known["depth_mm"] = math.nan if mini else ball.depth_mm(radius)
    return {"touch": pack["imgs"][i], "background": pack["f0"], "sensor": make, "press": f"{make}-{press:02d}", **known}
