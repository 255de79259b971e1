"""Reads a pack in shards from a URL: whole shards are fetched in advance into a local cache of limited size.

    <url>/pack.json                 as a pack's, with the number of rows of each shard
          samples.parquet           as a pack's, in the order of the shards
          shard-00000.vision.npy    uint8 [n, size, size, 3]; or .jpegs, as in a pack
          shard-00000.touch.npy     ...

Touch groups are in random order and each in one shard (if it fits), so any few shards are a random sample
(``data/sharding.py`` writes them). A ``StreamedPack`` has the interface of ``Pack``.
"""

import functools
import gc
import itertools
import shutil
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, ClassVar

import fsspec
import numpy as np
from filelock import FileLock, Timeout

from mvitac.data.lazy import Pieces
from mvitac.data.pack import SHARDED, Images, Pack
from mvitac.data.storage import SUFFIXES
from mvitac.registry import from_json
from mvitac.system.files import brief, check_place, digest_file

NUM_FETCHING = 4  # number of files fetched at a time
HEADER = 128  # bytes of a .npy header; numpy pads it to this length for any number of rows


def reach(url: str) -> tuple[Any, str]:
    """Return the fsspec file system of ``url`` and the path in it; ValueError if fsspec does not know the protocol."""
    if not url.strip():
        raise ValueError("the URL of the shards is empty: give a folder, file:///..., s3://...")
    try:
        system, place = fsspec.url_to_fs(url)
    except ImportError as error:
        raise ValueError(
            f"{url} cannot be opened ({brief(error)}): s3:// needs pip install -e '.[s3]' in mvitac's clone"
        ) from None
    except ValueError as error:
        raise ValueError(f"{url} cannot be opened ({brief(error)}): give a folder, file:///..., s3://...") from None
    return system, place.rstrip("/")


def shard_name(number: int, modality: str, store: str) -> str:
    return f"shard-{number:05d}.{modality}{SUFFIXES[store]}"


class StreamedPack(Pack):
    """The pack in shards at a URL."""

    format: ClassVar[str] = SHARDED

    def __init__(self, url: str, cache: Path, *, limit: int, window: int) -> None:
        """Open ``url``, whose files are verified and kept in ``cache``, at most ``limit`` bytes: two windows must fit.

        ``window`` is the number of shards whose rows training mixes at a time.
        """
        self.url, self.window, self._limit = url, window, limit
        self._fetched: list[int] = []
        self._system, self._place = reach(url)
        check_place(cache / "0")
        folder, self._lock = _own_folder(cache)
        known, given = folder / "pack.json", folder / "given.json"
        self._fetch("pack.json", given, missing="make one with `mvitac data shard PACK URL`")
        same = known.is_file() and known.read_bytes() == given.read_bytes()
        for path in folder.iterdir():  # of another pack, or incomplete
            if path != given and (not same or path.suffix == ".part"):
                path.unlink()
        given.replace(known)
        if not (folder / "samples.parquet").is_file():
            self._fetch("samples.parquet", folder / "samples.parquet")
        try:
            super().__init__(folder, verify=False)
        except ValueError as error:
            (folder / "samples.parquet").unlink(missing_ok=True)  # else it would outlive a repair at the URL
            raise ValueError(str(error).replace(str(folder), url)) from None

    @property
    def fetched(self) -> int:
        """Bytes of images fetched from ``url`` so far."""
        return sum(self._fetched)

    @functools.cached_property
    def shards(self) -> np.ndarray:
        return np.repeat(np.arange(len(self._counts)), self._counts)

    def expect(self, rows: np.ndarray) -> None:
        numbers = self.shards[rows]
        first = np.full(len(self._counts), len(rows))
        first[numbers[::-1]] = np.arange(len(rows))[::-1]  # the last assignment wins: the first row of each shard
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

        self._cache = Cache(self.path, sizes, self._limit, lambda name: self._load(name, files[name], rows[name]))
        return {
            m: Pieces(self._shape(m, self.num), starts, functools.partial(self._shard, m)) for m in self.spec.modalities
        }

    def _lengths(self, modality: str, starts: np.ndarray) -> np.ndarray:
        """Return int64 [number of shards], the bytes of each file."""
        if self.store == "jpeg":
            return np.add.reduceat(self.column(f"bytes_{modality}").astype(np.int64), starts[:-1])
        return HEADER + np.diff(starts) * int(np.prod(self._shape(modality, 1)))

    def _shard(self, modality: str, number: int) -> Images:
        """Return the images of shard ``number``; when shards are read in sequence, the next one is fetched in advance."""
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
        # Not np.load, which parses the header with Python's parser: that failed once in several threads.
        return np.memmap(path, np.uint8, "r", HEADER, self._shape(modality, len(rows)))

    def _fetch(self, name: str, path: Path, missing: str = "it is damaged, make it again") -> None:
        part = path.with_name(f"{path.name}.part")
        try:
            self._system.get_file(f"{self._place}/{name}", str(part))
        except FileNotFoundError:
            raise ValueError(f"no {name} at {self.url}: {missing}") from None
        except Exception as error:  # each kind of store raises its own
            raise ValueError(f"{self.url}/{name} cannot be read ({brief(error)})") from None
        part.replace(path)


class Cache:
    """A folder of limited size. Threads load the expected files; others are deleted, least recently used first."""

    def __init__(self, folder: Path, sizes: dict[str, int], limit: int, load: Callable[[str], Images]) -> None:
        """A cache in ``folder``, of this process only. ``sizes``: file name -> bytes; ``limit`` of their sum in bytes.

        ``load`` fetches a file into ``folder``, if it is not there, and opens it.
        """
        self._folder, self._sizes, self._limit, self._load = folder, sizes, limit, load
        self._mutex, self._pool = threading.Lock(), ThreadPoolExecutor(NUM_FETCHING, "shards")
        self._kept: set[str] = set()
        self._next: str | None = None
        # Files here or being fetched, by last use. None: left by an earlier process, not yet verified.
        self._held: dict[str, Future[Images] | None] = {p.name: None for p in folder.iterdir() if p.name in sizes}
        self._make_room(0)

    def expect(self, names: Iterable[str]) -> None:
        """Keep or load as many of the first ``names`` as fit; cancel other files that are not being fetched yet."""
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
        """Wait for file ``name`` and return its images.

        If nothing is expected and files are read in sequence, the next file ``after`` is fetched in advance.
        """
        while True:
            with self._mutex:
                future = self._start(name)
                if after and name == self._next and not self._kept:
                    self._start(after)
                self._next = after or name
            try:
                return future.result()
            except CancelledError:  # another thread called expect()
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
            (self._folder / name).unlink(missing_ok=True)  # a process that has mapped it can still read it
            room += self._sizes[name]


def _own_folder(cache: Path) -> tuple[Path, FileLock]:
    """Return a folder in ``cache`` for this process, and its lock; delete the folders of processes that ended."""
    gc.collect()  # packs of this process that are no longer used hold locks
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
    raise AssertionError("unreachable: the numbers are unlimited")
