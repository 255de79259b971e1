"""Finds and checks the images that a table's rows refer to, and the background of each touch image."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from mvitac.data.source import Stamp, stamp_of
from mvitac.datasets.table.image_refs import ImageRef
from mvitac.datasets.table.manifest import Manifest

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
    table.check(vision, *touch)
    if vision in touch:
        raise ValueError(f"column {vision!r} would be both vision and touch: vision='' if there is no camera")
    if not (vision or touch):
        hint = f"name the image columns, --data.vision COLUMN --data.touch COLUMN, of {', '.join(have)}"
        raise ValueError(f"{table.path} has no column vision, touch, or left and right: {hint}")
    return vision, touch


def backgrounds(
    table: Manifest, touch: Sequence[str], columns: Sequence[str], sensor: str | None, empty: Sequence[bool] | None
) -> list[Background]:
    """Return the background of each row.

    It is in ``columns``, one per column of ``touch`` (default: "background"). If ``empty`` says which rows show no
    contact, it is the first of these of the row's ``sensor``.
    """
    if empty is None:
        columns = columns or ("background",)
        if len(columns) != len(touch):
            raise ValueError(f"background {' '.join(columns)}: touch {' '.join(touch)} needs one column each")
        table.check(*columns)
        found = {column: table.refs(column) for column in columns}
        for i in range(len(table.rows)):
            if any(table.images[t][i] and not found[c][i] for t, c in zip(touch, columns, strict=True)):
                raise ValueError(f"{table.at(i)} has no {' or '.join(columns)}: difference images need one")
        return [tuple((ref,) if (ref := found[c][i]) else () for c in columns) for i in range(len(table.rows))]
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
    found = [stamp_of(str(file)) for file in Path(path).rglob("*") if file.is_file()]
    return sum(size for size, _ in found), max((time for _, time in found), default=0)


def check_present(
    table: Manifest, by_modality: Mapping[str, Sequence[str]], allow_missing: bool
) -> dict[str, list[bool]]:
    """Return, for each modality that some rows lack, which rows lack it; ValueError unless ``allow_missing``."""
    missing: dict[str, list[bool]] = {}
    for modality, columns in by_modality.items():
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
    present = [m for m, columns in by_modality.items() if columns]
    for i in range(len(table.rows)):
        if missing and all(m in missing and missing[m][i] for m in present):
            raise ValueError(f"{table.at(i)} has neither image: leave it out (--data.only)")
    return missing


def check_files(table: Manifest, columns: Sequence[str], grounds: Sequence[Background]) -> dict[str, Stamp]:
    """Check that every image file exists and is not empty, and that no row has one image in two ``columns``.

    Returns the stamp of each file by its path.
    """
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
