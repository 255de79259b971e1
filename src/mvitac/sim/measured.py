"""Two real gels, measured: how they look at rest, and how their colour changes with slope and place.

The numbers are those of Taxim (Si and Yuan, RA-L 2022; package ``taxim``, MIT): one frame of the gel at rest, and for each
magnitude and direction of slope a quadratic polynomial of the place that was fitted to presses of one ball. Only its files
are read. They hold BGR; ``grad_r`` is the first of the three channels.
"""

import importlib.util
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, uniform_filter

F = NDArray[Any]  # float32
MM = 0.0295  # side of a pixel: params.json of both calibrations
BALL_MM = 2.0  # github.com/Robo-Touch/Taxim, Basics/sensorParams.py
_BINS = 124  # of magnitude over 0 to 90 degrees, and of direction over the circle
_SPREAD = 1.5  # standard deviations of the ball's places inside which the polynomials are trusted


def folder(calibration: str) -> Path:
    """Return the folder of taxim's files of one sensor. ValueError where taxim is not installed."""
    found = importlib.util.find_spec("taxim")
    if found is None or not found.submodule_search_locations:
        raise ValueError(f"sensor {calibration} is measured by the package taxim: pip install 'mvitac[taxim]'")
    return Path(found.submodule_search_locations[0]) / "calib" / calibration


@dataclass(frozen=True, eq=False)
class Gel:
    """A real gel of 640 x 480 pixels of ``MM``. Places are pixels (x, y) of that frame."""

    rest: F  # levels without contact [480, 640, 3]
    table: F  # polynomial of the change of level [magnitude * direction, 3, 6]
    low: F  # places of the ball's centre between which the polynomials are trusted [2]
    high: F

    def light(self, gx: F, gy: F, pixel_mm: float, shift: F, gain: float) -> F:
        """Return levels [H, W, 3] of a gel with slopes ``gx``, ``gy`` [H, W].

        ``shift`` (x, y), each -1 to 1, says where the field of view lies: in the middle of the real one or at its rim.
        """
        h, w = gx.shape
        step = pixel_mm / MM
        free = np.maximum((np.array([640, 480]) - step * np.array([w, h])) / 2, 0) * shift
        x = (np.arange(w) - (w - 1) / 2) * step + 319.5 + free[0]
        y = (np.arange(h) - (h - 1) / 2) * step + 239.5 + free[1]
        rows, columns = (np.clip(np.floor(axis + 0.5), 0, n - 1).astype(int) for axis, n in ((y, 480), (x, 640)))
        picture = _smooth(self, round(step))[np.ix_(rows, columns)]

        steep = np.hypot(gx, gy)
        magnitude = np.minimum((np.arctan(steep) * (2 * _BINS / np.pi)).astype(int), _BINS)
        direction = ((np.arctan2(gy, gx) + np.pi) * (_BINS / (2 * np.pi))).astype(int) % _BINS
        # The ball has this slope at one place, which tells where its centre would be: at the places that were pressed?
        toward = BALL_MM / MM / np.sqrt(1 + steep * steep)
        u, v = (
            np.clip(axis + toward * g, low, high) - toward * g
            for axis, g, low, high in zip((x[None], y[:, None]), (gx, gy), self.low, self.high, strict=True)
        )
        place = np.stack([u * u, v * v, u * v, u, v, np.ones_like(u)], axis=-1).astype(np.float32)
        return picture + np.float32(gain) * np.einsum("hwck,hwk->hwc", self.table[magnitude * _BINS + direction], place)


@cache
def read(calibration: str) -> Gel:
    """Read the gel of one of taxim's calibrations, "gelsight" or "gelsight_mini"."""
    files = folder(calibration)
    with np.load(files / "dataPack.npz") as pack:
        rest, places = pack["f0"][..., ::-1].astype(np.float32), pack["touch_center"].astype(np.float32)
    with np.load(files / "polycalib.npz") as fitted:
        table = np.stack([fitted[f"grad_{channel}"] for channel in "bgr"], axis=2)[:, :_BINS]
    table = gaussian_filter1d(table, 1.5, axis=0, mode="nearest")  # each bin was fitted to few pixels
    table = gaussian_filter1d(table, 2.0, axis=1, mode="wrap")
    table = table - table[:1]  # no slope, no change: the gel at rest is the frame itself
    spread = _SPREAD * places.std(0)
    return Gel(rest, table.reshape(-1, 3, 6).astype(np.float32), places.mean(0) - spread, places.mean(0) + spread)


@cache
def _smooth(gel: Gel, width: int) -> F:
    """The gel at rest, averaged over squares of ``width`` pixels."""
    return uniform_filter(gel.rest, width, mode="nearest", axes=(0, 1)) if width > 1 else gel.rest
