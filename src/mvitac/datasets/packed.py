"""``--data pack``: a pack that already lies on disk, whatever it was made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from mvitac.datasets.base import DatasetConfig
from mvitac.pack import Pack
from mvitac.source import Source


@dataclass(frozen=True, kw_only=True)
class PackConfig(DatasetConfig):
    """A folder written by ``mvitac data simulate`` or ``mvitac data pack``."""

    name: ClassVar[str] = "pack"

    path: Path = Path("pack")
    """The pack's folder."""

    def source(self) -> Source:
        raise ValueError(f"{self.path} is a pack already: use it with --data pack, there is nothing to pack")

    def open(self, *, quiet: bool = False) -> Pack:
        return Pack(self.path)
