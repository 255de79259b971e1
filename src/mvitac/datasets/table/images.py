"""The images that a table's rows refer to, and the background of each touch image: found, checked, and read."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.images import difference, fit, shrink
from mvitac.data.source import Lost, Sample, Stamp, stamp_of
from mvitac.datasets.table.image_refs import Damage, ImageRef, mean_image, read_all
from mvitac.datasets.table.manifest import Manifest
from mvitac.system.files import walk

NUM_NO_CONTACT = 16  # number of no-contact frames that are averaged to a sensor's background
Background = tuple[tuple[ImageRef, ...], ...]
"""Per touch column, the no-contact images whose mean is subtracted from a row's touch image."""


def find(table: Manifest, vision: str | None, touch: tuple[str, ...]) -> tuple[str | None, tuple[str, ...]]:
    """Return the columns of vision and touch images: those asked for ("" = none), else those with the usual names."""
    have = table.columns
    vision = ("vision" if "vision" in have else None) if vision is None else vision or None
    if touch:
        touch = tuple(c for c in touch if c)
    else:
        touch = ("touch",) if "touch" in have else ("left", "right") if {"left", "right"} <= set(have) else ()
    table.check(vision, *touch, images=True)
    if vision in touch:
        raise ValueError(f"column {vision!r} would be both vision and touch: vision='' if there is no camera")
    if not (vision or touch):
        hint = f"name the image columns, --data.vision COLUMN --data.touch COLUMN, of {', '.join(have)}"
        raise ValueError(f"{table.path} has no column vision, touch, or left and right: {hint}")
    return vision, touch


def backgrounds(
    table: Manifest, touch: Sequence[str], columns: Sequence[str], sensor: str | None, empty: Sequence[bool] | None
) -> list[Background]:
    """Return the background of each row: in ``columns``, one per column of ``touch``.

    If ``empty`` says which rows show no contact, it is the first of these of the row's ``sensor``.
    """
    if empty is None:
        if len(columns) != len(touch):
            raise ValueError(f"background {' '.join(columns)}: touch {' '.join(touch)} needs one column each")
        found = [[table.images[c][i] for c in columns] for i in range(len(table.rows))]
        for i, refs in enumerate(found):
            if any(table.images[column][i] and not ref for column, ref in zip(touch, refs, strict=True)):
                raise ValueError(f"{table.at(i)} has no {' or '.join(columns)}: difference images need one")
        return [tuple((ref,) if ref else () for ref in refs) for refs in found]
    names = [row[sensor] if sensor else "" for row in table.rows]
    known: dict[str, Background] = {}
    for name in dict.fromkeys(names):
        rows = [i for i in range(len(names)) if empty[i] and names[i] == name]
        known[name] = tuple(tuple(r for i in rows if (r := table.images[c][i]))[:NUM_NO_CONTACT] for c in touch)
        if not all(known[name]):
            raise ValueError(f"{table.path}: no row of sensor {name!r} is without contact, as --data.no-contact says")
    return [known[name] for name in names]


def folder_stamp(path: str) -> Stamp:
    """Return the stamp of a folder: the size of its files, and when the last was written."""
    found = [stamp_of(str(file)) for file in walk(Path(path)) if file.is_file()]
    return sum(size for size, _ in found), max((time for _, time in found), default=0)


def check_present(table: Manifest, asked: Mapping[str, Sequence[str]], allow_missing: bool) -> dict[str, list[bool]]:
    """Return, for each modality that some rows lack, which rows lack it; ValueError unless ``allow_missing``."""
    missing: dict[str, list[bool]] = {}
    for modality, columns in asked.items():
        gaps = [[table.images[c][i] is None for c in columns] for i in range(len(table.rows))]
        for i, gap in enumerate(gaps):
            if any(gap) and not (allow_missing and all(gap)):
                hint = "--data.allow-missing accepts it" if all(gap) else "stacked sensors need both images"
                raise ValueError(f"{table.at(i)} has no {columns[gap.index(True)]} path: {hint}")
        lacking = [bool(gap) and all(gap) for gap in gaps]
        if all(lacking) and columns:
            raise ValueError(f"{table.path}: {modality} is empty in every row: leave it out by --data.{modality} ''")
        if any(lacking):
            missing[modality] = lacking
    present = [m for m, columns in asked.items() if columns]
    for i in range(len(table.rows)):
        if missing and all(m in missing and missing[m][i] for m in present):
            raise ValueError(f"{table.at(i)} has neither image: leave it out (--data.only)")
    return missing


