"""What changes between two moments of one press: the camera and the hand move a little, and the hand presses harder.

Object, lamp, clutter and sensor stay. The sizes were set by eye, for frames of a video some tenths of a second apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvitac.sim.gel import F


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Displacement of a later moment of a press from moment 0."""

    turn: float
    """Rotation of the camera in radians."""
    shift: NDArray[np.float64]
    """Shift of the camera picture (x, y) in parts of its width."""
    zoom: float
    """Factor of the camera's field of view."""
    slip: NDArray[np.float64]
    """Movement of the object over the gel (x, y) in mm."""
    force: float
    """Factor of the force, at least 1."""
    noise: np.random.Generator
    """Source of the pixel noise of both pictures."""

    @classmethod
    def draw(cls, *numbers: int) -> Motion:
        """Draw a motion that depends only on ``numbers``."""
        rng = np.random.default_rng(numbers)
        return cls(
            turn=rng.normal(0, 0.04),
            shift=rng.normal(0, 0.03, 2),
            zoom=float(np.exp(rng.normal(0, 0.03))),
            slip=rng.normal(0, 0.4, 2),
            force=float(np.exp(rng.uniform(0.0, 0.6))),
            noise=rng,
        )

    def seen(self, x: F, y: F, width: float) -> tuple[F, F]:
        """Camera coordinates x, y [n, n] in mm of a picture ``width`` mm wide, after the camera has moved."""
        cos, sin = (np.float32(self.zoom * part) for part in (np.cos(self.turn), np.sin(self.turn)))
        dx, dy = (np.float32(part * width) for part in self.shift)
        return cos * x + sin * y + dx, cos * y - sin * x + dy

    def felt(self, x: F, y: F, force: float, shear: NDArray[np.float64]) -> tuple[F, F, float, NDArray[np.float64]]:
        """Gel coordinates x, y [n, n] in mm, force in N and shear in mm. The gel follows half of the slip."""
        dx, dy = (np.float32(part) for part in self.slip)
        return x - dx, y - dy, force * self.force, shear + self.slip / 2
