"""A pack in shards, read from a URL: whole shards come, in order and ahead of time, into a local folder of bounded size.

    <url>/pack.json                 as a pack's, with the rows of each shard
          samples.parquet           as a pack's, in the order of the shards
          shard-00000.vision.npy    uint8 [n, size, size, 3]; or .jpegs, as in a pack
          shard-00000.touch.npy     ...

Rows of one touch are in one shard if they fit, in random order otherwise, so any few shards are a sample of all
(``data/sharding.py`` writes them). To its reader it is a ``Pack``: same table, same images by row. No torch here.
"""

from __future__ import annotations

import functools
import gc
import itertools
import os
import shutil
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, ClassVar

import fsspec
import numpy as np
from filelock import FileLock, Timeout

from mvitac.data.jpeg import Lazy
from mvitac.data.pack import SHARDED, SUFFIXES, Images, Pack
from mvitac.registry import from_json
from mvitac.system.files import brief, check_place, digest_file

NUM_FETCHING = 4
"""Files on their way at a time."""
HEADER = 128
"""Bytes before the rows of a .npy; numpy leaves room in it for any number of them."""


def reach(url: str) -> tuple[Any, str]:
    """The fsspec file system of ``url`` and the place in it; ValueError if there is no such kind of place."""
    try:
        system, place = fsspec.url_to_fs(url)
    except ImportError as error:
        raise ValueError(f"{url} cannot be opened ({brief(error)}): s3:// needs pip install 'mvitac[s3]'") from None
    except ValueError as error:
        raise ValueError(f"{url} cannot be opened ({brief(error)}): give a folder, file:///..., s3://...") from None
    return system, place.rstrip("/")


def shard_name(number: int, modality: str, store: str) -> str:
    return f"shard-{number:05d}.{modality}{SUFFIXES[store]}"


