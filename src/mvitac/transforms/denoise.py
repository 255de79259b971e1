"""Noise of images: how much there is, and a filter that takes it off.

Shapes: N images of H x W pixels and C channels, levels 0 to 255.
"""

import numpy as np
from scipy.ndimage import convolve, gaussian_filter

DETAIL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])[None, :, :, None] / 6
"""A filter that is blind to flat and sloping surfaces and keeps the standard deviation of noise (Immerkaer,
https://doi.org/10.1006/cviu.1996.0060)."""
BLUR, NEAR = 1.0, 1.5
"""Standard deviations in pixels of the blur, and of the neighbourhood in which detail is compared with noise."""


def noise_level(images: np.ndarray) -> float:
    """Standard deviation of the pixel noise of images [N, H, W, C], in levels. Fine texture counts as noise, too."""
    return float(np.median(np.abs(convolve(images.astype(np.float32), DETAIL)[:, 1:-1, 1:-1])) / 0.6745)


def denoise(images: np.ndarray, level: float) -> np.ndarray:
    """Take noise of ``level`` off images uint8 [N, H, W, C]; none at 0.

    A Wiener filter: detail finer than a blur is reduced where it is not above the noise, in all channels alike.
    """
    if not level:
        return images
    whole = images.astype(np.float32)
    smooth = gaussian_filter(whole, (0, BLUR, BLUR, 0))
    power = gaussian_filter(((whole - smooth) ** 2).mean(-1, keepdims=True), (0, NEAR, NEAR, 0))
    share = np.clip(
        1 - (0.9 * level) ** 2 / np.maximum(power, 1e-6), 0, 1
    )  # the blur takes a fifth of the noise's power
    return np.clip(np.rint(smooth + share * (whole - smooth)), 0, 255).astype(np.uint8)
