"""Builds packs: reads the items of a source, resizes and checks the images, and writes them to disk.

``build`` writes to ``<pack>.partial`` (see ``data/partial_pack.py``). A killed build resumes there and gives the same
bytes. The finished folder is renamed, so a folder with a pack.json is a complete pack. If several processes want the same
pack, one builds it and the others wait.
"""

import contextlib
import hashlib
import io
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.data.build_parts import Work, make_parts
from mvitac.data.pack import FORMAT, Pack
from mvitac.data.pack_table import check_table
from mvitac.data.partial_pack import JpegFile, Part, RowFile
from mvitac.data.source import Source
from mvitac.data.storage import FORMAT_VERSIONS, QUALITY, SUFFIXES, Store, check_request, stored_as
from mvitac.registry import to_json
from mvitac.system.files import brief, digest, digest_file, read_json, write_atomic, write_json
from mvitac.system.locks import hold_lock
from mvitac.system.progress import shown
from mvitac.system.progress import work as progress
from mvitac.system.provenance import provenance

NUM_PART_ITEMS = 32  # samples per part: the most that an interruption costs each process


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
    """Read ``source`` into a new pack.

    An interrupted build continues from ``<out>.partial``. If another process builds the same pack, this one waits for it.

    Args:
        source: The dataset to read.
        out: Folder of the new pack.
        size: Side of the stored images in pixels.
        workers: Number of processes; 0 = one per core.
        max_damaged: Largest fraction of damaged items to accept. They are listed in pack.json under "damaged".
        quiet: Show no progress.
        store: "raw" pixels or "jpeg".
        quality: JPEG quality, 1 to 100.
        exist_ok: Return an existing pack instead of raising an error.

    Raises:
        ValueError: If more items are damaged, the pack exists, or the disk is too small.

    Example:
        >>> build(MaterialsConfig(num=100).source(), "packs/materials", size=72)
    """
    out = Path(out)
    check_request(size, workers, max_damaged, store=store, quality=quality)
    beside = [out.absolute().with_name(f"{out.absolute().name}{left}") for left in (".partial", ".lock")]
    if not out.exists() or any(left.exists() for left in beside):
        with hold_lock(out, f"{out} is being packed by another process: waiting for it", wait=True, quiet=quiet):
            # What identifies a pack; it is kept in request.json and pack.json.
            request = {"fingerprint": source.fingerprint(), "size": size, "spec": to_json(source.spec())}
            request |= stored_as(store, quality)
            if not out.exists():
                return _build(source, out, request, workers, max_damaged, quiet)
            if _clean_up(out, request):
                return Pack(out)
    if exist_ok:
        return Pack(out)
    raise ValueError(f"{out} already exists: choose another --out, or delete it first")


def _clean_up(out: Path, request: dict[str, Any]) -> bool:
    """Delete what a killed build left beside the finished pack ``out``; return whether it was of the same request."""
    partial = out.with_name(out.name + ".partial")
    if (partial / "pack").exists():
        return False
    meta = read_json(out / "pack.json", "a pack's description")
    if not isinstance(meta, dict) or {name: meta.get(name) for name in request} != json.loads(json.dumps(request)):
        return False
    if partial.exists():
        shutil.rmtree(partial)
    return True


def _build(source: Source, out: Path, request: dict[str, Any], workers: int, max_damaged: float, quiet: bool) -> Pack:
    """Build the pack in the process that holds the lock."""
    spec, counts, size = source.spec(), source.samples_per_item(), request["size"]
    num = sum(counts)
    if not num:
        raise ValueError(f"dataset {spec.name!r} has no samples to pack")
    partial = out.with_name(out.name + ".partial")
    files: dict[str, RowFile | JpegFile] = {}
    for modality in spec.modalities:
        name = f"{modality}{SUFFIXES[request.get('store', 'raw')]}"
        place = partial / "pack" / name, num, (size, size, spec.channels(modality))
        files[modality] = JpegFile(*place, request["quality"]) if "store" in request else RowFile(*place)
    disk = _check_disk(out, list(files.values()))
    _claim(partial, request, source.sizes_at)
    if not quiet:
        print(f"packing {num} samples at {size} px into {out}: {disk}")
    for rows in files.values():
        rows.create()
    parts = _parts(source, partial)
    job = Work(source, spec, size, counts, files)
    digests = _write_parts(job, parts, workers, quiet)
    _finish(partial / "pack", job, parts, digests, request, max_damaged)
    with contextlib.suppress(FileExistsError):
        out.parent.mkdir(parents=True)
    os.rename(partial / "pack", out)
    pack = Pack(out, verify=False)
    shutil.rmtree(partial)
    return pack


