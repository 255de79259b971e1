"""Making a pack: any source's items, resized, checked, and written so that no interruption costs more than a part of them.

``build`` works in ``<pack>.partial`` (``data/partial_pack.py`` has its files). Killed at any instant, it resumes there and ends
byte-identical. The finished folder is renamed into place, so a folder with a pack.json is a whole pack. Of several
processes that want one pack, one makes it and the others wait. No torch here.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import multiprocessing
import os
import shutil
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from mvitac.data.images import fit
from mvitac.data.jpeg import QUALITY
from mvitac.data.pack import FORMAT, FORMAT_VERSIONS, SPLITS, SUFFIXES, Pack, Store, check_table
from mvitac.data.partial_pack import JpegFile, Part, RowFile
from mvitac.data.source import Lost, Sample, Source
from mvitac.data.spec import DataSpec
from mvitac.registry import from_json, to_json, unknown
from mvitac.system.files import brief, digest, digest_file, read_json, write_atomic, write_json
from mvitac.system.locks import hold_lock
from mvitac.system.malloc import keep_freed_memory
from mvitac.system.progress import shown, work
from mvitac.system.provenance import provenance

NUM_PART_ITEMS = 32


def check_request(
    size: int, workers: int, max_damaged: float = 0.0, *, store: str = "raw", quality: int = QUALITY
) -> None:
    """Refuse impossible packing options before any work."""
    if not 8 <= size <= 1024:
        raise ValueError(f"size {size} is not possible: give the stored side in pixels, 8 to 1024")
    if not 0 <= workers <= 1024:
        raise ValueError(f"workers {workers} is not possible: give 1 to 1024 processes, or 0 for one per core")
    if not 0 <= max_damaged <= 1:
        raise ValueError(f"max_damaged {max_damaged} is not possible: give a fraction of the items, 0 to 1")
    if store not in SUFFIXES:
        raise unknown("store", str(store), SUFFIXES)
    if not 1 <= quality <= 100:
        raise ValueError(f"quality {quality} is not possible: give JPEG's 1 to 100")


def stored_as(store: Store, quality: int) -> dict[str, Any]:
    """What tells a pack of JPEGs from others of the same source and size; nothing of a raw one, as ever."""
    return {} if store == "raw" else {"store": store, "quality": quality}


def build(
    source: Source,
    out: str | Path,
    *,
    size: int,
    workers: int = 1,
    max_damaged: float = 0.0,
    quiet: bool = False,
    store: Store = "raw",
    quality: int = QUALITY,
    exist_ok: bool = False,
) -> Pack:
    """Read ``source`` into a new pack at ``out``, images stored [size, size]: raw, or as JPEG of ``quality``.

    An interrupted build continues from ``<out>.partial``; one under way in another process is waited for. Damaged items are
    listed in pack.json under "damaged" if they are at most the fraction ``max_damaged`` of all, otherwise ValueError names
    the first. A pack that is there is a ValueError or, with ``exist_ok``, what is returned.
    """
    out = Path(out)
    check_request(size, workers, max_damaged, store=store, quality=quality)
    if not out.exists():
        with hold_lock(out, f"{out} is being packed by another process: waiting for it", wait=True, quiet=quiet):
            if not out.exists():
                return _build(source, out, size, workers, max_damaged, quiet, store, quality)
    if exist_ok:
        return Pack(out)
    raise ValueError(f"{out} already exists: choose another --out, or delete it first")


def _build(
    source: Source,
    out: Path,
    size: int,
    workers: int,
    max_damaged: float,
    quiet: bool,
    store: Store,
    quality: int,
) -> Pack:
    """``build`` for the one process that does."""
    spec, items, counts = source.spec(), source.items(), source.samples_per_item()
    num = sum(counts)
    if not num:
        raise ValueError(f"dataset {spec.name!r} has no samples to pack")
    request = {"fingerprint": source.fingerprint(), "size": size, "spec": to_json(spec), **stored_as(store, quality)}
    partial = out.with_name(out.name + ".partial")
    files: dict[str, RowFile | JpegFile] = {}
    for modality in spec.modalities:
        path, shape = partial / "pack" / f"{modality}{SUFFIXES[store]}", (size, size, spec.channels(modality))
        files[modality] = RowFile(path, num, shape) if store == "raw" else JpegFile(path, num, shape, quality)
    disk = _check_disk(out, list(files.values()))
    if (partial / "request.json").exists():
        known = read_json(partial / "request.json", f"an unfinished pack's request (delete {partial})")
        if source.sizes_at:
            with contextlib.suppress(KeyError, TypeError):  # it is of something else
                known["fingerprint"][source.sizes_at] = request["fingerprint"][source.sizes_at]
        if known != json.loads(json.dumps(request)):
            raise ValueError(f"{partial} is an unfinished pack of something else: delete it or choose another --out")
    else:
        write_json(partial / "request.json", request)
    if not quiet:
        text = f"packing {num} samples at {size} px into {out}: {disk}"
        Console().print(text, soft_wrap=True, highlight=False, markup=False)
    for rows in files.values():
        rows.create()

    step = max(1, NUM_PART_ITEMS * len(items) // max(len(items), num))  # few items where one gives many (a video)
    firsts = [0, *accumulate(counts)]
    stamps, parts = source.stamps(), []
    for i, start in enumerate(range(0, len(items), step)):
        end = min(start + step, len(items))
        stamp = None if stamps is None else digest([items[start:end], stamps[start:end]])
        parts.append(Part(partial / f"part-{i:06d}.json", (start, end), firsts[start], stamp))
    # Parts come in order, so the digests are taken beside the other processes' work, of rows still in memory.
    sums = {modality: hashlib.sha256(rows.header(num)) for modality, rows in files.items()}
    with shown(quiet=quiet), work(f"packing {spec.name}", len(items), "items", announce=False) as advance:
        for part, made in zip(parts, _run(_Work(source, spec, size, counts, files), parts, workers), strict=True):
            for modality, rows in files.items():
                sums[modality].update(rows.join(part, made))
            advance(part.items[1] - part.items[0])
    digests = {rows.path.name: sums[modality].hexdigest() for modality, rows in files.items()}
    pack = _finish(partial, out, request, files, parts, digests, items, max_damaged)
    shutil.rmtree(partial)
    return pack


@dataclass(frozen=True)
class _Work:
    """What every process that packs needs to know. It goes to each once: a source of 100,000 rows takes seconds to send."""

    source: Source
    spec: DataSpec
    size: int
    counts: Sequence[int]
    files: dict[str, RowFile | JpegFile]


def _check_disk(out: Path, files: Sequence[RowFile | JpegFile]) -> str:
    """What packing will take and what is free, in words; ValueError if that is too little."""
    need = sum(rows.need() for rows in files)  # less what an interrupted build has taken
    parent = next(p for p in [out.absolute().parent, *out.absolute().parents] if p.exists())
    free = shutil.disk_usage(parent).free
    if need > free:
        raise ValueError(f"packing needs about {_bytes(need)}, {parent} has {_bytes(free)} free")
    return f"needs about {_bytes(need)} of disk, {_bytes(free)} are free"


def _bytes(num: int) -> str:
    return f"{num / 1e9:.1f} GB" if num >= 1e8 else f"{num / 1e6:.1f} MB"


def _run(work: _Work, parts: Sequence[Part], workers: int) -> Iterator[int]:
    """How many rows each of ``parts`` has, in order, as they are done."""
    workers = workers or os.cpu_count() or 1
    if workers == 1 or len(parts) < 2:
        keep_freed_memory()
        for part in parts:
            yield _make_part(work, part)
        return
    # spawn, because a forked child may inherit torch's locks; workers import no torch, so starting one is cheap.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(work,)) as pool:
        try:
            yield from pool.map(_make_part_here, parts)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


_work: _Work
"""What this worker process packs."""


def _start_worker(work: _Work) -> None:
    global _work
    keep_freed_memory()
    os.environ["OMP_NUM_THREADS"] = "1"  # one worker, one core; also keeps sums in one order
    _work = work


def _make_part_here(part: Part) -> int:
    return _make_part(_work, part)


def _make_part(work: _Work, part: Part) -> int:
    """Write ``part`` unless an interrupted build did, and did it well; returns how many rows it has."""
    with contextlib.suppress(ValueError, KeyError, TypeError, FileNotFoundError):  # not there, or damaged
        known = part.read()
        num = len(known["columns"])
        found = {
            m: [zlib.crc32(row) for row in rows.found(part, num, known.get("bytes", {}).get(m, []))]
            for m, rows in work.files.items()
        }
        if found == known["crc"]:  # else a machine lost power before all of it was on the disk
            return num
    return _write_part(work, part)


def _write_part(work: _Work, part: Part) -> int:
    columns: list[dict[str, Any]] = []
    damaged: list[list[Any]] = []
    lost: list[list[str]] = []
    sums: dict[str, list[int]] = {m: [] for m in work.files}
    lengths: dict[str, list[int]] = {m: [] for m, rows in work.files.items() if isinstance(rows, JpegFile)}
    for number in range(*part.items):
        try:
            read = work.source.read(number)
            samples = [one for one in read if isinstance(one, Sample)]
            lost += [[one.name, one.why] for one in read if isinstance(one, Lost)]
            images = {m: [_check_image(s, m, work.spec, work.size) for s in samples] for m in work.files}
            for sample in samples:
                _check_columns(sample.columns, work.spec)
        except (ValueError, OSError) as error:
            damaged.append([number, str(error)])
            continue
        if len(samples) > work.counts[number]:
            raise ValueError(f"item {number} gives {len(samples)} samples, its source promised {work.counts[number]}")
        for modality, rows in work.files.items():
            stored = [rows.stored(image) for image in images[modality]]
            rows.put(part, len(columns), stored)
            sums[modality] += [zlib.crc32(row) for row in stored]
            if modality in lengths:
                lengths[modality] += [len(row) for row in stored]
        columns += [sample.columns for sample in samples]
    known = {
        "items": part.items,
        "first": part.first,
        "stamp": part.stamp,
        "columns": columns,
        "damaged": damaged,
        "lost": lost,
        "crc": sums,
        **({"bytes": lengths} if lengths else {}),
    }
    # The rows are written before what vouches for them. Nothing waits for the disk: a resumed build checks the sums.
    write_atomic(part.path, lambda file: file.write(json.dumps(known).encode()), sync=False)
    return len(columns)


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
    for name in ("id", "group", "split", *(f"label_{t.name}" for t in spec.tasks)):
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


def _finish(
    partial: Path,
    out: Path,
    request: dict[str, Any],
    files: dict[str, RowFile | JpegFile],
    parts: Sequence[Part],
    digests: dict[str, str],
    items: Sequence[str],
    max_damaged: float,
) -> Pack:
    """Complete ``<partial>/pack`` and rename it to ``out``; ``digests`` are those of the image files as they are."""
    spec: DataSpec = from_json(DataSpec, json.loads(json.dumps(request["spec"])), "spec")
    columns: list[dict[str, Any]] = []
    damaged: list[list[Any]] = []
    lost: list[list[str]] = []
    sums: dict[str, list[int]] = {m: [] for m in files}  # so that damage can be told by row
    lengths: dict[str, list[int]] = {m: [] for m, rows in files.items() if isinstance(rows, JpegFile)}
    runs: list[tuple[int, int]] = []
    for part in parts:
        known = part.read()
        runs.append((part.first, len(known["columns"])))
        columns += known["columns"]
        damaged += known["damaged"]
        lost += known["lost"]
        for modality in files:
            sums[modality] += known["crc"][modality]
        for modality in lengths:
            lengths[modality] += known["bytes"][modality]
    named = [*([items[number], why] for number, why in damaged), *lost]
    if len(damaged) > max_damaged * len(items) or len(lost) > max_damaged * (len(columns) + len(lost)):
        for part in parts:  # the damaged parts are read again next time, when they may have been repaired
            known = part.read()
            if known["damaged"] or known["lost"]:
                part.path.unlink()
        what = (
            f"{len(damaged)} of {len(items)} items" if damaged else f"{len(lost)} of {len(columns) + len(lost)} samples"
        )
        raise ValueError(
            f"{what} cannot be read, first {named[0][0]}: {named[0][1]}"
            " (repair it, or leave a share of them out: mvitac data pack --max-damaged SHARE)"
        )
    if not columns:
        raise ValueError("every item is damaged: nothing to pack")
    if any(len(columns) < rows.num for rows in files.values()):
        # Killed here, the next build finds that the sums of what has moved are wrong, and reads that again.
        for rows in files.values():
            rows.close_holes(runs)
        digests = {rows.path.name: digest_file(rows.path) for rows in files.values()}
    joined = partial / "pack"
    for path in joined.iterdir():  # of a build that was killed here
        if path.name not in digests:
            path.unlink()
    buffer = io.BytesIO()
    table = _table(columns)
    for kind, numbers in (("crc", sums), ("bytes", lengths)):
        for name, column in ((f"{kind}_{modality}", numbers[modality]) for modality in numbers):
            table = table.drop_columns(name) if name in table.column_names else table  # a manifest made of another pack
            table = table.append_column(name, pa.array(column, pa.uint32()))
    check_table(table, spec)
    pq.write_table(table, buffer)
    write_atomic(joined / "samples.parquet", lambda file: file.write(buffer.getvalue()))
    digests = {"samples.parquet": hashlib.sha256(buffer.getvalue()).hexdigest(), **digests}
    meta = {
        "format": FORMAT,
        "format_version": FORMAT_VERSIONS[request.get("store", "raw")],
        "num": len(columns),
        "digests": digests,
        "damaged": named,
        **request,
    }
    write_json(joined / "pack.json", {**meta, "digest": digest(json.loads(json.dumps(meta)))})
    # Beside the pack's own description, not in it: packs of equal content must be byte-identical.
    write_json(joined / "provenance.json", provenance())
    with contextlib.suppress(FileExistsError):
        out.parent.mkdir(parents=True)
    os.rename(joined, out)
    return Pack(out, verify=False)


def _table(columns: list[dict[str, Any]]) -> pa.Table:
    names = list(dict.fromkeys(name for row in columns for name in row))
    arrays = {}
    for name in names:
        try:
            arrays[name] = pa.array([row.get(name) for row in columns])
        except pa.ArrowException as error:
            raise ValueError(f"column {name!r} mixes kinds of values: {brief(error)}") from None
    return pa.table(arrays)
