"""Where an image lies: in a file of its own, in a video, in a tar, in a cell of a parquet table.

A reader names places; whoever packs reads those that lie together in one pass.
"""

from __future__ import annotations

import functools
import io
from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from mvitac import video
from mvitac.datasets.images import decode

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg")


@dataclass(frozen=True, slots=True)
class Place(ABC):
    """One image of a dataset; sorts and hashes by where it lies."""

    path: str

    def together(self) -> Hashable | None:
        """What must be opened to read it and is worth opening once for many; None if it is read alone."""
        return None

    @staticmethod
    @abstractmethod
    def read(places: Sequence[Place]) -> Iterator[Image.Image]:
        """``places`` as RGB, ascending and all of one kind and ``together``; ValueError names the damage."""


@dataclass(frozen=True, slots=True, order=True)
class File(Place):
    """An image file."""

    def __str__(self) -> str:
        return self.path

    @staticmethod
    def read(places: Sequence[Place]) -> Iterator[Image.Image]:
        return (decode(place.path) for place in places)


@dataclass(frozen=True, slots=True, order=True)
class Frame(Place):
    """Frame ``index`` (from 0) of a video."""

    index: int

    def __str__(self) -> str:
        return f"{self.path} frame {self.index}"

    def together(self) -> Hashable:
        return self.path

    @staticmethod
    def read(places: Sequence[Place]) -> Iterator[Image.Image]:
        for _, image in video.frames(places[0].path, [place.index for place in places]):  # type: ignore[attr-defined]
            yield Image.fromarray(image)


@dataclass(frozen=True, slots=True, order=True)
class Stretch(Place):
    """``size`` bytes from ``offset`` on, which are an image file: a member of a tar that is not compressed."""

    offset: int
    size: int

    def __str__(self) -> str:
        return f"{self.path} byte {self.offset}"

    @staticmethod
    def read(places: Sequence[Place]) -> Iterator[Image.Image]:
        for place in places:
            with open(place.path, "rb") as file:
                file.seek(place.offset)  # type: ignore[attr-defined]
                yield decode(io.BytesIO(file.read(place.size)), str(place))  # type: ignore[attr-defined]


@dataclass(frozen=True, slots=True, order=True)
class Cell(Place):
    """Row ``row`` of row group ``group``, column ``column``: encoded bytes, or Hugging Face's struct<bytes, path>."""

    group: int
    column: str
    row: int

    def __str__(self) -> str:
        return f"{self.path} row group {self.group} row {self.row} {self.column}"

    def together(self) -> Hashable:
        return (self.path, self.group)

    @staticmethod
    def read(places: Sequence[Place]) -> Iterator[Image.Image]:
        first: Cell = places[0]  # type: ignore[assignment]
        try:
            values = pq.ParquetFile(first.path).read_row_group(first.group, columns=[first.column]).column(0)
        except (pa.ArrowException, OSError) as error:
            raise ValueError(f"{first.path} cannot be read ({' '.join(str(error).split())[:120]})") from None
        for place in places:
            value = values[place.row].as_py()  # type: ignore[attr-defined]
            if isinstance(value, dict):
                beside = Path(first.path).parent / (value.get("path") or "")
                value = value.get("bytes") or (beside.read_bytes() if beside.is_file() else None)
            if not value:
                raise ValueError(f"{place} holds no image")
            yield decode(io.BytesIO(value), str(place))


def read_all(places: Sequence[Place]) -> Iterator[tuple[Place, Image.Image]]:
    """Every distinct one of ``places``, which lie together, with its image (RGB)."""
    distinct = sorted(set(places))  # type: ignore[type-var]
    if distinct:
        yield from zip(distinct, type(distinct[0]).read(distinct), strict=True)


@functools.lru_cache(maxsize=64)
def mean_image(places: tuple[Place, ...]) -> np.ndarray:
    """The mean of several images of one size, uint8 [H, W, 3]: what a sensor sees without contact."""
    total, num = None, 0
    for place in places:
        for _, read in read_all([place]):
            image = np.asarray(read)
            if total is not None and image.shape != total.shape:
                raise ValueError(f"{place} is {image.shape[1]} x {image.shape[0]}: backgrounds must be of one size")
            total = image.astype(np.float64) if total is None else total + image
            num += 1
    assert total is not None
    return np.rint(total / num).astype(np.uint8)


def difference(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """``image`` minus ``background``, halved, plus one half: no contact is 128; uint8 as both."""
    if image.shape != background.shape:
        (h, w), (h2, w2) = image.shape[:2], background.shape[:2]
        raise ValueError(f"image is {w} x {h}, its background {w2} x {h2}: a difference needs one size")
    return ((image.astype(np.int16) - background + 256) >> 1).astype(np.uint8)
