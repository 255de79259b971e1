"""The images that a table's rows name: found, there or allowed to be missing, and what each touch is compared with.

Rows are given by their numbers, counted from 1; ``places`` holds one list per image column.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mvitac.data.source import Stamp, stamp_of
from mvitac.datasets.table.image_refs import ImageRef
from mvitac.datasets.table.manifest import Condition, Manifest

NUM_NO_CONTACT = 16
"""No-contact frames whose mean is a sensor's background."""
Places = dict[str, list[ImageRef | None]]


def image_columns(manifest: Manifest, vision: str | None, touch: tuple[str, ...]) -> tuple[str | None, tuple[str, ...]]:
    """The columns of vision and touch images, as asked for ("" = none) or found by their usual names."""
    have = (*manifest.columns, *manifest.found)
    vision = ("vision" if "vision" in have else None) if vision is None else vision or None
    if touch:
        touch = tuple(c for c in touch if c)
    else:
        touch = ("touch",) if "touch" in have else ("left", "right") if {"left", "right"} <= set(have) else ()
    for column in (vision, *touch):
        if column:
            manifest.check(column)
    if not (vision or touch):
        raise ValueError(
            f"{manifest.file} has no column vision, touch, or left and right (it has {', '.join(have)}):"
            " name the image columns by vision and touch"
        )
    return vision, touch


def read_backgrounds(
    manifest: Manifest,
    places: Places,
    touch: Sequence[str],
    kept: Sequence[int],
    sensor: str | None,
    columns: tuple[str, ...],
    no_contact: Sequence[Condition],
) -> list[dict[int, tuple[ImageRef, ...]]]:
    """Per touch column: row number -> the no-contact images that it is compared with.

    They stand in ``columns`` beside the touch, or are the first of the rows of its ``sensor`` that meet ``no_contact``.
    """
    if not no_contact:
        if not columns and "background" not in (*manifest.columns, *manifest.found):
            raise ValueError(
                f"{manifest.file} has no column 'background': difference images need background columns, or no_contact rows"
            )
        columns = columns or ("background",)
        if len(columns) != len(touch):
            raise ValueError(
                f"background {' '.join(columns)}: difference images of touch {' '.join(touch)} need as many background"
                " columns, or no_contact rows"
            )
        for column in columns:
            manifest.check(column)
        result = []
        for column in columns:
            found = manifest.places(column)
            empty = next((i + 1 for i in kept if found[i] is None and any(places[t][i] for t in touch)), None)
            if empty:
                raise ValueError(f"{manifest.file} row {empty} has no {column} path: difference images need one")
            result.append({i + 1: (place,) for i in kept if (place := found[i])})
        return result
    by_sensor: dict[str, list[int]] = {}
    for i in kept:
        if all(condition.holds(manifest.rows[i]) for condition in no_contact):
            by_sensor.setdefault(manifest.rows[i][sensor] if sensor else "", []).append(i)
    result = []
    for column in touch:
        means = {
            s: tuple(p for i in rows if (p := places[column][i]))[:NUM_NO_CONTACT] for s, rows in by_sensor.items()
        }
        for i in kept:
            name = manifest.rows[i][sensor] if sensor else ""
            if not means.get(name):
                raise ValueError(
                    f"{manifest.file} row {i + 1}: no row meets {' and '.join(map(str, no_contact))} for its sensor {name!r}"
                )
        result.append({i + 1: means[manifest.rows[i][sensor] if sensor else ""] for i in kept})
    return result


def check_present(
    manifest: Manifest,
    places: Places,
    vision: str | None,
    touch: Sequence[str],
    numbers: Sequence[int],
    allow_missing: bool,
) -> dict[str, list[bool]]:
    """Which rows lack which modality, for those modalities that some rows lack; ValueError unless that is allowed."""
    missing: dict[str, list[bool]] = {}
    for modality, columns in (("vision", [vision] if vision else []), ("touch", touch)):
        gaps = [[places[c][i] is None for c in columns] for i in range(len(numbers))]
        for number, gap in zip(numbers, gaps, strict=True):
            if any(gap) and not (allow_missing and all(gap)):
                column = columns[gap.index(True)]
                hint = (
                    "allow_missing accepts rows without a modality" if all(gap) else "stacked sensors need both images"
                )
                raise ValueError(
                    f"{manifest.file} row {number} has no {column} path: fill it, or leave the row out (only); {hint}"
                )
        lacking = [bool(gap) and all(gap) for gap in gaps]
        if all(lacking) and columns:
            raise ValueError(f"{manifest.file}: {modality} is empty in every row: leave it out by {modality}=''")
        if any(lacking):
            missing[modality] = lacking
    present = [m for m, columns in (("vision", vision), ("touch", touch)) if columns]
    for i, number in enumerate(numbers):
        if missing and all(missing.get(m, [False] * len(numbers))[i] for m in present):
            raise ValueError(f"{manifest.file} row {number} has neither image: leave it out (only)")
    return missing


def check_files(
    manifest: Manifest,
    places: Places,
    backgrounds: Sequence[dict[int, tuple[ImageRef, ...]]],
    numbers: Sequence[int],
) -> tuple[list[int], dict[str, Stamp]]:
    """Sizes of the files that the rows name, for the fingerprint, and the stamp of each by its path; ValueError for any
    that is missing or empty."""
    stamps: dict[str, Stamp] = {}
    missing: list[str] = []
    every: list[int] = []
    for i, number in enumerate(numbers):
        named = [(column, found[i]) for column, found in places.items()]
        named += [("background", place) for b in backgrounds for place in b.get(number, ())]
        for column, place in named:
            if place is None:
                continue
            if place.path not in stamps:
                stamps[place.path] = stamp_of(place.path)
            size = stamps[place.path][0]
            every.append(size)
            if size <= 0:
                name = manifest.rows[number - 1].get(column) or Path(place.path).name
                missing.append(f"row {number} {column} {name}{' (0 bytes)' if size == 0 else ''}")
    if missing:
        raise ValueError(
            f"{manifest.file}: {len(missing)} of {len(every)} image files are missing or empty, e.g."
            f" {'; '.join(missing[:3])} (paths are relative to {manifest.root})"
        )
    return every, stamps
