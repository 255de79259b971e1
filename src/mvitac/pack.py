"""The pack: what any dataset becomes on disk, read once, then memory-mapped by every run.

    <pack>/pack.json         format, counts, digests, spec, source, licence, versions
           samples.parquet   one row per sample: id, group, split, label_<task>, sensor, ... (row i <-> image i)
                             has_vision, has_touch (bool) where some rows lack an image; zeros stand for it
           vision.npy        uint8 [N, size, size, 3]      absent where the dataset has no camera
           touch.npy         uint8 [N, size, size, 3 or 6]

``build`` works item by item into ``<pack>.partial`` (killed at any instant, it resumes there and ends byte-identical)
and renames the finished folder into place, so a folder with a pack.json is a whole pack. No torch here.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import multiprocessing
import os
import shutil
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mvitac.allocator import keep_freed_memory
from mvitac.record import brief, digest, digest_file, naming, provenance, read_json, write_atomic, write_json
from mvitac.registry import from_json, to_json, unknown
from mvitac.spec import DataSpec

FORMAT = "mvitac-pack"
FORMAT_VERSION = 1
SPLITS = ("train", "val", "test", "unlabelled")
"""Pre-training sees train and unlabelled; val chooses (kNN while training, a probe's regularisation); test only scores."""
NUM_PART_ITEMS = 32


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One row of a dataset, images as decoded: uint8 [H, W, C] of any size, or None where the modality is absent.

    A row that lacks a modality the dataset has says so in its columns: has_vision or has_touch (bool) is False.
    """

    vision: np.ndarray | None
    touch: np.ndarray | None
    columns: dict[str, Any] = field(default_factory=dict)
    """At least id (str), group (str), split (one of SPLITS) and a label_<task> (int, -1 = none) per task."""


@dataclass(frozen=True)
class Count:
    """What a published list says there is, beside what was found."""

    what: str
    published: int
    found: int
    detail: str = ""
    """What is missing or too many, where that can be said."""


class Source(ABC):
    """Something to read samples from; picklable, so that packing can use several processes."""

    @abstractmethod
    def spec(self) -> DataSpec: ...

    @abstractmethod
    def items(self) -> Sequence[str]:
        """Names of the independent units of work, in pack order: a row, a grasp, a recording."""

    @abstractmethod
    def read(self, item: int) -> list[Sample]:
        """The samples of item number ``item``; ValueError or OSError if it is damaged."""

    @abstractmethod
    def fingerprint(self) -> dict[str, Any]:
        """Whatever decides the content, JSON-ready: two sources with equal fingerprints give equal packs."""

    def num_samples(self) -> int:
        """How many samples to expect, for the disk estimate."""
        return len(self.items())

    def expected(self) -> list[Count]:
        """What a published list of the dataset says, beside what is there, for `mvitac data check`."""
        return []


class Pack:
    """An opened pack: ``table`` (pyarrow), ``images[modality]`` (memory-mapped uint8 [N, S, S, C]), ``spec``."""

    def __init__(self, path: str | Path, *, verify: bool = True) -> None:
        """Open and check ``path``; ``verify`` also recomputes the image digests (about 1 s per GB)."""
        self.path = Path(path)
        if not self.path.is_dir():
            raise ValueError(f"no pack at {self.path}: make one with `mvitac data simulate` or `mvitac data pack`")
        meta = read_json(self.path / "pack.json", "a pack's description")
        if not isinstance(meta, dict) or meta.get("format") != FORMAT:
            raise ValueError(f"{self.path / 'pack.json'} does not describe a pack: choose a folder `mvitac data` wrote")
        if meta.get("format_version") != FORMAT_VERSION:
            raise ValueError(
                f"{self.path} has pack format {meta.get('format_version')}, this version reads {FORMAT_VERSION}: re-pack it"
            )
        rest = {key: value for key, value in meta.items() if key != "digest"}
        if meta.get("digest", given := digest(rest)) != given:
            raise ValueError(
                f"{self.path / 'pack.json'} does not match its digest: it was changed or damaged, re-pack it"
            )
        try:
            self.spec: DataSpec = from_json(DataSpec, meta.get("spec"), "spec")
            self.num, self.size = (int(from_json(int, meta.get(name), name)) for name in ("num", "size"))
            self.digests: dict[str, str] = from_json(dict[str, str], meta.get("digests"), "digests")
            if sorted(self.digests) != sorted(
                names := ("samples.parquet", *(f"{m}.npy" for m in self.spec.modalities))
            ):
                raise ValueError(f"digests: expected those of {', '.join(names)}")
        except ValueError as error:
            raise ValueError(f"{self.path / 'pack.json'} is damaged ({error}): re-pack it") from None
        self.meta: dict[str, Any] = meta
        self.images: dict[str, np.ndarray] = {m: self._map(m) for m in self.spec.modalities}
        for name, expected in self.digests.items():
            if (verify or name == "samples.parquet") and digest_file(self._file(name)) != expected:
                raise ValueError(f"{self.path / name} does not match its digest: the pack is damaged, make it again")
        try:
            self.table: pa.Table = pq.read_table(self._file("samples.parquet"))
        except Exception as error:  # arrow raises several kinds for a damaged file
            raise ValueError(
                f"{self.path / 'samples.parquet'} cannot be read ({brief(error)}): the pack is damaged, make it again"
            ) from None
        if self.table.num_rows != self.num:
            raise ValueError(
                f"{self.path}: {self.table.num_rows} table rows for {self.num} images: make the pack again"
            )
        try:
            _check_table(self.table, self.spec)
        except ValueError as error:
            raise ValueError(f"{self.path / 'samples.parquet'}: {error} (make the pack again)") from None

    @property
    def digest(self) -> str:
        """Content address of the pack: equal content, equal digest."""
        return digest(self.digests)

    def column(self, name: str) -> np.ndarray:
        """One table column as numpy [N]; ValueError names the columns there are."""
        if name not in self.table.column_names:
            raise unknown("column", name, self.table.column_names)
        return np.array(self.table.column(name).to_numpy(zero_copy_only=False))  # arrow memory is read-only

    @functools.cached_property
    def _labels(self) -> dict[str, np.ndarray]:
        labels = {task.name: self.column(f"label_{task.name}").astype(np.int64) for task in self.spec.tasks}
        for task in self.spec.tasks:
            for name, value in task.only.items():
                labels[task.name][self.column(name).astype(str) != value] = -1
        return labels

    def labels(self, task: str) -> np.ndarray:
        """[N] int64 labels of ``task``, -1 where there is none or the task is not about the row (``Task.only``)."""
        return self._labels[task]

    def has(self, modality: str) -> np.ndarray:
        """bool [N]: which rows have an image of ``modality``; the others hold zeros, which nothing should look at."""
        name = f"has_{modality}"
        return self.column(name) if name in self.table.column_names else np.ones(self.num, bool)

    def rows(self, *splits: str, only: dict[str, str] | None = None, having: Sequence[str] = ()) -> np.ndarray:
        """Ascending int64 row numbers whose split is among ``splits``, whose columns equal ``only`` and which have an
        image of every modality in ``having``."""
        mask = np.isin(self.column("split"), splits)
        for modality in having:
            mask &= self.has(modality)
        for name, value in (only or {}).items():
            mask &= self.column(name).astype(str) == value
        return np.flatnonzero(mask)

    @functools.cached_property
    def touch_groups(self) -> np.ndarray:
        """[N] int64: number of each row's touch group (column touch_group, else group), in which rows are near-copies."""
        name = "touch_group" if "touch_group" in self.table.column_names else "group"
        return np.unique(self.column(name).astype(str), return_inverse=True)[1]

    @functools.cached_property
    def _rows_by_touch_group(self) -> list[np.ndarray]:
        order = np.argsort(self.touch_groups, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.touch_groups))[:-1])

    def rows_of(self, touch_group: int) -> np.ndarray:
        """Ascending row numbers of touch group number ``touch_group``."""
        return self._rows_by_touch_group[touch_group]

    def _file(self, name: str) -> Path:
        path = self.path / name
        if not path.is_file():
            raise ValueError(f"{path} is missing: the pack is damaged, make it again")
        return path

    def _map(self, modality: str) -> np.ndarray:
        path = self._file(f"{modality}.npy")
        expected = (self.num, self.size, self.size, self.spec.channels(modality))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about headers that only damage can produce
                images = np.load(path, mmap_mode="r", allow_pickle=False)
        except Exception as error:  # numpy raises whatever a damaged header leads its parser to
            raise ValueError(f"{path} cannot be mapped ({brief(error)}): the pack is damaged, make it again") from None
        if not isinstance(images, np.ndarray) or images.shape != expected or images.dtype != np.uint8:
            held = f"{images.dtype} {images.shape}" if isinstance(images, np.ndarray) else "no array"
            raise ValueError(f"{path} holds {held}, pack.json promises uint8 {expected}")
        return images


