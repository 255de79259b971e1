"""Reliefs: height functions of the plane, one per material instance, which can be evaluated at any scale.

Shapes: x, y [H, W] mm on the object; u, v [H, W] the same in wavelengths, rotated so that u is along the grain.
Each `KINDS` function maps u, v and four random tables to an unscaled height [H, W]. `Relief` then gives all kinds the same
height distribution (unit RMS, skewness set by `asperity`), so that kinds differ only in spatial arrangement.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from mvitac.sim.gel import F

_SIDE = 64  # period of the random tables in wavelengths, larger than any picture
_NEXT = (np.arange(_SIDE) + 1) % _SIDE
_STEPS = 129
_NORMAL = ndtri((np.arange(_STEPS) + 0.5) / _STEPS).astype(np.float32)


def noise(u: F, v: F, table: F) -> F:
    """Interpolate a random lattice [64, 64] smoothly at u, v: mean about zero, features of size 1."""
    fu, fv = np.floor(u), np.floor(v)
    cell, j = fu.astype(np.intp), fv.astype(np.intp)
    a, b = u - fu, v - fv
    for s in (a, b):  # s * s * (3 - 2 * s)
        rise = 3 - 2 * s
        s *= s
        s *= rise
    # Most of the simulator's time is spent here: in place, with row differences computed once per table, not per pixel.
    flat, step = table.ravel(), np.subtract(table[_NEXT], table).ravel()
    cell &= 63
    cell *= _SIDE
    j &= 63
    near = cell + j
    top = step[near]
    top *= a
    top += flat[near]
    j += 1
    j &= 63
    cell += j
    height = step[cell]
    height *= a
    height += flat[cell]
    height -= top
    height *= b
    height += top
    return height


def fractal(u: F, v: F, table: F, octaves: int = 3, fall: float = 0.55) -> F:
    """Sum noise octaves, each twice as fine and `fall` times as high, and rotated to hide the lattice."""
    total, height = noise(u, v, table), 1.0
    for _ in range(octaves - 1):
        u, v = 1.62 * u - 1.18 * v + 17.3, 1.18 * u + 1.62 * v + 5.7
        height *= fall
        total = total + np.float32(height) * noise(u, v, table)
    return total


def cells(u: F, v: F, t: NDArray[np.float32], regular: float = 0.0) -> tuple[F, F, NDArray[np.int32]]:
    """Return the distances to the nearest and second nearest random point, and the nearest point's cell number."""
    fu, fv = np.floor(u), np.floor(v)
    i, j = fu.astype(np.int32), fv.astype(np.int32)
    a, b = u - fu, v - fv
    first = np.full(u.shape, 9.0, np.float32)
    second, owner = first.copy(), np.zeros(u.shape, np.int32)
    px, py = (0.5 + np.float32(0.29 * (1 - regular)) * np.clip(t[:2], -1.7, 1.7)).reshape(2, -1)
    for di in (-1, 0, 1):
        row = ((i + di) & 63) * _SIDE
        for dj in (-1, 0, 1):
            cell = row + ((j + dj) & 63)
            d = (px[cell] + (np.float32(di) - a)) ** 2 + (py[cell] + (np.float32(dj) - b)) ** 2
            nearer = d < first
            np.minimum(second, np.maximum(d, first), out=second)
            np.copyto(owner, cell, where=nearer)
            np.minimum(first, d, out=first)
    return np.sqrt(first), np.sqrt(second), owner


def _sin(a: F) -> F:
    return np.sin(a * np.float32(2 * np.pi))


def _pores(u: F, v: F, t: F) -> F:
    first, _, owner = cells(u, v, t)
    return np.minimum(first * (1.6 + 0.5 * t[2].ravel()[owner]), 1.0) + 0.25 * noise(2.3 * u, 2.3 * v, t[3])


def _grains(u: F, v: F, t: F) -> F:
    first, _, owner = cells(1.5 * u, 1.5 * v, t)
    return 0.5 * t[2].ravel()[owner] - 1.4 * first


def _pebbles(u: F, v: F, t: F) -> F:
    first, second, owner = cells(0.75 * u, 0.75 * v, t, 0.2)
    return np.sqrt(np.maximum(second - first, 0)) * (1.2 + 0.35 * t[2].ravel()[owner])


def _facets(u: F, v: F, t: F) -> F:
    _, _, owner = cells(0.6 * u, 0.6 * v, t)
    level, along, across = t[1].ravel()[owner], t[2].ravel()[owner], t[3].ravel()[owner]
    return level + 0.6 * (along * _sin(0.23 * u) + across * _sin(0.19 * v))  # planes with random tilt


