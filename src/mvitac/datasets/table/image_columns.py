"""Finds and checks the images that a table's rows refer to, and the background of each touch image.

Row numbers count from 1, row indices from 0.
"""

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mvitac.data.pack_table import SPLITS
from mvitac.data.source import Stamp, stamp_of
from mvitac.datasets.table.image_refs import ImageRef
from mvitac.datasets.table.manifest import Condition, Manifest

NUM_NO_CONTACT = 16  # number of no-contact frames that are averaged to a sensor's background
Refs = dict[str, list[ImageRef | None]]  # image column -> one reference per row; None where the row has no image
Background = dict[int, tuple[ImageRef, ...]]
"""Row number -> the no-contact images whose mean is subtracted from the row's touch image."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The rows of a manifest that become samples; all lists have one entry per row."""

    manifest: Manifest
    numbers: list[int]  # row numbers in the manifest, counted from 1
    rows: list[dict[str, str]]
    refs: Refs
    backgrounds: list[Background]  # one per touch column; empty for raw images

    @property
    def where(self) -> str:
        """Name of the table, for error messages."""
        return str(self.manifest.file)

    def filled(self, column: str, what: str) -> list[str]:
        """Return the cells of ``column``; ValueError if one of them is empty."""
        empty = [number for number, row in zip(self.numbers, self.rows, strict=True) if not row[column]]
        if empty:
            hint = f"; write one of {', '.join(SPLITS)}" if what == "split" else ""
            raise ValueError(
                f"{self.where}: column {column!r} ({what}) is empty in {len(empty)} rows, first row {empty[0]}{hint}"
            )
        return [row[column] for row in self.rows]

    def ids(self) -> list[str]:
        """Return the column "id" if there is one, else the row numbers."""
        if "id" not in self.manifest.columns:
            return [f"{number:06d}" for number in self.numbers]
        ids = self.filled("id", "id")
        twice = [name for name, count in Counter(ids).items() if count > 1]
        if twice:
            raise ValueError(f"{self.where}: id {twice[0]!r} occurs in several rows: ids must differ")
        return ids


def find(manifest: Manifest, vision: str | None, touch: tuple[str, ...]) -> tuple[str | None, tuple[str, ...]]:
    """Return the columns of vision and touch images: those asked for ("" = none), else those with the usual names."""
    have = (*manifest.columns, *manifest.found)
    vision = ("vision" if "vision" in have else None) if vision is None else vision or None
    if touch:
        touch = tuple(c for c in touch if c)
    else:
        touch = ("touch",) if "touch" in have else ("left", "right") if {"left", "right"} <= set(have) else ()
    for column in (vision, *touch):
        if column:
            manifest.check(column)
    if vision in touch:
        raise ValueError(
            f"column {vision!r} would be both vision and touch: give every image its own column, or vision='' if there is"
            " no camera"
        )
    if not (vision or touch):
        raise ValueError(
            f"{manifest.file} has no column vision, touch, or left and right (it has {', '.join(have)}):"
            " name the image columns, --data.vision COLUMN --data.touch COLUMN"
        )
    return vision, touch


def backgrounds_from_columns(
    manifest: Manifest, refs: Refs, touch: Sequence[str], kept: Sequence[int], columns: tuple[str, ...]
) -> list[Background]:
    """Read the background of each touch column from a column of its own (default: "background")."""
    if not columns and "background" not in (*manifest.columns, *manifest.found):
        raise ValueError(
            f"{manifest.file} has no column 'background': difference images need background columns, or --data.no-contact"
        )
    columns = columns or ("background",)
    if len(columns) != len(touch):
        raise ValueError(
            f"background {' '.join(columns)}: difference images of touch {' '.join(touch)} need as many background"
            " columns, or --data.no-contact for rows without contact"
        )
    for column in columns:
        manifest.check(column)
    result = []
    for column in columns:
        found = manifest.refs(column)
        empty = next((i + 1 for i in kept if found[i] is None and any(refs[t][i] for t in touch)), None)
        if empty:
            raise ValueError(f"{manifest.file} row {empty} has no {column} path: difference images need one")
        result.append({i + 1: (ref,) for i in kept if (ref := found[i])})
    return result


