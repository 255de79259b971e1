"""What a dataset owes a pack: items to read samples from, one by one, and a name for all that decides their content.

A worker process that packs has a copy of its source, so a source is picklable and imports no torch.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mvitac.spec import DataSpec


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


class Source(ABC):
    """Something to read samples from; picklable, so that packing can use several processes."""

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
        """Whatever decides the content, JSON-ready: two sources with equal fingerprints give equal packs."""

    def samples_per_item(self) -> Sequence[int]:
        """How many samples each item gives if none is damaged or lost, which decides where their rows lie; never more."""
        return [1] * len(self.items())

    def expected(self) -> list[Count]:
        """What a published list of the dataset says, beside what is there, for `mvitac data check`."""
        return []