def _crackle(u: F, v: F, t: F) -> F:
    first, second, _ = cells(u, v, t)
    return np.minimum(second - first, 0.35) + 0.06 * noise(3 * u, 3 * v, t[3])


def _brick(u: F, v: F, t: F) -> F:
    row = np.floor(v)
    along = 0.5 * u + 0.5 * (row % 2)
    du, dv = np.abs(along - np.floor(along) - 0.5), np.abs(v - row - 0.5)
    wall = np.minimum((0.5 - du) * 2, 0.5 - dv)
    brick = (np.floor(along).astype(np.int32) & 63) * _SIDE + (row.astype(np.int32) & 63)
    return np.minimum(wall, 0.12) * 6 + 0.25 * t[2].ravel()[brick] + 0.2 * noise(4 * u, 4 * v, t[3])


def _tiles(u: F, v: F, t: F) -> F:
    du, dv = np.abs(u - np.floor(u) - 0.5), np.abs(v - np.floor(v) - 0.5)
    return np.minimum(0.5 - np.maximum(du, dv), 0.1) * 8 + 0.12 * noise(1.7 * u, 1.7 * v, t[3])


def _wood(u: F, v: F, t: F) -> F:
    ring = 0.8 * v + 0.9 * noise(0.22 * u, 0.45 * v, t[0])
    return _sin(ring) + 0.4 * _sin(2 * ring + 0.2) + 0.45 * noise(0.25 * u, 4 * v, t[1])


def _fissures(u: F, v: F, t: F) -> F:
    warp = 0.5 * noise(0.5 * u, 0.5 * v, t[1])
    return np.minimum(np.abs(noise(0.35 * u, v + warp, t[0])) * 1.6, 0.9) + 0.25 * noise(1.4 * u, 2.6 * v, t[2])


def _blades(u: F, v: F, t: F) -> F:
    fan = (noise(0.22 * u + 1.1 * v * s, 1.9 * v - 0.5 * u * s, t[k]) for k, s in enumerate((-0.5, 0.0, 0.6)))
    return np.maximum.reduce(list(fan))


def _veins(u: F, v: F, t: F) -> F:
    side = np.abs(v - 4 * np.floor(v / 4 + 0.5)) + 0.15 * noise(0.7 * u, 0.7 * v, t[0])
    return np.abs(_sin(0.5 * (u - 0.8 * side))) - np.exp(-((side / 0.25) ** 2)) + 0.2 * noise(2 * u, 2 * v, t[1])


def _fibres(u: F, v: F, t: F) -> F:
    turned = ((0.97, 0.26), (0.17, 0.98), (0.77, -0.64), (-0.5, 0.87))
    layers = [np.abs(noise(0.25 * (c * u + s * v), 1.5 * (c * v - s * u), t[k])) for k, (c, s) in enumerate(turned)]
    return -np.minimum.reduce(layers)


def _weave(u: F, v: F, t: F) -> F:
    over = _sin(0.5 * u) * _sin(0.5 * v) > 0
    warp, weft = np.abs(_sin(0.5 * u)), np.abs(_sin(0.5 * v))
    fine = np.where(over, noise(6 * u, v, t[0]), noise(u, 6 * v, t[1]))
    return np.where(over, warp + 0.5 * weft, weft + 0.5 * warp) + 0.3 * fine


def _rib(u: F, v: F, t: F) -> F:
    ridge = np.abs(_sin(0.5 * (v + 0.12 * noise(0.5 * u, 0.5 * v, t[0]))))
    return ridge + 0.22 * _sin(1.6 * u + 2 * np.abs(v - np.floor(v) - 0.5))


