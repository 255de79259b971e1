"""Images of one gel in the colours of another, against the same heights rendered by both."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mvitac.transforms.gel_colours import learn_colours, recolour, slope_colours

SIDE = 48
PIXEL_MM = 12.8 / SIDE

NEAR = np.array([[40.0, 60.0], [-70.0, 5.0], [20.0, -65.0]])
FAR = np.array([[-55.0, 10.0], [25.0, 60.0], [35.0, -50.0]])
"""Change of level per slope along x and y: the second gel has other LEDs."""


def slopes(num: int = 48, size: int = 40, seed: int = 0) -> np.ndarray:
    """Slopes [num, size, size, 2] of heights with sharp ridges and smooth valleys, as a membrane shows them."""
    height = -np.abs(gaussian_filter(np.random.default_rng(seed).normal(size=(num, size, size)), (0, 5, 5)))
    g = np.stack([np.gradient(height, axis=2), np.gradient(height, axis=1)], axis=-1)
    return g / g.std() / 4


def images(colours: np.ndarray, g: np.ndarray, seed: int) -> np.ndarray:
    """What a gel of these ``colours`` shows: lamps of its own, a tint of each image, noise."""
    rng, size = np.random.default_rng(seed), g.shape[1]
    lamp = gaussian_filter(rng.normal(size=(size, size, 3)), (12, 12, 0)) * 400 + rng.uniform(90, 150, 3)
    tint = rng.normal(0, 4, (len(g), 1, 1, 3))
    return np.clip(np.rint(lamp + tint + g @ colours.T + rng.normal(0, 1, (*g.shape[:3], 3))), 0, 255).astype(np.uint8)


def test_recoloured_images_are_those_of_the_other_gel() -> None:
    """Learned on different presses; shown on new ones that both gels saw."""
    source, target = learn_colours(images(NEAR, slopes(), 1)), learn_colours(images(FAR, slopes(seed=5), 2))
    new = slopes(8, seed=9)
    here, there = images(NEAR, new, 1), images(FAR, new, 2).astype(float)
    shown = recolour(here, source, target).astype(float)
    assert shown.shape == there.shape

    def close(a: np.ndarray, b: np.ndarray) -> float:
        a, b = (x - x.mean((1, 2), keepdims=True) for x in (a, b))
        return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])

    assert close(shown, there) > 0.95 > 0.6 > close(here.astype(float), there)
    assert np.abs(shown.mean((0, 1, 2)) - there.mean((0, 1, 2))).max() < 5  # the other gel's lamps


def test_sign_and_factor_come_from_the_gel() -> None:
    """Ridges stay ridges: also for colours of opposite sign, and whatever the brightness of the LEDs."""
    plain, opposite, bright = (learn_colours(images(c, slopes(), 1)) for c in (NEAR / 2, -NEAR / 2, NEAR))
    for learned, truth in ((plain, NEAR), (opposite, -NEAR), (bright, NEAR)):
        assert (learned.colours * truth).sum() / np.linalg.norm(learned.colours) / np.linalg.norm(truth) > 0.98
        np.testing.assert_allclose(learned.mixtures.T @ learned.colours, np.eye(2), atol=1e-6)  # there and back
    assert np.linalg.norm(bright.colours) / np.linalg.norm(plain.colours) == pytest.approx(2, rel=0.1)
    g = (images(NEAR, slopes(), 1) - images(NEAR, slopes() * 0, 1).astype(float)) @ bright.mixtures
    assert np.sqrt((g**2).mean()) == pytest.approx(1, rel=0.15)  # in units of the slopes' spread


def test_what_cannot_be_learned_is_an_error() -> None:
    with pytest.raises(ValueError, match="need 32"):
        learn_colours(images(NEAR, slopes(8), 1))
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(48, 40, 40)), (0, 3, 3))  # peaks are like pits
    both = np.stack([np.gradient(noise, axis=2), np.gradient(noise, axis=1)], axis=-1)
    with pytest.raises(ValueError, match="do not tell peaks from pits"):
        learn_colours(images(NEAR, both / both.std() / 4, 1))
    # Stripes obey any law about how things change along them.
    stripes = np.sin(np.arange(SIDE) + np.arange(8)[:, None])[:, None, :, None] * np.full((SIDE, 1, 3), 60.0)
    for one_signal in (stripes, np.zeros((8, SIDE, SIDE, 3))):
        with pytest.raises(ValueError, match="do not follow slopes"):
            slope_colours(one_signal)


def imprint(seed: int) -> np.ndarray:
    """Bumps of about a millimetre in a dome that is off the middle, [SIDE, SIDE] mm."""
    rng = np.random.default_rng(seed)
    bumps = gaussian_filter(rng.standard_normal((SIDE, SIDE)), 2.5)
    y, x = (np.mgrid[0:SIDE, 0:SIDE] - SIDE / 2 - rng.normal(0, 6, (2, 1, 1))) * PIXEL_MM
    return np.maximum(0.25 * bumps / bumps.std() + 0.8 - (x**2 + y**2) / 40, 0).astype(np.float32)


def test_colours_of_exact_slopes() -> None:
    """Both colours, their proportion and that ink is no slope, to a per cent; the sign of the height stays open."""
    response, ink = np.array([[-100.0, 20], [30, 40], [60, -90]]), np.array([30.0, 50, 20])
    heights = np.stack([imprint(i) for i in range(32)])
    gy, gx = np.gradient(heights, PIXEL_MM, axis=(1, 2))
    dots = gaussian_filter(np.random.default_rng(0).standard_normal(heights.shape), (0, 1, 1))[..., None] * ink
    colours, mixtures, curl = slope_colours(np.stack([gx, gy], -1) @ response.T + dots)
    assert curl < 0.01
    np.testing.assert_allclose(colours / (colours[0, 0] / response[0, 0]), response, atol=2)
    np.testing.assert_allclose(mixtures.T @ colours, np.eye(2), atol=1e-6)
    assert np.abs(mixtures.T @ ink).max() < 0.03 * np.abs(mixtures.T @ response).max()
