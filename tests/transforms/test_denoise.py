"""Noise: how much there is, and what remains of it."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from mvitac.transforms.denoise import denoise, noise_level


def scenes(num: int = 6, size: int = 48) -> np.ndarray:
    """Smooth pictures with a sharp edge, float [num, size, size, 3]."""
    rng = np.random.default_rng(0)
    smooth = 128 + 400 * gaussian_filter(rng.normal(size=(num, size, size, 3)), (0, 6, 6, 0))
    smooth[:, :, size // 2 :] += 60
    return smooth


def noisy(level: float) -> np.ndarray:
    images = scenes()
    noise = np.random.default_rng(1).normal(0, level, images.shape)
    return np.clip(np.rint(images + noise), 0, 255).astype(np.uint8)


def test_the_level_is_that_of_the_noise() -> None:
    for level in (5.0, 20.0):
        assert abs(noise_level(noisy(level)) / level - 1) < 0.05
    assert noise_level(noisy(0.0)) < 1


def test_noise_goes_and_edges_stay() -> None:
    truth, given = scenes(), noisy(20.0)
    cleaned = denoise(given, 20.0)
    assert cleaned.dtype == np.uint8 and cleaned.shape == given.shape

    def error(images: np.ndarray, where: slice = slice(None)) -> float:
        return float(np.sqrt(((images - truth)[:, :, where] ** 2).mean()))

    blurred = gaussian_filter(given.astype(float), (0, 1.5, 1.5, 0))
    assert error(cleaned) < error(given) / 2
    edge = slice(22, 26)
    assert error(cleaned, edge) < error(blurred, edge)  # a blur as strong smears the edge
    assert np.array_equal(denoise(given, 0.0), given)
