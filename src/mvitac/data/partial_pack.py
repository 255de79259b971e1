"""What of an unfinished pack is on the disk: image files, and parts that vouch for the rows written to them.

A raw image is written once, at its final place. JPEGs, whose place depends on the length of all before them, are written in
files of the parts, which are joined in order. A part's own file comes last and holds the sums of its rows, so whatever was
cut is found and done again (``data/build.py``). No torch here.
"""

from __future__ import annotations

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
"""Bytes of an image's pixels over those of its JPEG: rather low, real frames have 4 at 64 px and 6 to 10 at 256."""

Buffer = bytes | memoryview


@dataclass(frozen=True)
class RowFile:
    """The image file of one modality, made at full length: whoever has a row writes it at its place."""

    path: Path
    num: int
    shape: tuple[int, int, int]

    def header(self, num: int) -> bytes:
        """What stands before ``num`` rows; numpy leaves room in it, so that its length is the same for any number."""
        buffer = io.BytesIO()
        shape = (num, *self.shape)
        np.lib.format.write_array_header_1_0(buffer, {"descr": "|u1", "fortran_order": False, "shape": shape})
        return buffer.getvalue()

    def place(self, row: int) -> int:
        """Byte of the file at which ``row`` begins."""
        return len(self.header(self.num)) + row * math.prod(self.shape)

    def need(self) -> int:
        """Bytes of disk that are yet to be taken."""
        return self.place(self.num) - (self.path.stat().st_blocks * 512 if self.path.exists() else 0)

    def create(self) -> None:
        """Make the file, zeros that take no space; what an interrupted build wrote stays."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.touch()
        with naming(self.path), self.path.open("r+b") as file:
            file.write(self.header(self.num))
            file.truncate(self.place(self.num))

    def stored(self, image: np.ndarray) -> Buffer:
        """``image`` as it is written."""
        return image.data

    def put(self, part: Part, start: int, rows: Iterable[Buffer]) -> None:
        """Write rows ``start`` on of ``part``."""
        self.write(part.first + start, rows)

    def write(self, first: int, rows: Iterable[Buffer]) -> None:
        """Write rows ``first`` on. (Not through a map: on a full disk a store into a map kills the process.)"""
        with naming(self.path), self.path.open("r+b") as file:
            file.seek(self.place(first))
            for row in rows:
                file.write(row)

    def map(self) -> np.ndarray:
        """All rows, to read, mapped."""
        return np.load(self.path, mmap_mode="r", allow_pickle=False)

    def found(self, part: Part, num: int, lengths: Sequence[int]) -> Iterator[Buffer]:
        """The ``num`` rows of ``part`` as they are on the disk; ``lengths`` are for JPEGs only."""
        return (image.data for image in self.map()[part.first : part.first + num])

    def join(self, part: Part, num: int) -> Buffer:
        """The bytes of the ``num`` rows of ``part``, which are in place."""
        return self.map()[part.first : part.first + num].data

    def close_holes(self, runs: Sequence[tuple[int, int]]) -> None:
        """Move rows up so that the ``runs`` (first row, how many), in order, leave nothing between them or behind."""
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
    """The image file of one modality where JPEG is stored: each part's rows in a file of its own, then joined in order.

    So an image is on the disk twice until the pack is finished, and whatever interrupts the joining, it begins anew.
    """

    path: Path
    num: int
    shape: tuple[int, int, int]
    quality: int

    def header(self, num: int) -> bytes:
        """Nothing stands before the rows."""
        return b""

    def need(self) -> int:
        """About how many bytes of disk are yet to be taken, at quality 95."""
        parts = self.path.parent.parent.glob(f"part-*.{self.path.name}")
        taken = sum(path.stat().st_size for path in parts) + (self.path.stat().st_size if self.path.exists() else 0)
        return max(0, 2 * self.num * math.prod(self.shape) // LIKELY_RATIO - taken)

    def create(self) -> None:
        """Make the file anew, empty: joining begins."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_bytes(b"")

    def stored(self, image: np.ndarray) -> Buffer:
        """``image`` as it is written."""
        return encode(image, self.quality)

    def part_file(self, part: Part) -> Path:
        """Where the rows of ``part`` wait to be joined."""
        return part.path.with_suffix(f".{self.path.name}")

    def put(self, part: Part, start: int, rows: Iterable[Buffer]) -> None:
        """Write rows ``start`` on of ``part``; rows must come in order."""
        path = self.part_file(part)
        with naming(path), path.open("ab" if start else "wb") as file:
            for row in rows:
                file.write(row)

    def found(self, part: Part, num: int, lengths: Sequence[int]) -> Iterator[Buffer]:
        """The ``num`` rows of ``part``, of ``lengths`` bytes each, as they are on the disk."""
        if num:
            with self.part_file(part).open("rb") as file:
                yield from map(file.read, lengths)

    def join(self, part: Part, num: int) -> Buffer:
        """Append the rows of ``part`` to those of the parts before it, and give their bytes."""
        jpegs = self.part_file(part).read_bytes() if num else b""
        with naming(self.path), self.path.open("ab") as file:
            file.write(jpegs)
        return jpegs

    def close_holes(self, runs: Sequence[tuple[int, int]]) -> None:
        """There are none."""


@dataclass(frozen=True)
class Part:
    """Items ``items[0]`` up to ``items[1]``, whose rows begin at ``first``; done where its file says so and is right."""

    path: Path
    items: tuple[int, int]
    first: int
    stamp: str | None = None
    """Of the files that its items are read from, if they are files."""

    def read(self) -> dict[str, Any]:
        """columns, damaged, lost, crc and bytes (modality -> sum and, of JPEGs, length of each row); ValueError if it is
        not there, or of other rows or of files that have changed since."""
        known = read_json(self.path, "a part of an unfinished pack")
        if (known["items"], known["first"], known.get("stamp")) != ([*self.items], self.first, self.stamp):
            raise ValueError(f"{self.path} is of other rows or files: delete it and run the same command again")
        return known
