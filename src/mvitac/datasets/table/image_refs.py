"""Where an image lies: in a file of its own, in a video, in a tar, in a cell of a parquet table.

A reader names places; whoever packs reads those that lie together in one pass.
"""

from __future__ import annotations

import functools
import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from mvitac.data import video
from mvitac.data.images import decode

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg")


Damage = dict["ImageRef", str]
"""A place whose image is damaged -> what is wrong with it."""


@dataclass(frozen=True, slots=True)
class ImageRef(ABC):
    """One image of a dataset; sorts and hashes by where it lies."""

    path: str

    def together(self) -> Hashable | None:
        """What must be opened to read it and is worth opening once for many; None if it is read alone."""
        return None

    def within(self) -> tuple[int, ...]:
        """Which bytes of the file it is, where the table of rows does not decide that."""
        return ()

    @staticmethod
    @abstractmethod
    def read(places: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        """``places``, ascending and all of one kind and ``together``, each with its image as RGB.

        A damaged one is left out and put into ``lost``; ValueError or OSError if what holds them cannot be opened.
        """


@dataclass(frozen=True, slots=True, order=True)
class File(ImageRef):
    """An image file."""

    def __str__(self) -> str:
        return self.path

    @staticmethod
    def read(places: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        return _each(places, lambda place: decode(place.path), lost)


@dataclass(frozen=True, slots=True, order=True)
class Frame(ImageRef):
    """Frame ``index`` (from 0) of a video."""

    index: int

    def __str__(self) -> str:
        return f"{self.path} frame {self.index}"

    def together(self) -> Hashable:
        return self.path

    @staticmethod
    def read(places: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        path, at = places[0].path, {place.index: place for place in places}  # type: ignore[attr-defined]
        why: dict[int, str] = {}
        for index, image in video.frames(path, list(at), lost=why):
            yield at[index], Image.fromarray(image)
        lost.update({at[index]: f"{path}: frame {index} {reason}" for index, reason in why.items()})


@dataclass(frozen=True, slots=True, order=True)
class TarMember(ImageRef):
    """``size`` bytes from ``offset`` on, which are an image file: a member of a tar that is not compressed."""

    offset: int
    size: int

    def __str__(self) -> str:
        return f"{self.path} byte {self.offset}"

    def within(self) -> tuple[int, ...]:
        return self.offset, self.size

    @staticmethod
    def read(places: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        def image(place: Any) -> Image.Image:
            with open(place.path, "rb") as file:
                file.seek(place.offset)
                return decode(io.BytesIO(file.read(place.size)), str(place))

        return _each(places, image, lost)


@dataclass(frozen=True, slots=True, order=True)
class ParquetCell(ImageRef):
    """Row ``row`` of row group ``group``, column ``column``: encoded bytes, or Hugging Face's struct<bytes, path>."""

    group: int
    column: str
    row: int

    def __str__(self) -> str:
        return f"{self.path} row group {self.group} row {self.row} {self.column}"

    def together(self) -> Hashable:
        return (self.path, self.group)

    @staticmethod
    def read(places: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        first: ParquetCell = places[0]  # type: ignore[assignment]
        try:
            values = pq.ParquetFile(first.path).read_row_group(first.group, columns=[first.column]).column(0)
        except (pa.ArrowException, OSError) as error:
            raise ValueError(f"{first.path} cannot be read ({' '.join(str(error).split())[:120]})") from None

        def image(place: Any) -> Image.Image:
            value = values[place.row].as_py()
            if isinstance(value, dict):
                beside = Path(first.path).parent / (value.get("path") or "")
                value = value.get("bytes") or (beside.read_bytes() if beside.is_file() else None)
            if not value:
                raise ValueError(f"{place} holds no image")
            return decode(io.BytesIO(value), str(place))

        yield from _each(places, image, lost)


def _each(
    places: Sequence[ImageRef], image: Callable[[Any], Image.Image], lost: Damage
) -> Iterator[tuple[ImageRef, Image.Image]]:
    """``places`` one by one, each with its ``image``; the damaged ones go to ``lost``."""
    for place in places:
        try:
            found = image(place)
        except (ValueError, OSError) as error:
            lost[place] = str(error)
        else:
            yield place, found


def read_all(places: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
    """Every distinct one of ``places``, which lie together, with its image (RGB); the damaged ones go to ``lost``."""
    distinct = sorted(set(places))  # type: ignore[type-var]
    if distinct:
        yield from type(distinct[0]).read(distinct, lost)


@functools.lru_cache(maxsize=64)
def mean_image(places: tuple[ImageRef, ...]) -> np.ndarray:
    """The mean of several images of one size, uint8 [H, W, 3]: what a sensor sees without contact."""
    total, num = None, 0
    for place in places:
        lost: Damage = {}
        for _, read in read_all([place], lost):
            image = np.asarray(read)
            if total is not None and image.shape != total.shape:
                raise ValueError(f"{place} is {image.shape[1]} x {image.shape[0]}: backgrounds must be of one size")
            total = image.astype(np.float64) if total is None else total + image
            num += 1
        if lost:
            raise ValueError(lost[place])
    assert total is not None
    return np.rint(total / num).astype(np.uint8)
