"""A pack's images kept as JPEG: a fraction of the bytes of their pixels, decoded when they are asked for.

One file holds the JPEGs of all rows, one right after another; how many bytes each has is in the pack's table. The sensors
of a stacked image stand one below the other in one JPEG of three channels. A black image, which also stands for one that
is missing, has no bytes. No torch here.
"""

from __future__ import annotations

import functools
import io
import os
from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mvitac.system.files import brief

QUALITY = 95
FEW = 8
"""Images up to which one thread decodes them: handing them out would cost more than it saves."""


def encode(image: np.ndarray, quality: int) -> bytes:
    """uint8 [S, S, C] as JPEG, with the colours in full resolution (4:4:4): a gel tells slopes by its coloured lights, and
    the usual 4:2:0 keeps but a quarter of them. Other builds of libjpeg may give other bytes."""
    if not image.any():
        return b""
    size = len(image)
    buffer = io.BytesIO()
    sensors = image.reshape(size, size, -1, 3).transpose(2, 0, 1, 3).reshape(-1, size, 3)
    Image.fromarray(sensors).save(buffer, "JPEG", quality=quality, subsampling=0)
    return buffer.getvalue()


def decode(jpeg: bytes, shape: tuple[int, int, int]) -> np.ndarray:
    """uint8 ``shape`` [S, S, C]; ValueError or OSError if ``jpeg`` is cut short or of another shape. (Damage within gives
    other pixels, as libjpeg has it: what a pack holds is known by its sums.)"""
    if not jpeg:
        return np.zeros(shape, np.uint8)
    size, _, channels = shape
    with Image.open(io.BytesIO(jpeg), formats=("JPEG",)) as image:
        if (image.mode, image.size) != ("RGB", (size, size * channels // 3)):
            raise ValueError(f"it is {image.mode} of {image.width} x {image.height}")
        sensors = np.asarray(image).reshape(-1, size, size, 3)
    return sensors.transpose(1, 2, 0, 3).reshape(shape)


class Lazy(ABC):
    """An array uint8 [N, S, S, C] whose rows are made when they are indexed. Safe to share between threads.

    Indexed as numpy does it, rows first: a number, a slice, an array of numbers or a mask, then anything of an image's axes.
    """

    dtype = np.dtype(np.uint8)

    def __init__(self, shape: tuple[int, int, int, int]) -> None:
        self.shape = shape
        self._numbers = np.arange(shape[0])

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes of all images once made."""
        return int(np.prod(self.shape, dtype=np.int64))

    def __getitem__(self, index: Any) -> np.ndarray:
        """A new array, as numpy would give it; ValueError names the file and the row that is damaged."""
        rows, *within = index if isinstance(index, tuple) else (index,)
        rows = np.asarray(self._numbers[rows])
        images = self._made(rows.ravel()).reshape(*rows.shape, *self.shape[1:])
        return images[(..., *within, *[slice(None)] * (3 - len(within)))] if within else images

    @abstractmethod
    def _made(self, rows: np.ndarray) -> np.ndarray:
        """uint8 [n, S, S, C]: the images of ``rows`` [n], which are numbers of rows that are there."""


class Jpegs(Lazy):
    """What a file of JPEGs stands for: rows are decoded, many at once by as many threads as there are cores, or as
    OMP_NUM_THREADS allows."""

    def __init__(self, path: Path, shape: tuple[int, int, int, int], lengths: np.ndarray) -> None:
        """``lengths`` [N] are the bytes of each row; ValueError if the file has not as many."""
        super().__init__(shape)
        self.path = path
        self._ends = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
        if (held := path.stat().st_size) != self._ends[-1]:
            raise ValueError(f"{path} holds {held} bytes, its table promises {self._ends[-1]}")
        self._file = np.memmap(path, np.uint8, "r") if held else np.zeros(0, np.uint8)  # nothing cannot be mapped

    def jpeg(self, row: int) -> bytes:
        """Row ``row`` as it is stored."""
        return self._file[self._ends[row] : self._ends[row + 1]].tobytes()

    def _made(self, rows: np.ndarray) -> np.ndarray:
        images = np.empty((len(rows), *self.shape[1:]), np.uint8)

        def fill(some: np.ndarray) -> None:
            for i in some:
                row = int(rows[i])
                try:
                    images[i] = decode(self.jpeg(row), self.shape[1:])
                except Exception as error:  # Pillow raises several kinds
                    raise ValueError(
                        f"{self.path}: row {row} cannot be decoded ({brief(error)}): the pack is damaged, make it again"
                    ) from None

        places = np.arange(len(rows))
        if len(rows) <= FEW or (num := _num_threads()) == 1:
            fill(places)
        else:
            list(_threads().map(fill, np.array_split(places, min(4 * num, len(rows) // 2))))
        return images


def _num_threads() -> int:
    allowed = os.environ.get("OMP_NUM_THREADS", "")
    return min(int(allowed) if allowed.isdecimal() and int(allowed) else 8, os.cpu_count() or 1)


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Of this process; Pillow decodes without Python's lock."""
    return ThreadPoolExecutor(_num_threads(), "jpeg")
