"""Touch images of one sensor in the colours of another, learned from unlabelled images of both.

An optical gel shows slope as colour: I(x, y) = I0 + rx gx + ry gy. I0 [3] is the image without contact, gx and gy are the
slopes of the imprint, and rx, ry [3] are the colour changes per unit of slope along x and y. They need no calibration:
slopes are derivatives of one height, so d gx / dy = d gy / dx, and of all pairs of linear colour mixtures only those of gx
and gy satisfy this (integrability, as in uncalibrated photometric stereo: Yuille and Snow, CVPR 1997). That leaves a
factor and the sign open: (r, g) and (-r, -g) give the same images, so peaks may be taken for pits. The factor follows
from the presses, whose slopes have the same spread on all sensors. The sign follows from the gel: it is a membrane that
bridges gaps, so an imprint has sharp ridges and smooth valleys, and the curvature of its height is skewed, with the
same sign on all gels that press the same kind of things (docs/results/sensors.md).

Shapes: N images of H x W pixels, levels 0 to 255.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh
from scipy.ndimage import gaussian_filter
from scipy.stats import skew

MIN_IMAGES, NUM_IMAGES = 32, 400  # least number of images of a sensor, and the number that is used
SMOOTH, SURE = 36, 3.0
"""Curvature is that of slopes blurred by this fraction of the side: of 0, 1, 2 and 3 pixels of 72, 2 told the sign of the
four known simulated sensors best (t 5.1 to 5.9 with 100 images, 2.1 to 2.9 without blur). Below ``SURE`` it is refused."""

MAX_CURL, MAX_STRETCH = 0.2, 30.0
"""Above these limits the result is not a pair of slopes. Curl is .03 to .11 for gels, .25 to .5 for gray images."""


@dataclass(frozen=True, eq=False)
class GelColours:
    """How one sensor shows slopes."""

    level: np.ndarray  # [3], mean colour
    rest: np.ndarray  # [H, W, 3], mean image minus ``level``
    colours: np.ndarray
    """[3, 2], change of level per slope along x and y, in units of the root mean square of the slopes."""
    mixtures: np.ndarray  # [3, 2], where ``d @ mixtures`` are the slopes of a change of level ``d``


def slope_colours(images: Float[np.ndarray, "N H W 3"]) -> tuple[np.ndarray, np.ndarray, float]:
    """Learn the colours of slope from images of one sensor, minus their mean; ValueError if no mixtures are slopes.

    Returns ``colours`` [3, 2], rx and ry as columns, up to a common factor; ``mixtures`` [3, 2], where ``d @ mixtures``
    are gx and gy of a colour ``d``, up to the inverse factor; and ``curl``, 0 for perfect slopes and .5 for noise.
    """
    down = ((images[:, 2:, 1:-1] - images[:, :-2, 1:-1]) / 2).reshape(-1, 3)
    right = ((images[:, 1:-1, 2:] - images[:, 1:-1, :-2]) / 2).reshape(-1, 3)
    rounding = np.eye(3) * len(down) / 24  # variance of rounding to whole levels: regularises equal channels
    yy, xx, yx = down.T @ down + rounding, right.T @ right + rounding, down.T @ right
    # Find mixtures p, q [3] that minimise |d(p . I)/dy - d(q . I)/dx|^2 relative to their total variation.
    change = yy + xx
    shares, pairs = eigh(np.block([[yy, -yx], [-yx.T, xx]]), np.kron(np.eye(2), change))
    mixtures, curl = pairs[:, 0].reshape(2, 3).T, float(shares[0])
    slopes = mixtures.T @ change @ mixtures
    if curl > MAX_CURL or np.linalg.cond(slopes) > MAX_STRETCH:
        raise ValueError(f"colours do not follow slopes along x and y (curl {curl:.2f})")
    return change @ mixtures @ np.linalg.inv(slopes), mixtures, curl


def learn_colours(images: np.ndarray) -> GelColours:
    """Learn the colours of slope of one sensor from images [N, H, W, 3] of different presses, or raise ValueError."""
    if len(images) < MIN_IMAGES:
        few = f"{len(images)} images: the colours of a gel need {MIN_IMAGES} of different presses"
        raise ValueError(f"{few}, better twice that")
    mean = images.mean(0, dtype=np.float64)
    level = mean.mean((0, 1))
    colours, mixtures, _ = slope_colours(images - mean)
    slopes = _without_light(images, mean - level) @ mixtures
    factor = np.sqrt((slopes**2).mean())
    height, width = images.shape[1:3]
    smooth = gaussian_filter(slopes, (0, height / SMOOTH, width / SMOOTH, 0))
    curvature = np.gradient(smooth[..., 0], axis=2) + np.gradient(smooth[..., 1], axis=1)
    inner = curvature[:, height // 8 : -(height // 8), width // 8 : -(width // 8)]
    bend = np.tanh(skew(inner.reshape(len(images), -1), axis=1))
    if abs(t := bend.mean() / bend.std() * len(images) ** 0.5) < SURE:
        raise ValueError(f"{len(images)} images do not tell peaks from pits (t {t:.1f}): give more presses")
    factor = -factor if t > 0 else factor
    return GelColours(level=level, rest=mean - level, colours=colours * factor, mixtures=mixtures / factor)


def recolour(images: np.ndarray, source: GelColours, target: GelColours) -> np.ndarray:
    """Show images uint8 [N, H, W, 3] of the sensor ``source`` as the sensor ``target`` would show the same slopes."""
    slopes = _without_light(images, source.rest) @ (source.mixtures @ target.colours.T)
    return np.clip(np.rint(target.level + target.rest + slopes), 0, 255).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Looks:
    """A sensor in the colours of others: call it with images uint8 [N, H, W, 3] to get them as each target shows them."""

    sensor: str
    names: tuple[str, ...]  # of the targets
    num_images: int  # unlabelled images of the sensor that its colours were learned from
    source: GelColours
    targets: tuple[GelColours, ...]

    def __call__(self, images: np.ndarray) -> list[np.ndarray]:
        return [recolour(images, self.source, target) for target in self.targets]

    def about(self) -> dict[str, object]:
        """What a description of a model keeps, JSON-ready."""
        return {"sensor": self.sensor, "in_colours_of": list(self.names), "num_images": self.num_images}


def _without_light(images: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """``images`` minus the sensor's lamps ``rest`` and minus their own mean colour: LEDs and tint drift."""
    levels = images.astype(np.float64)
    return levels - levels.mean((1, 2), keepdims=True) - rest
