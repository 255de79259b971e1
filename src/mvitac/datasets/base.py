"""The dataset contract: a config that says where samples come from; everything else reads the pack made of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from mvitac.data.build import build, check_request, stored_as
from mvitac.data.jpeg import QUALITY
from mvitac.data.pack import Pack, Store
from mvitac.data.source import Source
from mvitac.registry import Registered
from mvitac.system.files import cache_dir, check_place, digest

KEEPING = ("size", "workers", "store", "quality")
"""Options of every dataset that say how its images are kept, not which they are."""


@dataclass(frozen=True, kw_only=True)
class DatasetConfig(Registered, ABC):
    """Base of every dataset's config. Adding a dataset is one file: a ``Source`` and a config naming it."""

    local: ClassVar[tuple[str, ...]] = ("workers",)
    """Options that decide nothing of the outcome."""
    phased: ClassVar[bool] = False
    """Whether rows of a touch group show phases of a grasp (before, during, after) instead of repeated touches."""

    size: int = 256
    """Side in pixels at which images are stored; crops are cut from it (paper: 256)."""
    workers: int = 0
    """Processes that read or simulate while packing; 0 = one per core."""
    store: Store = "raw"
    """Images as raw pixels, read at the speed of memory, or as jpeg, a fraction of the disk, decoded in every step."""
    quality: int = QUALITY
    """Of JPEG, 1 to 100; at 95 a pixel is off by 1 or 2 of 255 levels. Colours stay in full resolution (4:4:4)."""

    def __post_init__(self) -> None:
        check_request(self.size, self.workers, store=self.store, quality=self.quality)

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Fields that do not change the outcome of a run: local options, and how raw pixels would be compressed."""
        return (*self.local, "store", "quality") if self.store == "raw" else self.local

    @abstractmethod
    def source(self) -> Source:
        """Where the samples come from; ValueError if it is not there."""

    def open(self, *, quiet: bool = False) -> Pack:
        """The pack of this dataset, made in the cache (see ``files.cache_dir``) the first time, and anew when its files
        have changed."""
        source = self.source()
        kept = stored_as(self.store, self.quality)
        stamps = source.stamps()
        changed = {} if stamps is None else {"stamps": digest(stamps)}
        key = digest({"fingerprint": source.fingerprint(), "size": self.size, **kept, **changed})[:16]
        path = cache_dir() / "packs" / f"{self.name}-{key}"
        if path.exists():
            return Pack(path)
        try:
            check_place(path)
        except ValueError as error:
            raise ValueError(f"the cache of packs: {error} with MVITAC_CACHE") from None
        return build(
            source,
            path,
            size=self.size,
            workers=self.workers,
            quiet=quiet,
            store=self.store,
            quality=self.quality,
            exist_ok=True,
        )
