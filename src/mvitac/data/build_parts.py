"""Makes the parts of a pack, in several processes: reads items, checks and resizes images, writes rows and checksums."""

import contextlib
import json
import math
import multiprocessing
import numbers
import os
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from mvitac.data.images import fit
from mvitac.data.pack_table import SPLITS
from mvitac.data.partial_pack import JpegFile, Part, RowFile
from mvitac.data.source import Lost, Sample, Source
from mvitac.data.spec import DataSpec
from mvitac.registry import unknown
from mvitac.system.files import write_atomic
from mvitac.system.malloc import keep_freed_memory


@dataclass(frozen=True)
class Work:
    """What each worker process needs. It is sent once per process: sending a source of 100,000 rows takes seconds."""

    source: Source
    spec: DataSpec
    size: int
    counts: Sequence[int]
    files: dict[str, RowFile | JpegFile]


def make_parts(work: Work, parts: Sequence[Part], workers: int) -> Iterator[int]:
    """Make the parts and yield the number of rows of each, in order."""
    workers = workers or os.cpu_count() or 1
    if workers == 1 or len(parts) < 2:
        keep_freed_memory()
        for part in parts:
            yield _make_part(work, part)
        return
    # spawn: a forked child may inherit locks held by torch. Starting a worker is cheap, because it does not import torch.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(work,)) as pool:
        try:
            yield from pool.map(_make_part_here, parts)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


_work: Work  # the work of this worker process


def _start_worker(work: Work) -> None:
    global _work
    keep_freed_memory()
    os.environ["OMP_NUM_THREADS"] = "1"  # one core per worker; also fixes the order of sums
    _work = work


def _make_part_here(part: Part) -> int:
    return _make_part(_work, part)


def _make_part(work: Work, part: Part) -> int:
    """Write ``part`` unless an interrupted build has done so correctly; return its number of rows."""
    with contextlib.suppress(ValueError, KeyError, TypeError, FileNotFoundError):  # missing or damaged
        known = part.read()
        num = len(known["columns"])
        sizes = known.get("bytes", {})
        found = {m: [zlib.crc32(r) for r in rows.found(part, num, sizes.get(m, []))] for m, rows in work.files.items()}
        if found == known["crc"]:  # false if the machine lost power before all data reached the disk
            return num
    return _write_part(work, part)


def _write_part(work: Work, part: Part) -> int:
    """Read the items of ``part``, write their rows, then the part's own file; return the number of rows."""
    columns: list[dict[str, Any]] = []
    damaged: list[list[Any]] = []
    lost: list[list[str]] = []
    sums: dict[str, list[int]] = {m: [] for m in work.files}
    lengths: dict[str, list[int]] = {m: [] for m, rows in work.files.items() if isinstance(rows, JpegFile)}
    for number in range(*part.items):
        try:
            samples, images, missing = _read_item(work, number)
        except (ValueError, OSError) as error:
            damaged.append([number, str(error)])
            continue
        lost += missing
        if len(samples) > work.counts[number]:
            raise ValueError(f"item {number} gives {len(samples)} samples, its source promised {work.counts[number]}")
        for modality, rows in work.files.items():
            stored = [rows.stored(image) for image in images[modality]]
            rows.put(part, len(columns), stored)
            sums[modality] += [zlib.crc32(row) for row in stored]
            if modality in lengths:
                lengths[modality] += [len(row) for row in stored]
        columns += [sample.columns for sample in samples]
    record = {"items": part.items, "first": part.first, "stamp": part.stamp, "columns": columns}
    record |= {"damaged": damaged, "lost": lost, "crc": sums, **({"bytes": lengths} if lengths else {})}
    # The part's file is written last, without fsync: a resumed build checks the checksums.
    write_atomic(part.path, lambda file: file.write(json.dumps(record).encode()), sync=False)
    return len(columns)


def _read_item(work: Work, number: int) -> tuple[list[Sample], dict[str, list[np.ndarray]], list[list[str]]]:
    """Return an item's samples, their images by modality, and name and reason of the samples that are lost."""
    read = work.source.read(number)
    samples = [one for one in read if isinstance(one, Sample)]
    images = {m: [_check_image(s, m, work.spec, work.size) for s in samples] for m in work.files}
    for sample in samples:
        _check_columns(sample.columns, work.spec)
    return samples, images, [[one.name, one.why] for one in read if isinstance(one, Lost)]


def _check_image(sample: Sample, modality: str, spec: DataSpec, size: int) -> np.ndarray:
    image = getattr(sample, modality)
    if (image is None) != (sample.columns.get(f"has_{modality}", True) is False):
        raise ValueError(f"{'no' if image is None else 'a'} {modality} image, against its column has_{modality}")
    if image is None:
        return np.zeros((size, size, spec.channels(modality)), np.uint8)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != spec.channels(modality):
        raise ValueError(
            f"{modality} image is {image.dtype} {image.shape}, not uint8 H x W x {spec.channels(modality)}"
        )
    if 0 in image.shape:
        raise ValueError(f"{modality} image is {image.shape}: it has no pixels")
    return np.ascontiguousarray(fit(image, size))


def _check_columns(columns: dict[str, Any], spec: DataSpec) -> None:
    targets = {target.name for task in spec.values for target in task.targets}
    for name in ("id", "group", "split", *(f"label_{t.name}" for t in spec.tasks), *sorted(targets)):
        if name not in columns:
            raise ValueError(f"column {name!r} is missing")
    for name in ("id", "group"):
        if columns[name] is None:
            raise ValueError(f"column {name!r} is None: every sample needs one")
    if columns["split"] not in SPLITS:
        raise unknown("split", str(columns["split"]), SPLITS)
    for task in spec.tasks:
        label = columns[f"label_{task.name}"]
        if isinstance(label, bool) or not isinstance(label, (int, np.integer)) or not -1 <= label < len(task.classes):
            raise ValueError(f"label_{task.name} is {label!r}: {task.name} has classes 0 to {len(task.classes) - 1}")
    for name in sorted(targets):
        value = columns[name]
        if isinstance(value, bool) or not isinstance(value, numbers.Real) or math.isinf(value):
            raise ValueError(f"{name} is {value!r}: a value is a finite number, or NaN for none")