def _check_table(table: pa.Table, spec: DataSpec) -> None:
    """What every reader of a pack's table relies on; ValueError names the column, the row and what is allowed."""
    labels = {f"label_{task.name}": len(task.classes) for task in spec.tasks}
    for name in ("id", "group", "split", *labels, *(c for columns in spec.controls.values() for c in columns)):
        if name not in table.column_names:
            raise unknown("column", name, table.column_names)
    for name in (name for task in spec.tasks for name in task.only):
        if name not in table.column_names:
            raise unknown("column", name, table.column_names)

    def first(bad: Any) -> int:
        return int(np.flatnonzero(np.asarray(bad))[0])

    for name in ("id", "group", "split", "touch_group", *labels):
        if name in table.column_names and table.column(name).null_count:
            row = first(table.column(name).is_null().to_numpy())
            raise ValueError(f"column {name} is empty in row {row}: every row needs one")
    for name in (f"has_{modality}" for modality in spec.modalities):
        if name in table.column_names and (table.column(name).null_count or table.column(name).type != pa.bool_()):
            raise ValueError(f"column {name} holds {table.column(name).type}: write true or false in every row")
    for split in table.column("split").unique().to_pylist():
        if split not in SPLITS:
            raise unknown("split", str(split), SPLITS)
    for name, num in labels.items():
        kind = table.column(name).type
        if not pa.types.is_integer(kind):
            raise ValueError(f"column {name} holds {kind}: a label is a whole number, 0 to {num - 1}, or -1 for none")
        values = table.column(name).to_numpy()
        if ((values < -1) | (values >= num)).any():
            row = first((values < -1) | (values >= num))
            raise ValueError(f"{name} is {values[row]} in row {row}: give 0 to {num - 1}, or -1 for none")
    for name in (c for columns in spec.controls.values() for c in columns):
        kind = table.column(name).type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
            raise ValueError(f"column {name} holds {kind}: a control needs a number in every row")
        values = table.column(name).to_numpy(zero_copy_only=False).astype(float)
        if not np.isfinite(values).all():
            raise ValueError(f"column {name} is no number in row {first(~np.isfinite(values))}: a control needs one")
    _check_ids(table.column("id").to_pylist())


