"""Packs as datasets: a folder on disk (``pack``) or shards behind a URL (``stream``)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import pyarrow as pa

from mvitac.data.pack import Pack
from mvitac.data.source import Source
from mvitac.datasets.base import DatasetConfig
from mvitac.system.files import cache_dir


@dataclass(frozen=True, kw_only=True)
class PackConfig(DatasetConfig):
    """A folder written by ``mvitac data simulate`` or ``mvitac data pack``."""

    name: ClassVar[str] = "pack"

    path: Path = Path("pack")
    """The pack's folder."""

    score_on: Literal["test", "val"] = "test"
    """val: split val stands in for test, and test is out of sight: for choosing a recipe by `mvitac compare`, so that its
    test scores stay unseen until it is chosen."""

    def source(self) -> Source:
        raise ValueError(f"{self.path} is a pack already: use it with --data pack, there is nothing to pack")

    def open(self, *, quiet: bool = False) -> Pack:
        pack = Pack(self.path)
        if self.score_on == "val":
            if not len(pack.rows("val")):
                raise ValueError(f"{self.path} has no split val to score on: leave out --data.score-on")
            for column in {"split", *(task.split for task in pack.spec.tasks)}:
                pack.table = _shifted(pack.table, column)
        return pack


def _shifted(table: pa.Table, column: str) -> pa.Table:
    """``table`` with val called test in ``column``, and test called hidden."""
    new = [{"test": "hidden", "val": "test"}.get(split, split) for split in table.column(column).to_pylist()]
    return table.set_column(table.schema.get_field_index(column), column, pa.array(new))


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
        from mvitac.data.streaming import StreamedPack, share_of

        cache = self.cache or cache_dir() / "shards"
        return StreamedPack(self.url, cache, limit=share_of(self.cache_gb), window=self.window)
