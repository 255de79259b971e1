"""Builds packs: reads the items of a source, resizes and checks the images, and writes them to disk.

    <pack>.partial/request.json    what is packed
                   parts.jsonl     of each part that is on disk: its items, their columns, the checksums of their images
                   pack/           the image files of the new pack, to which parts are appended in order

A part is a few items. It is in the list once its images are in the files, so a killed build goes on after the last part
whose images have their checksums, and gives the same bytes. The finished folder is renamed: a folder with a pack.json is
a complete pack. If several processes want the same pack, one builds it and the others wait.
"""

import contextlib
import io
import json
import math
import os
import shutil
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.data.pack import FORMAT, FORMAT_VERSION, Pack
from mvitac.data.pack_table import check_table
from mvitac.data.read_samples import Part, Reader, read_parts, stop_second_build, table_of
from mvitac.data.source import Source
from mvitac.data.spec import QUALITY, SUFFIXES, DataSpec, Store, check_request, stored_as
from mvitac.registry import to_json
from mvitac.system.files import digest, digest_file, naming, read_json, write_atomic, write_json
from mvitac.system.locks import hold_lock
from mvitac.system.progress import shown
from mvitac.system.progress import work as progress
from mvitac.system.provenance import provenance

NUM_PART_ROWS = 32  # the most that an interruption costs each process
LIKELY_RATIO = 3  # compression of JPEG; a low estimate: real frames have 4 at 64 px and 6 to 10 at 256 px


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
    """Read ``source`` into a new pack; an interrupted build continues from ``<out>.partial``.

    Args:
        size: Side of the stored images in pixels.
        workers: Number of processes; 0 = one per core.
        max_damaged: Largest fraction of damaged items to accept. They are listed in pack.json under "damaged".
        store: "raw" pixels or "jpeg".
        quality: JPEG quality, 1 to 100.
        exist_ok: Return an existing pack instead of raising an error.

    Raises:
        ValueError: If more items are damaged, the pack exists, or the disk is too small.

    Examples:
        >>> build(MaterialsConfig(num=100).source(), "packs/materials", size=72)
    """
    stop_second_build()
    out = Path(out)
    check_request(store, size=size, workers=workers, max_damaged=max_damaged, quality=quality)
    if not out.name:
        raise ValueError(f"{out} already exists: choose another --out")
    if not out.exists() or not exist_ok:  # also takes away the lock of a process that was killed at its end
        busy = f"{out} is being packed by another process: waiting for it"
        with hold_lock(out, busy, wait=True, quiet=quiet) as left:
            partial = out.with_name(out.name + ".partial")
            with contextlib.suppress(OSError):
                partial.rmdir()  # an empty one is of a build that found the disk full
            if partial.exists() and not (left or (partial / "request.json").exists()):
                raise ValueError(f"{partial} is no unfinished pack: delete it, or choose another --out")
            if not os.path.lexists(out):
                # What identifies a pack; it is kept in request.json and pack.json.
                request = {"fingerprint": source.fingerprint(), "size": size, "spec": to_json(source.spec())}
                return _build(source, out, request | stored_as(store, quality), workers, max_damaged, quiet)
    if not exist_ok:
        raise ValueError(f"{out} already exists: choose another --out, or delete it first")
    return Pack(out)