def _claim(partial: Path, request: dict[str, Any], sizes_at: str | None) -> None:
    """Write the request of a new build, or check that an interrupted build was of the same request."""
    if not (partial / "request.json").exists():
        write_json(partial / "request.json", request)
        return
    known = read_json(partial / "request.json", f"an unfinished pack's request (delete {partial})")
    if sizes_at:  # changed files are found part by part, by their stamps
        with contextlib.suppress(KeyError, TypeError):  # a request of another dataset
            known["fingerprint"][sizes_at] = request["fingerprint"][sizes_at]
    if known != json.loads(json.dumps(request)):
        raise ValueError(f"{partial} is an unfinished pack of something else: delete it or choose another --out")


def _parts(source: Source, partial: Path) -> list[Part]:
    """Divide the items into parts of about ``NUM_PART_ITEMS`` samples."""
    items, counts, stamps = source.items(), source.samples_per_item(), source.stamps()
    step = max(1, NUM_PART_ITEMS * len(items) // max(len(items), sum(counts)))
    firsts = [0, *accumulate(counts)]
    parts = []
    for i, start in enumerate(range(0, len(items), step)):
        end = min(start + step, len(items))
        stamp = None if stamps is None else digest([items[start:end], stamps[start:end]])
        parts.append(Part(partial / f"part-{i:06d}.json", (start, end), firsts[start], stamp))
    return parts


def _write_parts(work: Work, parts: Sequence[Part], workers: int, quiet: bool) -> dict[str, str]:
    """Write all parts and return the digest of each image file by its name."""
    # Parts are done in order, so digests are computed while other processes work, from rows still in memory.
    sums = {modality: hashlib.sha256(rows.header(rows.num)) for modality, rows in work.files.items()}
    with (
        shown(quiet=quiet),
        progress(f"packing {work.spec.name}", len(work.counts), "items") as advance,
    ):
        for part, num in zip(parts, make_parts(work, parts, workers), strict=True):
            for modality, rows in work.files.items():
                sums[modality].update(rows.join(part, num))
            advance(part.items[1] - part.items[0])
    return {rows.path.name: sums[modality].hexdigest() for modality, rows in work.files.items()}


def _check_disk(out: Path, files: Sequence[RowFile | JpegFile]) -> str:
    """Return a text with the disk space needed and available; ValueError if it is not enough."""
    need = sum(rows.need() for rows in files)  # without what an interrupted build has written
    parent = next(p for p in [out.absolute().parent, *out.absolute().parents] if p.exists())
    free = shutil.disk_usage(parent).free
    if need > free:
        raise ValueError(f"packing needs about {need / 1e9:,.2f} GB, {parent} has {free / 1e9:,.2f} GB free")
    return f"needs about {need / 1e9:,.2f} GB of disk, {free / 1e9:,.2f} GB are free"


@dataclass
class _Contents:
    """What all parts together say of the pack's rows."""

    columns: list[dict[str, Any]] = field(default_factory=list)
    damaged: list[list[Any]] = field(default_factory=list)  # item number and reason
    lost: list[list[str]] = field(default_factory=list)  # sample name and reason
    runs: list[tuple[int, int]] = field(default_factory=list)  # first row and number of rows of each part
    numbers: dict[str, list[int]] = field(default_factory=dict)
    """Columns crc_<modality> and, of JPEGs, bytes_<modality>."""

    def add(self, part: Part) -> None:
        known = part.read()
        self.runs.append((part.first, len(known["columns"])))
        self.columns += known["columns"]
        self.damaged += known["damaged"]
        self.lost += known["lost"]
        for kind in ("crc", "bytes"):
            for modality, values in known.get(kind, {}).items():
                self.numbers.setdefault(f"{kind}_{modality}", []).extend(values)


def _finish(
    folder: Path, job: Work, parts: Sequence[Part], digests: dict[str, str], request: dict[str, Any], max_damaged: float
) -> None:
    """Complete the pack in ``folder``; ``digests`` are those of the image files."""
    contents = _Contents()
    for part in parts:
        contents.add(part)
    damaged = _check_damage(contents, parts, job.source.items(), max_damaged)
    num = len(contents.columns)
    if any(num < rows.num for rows in job.files.values()):
        # If killed here, the next build finds that the checksums of moved rows are wrong, and reads these rows again.
        for rows in job.files.values():
            rows.close_holes(contents.runs)
        digests = {rows.path.name: digest_file(rows.path) for rows in job.files.values()}
    for path in folder.iterdir():  # left by a build that was killed here
        if path.name not in digests:
            path.unlink()
    table = io.BytesIO()
    pq.write_table(_table(contents, job), table)
    write_atomic(folder / "samples.parquet", lambda file: file.write(table.getvalue()))
    meta = {
        "format": FORMAT,
        "format_version": FORMAT_VERSIONS[request.get("store", "raw")],
        "num": num,
        "digests": {"samples.parquet": hashlib.sha256(table.getvalue()).hexdigest(), **digests},
        "damaged": damaged,
        **request,
    }
    write_json(folder / "pack.json", {**meta, "digest": digest(json.loads(json.dumps(meta)))})
    # In a file of its own, because packs of equal content must be byte-identical.
    write_json(folder / "provenance.json", provenance())


def _check_damage(
    contents: _Contents, parts: Sequence[Part], items: Sequence[str], max_damaged: float
) -> list[list[str]]:
    """Return name and reason of everything that could not be read; ValueError if it is more than ``max_damaged``."""
    num_damaged, num_lost, num = len(contents.damaged), len(contents.lost), len(contents.columns)
    named = [*([items[number], why] for number, why in contents.damaged), *contents.lost]
    if num_damaged > max_damaged * len(items) or num_lost > max_damaged * (num + num_lost):
        for part in parts:  # the next build reads the damaged parts again, when they may have been repaired
            known = part.read()
            if known["damaged"] or known["lost"]:
                part.path.unlink()
        what = f"{num_damaged} of {len(items)} items" if num_damaged else f"{num_lost} of {num + num_lost} samples"
        raise ValueError(
            f"{what} cannot be read, first {named[0][0]}: {named[0][1]}"
            " (repair it, or leave a share of them out: mvitac data pack --max-damaged SHARE)"
        )
    if not num:
        raise ValueError("every item is damaged: nothing to pack")
    return named


def _table(contents: _Contents, job: Work) -> pa.Table:
    """Return the table of the pack, with a checksum (and the length of a JPEG) per image."""
    arrays = {}
    for name in dict.fromkeys(name for row in contents.columns for name in row):
        try:
            arrays[name] = pa.array([row.get(name) for row in contents.columns])
        except pa.ArrowException as error:
            raise ValueError(f"column {name!r} mixes kinds of values: {brief(error)}") from None
    table = pa.table(arrays)
    for name in [f"{kind}_{modality}" for kind in ("crc", "bytes") for modality in job.files]:
        if name in contents.numbers:
            # A manifest that was made from another pack has these columns already.
            table = table.drop_columns(name) if name in table.column_names else table
            table = table.append_column(name, pa.array(contents.numbers[name], pa.uint32()))
    check_table(table, job.spec)
    return table