def backgrounds_from_rows(
    manifest: Manifest,
    refs: Refs,
    touch: Sequence[str],
    kept: Sequence[int],
    sensor: str | None,
    no_contact: Sequence[Condition],
) -> list[Background]:
    """Use the first rows of each sensor that meet ``no_contact`` as the background of that sensor's rows."""
    names = {i: manifest.rows[i][sensor] if sensor else "" for i in kept}
    empty_rows: dict[str, list[int]] = {}
    for i in kept:
        if all(condition.holds(manifest.rows[i]) for condition in no_contact):
            empty_rows.setdefault(names[i], []).append(i)
    result = []
    for column in touch:
        images = {
            s: tuple(r for i in rows if (r := refs[column][i]))[:NUM_NO_CONTACT] for s, rows in empty_rows.items()
        }
        for i in kept:
            if not images.get(names[i]):
                raise ValueError(
                    f"{manifest.file} row {i + 1}: no row meets {' and '.join(map(str, no_contact))} for its sensor"
                    f" {names[i]!r}"
                )
        result.append({i + 1: images[names[i]] for i in kept})
    return result


def check_present(
    selected: Selection, by_modality: dict[str, Sequence[str]], allow_missing: bool
) -> dict[str, list[bool]]:
    """Return, for each modality that some rows lack, which rows lack it; ValueError unless ``allow_missing``."""
    missing: dict[str, list[bool]] = {}
    for modality, columns in by_modality.items():
        gaps = [[selected.refs[c][i] is None for c in columns] for i in range(len(selected.rows))]
        for number, gap in zip(selected.numbers, gaps, strict=True):
            if any(gap) and not (allow_missing and all(gap)):
                accept = "--data.allow-missing accepts rows without a modality"
                hint = accept if all(gap) else "stacked sensors need both images"
                raise ValueError(
                    f"{selected.manifest.at(number)} has no {columns[gap.index(True)]} path: fill it, or leave the row out"
                    f" (--data.only); {hint}"
                )
        lacking = [bool(gap) and all(gap) for gap in gaps]
        if all(lacking) and columns:
            raise ValueError(
                f"{selected.where}: {modality} is empty in every row: leave it out by --data.{modality} ''"
            )
        if any(lacking):
            missing[modality] = lacking
    present = [m for m, columns in by_modality.items() if columns]
    for i, number in enumerate(selected.numbers):
        if missing and all(m in missing and missing[m][i] for m in present):
            raise ValueError(f"{selected.manifest.at(number)} has neither image: leave it out (--data.only)")
    return missing


def check_files(selected: Selection) -> tuple[list[int], dict[str, Stamp]]:
    """Check that every image file exists and is not empty, and that no row has one image in two columns.

    Returns the file size of each image of each row (for the fingerprint), and the stamp of each file by its path.
    """
    stamps: dict[str, Stamp] = {}
    missing: list[str] = []
    sizes: list[int] = []
    for i, number in enumerate(selected.numbers):
        named = [(column, found[i]) for column, found in selected.refs.items()]
        images = [replace(ref, path=os.path.normpath(ref.path)) for _, ref in named if ref]
        if len({*images}) < len(images):
            raise ValueError(
                f"{selected.manifest.at(number)} has one image in two of the columns {', '.join(selected.refs)}: each"
                " needs an image of its own"
            )
        named += [("background", ref) for b in selected.backgrounds for ref in b.get(number, ())]
        for column, ref in named:
            if ref is None:
                continue
            if ref.path not in stamps:
                stamps[ref.path] = stamp_of(ref.path)
            size = stamps[ref.path][0]
            sizes.append(size)
            if size <= 0:
                name = selected.rows[i].get(column) or Path(ref.path).name
                missing.append(f"row {number} {column} {name}{' (0 bytes)' if size == 0 else ''}")
    if missing:
        tried = "; backslashes were also tried as slashes" if "\\" in missing[0] else ""
        tried = "; C:\\... is on another computer" if re.search(r" [A-Za-z]:\\", missing[0]) else tried
        raise ValueError(
            f"{selected.where}: {len(missing)} of {len(sizes)} image files are missing or empty, e.g."
            f" {'; '.join(missing[:3])} (paths are relative to {selected.manifest.root}{tried})"
        )
    return sizes, stamps
