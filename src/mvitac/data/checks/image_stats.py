"""Statistics of a pack's images, computed in one pass for all checks. N rows, S = thumbnail side, F = fine side."""

import hashlib
from dataclasses import dataclass

import numpy as np

from mvitac.data.pack import Images, Pack

SIDE, FINE = 16, 32
CONSTANT = 1.0  # standard deviation in grey levels below which an image is constant
NUM_AT_ONCE = 128


@dataclass(frozen=True)
class ImageStats:
    """Statistics of the images of one sensor."""

    modality: str
    thumbs: np.ndarray  # uint8 [N, S, S, 3], area means
    fine: np.ndarray  # uint8 [N, F, F], area means of the channels' mean
    std: np.ndarray  # float32 [N], the largest of the three channels' standard deviations
    exact: np.ndarray  # bytes [N], digest of the pixels
    has: np.ndarray  # bool [N], whether the row has this image. If not, the other values are meaningless.

    @property
    def light(self) -> np.ndarray:
        """float32 [N, S, S], mean of the channels."""
        return self.thumbs.mean(axis=3, dtype=np.float32)

    @property
    def seen(self) -> np.ndarray:
        """bool [N], whether the row has an image that is not constant."""
        return self.has & (self.std >= CONSTANT)

    @property
    def gray(self) -> np.ndarray:
        """bool [N], whether the three channels are equal."""
        return (self.thumbs.max(axis=3).astype(int) - self.thumbs.min(axis=3)).max(axis=(1, 2)) <= 2


def look_at(pack: Pack) -> dict[str, ImageStats]:
    """Return ``ImageStats`` by name: vision, touch, or touch 1 and touch 2 if stacked. About 2 kB per image of any size."""
    found = {}
    for modality in pack.spec.modalities:
        num_sensors = pack.spec.channels(modality) // 3
        for sensor in range(num_sensors):
            name = modality if num_sensors == 1 else f"{modality} {sensor + 1}"
            found[name] = _look(modality, pack.images[modality], slice(3 * sensor, 3 * sensor + 3), pack.has(modality))
    return found


def _look(modality: str, images: Images, channels: slice, has: np.ndarray) -> ImageStats:
    num, size = images.shape[:2]
    side = min(SIDE, size)
    fine_side, every = min(FINE, size), max(1, size // 64)  # about 64 x 64 pixels suffice for a standard deviation
    thumbs, fine = np.empty((num, side, side, 3), np.uint8), np.empty((num, fine_side, fine_side), np.uint8)
    std, exact = np.empty(num, np.float32), np.empty(num, "S16")
    for start in range(0, num, NUM_AT_ONCE):
        at = slice(start, min(start + NUM_AT_ONCE, num))
        chunk = np.ascontiguousarray(images[at, :, :, channels])
        thumbs[at] = area_means(chunk, side)
        fine[at] = area_means(chunk, fine_side).mean(axis=3)
        std[at] = chunk[:, ::every, ::every].std(axis=(1, 2), dtype=np.float32).max(axis=1)
        exact[at] = [hashlib.blake2b(image, digest_size=8).hexdigest().encode() for image in chunk]
    return ImageStats(modality, thumbs, fine, std, exact, has)


def area_means(images: np.ndarray, side: int) -> np.ndarray:
    """Average uint8 [N, H, W, C] to [N, side, side, C]."""
    sums = images.astype(np.float32)
    for axis in (1, 2):
        edges = np.linspace(0, images.shape[axis], side + 1).astype(int)
        sums = np.add.reduceat(sums, edges[:-1], axis=axis)
        sums /= np.diff(edges).reshape(side, *[1] * (3 - axis))
    return sums.round().astype(np.uint8)
