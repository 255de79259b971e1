"""Coordinates of the pictures of materials."""

import numpy as np
from numpy.typing import NDArray

from mvitac.sim.gel import F

Place = NDArray[np.float64]  # (x, y), in mm unless said otherwise


def grid(size: int, width_mm: float) -> tuple[F, F, float]:
    """Return x, y [n, n] in mm and mm per pixel of the internal picture, which is twice as fine if `size` is small."""
    n = 2 * size if size <= 96 else max(192, size)
    pixel = width_mm / n
    axis = (np.arange(n, dtype=np.float32) - (n - 1) / 2) * np.float32(pixel)
    x, y = np.meshgrid(axis, axis)
    return x, y, pixel


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
