"""Packs as datasets: a folder on disk (``pack``) or shards at a URL (``stream``)."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

import pyarrow as pa

from mvitac.data.pack import Pack
from mvitac.datasets.base import DatasetConfig
from mvitac.system.files import cache_dir

ON_VAL = "scores are on split val (--data.score-on val); split test is hidden"
"""The note beside all scores of such data."""


@dataclass(frozen=True, kw_only=True)
class PackConfig(DatasetConfig):
    """A folder written by ``mvitac data simulate`` or ``mvitac data pack``."""

    name: ClassVar[str] = "pack"

    path: Path = Path("pack")
    """The pack's folder."""

    score_on: Literal["test", "val"] = "test"
    """val: use split val as the test split and hide test, to choose a recipe by `mvitac compare` without its test
    scores."""

    def _frames(self, quiet: bool) -> Pack:
        pack = Pack(self.path)
        if self.score_on == "val":
            if not len(pack.rows("val")):
                raise ValueError(f"{self.path} has no split val to score on: leave out --data.score-on")
            for name in pack.spec.split_columns:
                column = [{"test": "hidden", "val": "test"}.get(split, split) for split in pack.column(name)]
                pack.table = pack.table.set_column(pack.table.schema.get_field_index(name), name, pa.array(column))
            pack.spec = replace(pack.spec, notes=(*pack.spec.notes, ON_VAL))
        return pack


@dataclass(frozen=True, kw_only=True)
class StreamConfig(DatasetConfig):
    """Shards written by ``mvitac data shard``, which are fetched when needed."""

    name: ClassVar[str] = "stream"
    local: ClassVar[tuple[str, ...]] = (*DatasetConfig.local, "cache", "cache_gb")

    url: str = "shards"
    """Location of the shards: a folder, file:///..., s3://bucket/path (needs mvitac[s3]), or any URL fsspec supports."""
    cache: Path | None = None
    """Folder for fetched shards, on a fast local disk; default: "shards" in the cache of packs."""
    cache_gb: float = 8.0
    """Size of the cache in GB, for all processes of a machine together. A dataset that fits is fetched once."""
    window: int = 8
    """Number of shards from which each process draws batches, while the same number is fetched in advance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window < 1:
            raise ValueError(f"window {self.window}: give a number of shards, at least 1")
        if not 0 < self.cache_gb < float("inf"):
            raise ValueError(f"cache_gb {self.cache_gb}: give a positive number of gigabytes")

    def _frames(self, quiet: bool) -> Pack:
        from mvitac.data.streaming import StreamedPack

        cache = self.cache or cache_dir() / "shards"
        limit = int(self.cache_gb * 1e9) // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # torchrun sets it
        return StreamedPack(self.url, cache, limit=limit, window=self.window)
