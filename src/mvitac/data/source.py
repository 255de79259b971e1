"""The interface that a dataset implements: list items, read samples, return a fingerprint."""

import os
import stat
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mvitac.data.spec import DataSpec


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One row of a dataset. Images are uint8 [H, W, C] of any size, or None if the row has none.

    If the dataset has the modality and the row does not, column has_vision or has_touch is False.
    """

    vision: np.ndarray | None
    touch: np.ndarray | None
    columns: dict[str, Any] = field(default_factory=dict)
    """At least id (str), group (str), split (one of SPLITS) and a label_<task> (int, -1 = none) per task."""


@dataclass(frozen=True)
class Lost:
    """A damaged sample of an otherwise good item, such as one frame of a recording."""

    name: str
    why: str


Stamp = tuple[int, ...]  # size and modification time (ns) of a file, to detect changes without reading it


def stamp_of(path: str) -> Stamp:
    """Return the stamp of a regular file, else (-1, 0). Fast, because a manifest may name 200,000 files."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return -1, 0
    return (found.st_size, found.st_mtime_ns) if stat.S_ISREG(found.st_mode) else (-1, 0)


def one_stamp(stamps: Iterable[Stamp]) -> int:
    """Combine the stamps of an item's files, in order, to one number."""
    return zlib.crc32(repr([*stamps]).encode())


class Source(ABC):
    """A dataset to read. Each worker gets a copy, so it must be picklable and its module must not import torch."""

    @abstractmethod
    def spec(self) -> DataSpec: ...

    @abstractmethod
    def items(self) -> Sequence[str]:
        """Return the names of the independent units of work (a row, a grasp, a recording), in pack order."""

    @abstractmethod
    def read(self, item: int) -> Sequence[Sample | Lost]:
        """Return the samples of item number ``item``; ValueError or OSError if all of it is damaged."""

    @abstractmethod
    def fingerprint(self) -> dict[str, Any]:
        """Return JSON-ready values that, with the stamps, determine the content: what is read and how, not when."""

    def stamps(self) -> Sequence[int] | None:
        """Return a number per item (``one_stamp``) that changes when one of its files does.

        None if no files are read or the fingerprint covers their content. The pack does not depend on stamps.
        """
        return None

    def samples_per_item(self) -> Sequence[int]:
        """Return the largest number of samples of each item; it is exact if none is damaged or lost."""
        return [1] * len(self.items())
