"""``--data stream``: a pack in shards, on a slow disk or in an object store, of any size."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from mvitac.datasets.base import DatasetConfig
from mvitac.pack import Pack
from mvitac.record import cache_dir
from mvitac.source import Source


@dataclass(frozen=True, kw_only=True)
class StreamConfig(DatasetConfig):
    """Shards written by ``mvitac data shard``, fetched whole and in sequence as they are needed."""

    name: ClassVar[str] = "stream"
    local: ClassVar[tuple[str, ...]] = (*DatasetConfig.local, "cache", "cache_gb")

    url: str = "shards"
    """Where the shards are: a folder, file:///..., s3://bucket/path (needs mvitac[s3]), or whatever fsspec opens."""
    cache: Path | None = None
    """Folder for the shards that are in use; default: "shards" in the cache of packs. A fast local disk."""
    cache_gb: float = 8.0
    """What it may hold, all processes of a machine together; a set that fits is fetched once."""
    window: int = 8
    """Shards whose rows each process mixes at a time: batches are drawn from these, while as many again are on their way."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window < 1:
            raise ValueError(f"window {self.window}: give a number of shards, at least 1")
        if not 0 < self.cache_gb < float("inf"):
            raise ValueError(f"cache_gb {self.cache_gb}: give a positive number of gigabytes")

    def source(self) -> Source:
        raise ValueError(f"{self.url} holds a pack in shards: use it with --data stream, there is nothing to pack")

    def open(self, *, quiet: bool = False) -> Pack:
        from mvitac.streaming import StreamedPack, share_of

        cache = self.cache or cache_dir() / "shards"
        return StreamedPack(self.url, cache, limit=share_of(self.cache_gb), window=self.window)