_CELLS = (_pores, _grains, _pebbles, _facets, _crackle, _brick, _tiles)
_LINES = (_wood, _fissures, _blades, _veins, _fibres, _weave, _rib)
KINDS: dict[str, Callable[[F, F, F], F]] = {
    **{draw.__name__[1:]: draw for draw in (*_CELLS, *_LINES)},
    "blotch": lambda u, v, t: fractal(u, v, t[0], 4, 0.6),
    "brushed": lambda u, v, t: noise(0.12 * u, 1.8 * v, t[0]) + 0.7 * noise(0.2 * u, 3.7 * v + 9, t[1]),
    "emboss": lambda u, v, t: np.tanh(3.5 * noise(1.4 * u, 1.4 * v, t[0])) + 0.2 * noise(3 * u, 3 * v, t[1]),
    "plain": lambda u, v, t: noise(0.45 * u, 0.45 * v, t[0]) + 0.12 * noise(5 * u, 5 * v, t[1]),
    "studs": lambda u, v, t: np.cos(1.4 * np.pi * (u + v)) * np.cos(1.4 * np.pi * (u - v)) + 0.15 * noise(u, v, t[0]),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Relief:
    """The height function of one instance: call it with x, y [H, W] in mm. The result has unit RMS."""

    kind: str
    wavelength_mm: float
    anisotropy: float = 1.0  # stretch factor along the grain
    irregularity: float = 0.2  # 0: as regular as possible; 1: bent, uneven and covered with debris
    asperity: float = 0.0
    """-1: plateaus with pits and grooves; +1: separate peaks. Skewness R_sk of surface metrology (ISO 21920-2)."""
    tables: F  # random numbers [4, 64, 64] of this instance

    def __call__(self, x: F, y: F) -> F:
        wave = np.float32(self.wavelength_mm)
        u, v = x / (wave * np.float32(self.anisotropy)), y / wave
        bend = np.float32(0.45 * self.irregularity)
        across, along = noise(0.6 * u, 0.6 * v + 31, self.tables[3]), noise(0.6 * u + 31, 0.6 * v, self.tables[2])
        u, v = u + bend * across, v + bend * along
        height = KINDS[self.kind](u, v, self.tables)
        height = (height - height.mean()) / (height.std() + np.float32(1e-6))
        height = height + np.float32(0.1 + 0.5 * self.irregularity) * fractal(2.7 * u, 2.7 * v, self.tables[1], 2)
        return skew(height, self.asperity)


def draw_tables(rng: np.random.Generator) -> F:
    """Draw the random tables [4, 64, 64] of one instance."""
    return rng.standard_normal((4, _SIDE, _SIDE), np.float32)


def skew(height: F, asperity: float) -> F:
    """Give heights [H, W] a log-normal distribution of unit RMS: peaks for `asperity` > 0, pits for < 0.

    Ranks do not change, so the spatial arrangement is the same. h and -h with opposite asperity have the same spectrum.
    """
    sample = np.sort(height[1::5, 2::5], axis=None)
    ranks = sample[np.linspace(0, sample.size - 1, _STEPS).astype(np.int64)]
    normal, strength = np.interp(height, ranks, _NORMAL).astype(np.float32), 1.15 * abs(asperity)
    if strength < 1e-3:
        return normal
    sign = np.float32(np.sign(asperity))
    peaks = np.exp(np.float32(strength) * sign * normal)
    middle = np.exp(strength**2 / 2)
    return sign * (peaks - np.float32(middle)) / np.float32(middle * np.sqrt(np.exp(strength**2) - 1))


def marks(x: F, y: F, rng: np.random.Generator, *, curl: float, extent_mm: float, count: int = 3) -> F:
    """Draw `count` long narrow ridges or grooves of height 1 over [H, W]: kinked lines for curl 0, folds for curl 1."""
    total = np.zeros(np.broadcast_shapes(x.shape, y.shape), np.float32)
    for _ in range(count):
        angle, place, width = rng.uniform(0, np.pi), rng.uniform(-0.4, 0.4), rng.uniform(0.012, 0.022)
        wave, phase = rng.uniform(0.28, 0.5), rng.uniform(0, 1)
        kink, where = rng.uniform(-0.8, 0.8), rng.uniform(-0.3, 0.3)
        cos, sin = np.float32(np.cos(angle) / extent_mm), np.float32(np.sin(angle) / extent_mm)
        u, v = cos * x + sin * y, cos * y - sin * x
        turn, deep = np.float32(2 * np.pi / wave), np.float32(curl * 0.28 * wave)
        path = deep * np.sin(turn * u + np.float32(2 * np.pi * phase))
        slope = deep * turn * np.cos(turn * u + np.float32(2 * np.pi * phase))
        bent = np.float32((1 - curl) * kink * 0.5)
        path = path + bent * np.abs(u - np.float32(where))
        slope = slope + bent * np.sign(u - np.float32(where))
        distance = (v - np.float32(place) - path) / np.sqrt(1 + slope * slope)
        total += np.float32(rng.choice((-1.0, 1.0))) * np.exp(-((distance / np.float32(width)) ** 2))
    return total
