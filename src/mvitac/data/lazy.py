"""Arrays of images whose rows are made when they are indexed."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from mvitac.data.images import fit


class Lazy(ABC):
    """An array uint8 [N, S, S, C] whose rows are computed when indexed. Threads may share it.

    Indexing is numpy's: first the rows (number, slice, array or mask), then any index of an image's axes.
    """

    dtype = np.dtype(np.uint8)

    def __init__(self, shape: tuple[int, int, int, int]) -> None:
        self.shape = shape
        self._numbers = np.arange(shape[0])

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def nbytes(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    def __getitem__(self, index: Any) -> np.ndarray:
        """Return a new array; ValueError names the file and the row if it is damaged."""
        rows, *within = index if isinstance(index, tuple) else (index,)
        rows = np.asarray(self._numbers[rows])
        images = self._made(rows.ravel()).reshape(*rows.shape, *self.shape[1:])
        return images[(..., *within, *[slice(None)] * (3 - len(within)))] if within else images

    @abstractmethod
    def _made(self, rows: np.ndarray) -> np.ndarray:
        """Return the images uint8 [n, S, S, C] of ``rows`` [n], which are valid row numbers."""


class Changed(Lazy):
    """``images`` after ``change``: row numbers [n] and their images -> uint8 [n, S, S, ``channels``]."""

    def __init__(self, images: Any, channels: int, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        super().__init__((*images.shape[:3], channels))
        self._images, self._change = images, change

    def _made(self, rows: np.ndarray) -> np.ndarray:
        return self._change(rows, self._images[rows])


class Pieces(Lazy):
    """The images of several pieces, one after another; those of one piece are read together.

    Args:
        starts: First row of each piece, and N.
        piece: Number of a piece -> its images, which are resized if their side is not S; None: zeros.
    """

    def __init__(
        self, shape: tuple[int, int, int, int], starts: np.ndarray, piece: Callable[[int], np.ndarray | Lazy | None]
    ) -> None:
        super().__init__(shape)
        self._starts, self._piece = starts, piece

    def _made(self, rows: np.ndarray) -> np.ndarray:
        numbers = np.searchsorted(self._starts, rows, side="right") - 1
        if len(found := np.unique(numbers).tolist()) == 1:
            return self._of(found[0], rows)
        images = np.empty((len(rows), *self.shape[1:]), np.uint8)
        for number in found:
            here = numbers == number
            images[here] = self._of(number, rows[here])
        return images

    def _of(self, number: int, rows: np.ndarray) -> np.ndarray:
        piece, size = self._piece(number), self.shape[1]
        if piece is None:
            return np.zeros((len(rows), *self.shape[1:]), np.uint8)
        images = piece[rows - self._starts[number]]
        return images if images.shape[1] == size else np.stack([fit(image, size) for image in images])