def check_files(table: Manifest, columns: Sequence[str], grounds: Sequence[Background]) -> dict[str, Stamp]:
    """Return the stamp of each image file; ValueError if one is missing or empty, or twice in a row's ``columns``."""
    mean_image.cache_clear()  # a background may have changed since
    stamps: dict[str, Stamp] = {}
    missing: list[str] = []
    num = 0
    for i, number in enumerate(table.numbers):
        named = [(column, ref) for column in columns if (ref := table.images[column][i])]
        if len({replace(ref, path=os.path.normpath(ref.path)) for _, ref in named}) < len(named):
            raise ValueError(f"{table.at(i)} has one image in two of the columns {', '.join(columns)}")
        named += [("background", ref) for refs in (grounds[i] if grounds else ()) for ref in refs]
        for column, ref in named:
            if ref.path not in stamps:
                folder = type(ref) is not ImageRef and os.path.isdir(ref.path)  # zarr, a bag
                stamps[ref.path] = folder_stamp(ref.path) if folder else stamp_of(ref.path)
            num += 1
            if stamps[ref.path][0] <= 0:
                missing.append(f"row {number} {column} {table.rows[i].get(column) or os.path.basename(ref.path)}")
    if missing:
        few = f"{len(missing)} of {num} image files are missing or empty, e.g. {'; '.join(missing[:3])}"
        raise ValueError(f"{table.path}: {few} (paths are relative to {table.root})")
    return stamps


@dataclass(frozen=True, slots=True)
class Row:
    """One sample before its images are read: where they are, and the row's columns in the pack."""

    number: int
    vision: ImageRef | None
    touch: tuple[ImageRef, ...]
    background: tuple[tuple[ImageRef, ...], ...]
    """Per touch image, the no-contact images whose mean is subtracted; empty for raw images."""
    columns: dict[str, Any]

    def refs(self) -> Iterator[ImageRef]:
        yield from (ref for ref in (self.vision, *self.touch) if ref)
        yield from (ref for many in self.background for ref in many)


def bundles(rows: Sequence[Row], most: int) -> list[list[int]]:
    """Group row indices into items: at most ``most`` rows whose images are in the same containers; other rows alone."""
    items: list[list[int]] = []
    open_items: dict[Any, list[int]] = {}
    for i, row in enumerate(rows):
        key = tuple(ref.container() if ref else None for ref in (row.vision, *row.touch))
        if not any(key):
            items.append([i])
            continue
        item = open_items.get(key)
        if item is None or len(item) == most:
            item = open_items[key] = []
            items.append(item)
        item.append(i)
    return items


def read_rows(rows: Sequence[Row], size: int) -> list[Sample | Lost]:
    """Return the samples of rows that ``bundles`` put together, with images of side ``size``.

    A row with a damaged image is ``Lost``, or raises ValueError or OSError if it is the only one.
    """
    lost: Damage = {}
    vision = _load([row.vision for row in rows if row.vision], size, lost)
    num_touch = max(len(row.touch) for row in rows)
    touch = [_load([row.touch[k] for row in rows if row.touch], size, lost) for k in range(num_touch)]
    samples: list[Sample | Lost] = []
    for row in rows:
        try:
            for ref in (row.vision, *row.touch):
                if ref in lost:
                    raise ValueError(lost[ref])
            pressed = [images[ref] for images, ref in zip(touch, row.touch, strict=False)]
            for k, background in enumerate(row.background):
                pressed[k] = difference(pressed[k], fit(mean_image(background), size))
            both = np.concatenate(pressed, axis=2) if pressed else None
            samples.append(Sample(vision=vision[row.vision] if row.vision else None, touch=both, columns=row.columns))
        except (ValueError, OSError) as error:
            if len(rows) == 1:
                raise
            samples.append(Lost(f"row {row.number}", str(error)))  # the other rows of the video are still good
    return samples


def _load(refs: Sequence[ImageRef], size: int, lost: Damage) -> dict[ImageRef, np.ndarray]:
    """Read images at the stored size (a whole video would not fit otherwise); damaged ones are put in ``lost``."""
    return {ref: shrink(image, size) for ref, image in read_all(refs, lost)}
