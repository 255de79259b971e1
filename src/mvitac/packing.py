"""Making a pack: any source's items, resized, checked, and written so that no interruption costs more than a part of them.

``build`` works item by item into ``<pack>.partial`` (killed at any instant, it resumes there and ends byte-identical)
and renames the finished folder into place, so a folder with a pack.json is a whole pack. No torch here.
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
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mvitac.allocator import keep_freed_memory
from mvitac.pack import FORMAT, FORMAT_VERSION, SPLITS, Pack, check_table, fit
from mvitac.record import brief, digest, naming, provenance, read_json, write_atomic, write_json
from mvitac.registry import from_json, to_json, unknown
from mvitac.source import Lost, Sample, Source
from mvitac.spec import DataSpec

NUM_PART_ITEMS = 32


def check_request(size: int, workers: int, max_damaged: float = 0.0) -> None:
    """Refuse impossible packing options before any work."""
    if not 8 <= size <= 1024:
        raise ValueError(f"size {size} is not possible: give the stored side in pixels, 8 to 1024")
    if not 0 <= workers <= 1024:
        raise ValueError(f"workers {workers} is not possible: give 1 to 1024 processes, or 0 for one per core")
    if not 0 <= max_damaged <= 1:
        raise ValueError(f"max_damaged {max_damaged} is not possible: give a fraction of the items, 0 to 1")


def build(
    source: Source, out: str | Path, *, size: int, workers: int = 1, max_damaged: float = 0.0, quiet: bool = False
) -> Pack:
    """Read ``source`` into a new pack at ``out``, images stored [size, size].

    An interrupted build continues from ``<out>.partial``. Damaged items are listed in pack.json under "damaged" if they
    are at most the fraction ``max_damaged`` of all, otherwise ValueError names the first.
    """
    out = Path(out)
    check_request(size, workers, max_damaged)
    if out.exists():
        raise ValueError(f"{out} already exists: choose another --out, or delete it first")
    spec, items = source.spec(), source.items()
    if not items:
        raise ValueError(f"dataset {spec.name!r} has no samples to pack")
    request = {"fingerprint": source.fingerprint(), "size": size, "spec": to_json(spec)}
    partial = out.with_name(out.name + ".partial")
    _check_disk(out, spec, source.num_samples(), size)
    if (partial / "request.json").exists():
        if read_json(partial / "request.json", f"an unfinished pack's request (delete {partial})") != json.loads(
            json.dumps(request)
        ):
            raise ValueError(f"{partial} is an unfinished pack of something else: delete it or choose another --out")
    else:
        write_json(partial / "request.json", request)

    # A part is held in memory: few items where one gives many samples (a video).
    step = max(1, NUM_PART_ITEMS * len(items) // max(len(items), source.num_samples()))
    parts = [range(i, min(i + step, len(items))) for i in range(0, len(items), step)]
    missing = [i for i in range(len(parts)) if not (partial / f"part-{i:06d}.npz").exists()]
    with _progress(quiet) as progress:
        bar = progress.add_task(f"packing {spec.name}", total=len(items), completed=0)
        progress.update(bar, completed=len(items) - sum(len(parts[i]) for i in missing))
        jobs = [(source, spec, parts[i], size, partial / f"part-{i:06d}.npz") for i in missing]
        for done in _run(jobs, workers):
            progress.update(bar, advance=len(done))
    pack = _finish(
        partial, out, request, [partial / f"part-{i:06d}.npz" for i in range(len(parts))], items, max_damaged
    )
    shutil.rmtree(partial)
    return pack


def _progress(quiet: bool) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, disable=quiet)


def _check_disk(out: Path, spec: DataSpec, num: int, size: int) -> None:
    need = 2 * num * size * size * (spec.vision_channels + spec.touch_channels)  # the parts, then the joined arrays
    parent = next(p for p in [out.absolute().parent, *out.absolute().parents] if p.exists())
    free = shutil.disk_usage(parent).free
    if need > free:
        raise ValueError(f"packing needs about {need / 1e9:.1f} GB, {parent} has {free / 1e9:.1f} GB free")


def _run(jobs: list[tuple[Source, DataSpec, range, int, Path]], workers: int) -> Iterator[range]:
    workers = workers or os.cpu_count() or 1
    if workers == 1 or len(jobs) < 2:
        keep_freed_memory()
        for job in jobs:
            yield _write_part(job)
        return
    # spawn, because a forked child may inherit torch's locks; workers import no torch, so starting one is cheap. The
    # source goes to each worker once, not with every part: one of 100,000 rows takes seconds to send.
    context = multiprocessing.get_context("spawn")
    source, spec = jobs[0][:2]
    with ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(source, spec)) as pool:
        try:
            yield from pool.map(_work, [job[2:] for job in jobs])
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


_work_on: tuple[Source, DataSpec]
"""What this worker process packs."""


def _start_worker(source: Source, spec: DataSpec) -> None:
    global _work_on
    keep_freed_memory()
    os.environ["OMP_NUM_THREADS"] = "1"  # one worker, one core; also keeps sums in one order
    _work_on = source, spec


def _work(job: tuple[range, int, Path]) -> range:
    return _write_part((*_work_on, *job))


def _write_part(job: tuple[Source, DataSpec, range, int, Path]) -> range:
    source, spec, numbers, size, path = job
    columns: list[dict[str, Any]] = []
    images: dict[str, list[np.ndarray]] = {m: [] for m in spec.modalities}
    damaged: list[list[Any]] = []
    lost: list[list[str]] = []
    for number in numbers:
        try:
            read = source.read(number)
            samples = [one for one in read if isinstance(one, Sample)]
            lost += [[one.name, one.why] for one in read if isinstance(one, Lost)]
            fitted = [{m: _check_image(s, m, spec, size) for m in spec.modalities} for s in samples]
            for sample in samples:
                _check_columns(sample.columns, spec)
        except (ValueError, OSError) as error:
            damaged.append([number, str(error)])
            continue
        columns += [sample.columns for sample in samples]
        for each in fitted:
            for modality, image in each.items():
                images[modality].append(image)
    arrays = {
        m: np.stack(images[m]) if images[m] else np.zeros((0, size, size, spec.channels(m)), np.uint8) for m in images
    }
    texts = {"columns": columns, "damaged": damaged, "lost": lost}
    text = {name: np.array(json.dumps(value)) for name, value in texts.items()}
    write_atomic(path, lambda file: np.savez(file, **arrays, **text))  # type: ignore[arg-type]
    return numbers


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
    return fit(image, size)


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
    partial: Path, out: Path, request: dict[str, Any], paths: list[Path], items: Sequence[str], max_damaged: float
) -> Pack:
    """Join the parts into ``<partial>/pack`` and rename it to ``out``."""
    spec: DataSpec = from_json(DataSpec, json.loads(json.dumps(request["spec"])), "spec")
    columns: list[dict[str, Any]] = []
    damaged: list[list[Any]] = []
    lost: list[list[str]] = []
    for path in paths:
        columns += json.loads(str(_from_part(path, "columns")))
        damaged += json.loads(str(_from_part(path, "damaged")))
        lost += json.loads(str(_from_part(path, "lost")))
    named = [*([items[number], why] for number, why in damaged), *lost]
    if len(damaged) > max_damaged * len(items) or len(lost) > max_damaged * (len(columns) + len(lost)):
        for path in paths:  # the damaged parts are read again next time, when they may have been repaired
            if any(str(_from_part(path, name)) != "[]" for name in ("damaged", "lost")):
                path.unlink()
        what = (
            f"{len(damaged)} of {len(items)} items" if damaged else f"{len(lost)} of {len(columns) + len(lost)} samples"
        )
        raise ValueError(
            f"{what} cannot be read, first {named[0][0]}: {named[0][1]}"
            " (repair it, or allow a fraction with --max-damaged)"
        )
    if not columns:
        raise ValueError("every item is damaged: nothing to pack")
    joined = partial / "pack"
    shutil.rmtree(joined, ignore_errors=True)
    joined.mkdir()
    size = int(request["size"])
    sums: dict[str, list[int]] = {m: [] for m in spec.modalities}  # so that damage can be told by row
    digests: dict[str, str] = {}
    for modality in spec.modalities:
        shape = (len(columns), size, size, spec.channels(modality))
        name = f"{modality}.npy"
        # Written, not mapped: on a full disk a write is an error one can report, a store into a map kills the process.
        with naming(joined / name), (joined / name).open("wb") as file:
            written = _Hashing(file)
            np.lib.format.write_array_header_1_0(written, {"descr": "|u1", "fortran_order": False, "shape": shape})
            for path in paths:
                images = np.ascontiguousarray(_from_part(path, modality))
                written.write(images.data)
                sums[modality] += [zlib.crc32(image) for image in images]
        digests[name] = written.hash.hexdigest()
    buffer = io.BytesIO()
    table = _table(columns)
    for modality in spec.modalities:
        name = f"crc_{modality}"
        table = table.drop_columns(name) if name in table.column_names else table  # a manifest made of another pack
        table = table.append_column(name, pa.array(sums[modality], pa.uint32()))
    check_table(table, spec)
    pq.write_table(table, buffer)
    write_atomic(joined / "samples.parquet", lambda file: file.write(buffer.getvalue()))
    digests = {"samples.parquet": hashlib.sha256(buffer.getvalue()).hexdigest(), **digests}
    meta = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
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


def _from_part(path: Path, name: str) -> np.ndarray:
    """One array of a part, checked by its CRC."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as part:  # numpy leaks what it cannot read
            return part[name]
    except Exception as error:  # zipfile and numpy raise their own kinds for a damaged file
        raise ValueError(f"{path} is damaged ({brief(error)}): delete it and run the same command again") from None


class _Hashing:
    """A file that takes the sha256 of what is written, so that it need not be read again."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.hash = file, hashlib.sha256()

    def write(self, data: Any) -> int:
        self.hash.update(data)
        return self._file.write(data)


def _table(columns: list[dict[str, Any]]) -> pa.Table:
    names = list(dict.fromkeys(name for row in columns for name in row))
    arrays = {}
    for name in names:
        try:
            arrays[name] = pa.array([row.get(name) for row in columns])
        except pa.ArrowException as error:
            raise ValueError(f"column {name!r} mixes kinds of values: {brief(error)}") from None
    return pa.table(arrays)
