"""HDF5 and zarr files as a table: datasets with one row per frame, in one group or in one group per demonstration.

    grips.h5          camera, gel  uint8 [N, H, W, 3]      force_n [N]      pose [N, 6]      object [N] (text)
    demos.hdf5        data/demo_0/obs/camera  data/demo_0/obs/gel  data/demo_0/force  data/demo_1/...     (robomimic)
    episode_0.hdf5    observations/images/camera  observations/images/gel  observations/qpos  action      (ACT)
    buffer.zarr(.zip) data/camera  data/gel  data/action  meta/episode_ends                               (diffusion policy)

A demonstration is a group below which an image dataset has the name asked for, e.g. obs/camera. Its datasets are columns,
named by their path below it. Attributes of the group, and of the groups above it, are columns of one value. A replay buffer
has all episodes in one group, and their ends (exclusive) in meta/episode_ends.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import accumulate
from math import prod
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.images import MAX_PIXELS
from mvitac.datasets.table.image_refs import ArrayRow, Refs, entry, open_arrays
from mvitac.datasets.table.manifest import Manifest, text_of
from mvitac.system.files import check_ordinary, walk

USUAL = ("vision", "touch", "left", "right", "background")
"""Names of image datasets that are found without being asked for."""
MAX_ROWS = 3_000_000
"""Rows of all files together: their table is held in memory. An empty dataset of any length is a file of 2 kB."""
MAX_NUMBERS = 100_000_000
"""Numbers of one dataset that is a column."""
MAX_TEXT = 200
"""Characters of the longest attribute that is a column. robomimic keeps whole simulator files in attributes."""
MAGIC = (b"\xff\xd8", b"\x89P")  # first bytes of a JPEG and of a PNG
OWN = ("id", "demo", "frame")  # columns that episodes give
LeftOut = dict[str, str]  # name of what is no column -> why


def _check_blosc(array: Path) -> None:
    """Raise ValueError if a chunk is not as long as its header says: blosc would read on, in memory that is not its own."""
    for chunk in (file for file in walk(array) if file.is_file() and not file.name.startswith(".")):
        with chunk.open("rb") as file:
            if int.from_bytes(file.read(16)[12:], "little") != chunk.stat().st_size:
                raise ValueError(f"{chunk} is cut off: fetch it again")


def read_arrays(path: Path, files: Sequence[Path], images: Collection[str], vectors: Collection[str]) -> Manifest:
    """Return the table of ``files``, which are ``path`` itself or in this folder.

    ``images`` are the names of image datasets, by default ``USUAL``; ``vectors`` those of datasets [N, K] that become
    columns of lists. Columns demo (the group's path, after the file's name where that is needed), frame (from 0) and id
    are added; what the file calls so is left out.
    """
    rows: list[dict[str, str]] = []
    found, left_out, seen = Refs(), LeftOut(), ""
    notes: dict[str, None] = {}
    for file in files:
        for inner in walk(file) if file.is_dir() else ():
            if inner.is_symlink():
                raise ValueError(f"{inner} is a link: copy what it shows into {file}")
            check_ordinary(inner)  # a pipe never ends
            if inner.name == ".zarray" and b'"blosc"' in inner.read_bytes():
                _check_blosc(inner.parent)
        with open_arrays(file) as opened:
            everything = _datasets(opened)
            demos = _demonstrations(file, everything, images)
            lacking = (f"{file.name}: {name} is left out: it has no images" for name in _others(everything, demos))
            notes |= dict.fromkeys(lacking)
            for name in demos:
                demo = "/".join(filter(None, (file.stem if len(files) > 1 or not name else "", name)))
                datasets = _datasets(opened[name] if name else opened)
                refs = _images(file, name, datasets, images, MAX_ROWS - len(rows))
                num = len(next(iter(refs.values())))
                cells = _constants(opened, name, vectors) | _columns(demo, datasets, num, refs, vectors, left_out)
                notes |= {f"{c} of {file.name} is left out, ours has this name": None for c in OWN if c in cells}
                notes |= dict.fromkeys(_unwritten(file, {n: d for n, d in datasets.items() if n in {**refs, **cells}}))
                for column in {**found, **refs}:
                    found.setdefault(column, [None] * len(rows)).extend(refs.get(column, [None] * num))
                for i, (episode, frame) in enumerate(_episodes(demo, everything.get("meta/episode_ends"), num)):
                    own = dict(zip(OWN, (f"{episode}/{frame}", episode, str(frame)), strict=True))
                    rows.append({column: texts[i % len(texts)] for column, texts in cells.items()} | own)
            seen = _seen(everything)
    if missing := [name for name in images if name not in found]:
        raise _no_images(path, missing, seen)
    if len(said := [*notes]) > 3:
        said[3:] = [f"the same of {len(said) - 3} more datasets"]
    rows = [{name: cell for name, cell in row.items() if name not in left_out} for row in rows]
    return Manifest.of(path, rows, found, group="demo", left_out=left_out, notes=tuple(said))


def _datasets(group: Any) -> dict[str, Any]:
    """Return the datasets below ``group`` by their path; ValueError if one shows the content of other files."""
    if hasattr(group, "members"):  # zarr
        return dict(sorted((path, item) for path, item in group.members(max_depth=None) if hasattr(item, "shape")))
    import h5py
    from h5py import h5o  # type: ignore[attr-defined]

    found: dict[str, Any] = {}
    seen, left = set(), [("", group)]
    while left:  # as visititems, which takes minutes where thousands of groups are inside each other
        path, item = left.pop()
        where = h5o.get_info(item.id)
        if (where.fileno, where.addr) in seen:
            continue
        seen.add((where.fileno, where.addr))
        if getattr(item, "shape", None) is not None:
            found[path[1:]] = item
        for name in sorted(item, reverse=True) if isinstance(item, h5py.Group) else ():
            if isinstance(item.get(name, getlink=True), h5py.HardLink):
                left.append((f"{path}/{name}", item[name]))
    for path, data in found.items():
        if data.external or data.is_virtual:
            raise ValueError(f"{group.file.filename}: {path} shows the content of other files: copy it into this one")
    return found


def _unwritten(file: Path, datasets: dict[str, Any]) -> Iterator[str]:
    """A note on each dataset of which parts were never written, or are lost."""
    for data in datasets.values():
        if 0 in (data.chunks or ()):
            continue
        if hasattr(data, "nchunks_initialized"):  # zarr
            num, there = data.nchunks, data.nchunks_initialized
        elif data.chunks:
            num = prod(-(-side // of) for side, of in zip(data.shape, data.chunks, strict=True))
            there = data.id.get_num_chunks()
        else:
            num, there = 1, int(data.id.get_storage_size() > 0 or not data.size)
        if there < num:
            yield f"{file.name}: {num - there} of {num} chunks of {data.name} are not there and read as its fill value"


def _demonstrations(file: Path, datasets: dict[str, Any], images: Collection[str]) -> list[str]:
    """Return the paths of the groups that hold image datasets ("" = the file itself)."""
    if not datasets:
        raise ValueError(f"{file} holds no datasets: is it the right file?")
    found = ((path, name) for path in datasets for name in images or USUAL if f"/{path}".endswith(f"/{name}"))
    shown = ((path, name) for path, name in found if images or _holds_images(datasets[path]))
    if not (groups := list(dict.fromkeys(path[: -len(name)].rstrip("/") for path, name in shown))):
        raise _no_images(file, images or USUAL[:2], _seen(datasets))
    for home, _, name in (group.rpartition("/") for group in groups):  # robomimic keeps each image twice
        if f"{home}/next_{name}".lstrip("/") in groups:
            raise ValueError(f"{file}: {name} and next_{name} of {home} hold the same images: name them {name}/...")
    return groups


def _others(datasets: Iterable[str], demos: Collection[str]) -> list[str]:
    """Return the groups beside the demonstrations that hold datasets, but no demonstration."""
    homes = {(f"{name.rpartition('/')[0]}/".lstrip("/"), name.count("/") + 1) for name in demos if name}
    inside = ((path, depth) for path in datasets for home, depth in homes if path.startswith(home))
    beside = {"/".join(path.split("/")[:depth]) + "/" for path, depth in inside if path.count("/") >= depth}
    return sorted(group[:-1] for group in beside if not any(f"{name}/".startswith(group) for name in demos))


def _episodes(demo: str, ends: Any, num: int) -> list[tuple[str, int]]:
    """Return the episode of each row and the row's place in it; without ``ends``, the demonstration is one."""
    if ends is None:
        return [(demo, i) for i in range(num)]
    whole = ends.ndim == 1 and 0 < ends.size <= num
    starts = np.r_[0, np.asarray(ends[...])] if whole else np.zeros(1)
    if starts[-1] != num or (np.diff(starts) <= 0).any() or (starts % 1).any():
        raise ValueError(f"{demo}: meta/episode_ends does not rise to {num}, the number of images")
    number = np.searchsorted(starts[1:], np.arange(num), side="right")
    starts = starts[number]
    return [(f"{demo}/{k}", i - int(start)) for i, (k, start) in enumerate(zip(number, starts, strict=True))]