def _check_ids(ids: list[Any]) -> None:
    seen: set[Any] = set()
    for one in ids:
        if one in seen:
            raise ValueError(f"id {one!r} is there twice: give every sample its own")
        seen.add(one)


def fit(image: np.ndarray, size: int) -> np.ndarray:
    """uint8 [H, W, C] -> [size, size, C], squashed as the paper does (appendix B), three channels at a time."""
    if image.shape[:2] == (size, size):
        return image
    sensors = np.split(image, image.shape[2] // 3, axis=2)
    resized = [np.asarray(Image.fromarray(s).resize((size, size), Image.Resampling.BILINEAR)) for s in sensors]
    return np.concatenate(resized, axis=2)


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
    for number in numbers:
        try:
            samples = source.read(number)
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
    text = {"columns": np.array(json.dumps(columns)), "damaged": np.array(json.dumps(damaged))}
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
    for path in paths:
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as part:  # numpy leaks what it cannot read
                for modality in spec.modalities:
                    part[modality]  # decompressed and checked by its CRC
                columns += json.loads(str(part["columns"]))
                damaged += json.loads(str(part["damaged"]))
        except Exception as error:  # zipfile and numpy raise their own kinds for a damaged file
            raise ValueError(f"{path} is damaged ({brief(error)}): delete it and run the same command again") from None
    if len(damaged) > max_damaged * len(items):
        number, why = damaged[0]
        for path in paths:  # the damaged parts are read again next time, when they may have been repaired
            with np.load(path, allow_pickle=False) as part:
                hurt = str(part["damaged"]) != "[]"
            if hurt:
                path.unlink()
        raise ValueError(
            f"{len(damaged)} of {len(items)} items cannot be read, first {items[number]}: {why}"
            " (repair it, or allow a fraction with --max-damaged)"
        )
    if not columns:
        raise ValueError("every item is damaged: nothing to pack")
    joined = partial / "pack"
    shutil.rmtree(joined, ignore_errors=True)
    joined.mkdir()
    size = int(request["size"])
    for modality in spec.modalities:
        shape = (len(columns), size, size, spec.channels(modality))
        target = joined / f"{modality}.npy"
        # Written, not mapped: on a full disk a write is an error one can report, a store into a map kills the process.
        with naming(target), target.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
            for path in paths:
                with np.load(path, allow_pickle=False) as part:
                    file.write(np.ascontiguousarray(part[modality]).data)
    buffer = io.BytesIO()
    table = _table(columns)
    _check_table(table, spec)
    pq.write_table(table, buffer)
    write_atomic(joined / "samples.parquet", lambda file: file.write(buffer.getvalue()))
    names = ["samples.parquet", *(f"{m}.npy" for m in spec.modalities)]
    meta = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "num": len(columns),
        "digests": {name: digest_file(joined / name) for name in names},
        "damaged": [[items[number], why] for number, why in damaged],
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
