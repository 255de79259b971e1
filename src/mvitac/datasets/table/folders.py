"""Folders without a table: class folders, images or videos (the layouts are in ``mvitac.datasets.folder``).

Frames have the columns recording (their group), frame and, where it is known, time in seconds and minute.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvitac.data.images import IMAGES
from mvitac.data.pack_table import SPLITS
from mvitac.data.stamps import in_order, stamped
from mvitac.data.video import VIDEOS
from mvitac.datasets.table.clocks import nearest, times_of
from mvitac.datasets.table.image_refs import Frame, Refs
from mvitac.datasets.table.manifest import READERS, Manifest, Row
from mvitac.system.files import digest, walk

CAMERAS = ("touch", "left", "right", "vision")
EVERY = 5
"""Every how many frames of a video are used by default."""
VAL = 10
"""Without labels, every tenth recording is in val; of fewer recordings, the last tenth of the frames."""


def list_images(root: Path, plain: str, every: int | None) -> Manifest:
    """Return the table of the images below ``root``: of class folders, or of one recording.

    A file without a counterpart leaves a cell empty. ``plain``: modality of the images if no folders name it. ``every``: of
    a recording, every how many images are used.
    """
    splits = [split for split in SPLITS if (root / split).is_dir()]
    for other in sorted(root.iterdir()) if splits else ():
        if other.name not in SPLITS and other.is_dir() and _images_below(other):
            raise ValueError(f"{root} has images in {other.name} beside {', '.join(splits)}: rename or remove it")
    rows = [row for split in splits or [""] for row in _split_rows(root, split, plain, every or 1)]
    if not rows:
        raise ValueError(f"{root} holds no manifest, HDF5 file, videos or images ({', '.join(IMAGES)})")
    tables = sorted(file.name for file in root.iterdir() if file.suffix.lower() in READERS)
    beside = tuple(f"images are read without {name}: if it is their table, give it as --path" for name in tables)
    if all("label" in row for row in rows):
        if {row["label"].lower() for row in rows} <= {*SPLITS}:
            raise ValueError(f"{root}: its classes are named like splits, which are folders above vision and touch")
        if len({row["group"] for row in rows}) == len(rows):  # no groups, which results say
            rows = [{name: cell for name, cell in row.items() if name != "group"} for row in rows]
        return Manifest.of(root, rows, labels=("label",), notes=("each folder of images is a class", *beside))
    return Manifest.of(root, rows, group="recording", notes=beside)


def _split_rows(root: Path, split: str, plain: str, every: int) -> list[Row]:
    base = root / split
    named = [name for name in CAMERAS if (base / name).is_dir()]
    found = {name: _images_below(base / name) for name in named} or {plain: _images_below(base)}
    keys = sorted(key for key in set[str]().union(*found.values()) if "/." not in f"/{key}")  # no hidden thumbnails
    flat = [key for key in keys if "/" not in key]
    if flat and len(flat) < len(keys):
        raise ValueError(f"{base}: {flat[0]}.* is not in a class folder: put it in one, named by its class")
    if flat:
        keys = in_order(flat)
    times = stamped(keys) if flat else None
    rows = []
    for i, key in enumerate(keys):
        row = {n: images[key].relative_to(root).as_posix() if key in images else "" for n, images in found.items()}
        if not flat:
            label, *below = key.split("/")
            row |= {"label": label, "group": key.rpartition("/")[0] if len(below) > 1 else f"{split}/{key}"}
        elif i % every:
            continue
        else:
            row |= recording_row(base.resolve().name, i, None if times is None else float(times[i]))
        rows.append(row | {"split": split} if split else row)
    return rows


def _images_below(folder: Path) -> dict[str, Path]:
    """Return the images below ``folder`` by their path in it, without the suffix."""
    found: dict[str, Path] = {}
    for path in sorted(walk(folder)):
        if path.suffix.lower() in IMAGES and not path.is_dir():  # a link to nothing is a damaged image
            key = path.relative_to(folder).as_posix().removesuffix(path.suffix)
            if key in found:
                raise ValueError(f"{found[key]} and {path} differ in their suffix only: keep one of them")
            found[key] = path
    return found


def list_videos(path: Path, names: Sequence[str], plain: str, every: int | None, tolerance: float) -> Manifest | None:
    """Return the table of the videos at ``path`` or below it, None if there are none.

    It has every n-th frame of a recording's first camera, and the frames of its other cameras at that time.
    ``names`` are those of cameras besides ``CAMERAS``, the most important first; ``plain`` is the modality of a video
    without such a name, if none are given. Rows whose cameras are more than ``tolerance`` seconds apart are left out.
    """
    plain, names = "" if names else plain, tuple(dict.fromkeys((*names, *CAMERAS)))
    recordings: dict[str, dict[str, Path]] = {}
    for video in sorted(walk(path)) if path.is_dir() else [path]:
        if video.suffix.lower() in VIDEOS:
            parts = [*video.relative_to(path).parts[:-1], video.stem] if path.is_dir() else [video.stem]
            camera = next((name for name in names if name in parts), plain)
            if not camera or any(part.startswith(".") for part in parts):
                continue  # a camera that is not asked for, or what another system leaves beside a file
            recording = "/".join(part for part in parts if part != camera) or path.resolve().stem
            known = recordings.setdefault(recording, {}).setdefault(camera, video)
            if known != video:
                raise ValueError(f"{known} and {video} are both {camera} of {recording}: rename one")
    if not recordings:
        return None
    cameras = [name for name in names if any(name in files for files in recordings.values())]
    rows: list[Row] = []
    images: Refs = {camera: [] for camera in cameras}
    away, alone = 0.0, 0
    for recording, files in sorted(recordings.items()):
        times = {camera: times_of(file) for camera, file in files.items()}
        first = next(camera for camera in cameras if camera in files)
        own = times[first]
        shown = np.arange(0, len(own), every or EVERY)
        at = {camera: nearest(each, own[shown]) for camera, each in times.items()}
        at[first] = shown, np.zeros(len(shown))  # several may have one stamp
        apart = np.max([miss for _, miss in at.values()], axis=0)
        alone += int((apart > tolerance).sum())
        if len(apart) and apart.min() > tolerance:
            spans = "; ".join(f"{camera} {t[0]:.3f} to {t[-1]:.3f} s" for camera, t in times.items())
            raise ValueError(f"{path}: {recording} has no frame with all cameras within {tolerance:g} s: {spans}")
        for i in np.flatnonzero(apart <= tolerance):
            away = max(away, float(apart[i]))
            rows.append(recording_row(recording, int(shown[i]), float(own[shown[i]])))
            for camera in cameras:
                images[camera].append(Frame(str(files[camera]), int(at[camera][0][i])) if camera in files else None)
    note = f"{' and '.join(cameras)} are paired by time, at most {away:.3g} s apart"
    note += f"; {alone} frames without a partner within {tolerance:g} s are left out" * bool(alone)
    return Manifest.of(path, rows, images, group="recording", notes=(note,) if len(cameras) > 1 else ())


def recording_row(recording: str, frame: int, time: float | None) -> Row:
    row = {"id": f"{recording}/{frame:06d}", "recording": recording, "frame": str(frame)}
    return row if time is None else row | {"time": f"{time:.6f}", "minute": f"{recording}/{int(time // 60)}"}


def to_train(table: Manifest) -> Manifest:
    """Return ``table`` of recordings without labels, all of it to train on but a little val."""
    if "recording" not in table.columns or "split" in table.columns:
        return table
    rows: list[Row] = []
    names = list(dict.fromkeys(row["recording"] for row in table.rows))
    whole = len(names) >= VAL
    for number, name in enumerate(names):
        own = [row for row in table.rows if row["recording"] == name]
        last = len(own) - max(1, len(own) // VAL)
        for i, row in enumerate(own):
            val = number % VAL == VAL - 1 if whole else i >= last
            group = f"{name}, its end" if val and not whole else name
            rows.append({**row, "recording": group, "split": "val" if val else "train"})
    notes = (*table.notes, *(("val is the end of each recording, so it is much like train",) * (not whole)))
    return replace(table, rows=rows, digest=digest([table.digest, rows]), notes=notes)