class StreamedPack(Pack):
    """The pack in shards at ``url``."""

    format: ClassVar[str] = SHARDED

    def __init__(self, url: str, cache: Path, *, limit: int, window: int) -> None:
        """Open ``url``, with at most ``limit`` bytes of shards in the folder ``cache``. Every file is checked when it comes.

        ``window``: shards whose rows training mixes. ValueError if two such windows do not fit into the cache.
        """
        self.url, self.window, self._limit = url, window, limit
        self._fetched: list[int] = []
        self._system, self._place = reach(url)
        check_place(cache / "0")
        folder, self._lock = _own_folder(cache)
        known, given = folder / "pack.json", folder / "given.json"
        self._fetch("pack.json", given, missing="make one with `mvitac data shard PACK URL`")
        same = known.is_file() and known.read_bytes() == given.read_bytes()
        for path in folder.iterdir():  # of another pack, or cut short
            if path != given and (not same or path.suffix == ".part"):
                path.unlink()
        given.replace(known)
        if not (folder / "samples.parquet").is_file():
            self._fetch("samples.parquet", folder / "samples.parquet")
        try:
            super().__init__(folder, verify=False)
        except ValueError as error:
            (folder / "samples.parquet").unlink(missing_ok=True)  # else it would stay when the one at the URL is mended
            raise ValueError(str(error).replace(str(folder), url)) from None

    @property
    def fetched(self) -> int:
        """Bytes of images that came from ``url`` so far."""
        return sum(self._fetched)

    @functools.cached_property
    def shards(self) -> np.ndarray:
        return np.repeat(np.arange(len(self._counts)), self._counts)

    def expect(self, rows: np.ndarray) -> None:
        numbers = self.shards[rows]
        first = np.full(len(self._counts), len(rows))
        first[numbers[::-1]] = np.arange(len(rows))[::-1]  # of several, the last to be written stays: the first row
        coming = [number for number in np.argsort(first, kind="stable").tolist() if first[number] < len(rows)]
        self._cache.expect([shard_name(n, m, self.store) for n in coming for m in self.spec.modalities])

    def _files(self) -> dict[str, str]:
        self._counts = from_json(tuple[int, ...], self.meta.get("shards"), "shards")
        if sum(self._counts) != self.num or min(self._counts) < 1:
            raise ValueError(f"shards: expected numbers of rows, {self.num} in all")
        return {shard_name(n, m, self.store): m for m in self.spec.modalities for n in range(len(self._counts))}

    def _open(self, files: dict[str, str]) -> dict[str, Images]:
        starts = np.cumsum([0, *self._counts])
        pieces = [range(start, end) for start, end in itertools.pairwise(starts.tolist())]
        rows = dict(zip(files, pieces * len(self.spec.modalities), strict=True))
        lengths = np.stack([self._lengths(modality, starts) for modality in self.spec.modalities])
        sizes, by_shard = dict(zip(files, lengths.ravel().tolist(), strict=True)), lengths.sum(axis=0)
        need = int(min(2 * self.window * by_shard.max(), by_shard.sum())) + max(sizes.values())
        if need > self._limit:
            raise ValueError(
                f"a cache of {self._limit / 1e9:.3g} GB does not hold two windows of {self.window} shards:"
                f" give --data.cache-gb {need / 1e9 + 0.0005:.3f} per process on a machine, or a smaller --data.window"
            )

        def load(name: str) -> Images:
            return self._load(name, files[name], rows[name])

        self._cache = Cache(self.path, sizes, self._limit, load)
        return {
            m: Shards(self._shape(m, self.num), starts, functools.partial(self._shard, m)) for m in self.spec.modalities
        }

    def _lengths(self, modality: str, starts: np.ndarray) -> np.ndarray:
        """[number of shards] int64: bytes of each file."""
        if self.store == "jpeg":
            return np.add.reduceat(self.column(f"bytes_{modality}").astype(np.int64), starts[:-1])
        return HEADER + np.diff(starts) * int(np.prod(self._shape(modality, 1)))

    def _shard(self, modality: str, number: int) -> Images:
        """The images of shard ``number``; who reads one shard after another finds the next one under way."""
        after = shard_name(number + 1, modality, self.store) if number + 1 < len(self._counts) else None
        return self._cache.get(shard_name(number, modality, self.store), after)

    def _load(self, name: str, modality: str, rows: range) -> Images:
        path = self.path / name
        if not (path.is_file() and digest_file(path) == self.digests[name]):
            self._fetch(name, path)
            self._fetched.append(path.stat().st_size)
            if digest_file(path) != self.digests[name]:
                try:
                    where = self._damaged_rows(modality, self._read(path, modality, rows), rows.start)
                except ValueError:
                    where = f" (its rows are {rows.start} to {rows.stop - 1}, it has {path.stat().st_size} bytes)"
                path.unlink()
                raise ValueError(f"{self.url}/{name} does not match its digest{where}: make the shards again")
        return self._read(path, modality, rows)

    def _read(self, path: Path, modality: str, rows: range) -> Images:
        if self.store == "jpeg":
            return self._jpegs(modality, path, slice(rows.start, rows.stop))
        # Not np.load: Python's parser, which it gives the header to, failed once where threads used it together.
        return np.memmap(path, np.uint8, "r", HEADER, self._shape(modality, len(rows)))

    def _fetch(self, name: str, path: Path, missing: str = "it is damaged, make it again") -> None:
        part = path.with_name(f"{path.name}.part")
        try:
            self._system.get_file(f"{self._place}/{name}", str(part))
        except FileNotFoundError:
            raise ValueError(f"no {name} at {self.url}: {missing}") from None
        except Exception as error:  # every kind of store has its own
            raise ValueError(f"{self.url}/{name} cannot be read ({brief(error)})") from None
        part.replace(path)


