"""Reads the samples of a source in several processes: checks them, resizes their images and encodes these to store them."""

import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
import zlib
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from threadpoolctl import threadpool_limits

from mvitac.data.images import fit
from mvitac.data.jpeg import encode
from mvitac.data.pack_table import check_table
from mvitac.data.source import Lost, Sample, Source
from mvitac.data.spec import DataSpec
from mvitac.system.files import brief, naming
from mvitac.system.malloc import keep_freed_memory


@dataclass
class Part:
    """The items ``first`` to ``end`` of a source, read: their rows as they are stored. By modality, each row's image."""

    first: int
    end: int
    columns: list[dict[str, Any]] = field(default_factory=list)  # of each row
    damaged: list[list[str]] = field(default_factory=list)  # name and reason of each item that cannot be read
    lost: list[list[str]] = field(default_factory=list)  # the same of samples
    crc: dict[str, list[int]] = field(default_factory=dict)  # checksum of each row's image as stored
    bytes: dict[str, list[int]] = field(default_factory=dict)  # its length


@dataclass(frozen=True)
class Reader:
    """Reads parts. It is sent once per process, because sending a source of 100,000 rows takes seconds."""

    source: Source
    spec: DataSpec
    items: Sequence[str]
    size: int
    quality: int | None  # of JPEGs; None: raw pixels

    def __call__(self, first: int, end: int) -> tuple[Part, dict[str, bytes]]:
        """Read a part; also its images as stored, one after another, by modality."""
        part = Part(first, end)
        stored: dict[str, list[bytes]] = {modality: [] for modality in self.spec.modalities}
        for number in range(first, end):
            try:
                read = self.source.read(number)
                samples = [one for one in read if isinstance(one, Sample)]
                images = {m: [self._image(one, m) for one in samples] for m in stored}
            except (ValueError, OSError, LookupError) as error:  # LookupError: an array shorter than the rows say
                part.damaged.append([self.items[number], str(error)])
                continue
            part.columns += [sample.columns for sample in samples]
            part.lost += [[one.name, one.why] for one in read if isinstance(one, Lost)]
            for modality, found in images.items():
                stored[modality] += found
        try:
            if part.columns:  # at once: else a mistake in a reader is found after the last item
                check_table(table_of(part.columns), self.spec)
        except ValueError as error:
            raise ValueError(f"the rows from {self.items[first]} on: {error}") from None
        part.crc = {m: [zlib.crc32(image) for image in rows] for m, rows in stored.items()}
        part.bytes = {m: [len(image) for image in rows] for m, rows in stored.items()}
        return part, {m: b"".join(rows) for m, rows in stored.items()}

    def _image(self, sample: Sample, modality: str) -> bytes:
        image, channels = getattr(sample, modality), self.spec.channels(modality)
        if (image is None) != (sample.columns.get(f"has_{modality}", True) is False):
            raise ValueError(f"{'no' if image is None else 'a'} {modality} image, against its column has_{modality}")
        if image is None:
            image = np.zeros((self.size, self.size, channels), np.uint8)
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != channels or 0 in image.shape:
            raise ValueError(f"{modality} image is {image.dtype} {image.shape}, not uint8 H x W x {channels}")
        image = fit(image, self.size)
        return image.tobytes() if self.quality is None else encode(image, self.quality)


def table_of(columns: Sequence[dict[str, Any]]) -> pa.Table:
    """Return the rows as a table; ValueError names a column that mixes kinds of values."""
    arrays = {}
    for name in dict.fromkeys(name for row in columns for name in row):
        try:
            arrays[name] = pa.array([row.get(name) for row in columns])
        except pa.ArrowException as error:
            raise ValueError(f"column {name!r} mixes kinds of values: {brief(error)}") from None
    return pa.table(arrays)


def read_parts(read: Reader, parts: Sequence[tuple[int, int]], workers: int) -> Iterator[tuple[Part, dict[str, bytes]]]:
    """Yield the parts (first item, end), in order, read by ``workers`` processes; 0 = one per core."""
    workers = workers or os.cpu_count() or 1
    if workers == 1 or len(parts) < 2:
        keep_freed_memory()
        yield from (read(*part) for part in parts)
        return
    ahead: deque[Future[tuple[Part, dict[str, bytes]]]] = deque()
    # spawn: a forked child may inherit locks held by torch. Starting a worker is cheap, because it does not import torch.
    with (
        tempfile.NamedTemporaryFile(prefix="mvitac-") as file,
        ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _start_worker, (file.name,)) as pool,
    ):
        # In a file: the pipe to a new process is blocked for ever if that process ends before it has read all.
        with naming(Path(file.name)):
            file.write(pickle.dumps(read))
            file.flush()
        try:
            for part in parts:
                signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # also in processes that the first one starts
                ahead.append(pool.submit(_read_here, *part))
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
                if len(ahead) > 2 * workers:  # more would only fill the memory
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        except BrokenProcessPool:
            why = "out of memory, or a script without `if __name__ == '__main__':` (or give workers 1)"
            raise ValueError(f"a packing process died: {why}") from None
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # if the submission failed
            pool.shutdown(wait=True, cancel_futures=True)


def one_thread() -> None:
    """Give this process one core; this also fixes the order of sums."""
    os.environ["OMP_NUM_THREADS"] = "1"
    threadpool_limits(1)  # of libraries that are loaded, which do not read the variable again


_reader: Reader  # of this worker process


def _end_with_parent() -> None:
    """A parent that was killed takes no more results: its workers would wait for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _start_worker(file: str) -> None:
    global _reader
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # which a script's background job has
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # ends without a traceback
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    keep_freed_memory()
    _reader = pickle.loads(Path(file).read_bytes())
    one_thread()


def _read_here(first: int, end: int) -> tuple[Part, dict[str, bytes]]:
    return _reader(first, end)


def stop_second_build() -> None:
    """End a worker that is about to pack by itself, because its main module has no ``if __name__ == "__main__":``."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(1)
