"""What a dataset owes a pack: items to read samples from, one by one, and a name for all that decides their content.

A worker process that packs has a copy of its source, so a source is picklable and imports no torch.
"""

from __future__ import annotations

import os
import stat
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from mvitac.data.spec import DataSpec


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One row of a dataset, images as decoded: uint8 [H, W, C] of any size, or None where the modality is absent.

    A row that lacks a modality the dataset has says so in its columns: has_vision or has_touch (bool) is False.
    """

    vision: np.ndarray | None
    touch: np.ndarray | None
    columns: dict[str, Any] = field(default_factory=dict)
    """At least id (str), group (str), split (one of SPLITS) and a label_<task> (int, -1 = none) per task."""
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Height and width of a modality's image where it lies, if it comes at another size already."""


@dataclass(frozen=True)
class Count:
    """What a published list says there is, beside what was found."""

    what: str
    published: int
    found: int
    detail: str = ""
    """What is missing or too many, where that can be said."""


@dataclass(frozen=True)
class Lost:
    """A sample that an otherwise good item cannot give: a damaged frame of a recording."""

    name: str
    why: str


Stamp = tuple[int, ...]
"""What tells a changed file from an unchanged one without reading it: its bytes and when it was last written (ns)."""


def stamp_of(path: str) -> Stamp:
    """The stamp of a regular file, (-1, 0) if it is none. (Strings and one call: a manifest may name 200,000 files.)"""
    try:
        found = os.stat(path)
    except (OSError, ValueError):  # a NUL in the name is a ValueError
        return -1, 0
    return (found.st_size, found.st_mtime_ns) if stat.S_ISREG(found.st_mode) else (-1, 0)


def one_stamp(stamps: Iterable[Stamp]) -> int:
    """The stamps of the files of one item, in order, as one number."""
    return zlib.crc32(repr([*stamps]).encode())


class Source(ABC):
    """Something to read samples from; picklable, so that packing can use several processes."""

    sizes_at: ClassVar[str | None] = None
    """Key of the fingerprint that holds sizes of files. An unfinished pack goes by the stamps instead, part by part."""

    @abstractmethod
    def spec(self) -> DataSpec: ...

    @abstractmethod
    def items(self) -> Sequence[str]:
        """Names of the independent units of work, in pack order: a row, a grasp, a recording."""

    @abstractmethod
    def read(self, item: int) -> Sequence[Sample | Lost]:
        """The samples of item number ``item``; ValueError or OSError if it is damaged as a whole."""

    @abstractmethod
    def fingerprint(self) -> dict[str, Any]:
        """Whatever decides the content, JSON-ready: two sources with equal fingerprints and stamps give equal packs."""

    def stamps(self) -> Sequence[int] | None:
        """Per item a number (``one_stamp``) that is another when a file of it has changed; None if no files are read, or
        if the fingerprint tells their content. Not part of the pack, which does not depend on when a file was written."""
        return None

    def samples_per_item(self) -> Sequence[int]:
        """How many samples each item gives if none is damaged or lost, which decides where their rows lie; never more."""
        return [1] * len(self.items())

    def expected(self) -> list[Count]:
        """What a published list of the dataset says, beside what is there, for `mvitac data check`."""
        return []
