"""Files of an unfinished pack: image files, and one file per part with the checksums of its rows.

Raw images are written directly to their final position. The position of a JPEG depends on the length of all before it, so
each part writes its JPEGs to a file of its own, and these are joined in order. The part's own file is written last: a
resumed build (``data/build.py``) verifies the checksums and repeats the parts that fail.
"""

import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.jpeg import encode
from mvitac.system.files import naming, read_json

LIKELY_RATIO = 3
"""Assumed compression ratio of JPEG. It is a low estimate: real frames have 4 at 64 px and 6 to 10 at 256 px."""

Buffer = bytes | memoryview


@dataclass(frozen=True)
class RowFile:
    """The image file of one modality, created at full length. Each row is written at its position."""

    path: Path
    num: int
    shape: tuple[int, int, int]

    def header(self, num: int) -> bytes:
        """Return the .npy header of ``num`` rows; numpy pads it, so its length does not depend on ``num``."""
        buffer = io.BytesIO()
        shape = (num, *self.shape)
        np.lib.format.write_array_header_1_0(buffer, {"descr": "|u1", "fortran_order": False, "shape": shape})
        return buffer.getvalue()

    def place(self, row: int) -> int:
        """Return the position of ``row`` in the file."""
        return len(self.header(self.num)) + row * math.prod(self.shape)

    def need(self) -> int:
        """Return the disk space in bytes that is still needed."""
        return self.place(self.num) - (self.path.stat().st_blocks * 512 if self.path.exists() else 0)

    def create(self) -> None:
        """Create a sparse file of zeros; keep what an interrupted build wrote."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.touch()
        with naming(self.path), self.path.open("r+b") as file:
            file.write(self.header(self.num))
            file.truncate(self.place(self.num))

    def stored(self, image: np.ndarray) -> Buffer:
        """Return the bytes to write for ``image``."""
        return image.data

    def put(self, part: "Part", start: int, rows: Iterable[Buffer]) -> None:
        """Write rows of ``part``, beginning with its row ``start``."""
        self.write(part.first + start, rows)

    def write(self, first: int, rows: Iterable[Buffer]) -> None:
        """Write rows from ``first`` on. Not by a memory map: on a full disk, writing to one kills the process."""
        with naming(self.path), self.path.open("r+b") as file:
            file.seek(self.place(first))
            for row in rows:
                file.write(row)

    def map(self) -> np.ndarray:
        """Return all rows, memory-mapped for reading."""
        return np.load(self.path, mmap_mode="r", allow_pickle=False)

    def found(self, part: "Part", num: int, lengths: Sequence[int]) -> Iterator[Buffer]:
        """Return the ``num`` rows of ``part`` that are on disk; ``lengths`` are used by JPEGs only."""
        return (image.data for image in self.map()[part.first : part.first + num])

    def join(self, part: "Part", num: int) -> Buffer:
        """Return the bytes of the ``num`` rows of ``part``, which are in their final position already."""
        return self.map()[part.first : part.first + num].data

    def close_holes(self, runs: Sequence[tuple[int, int]]) -> None:
        """Move rows so that the ``runs`` (first row, number of rows), in order, are contiguous; truncate the file."""
        images, to = self.map(), 0
        for first, num in runs:
            if first != to:
                self.write(to, (image.copy().data for image in images[first : first + num]))
            to += num
        with naming(self.path), self.path.open("r+b") as file:
            file.write(self.header(to))
            file.truncate(self.place(to))


@dataclass(frozen=True)
class JpegFile:
    """The JPEG file of one modality. Each part writes its rows to a file of its own; these are then joined in order.

    Until the pack is finished, each image is on disk twice. Joining starts again after an interruption.
    """

    path: Path
    num: int
    shape: tuple[int, int, int]
    quality: int

    def header(self, num: int) -> bytes:
        """Return b"": there is no header."""
        return b""

    def need(self) -> int:
        """Estimate the disk space in bytes that is still needed, at quality 95."""
        parts = self.path.parent.parent.glob(f"part-*.{self.path.name}")
        taken = sum(path.stat().st_size for path in parts) + (self.path.stat().st_size if self.path.exists() else 0)
        return max(0, 2 * self.num * math.prod(self.shape) // LIKELY_RATIO - taken)

    def create(self) -> None:
        """Create an empty file, to which parts are joined."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_bytes(b"")

    def stored(self, image: np.ndarray) -> Buffer:
        """Return the bytes to write for ``image``."""
        return encode(image, self.quality)

    def part_file(self, part: "Part") -> Path:
        """Return the file of the rows of ``part``."""
        return part.path.with_suffix(f".{self.path.name}")

    def put(self, part: "Part", start: int, rows: Iterable[Buffer]) -> None:
        """Write rows of ``part``, beginning with its row ``start``; call in order."""
        path = self.part_file(part)
        with naming(path), path.open("ab" if start else "wb") as file:
            for row in rows:
                file.write(row)

    def found(self, part: "Part", num: int, lengths: Sequence[int]) -> Iterator[Buffer]:
        """Yield the ``num`` rows of ``part`` that are on disk; each has one of ``lengths`` bytes."""
        if num:
            with self.part_file(part).open("rb") as file:
                yield from map(file.read, lengths)

    def join(self, part: "Part", num: int) -> Buffer:
        """Append the rows of ``part`` to those of earlier parts, and return their bytes."""
        jpegs = self.part_file(part).read_bytes() if num else b""
        with naming(self.path), self.path.open("ab") as file:
            file.write(jpegs)
        return jpegs

    def close_holes(self, runs: Sequence[tuple[int, int]]) -> None:
        """Do nothing: joined rows have no holes."""


@dataclass(frozen=True)
class Part:
    """Items ``items[0]`` up to (excluding) ``items[1]``; their rows begin at ``first``."""

    path: Path
    items: tuple[int, int]
    first: int
    stamp: str | None = None  # digest of the stamps of the files that the items are read from, if any

    def read(self) -> dict[str, Any]:
        """What the part's file says: columns, damaged, lost, and by modality crc and bytes (JPEG) of each row.

        ValueError if the file does not exist, or is about other rows or about files that have changed.
        """
        known = read_json(self.path, "a part of an unfinished pack")
        if (known["items"], known["first"], known.get("stamp")) != ([*self.items], self.first, self.stamp):
            raise ValueError(f"{self.path} is of other rows or files: delete it and run the same command again")
        return known
