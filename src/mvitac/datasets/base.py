"""The base class of dataset configs. A config gives a source of samples; all other code reads the pack made from it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

from mvitac.data.build import build, check_request, stored_as
from mvitac.data.jpeg import QUALITY
from mvitac.data.pack import Pack, Store
from mvitac.data.source import Source
from mvitac.registry import Registered
from mvitac.system.files import cache_dir, check_place, digest

KEEPING = ("size", "workers", "store", "quality")
"""Options of every dataset that affect how images are stored, not which images they are."""


@dataclass(frozen=True, kw_only=True)
class DatasetConfig(Registered, ABC):
    """Base class of dataset configs. A new dataset is one file with a ``Source`` and a config."""

    local: ClassVar[tuple[str, ...]] = ("workers",)
    """Options that do not affect the result."""
    phased: ClassVar[bool] = False
    """Whether rows of a touch group show phases of a grasp (before, during, after) instead of repeated touches."""

    size: int = 256
    """Side of the stored images in pixels; crops are taken from them (paper: 256)."""
    workers: int = 0
    """Number of processes for packing; 0 = one per core."""
    store: Store = "raw"
    """Store images as raw pixels, which are fast to read, or as jpeg, which needs less disk and is decoded in every step."""
    quality: int = QUALITY
    """JPEG quality, 1 to 100. At 95, pixels differ by 1 or 2 of 255 levels. Colours keep full resolution (4:4:4)."""

    def __post_init__(self) -> None:
        check_request(self.size, self.workers, store=self.store, quality=self.quality)

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Fields that do not change the outcome of a run: local options, and how raw pixels would be compressed."""
        return (*self.local, "store", "quality") if self.store == "raw" else self.local

    @abstractmethod
    def source(self) -> Source:
        """Return the source of samples; ValueError if the data does not exist."""

    def open(self, *, quiet: bool = False) -> Pack:
        """Return the pack of this dataset. It is built in the cache (``files.cache_dir``) if it does not exist.

        If files of the dataset have changed, a new pack is built.
        """
        source = self.source()
        kept = stored_as(self.store, self.quality)
        stamps = source.stamps()
        changed = {} if stamps is None else {"stamps": digest(stamps)}
        key = digest({"fingerprint": source.fingerprint(), "size": self.size, **kept, **changed})[:16]
        path = cache_dir() / "packs" / f"{self.name}-{key}"
        if path.exists():
            pack = Pack(path)
            # A pack from before its reader named values has their columns already.
            pack.spec = replace(pack.spec, values=source.spec().values)
            return pack
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