def _holds_images(data: Any) -> bool:
    if data.ndim == 4:
        return True
    of_bytes = data.ndim == 1 and data.dtype.kind in "SVO"
    if not (of_bytes or (data.ndim == 2 and data.dtype == np.uint8)) or not data.shape[0]:
        return False
    first = entry(data, 0)
    return isinstance(first, bytes) and first.startswith(MAGIC)


def _seen(datasets: dict[str, Any]) -> str:
    longest_first = sorted(datasets, key=lambda path: (len(path), path), reverse=True)
    named = {path.rpartition("/")[2]: path for path in longest_first if datasets[path].ndim > 2}
    return ", ".join(f"{path} {list(datasets[path].shape)}" for path in sorted(named.values())[:6])


def _no_images(where: Path, names: Collection[str], seen: str) -> ValueError:
    lacks = f"{where} has no image dataset {' or '.join(map(repr, names))} (it has {seen or 'none'})"
    return ValueError(f"{lacks}: give their paths below the demonstration, --data.vision obs/camera")


def _images(file: Path, name: str, datasets: dict[str, Any], images: Collection[str], most: int) -> Refs:
    """Return a reference per row of each image dataset of demonstration ``name``, at most ``most``."""
    shown = {n: d for n, d in datasets.items() if n in images or (n in USUAL and _holds_images(d))}
    for data in shown.values():
        numbers = data.ndim == 4 and data.dtype.kind in "uif" and data.shape[3] in (1, 2, 3) and 0 not in data.shape[1:]
        if not numbers and not (data.ndim < 4 and _holds_images(data)):
            raise ValueError(f"{file}: {data.name} is {data.dtype} {list(data.shape)}, not [N, H, W, 1 to 3] or files")
        if numbers and (pixels := data.shape[1] * data.shape[2]) > MAX_PIXELS:
            raise ValueError(f"{file}: images of {data.name} have {pixels:,} pixels: at most {MAX_PIXELS:,} are read")
    (first, num), *others = ((data.name, data.shape[0]) for data in shown.values())
    for other, length in others:
        if length != num:
            raise ValueError(f"{file}: {other} has {length} rows, {first} has {num}: images of a row must be there")
    if num > most:
        raise ValueError(f"{file}: {first} has {num:,} rows: at most {MAX_ROWS:,} are read at once, use several packs")
    return {c: [ArrayRow(str(file), data.name, i) for i in range(num)] for c, data in shown.items()}