class Shards(Lazy):
    """The rows of all shards of one modality: those of a shard are read together."""

    def __init__(self, shape: tuple[int, int, int, int], starts: np.ndarray, shard: Callable[[int], Images]) -> None:
        super().__init__(shape)
        self._starts, self._shard = starts, shard

    def _made(self, rows: np.ndarray) -> np.ndarray:
        images = np.empty((len(rows), *self.shape[1:]), np.uint8)
        numbers = np.searchsorted(self._starts, rows, side="right") - 1
        for number in np.unique(numbers).tolist():
            here = numbers == number
            images[here] = self._shard(number)[rows[here] - self._starts[number]]
        return images


class Cache:
    """Files in a folder of bounded size: what is expected is loaded by threads and stays, the rest goes, oldest first."""

    def __init__(self, folder: Path, sizes: dict[str, int], limit: int, load: Callable[[str], Images]) -> None:
        """``load`` fetches a file into ``folder`` if it is not there, and opens it. ``limit`` >= all that is expected
        plus the largest of ``sizes``."""
        self._folder, self._sizes, self._limit, self._load = folder, sizes, limit, load
        self._mutex, self._pool = threading.Lock(), ThreadPoolExecutor(NUM_FETCHING, "shards")
        self._kept: set[str] = set()
        self._next: str | None = None
        # Files here, in the order of their last use, or on their way; None: left by an earlier process, to be looked at.
        self._held: dict[str, Future[Images] | None] = {p.name: None for p in folder.iterdir() if p.name in sizes}
        self._make_room(0)

    def expect(self, names: Iterable[str]) -> None:
        """Keep or load the first of ``names``, as many as fit; what else has not begun to come does not."""
        room, expected = self._limit - max(self._sizes.values()), []
        for name in names:
            room -= self._sizes[name]
            if room < 0:
                break
            expected.append(name)
        with self._mutex:
            self._kept = set(expected)
            for name in [n for n, f in self._held.items() if f and n not in self._kept and f.cancel()]:
                del self._held[name]
            for name in expected:
                self._start(name)

    def get(self, name: str, after: str | None = None) -> Images:
        """The images in file ``name``, waited for; where nothing is expected, and ``name`` is what came ``after`` the last
        one asked for, the one ``after`` it begins to come."""
        while True:
            with self._mutex:
                future = self._start(name)
                if after and name == self._next and not self._kept:
                    self._start(after)
                self._next = after or name
            try:
                return future.result()
            except CancelledError:  # another thread expects something else
                continue
            except BaseException:
                with self._mutex:
                    self._held.pop(name, None)  # so that it is tried again
                raise

    def _start(self, name: str) -> Future[Images]:
        there = name in self._held
        future = self._held.pop(name, None)
        if not there:
            self._make_room(self._sizes[name])
        self._held[name] = future = future or self._pool.submit(self._load, name)
        return future

    def _make_room(self, size: int) -> None:
        room = self._limit - sum(self._sizes[n] for n in self._held) - size
        for name in [n for n in self._held if n not in self._kept]:
            if room >= 0:
                return
            future = self._held.pop(name)
            if future and not future.cancel():
                wait([future])
            (self._folder / name).unlink(missing_ok=True)  # who has it mapped may still read it
            room += self._sizes[name]


def _own_folder(cache: Path) -> tuple[Path, FileLock]:
    """A folder in ``cache`` for this process alone, as long as the lock lives; those of ended processes are deleted."""
    gc.collect()  # of this process's own packs, those that nobody uses any more: they hold locks
    cache.mkdir(parents=True, exist_ok=True)
    own: tuple[Path, FileLock] | None = None
    for number in itertools.count():
        folder, lock = cache / f"process-{number}", FileLock(cache / f"process-{number}.lock")
        if own and not folder.exists():
            return own
        try:
            lock.acquire(blocking=False)
        except Timeout:
            continue
        if own:
            shutil.rmtree(folder)
            lock.release()
        else:
            folder.mkdir(exist_ok=True)
            own = folder, lock
    raise AssertionError("there are enough numbers")


def share_of(cache_gb: float) -> int:
    """Bytes of ``cache_gb`` that are this process's: torchrun says how many there are on the machine."""
    return int(cache_gb * 1e9) // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