def _build(source: Source, out: Path, request: dict[str, Any], workers: int, max_damaged: float, quiet: bool) -> Pack:
    spec, items, counts = source.spec(), source.items(), source.samples_per_item()
    num, size = sum(counts), request["size"]
    if not num:
        raise ValueError(f"dataset {spec.name!r} has no samples to pack")
    partial = _Partial(out.with_name(out.name + ".partial"), spec, num, request)
    disk = partial.check_disk()
    asked = partial.folder / "request.json"
    if not asked.exists():
        write_json(asked, request)
    elif read_json(asked, f"an unfinished pack's request (delete {asked.parent})") != json.loads(json.dumps(request)):
        # Changed files are found part by part, by their stamps.
        raise ValueError(f"{asked.parent} is an unfinished pack of something else: delete it or choose another --out")
    if not quiet:
        print(f"packing {num} samples at {size} px into {out}: {disk}")
    step = max(1, NUM_PART_ROWS * len(items) // max(len(items), num))
    parts = [(first, min(first + step, len(items))) for first in range(0, len(items), step)]
    stamps = source.stamps()
    stamp = {part: None if stamps is None else digest([items[slice(*part)], stamps[slice(*part)]]) for part in parts}
    todo = parts[partial.resume([(*part, stamp[part]) for part in parts]) :]
    reader = Reader(source, spec, items, size, request.get("quality"))
    done = todo[0][0] if todo else len(items)
    with shown(quiet=quiet), progress(f"packing {spec.name}", len(items), "items", done=done) as advance:
        for part, stored in read_parts(reader, todo, workers):
            partial.append(part, stamp[part.first, part.end], stored)
            advance(part.end - part.first)
    partial.finish(len(items), max_damaged)
    out.parent.mkdir(parents=True, exist_ok=True)
    os.rename(partial.folder / "pack", out)
    shutil.rmtree(partial.folder)
    return Pack(out, verify=False)


def _append(path: Path, data: bytes) -> None:
    with naming(path), path.open("ab") as file:
        file.write(data)


class _Partial:
    """An unfinished pack: image files, and the list of the parts in them."""

    def __init__(self, folder: Path, spec: DataSpec, num: int, request: dict[str, Any]) -> None:
        """``num`` is the number of rows if nothing is damaged."""
        self.folder, self.spec, self.num, self.request = folder, spec, num, request
        self.list = folder / "parts.jsonl"
        self.shapes = {m: (request["size"], request["size"], spec.channels(m)) for m in spec.modalities}
        self.files = {m: folder / "pack" / f"{m}{SUFFIXES[request['store']]}" for m in spec.modalities}
        self.parts: list[Part] = []

    def _header(self, modality: str, num: int) -> bytes:
        """The .npy header of ``num`` rows; numpy pads it, so its length does not depend on ``num``."""
        if self.request["store"] == "jpeg":
            return b""
        buffer, shape = io.BytesIO(), (num, *self.shapes[modality])
        np.lib.format.write_array_header_1_0(buffer, {"descr": "|u1", "fortran_order": False, "shape": shape})
        return buffer.getvalue()

    def _write_headers(self, num: int) -> None:
        for modality, path in self.files.items():
            with naming(path), path.open("r+b") as file:
                file.write(self._header(modality, num))

    def check_disk(self) -> str:
        """Return a text with the disk space needed and available; ValueError if it is not enough."""
        share = 1 if self.request["store"] == "raw" else LIKELY_RATIO
        whole = sum(len(self._header(m, 0)) + self.num * math.prod(shape) // share for m, shape in self.shapes.items())
        need = max(0, whole - sum(path.stat().st_size for path in self.files.values() if path.exists()))
        parent = next(p for p in self.folder.absolute().parents if p.exists())
        free = shutil.disk_usage(parent).free
        if need > free:
            raise ValueError(f"packing needs about {need / 1e9:,.2f} GB, {parent} has {free / 1e9:,.2f} GB free")
        return f"needs about {need / 1e9:,.2f} GB of disk, {free / 1e9:,.2f} GB are free"

    def resume(self, expected: Sequence[tuple[int, int, str | None]]) -> int:
        """Take up the parts of an interrupted build and return their number; what comes after them is cut off.

        ``expected``: first item, end and stamp of each part. A part counts if all its images are on disk (a machine that
        lost power may have lost some), and the files that it was read from have not changed since.
        """
        (self.folder / "pack").mkdir(parents=True, exist_ok=True)
        for path in (self.list, *self.files.values()):
            path.touch()
        kept, ends = 0, {m: len(self._header(m, 0)) for m in self.files}
        for line, wanted in zip(self.list.read_bytes().splitlines(keepends=True), expected, strict=False):
            part = _part_of(line, wanted)
            if part is None or not all(self._is_whole(part, m, end) for m, end in ends.items()):
                break
            self.parts.append(part)
            kept += len(line)
            ends = {m: end + sum(part.bytes[m]) for m, end in ends.items()}
        os.truncate(self.list, kept)
        for modality, path in self.files.items():
            os.truncate(path, ends[modality])
        self._write_headers(self.num)
        return len(self.parts)

    def _is_whole(self, part: Part, modality: str, start: int) -> bool:
        """Whether the images of ``part``, which begin at ``start`` of their file, have their checksums."""
        with self.files[modality].open("rb") as file:
            file.seek(start)
            return [zlib.crc32(file.read(length)) for length in part.bytes[modality]] == part.crc[modality]

    def append(self, part: Part, stamp: str | None, stored: dict[str, bytes]) -> None:
        """Write the images of ``part`` to the files, then the part to the list, without fsync: ``resume`` checks them."""
        for modality, images in stored.items():
            _append(self.files[modality], images)
        _append(self.list, json.dumps({**vars(part), "stamp": stamp}).encode() + b"\n")
        self.parts.append(part)

    def finish(self, num_items: int, max_damaged: float) -> None:
        folder, num = self.folder / "pack", sum(len(part.columns) for part in self.parts)
        damaged = self._check_damage(num_items, num, max_damaged)
        self._write_headers(num)
        for path in folder.iterdir():  # left by a build that was killed here
            if path not in self.files.values():
                path.unlink()
        table = self._table()
        write_atomic(folder / "samples.parquet", lambda file: pq.write_table(table, file))
        digests = {path.name: digest_file(path) for path in (folder / "samples.parquet", *self.files.values())}
        meta = {"format": FORMAT, "format_version": FORMAT_VERSION, "num": num, "digests": digests}
        meta |= {"damaged": damaged, **self.request}
        write_json(folder / "pack.json", {**meta, "digest": digest(json.loads(json.dumps(meta)))})
        # In a file of its own, because packs of equal content must be byte-identical.
        write_json(folder / "provenance.json", provenance())

    def _check_damage(self, num_items: int, num: int, max_damaged: float) -> list[list[str]]:
        """Name and reason of everything that could not be read; ValueError if it is more than ``max_damaged``."""
        damaged = [one for part in self.parts for one in part.damaged]
        lost = [one for part in self.parts for one in part.lost]
        if len(damaged) > max_damaged * num_items or len(lost) > max_damaged * (num + len(lost)):
            # The next build reads from the first damaged part on, when they may have been repaired.
            good = next(i for i, part in enumerate(self.parts) if part.damaged or part.lost)
            lines = self.list.read_bytes().splitlines(keepends=True)[:good]
            write_atomic(self.list, lambda file: file.write(b"".join(lines)))
            what = f"{len(damaged)} of {num_items} items" if damaged else f"{len(lost)} of {num + len(lost)} samples"
            first = ": ".join((damaged or lost)[0])
            raise ValueError(f"{what} cannot be read, first {first} (repair it, or give data pack --max-damaged SHARE)")
        if not num:
            raise ValueError("every item is damaged: nothing to pack")
        return [*damaged, *lost]

    def _table(self) -> pa.Table:
        """The table of the pack, with a checksum (and the length of a JPEG) per image."""
        table = table_of([row for part in self.parts for row in part.columns])
        for kind in ("crc", "bytes") if self.request["store"] == "jpeg" else ("crc",):
            for modality in self.files:
                name = f"{kind}_{modality}"
                # A manifest that was made from another pack has these columns already.
                table = table.drop_columns(name) if name in table.column_names else table
                numbers = [number for part in self.parts for number in getattr(part, kind)[modality]]
                table = table.append_column(name, pa.array(numbers, pa.uint32()))
        check_table(table, self.spec)
        return table


def _part_of(line: bytes, wanted: tuple[int, int, str | None]) -> Part | None:
    """The part of a ``line`` of the list; None if it was cut off or is not the ``wanted`` one."""
    with contextlib.suppress(ValueError, KeyError, TypeError):
        known = json.loads(line)
        if line.endswith(b"\n") and (known["first"], known["end"], known.pop("stamp")) == wanted:
            return Part(**known)
    return None