def _columns(
    demo: str, datasets: dict[str, Any], num: int, skip: Collection[str], vectors: Collection[str], left_out: LeftOut
) -> dict[str, list[str]]:
    """Return the texts of the datasets that are columns: one per row, or one for all; others go to ``left_out``."""
    import h5py

    cells: dict[str, list[str]] = {}
    for name, data in datasets.items():
        if name in skip:
            continue
        text = data.dtype.kind in "UT" or (hasattr(data, "asstr") and bool(h5py.check_string_dtype(data.dtype)))
        many = data.ndim > 2 or (data.ndim == 2 and data.shape[1] != 1 and name not in vectors)
        if many or (data.ndim and data.shape[0] != num) or (data.dtype.kind not in "biuf" and not text):
            needs = f"a column has a number or a text for each of the {num} images"
            left_out.setdefault(name, f"is {data.dtype} {list(data.shape)} in {demo}: {needs}")
        elif data.size > MAX_NUMBERS:
            left_out.setdefault(name, f"has {data.size:,} numbers: a column has at most {MAX_NUMBERS:,}")
        else:
            try:
                values = np.asarray((data.asstr("utf-8") if hasattr(data, "asstr") and text else data)[...])
            except UnicodeDecodeError:
                left_out.setdefault(name, f"is not UTF-8 text in {demo}: write it again")
                continue
            values = np.reshape(values, (-1,)) if data.size in (1, num) else values
            enumeration = (data.dtype.metadata or {}).get("enum") or {}  # of HDF5: name -> number
            texts = {number: text for text, number in enumeration.items()}
            cells[name] = [text_of(texts.get(v, v) if values.ndim == 1 else v) for v in values.tolist()]
    return cells


def _constants(opened: Any, name: str, vectors: Collection[str]) -> dict[str, list[str]]:
    """Return the attributes of group ``name`` and of those above it; the nearest counts. Long texts are left out."""
    cells: dict[str, list[str]] = {}
    # From group to group: the path of each from the root would take minutes where there are thousands.
    for group in accumulate(name.split("/") if name else [], getitem, initial=opened):
        for column, value in group.attrs.items():
            plain = np.asarray(value).tolist()
            plain = plain[0] if isinstance(plain, list) and len(plain) == 1 else plain
            plain = plain.decode(errors="replace") if isinstance(plain, bytes) else plain
            left_out = len(plain) > MAX_TEXT if isinstance(plain, str) else column not in vectors
            if isinstance(plain, (int, float)) or (isinstance(plain, (str, list)) and not left_out):
                cells[column] = [text_of(plain)]
    return cells
