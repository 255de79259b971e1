"""Images stored as JPEG in a pack: they need a fraction of the disk space and are decoded when indexed.

One file holds the JPEGs of all rows, one after another; the pack's table has the length of each. Stacked sensors are
placed below each other in one JPEG of three channels. A black image, which also represents a missing one, has length 0.
"""

import functools
import io
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import simplejpeg
from PIL import Image

from mvitac.data.lazy import Lazy
from mvitac.system.files import brief

FEW = 8  # up to this number of images, one thread is faster than several


def encode(image: np.ndarray, quality: int) -> bytes:
    """Encode uint8 [S, S, C] as JPEG, 4:4:4: a gel shows slopes by colour. Other builds of libjpeg may differ."""
    if not image.any():
        return b""
    buffer = io.BytesIO()
    sensors = image.reshape(*image.shape[:2], -1, 3).transpose(2, 0, 1, 3).reshape(-1, len(image), 3)
    Image.fromarray(sensors).save(buffer, "JPEG", quality=quality, subsampling=0)
    return buffer.getvalue()


def decode(jpeg: bytes, shape: tuple[int, int, int]) -> np.ndarray:
    """Decode to uint8 ``shape`` [S, S, C]; ValueError if ``jpeg`` has another shape or libjpeg warns of damage.

    Other damage gives wrong pixels without an error; a pack detects it by checksums.
    """
    if not jpeg:
        return np.zeros(shape, np.uint8)
    size, _, channels = shape
    height, width, colours, _ = simplejpeg.decode_jpeg_header(jpeg)
    if (height, width, colours) != (size * channels // 3, size, "YCbCr"):
        raise ValueError(f"it is {colours} of {width} x {height}")
    return simplejpeg.decode_jpeg(jpeg).reshape(-1, size, size, 3).transpose(1, 2, 0, 3).reshape(shape)


class Jpegs(Lazy):
    """A file of JPEGs as an array. Many rows are decoded in parallel, by at most OMP_NUM_THREADS (or 8) threads."""

    def __init__(self, path: Path, shape: tuple[int, int, int, int], lengths: np.ndarray) -> None:
        """``lengths`` [N] are the bytes of each row; ValueError if the file has another size."""
        super().__init__(shape)
        self.path = path
        self._ends = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
        if (held := path.stat().st_size) != self._ends[-1]:
            raise ValueError(f"it holds {held} bytes, its table promises {self._ends[-1]}")
        self._file = np.memmap(path, np.uint8, "r") if held else np.zeros(0, np.uint8)  # an empty file cannot be mapped

    def _made(self, rows: np.ndarray) -> np.ndarray:
        images = np.empty((len(rows), *self.shape[1:]), np.uint8)
        if len(rows) <= FEW or (num := _num_threads()) == 1:
            self._decode(rows, images)
        else:
            chunks = min(4 * num, len(rows) // 2)
            list(_threads().map(self._decode, np.array_split(rows, chunks), np.array_split(images, chunks)))
        return images

    def _decode(self, rows: np.ndarray, images: np.ndarray) -> None:
        for i, row in enumerate(rows.tolist()):
            try:
                images[i] = decode(self._file[self._ends[row] : self._ends[row + 1]].tobytes(), self.shape[1:])
            except ValueError as error:
                raise ValueError(f"{self.path}: row {row} cannot be decoded ({brief(error)}): pack again") from None


def _num_threads() -> int:
    allowed = os.environ.get("OMP_NUM_THREADS", "")
    return min(int(allowed) if allowed.isdecimal() and int(allowed) else 8, os.cpu_count() or 1)


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Return this process's pool; simplejpeg releases the GIL while decoding."""
    return ThreadPoolExecutor(_num_threads(), "jpeg")
