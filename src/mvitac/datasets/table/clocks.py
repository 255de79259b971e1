"""Joins what has another clock to the rows of a table by time stamps: logs of numbers, and lists of another camera's images.

``FILE:COLUMN`` names a log (.csv, .parquet, .jsonl) and its column of stamps; ``FILE:COLUMN-0.35`` sets its clock back by
.35 s. FILE is beside the table, or else beside the row's video; {} in it stands for the path of that, without the suffix.
"""

import math
import os
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from mvitac.data.spec import STAMPS
from mvitac.data.video import frame_times
from mvitac.datasets.table.image_refs import Frame, ImageRef
from mvitac.datasets.table.manifest import Manifest, number_of, read_manifest, text_of
from mvitac.system.files import digest

UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # stamps since 1970 above so much are in ns, us, ms


def nearest(times: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index in ascending ``times`` [N] nearest to each of ``wanted`` [M], and the distance in seconds."""
    if not len(times):
        return np.zeros(len(wanted), int), np.full(len(wanted), np.inf)
    after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
    before = np.maximum(after - 1, 0)
    at = np.where(np.abs(times[after] - wanted) < np.abs(times[before] - wanted), after, before)
    return at, np.abs(times[at] - wanted)


def seconds(cells: Sequence[str]) -> np.ndarray:
    """Return stamps [N] in seconds, NaN where there is none: s, or ms, us or ns since 1970, or dates as in ISO 8601."""

    def one(cell: str) -> float:
        number = number_of(cell) if cell else math.nan
        return datetime.fromisoformat(cell).timestamp() if number is None else number

    stamps = np.array([one(cell) for cell in cells], float)
    size = np.nanmax(np.abs(stamps), initial=0)
    return stamps * next((scale for above, scale in UNITS if size > above), 1.0)


def row_times(table: Manifest, column: str, refs: Sequence[ImageRef | None]) -> np.ndarray:
    """Return when the rows were seen [N], in seconds: by ``column``, else one of ``STAMPS``, else as their videos say."""
    if name := next((name for name in (column, *STAMPS) if name in table.columns), None):
        return seconds(table.filled(name, "time"))
    known: dict[str, np.ndarray] = {}
    times = np.full(len(refs), np.nan)
    for i, ref in enumerate(refs):
        if not isinstance(ref, Frame):
            raise ValueError(f"{table.at(i)} has no time: give the table a column {column!r} or {' or '.join(STAMPS)}")
        if ref.path not in known:
            known[ref.path] = frame_times(ref.path)
        if ref.index < len(known[ref.path]):
            times[i] = known[ref.path][ref.index]
    return times


def join(
    table: Manifest,
    logs: Sequence[str],
    images: Sequence[str],
    *,
    numbers: Collection[str],
    tolerance: float,
    linear: bool,
) -> Manifest:
    """Return the rows of ``table`` with the columns of ``logs`` at their time, and a note about each log.

    Rows without a measurement within ``tolerance`` seconds are left out; nothing is extrapolated.

    Args:
        table: Rows with a time: a column, or frames of videos.
        logs: ``FILE:COLUMN``, as above.
        images: Names that columns of images may have, the most important first.
        numbers: Columns that are interpolated if ``linear``; then both neighbours must be near enough. Others are nearest.
        tolerance: Largest distance in seconds.
        linear: Whether numbers are interpolated.
    """
    shown = next((column for column in images if column in table.columns), None)
    refs: list[ImageRef | None] = table.refs(shown) if shown else [None] * len(table.rows)
    for text in logs:
        name, _, rest = text.rpartition(":")
        if not name or not rest:
            raise ValueError(f"log {text!r}: write FILE:COLUMN, where COLUMN has the time stamps")
        column, shift = rest, 0.0
        if (found := re.fullmatch(r"(.+?)([+-]\d*\.?\d+)", rest)) and found[2]:
            column, shift = found[1], float(found[2])
        times = row_times(table, column, refs)
        made: list[dict[str, str]] = [{} for _ in table.rows]
        gap = 0.0
        for file, at in _files(table, name, refs).items():
            log = read_manifest(file)
            log.check(column)
            stamps = seconds([row[column] for row in log.rows]) + shift
            order = np.argsort(stamps, kind="stable")[: np.isfinite(stamps).sum()]  # NaN is last
            cells, largest = joined(log, order, stamps[order], times[at], (numbers if linear else ()), tolerance)
            gap = max(gap, largest)
            for i, row in zip(at, cells, strict=True):
                made[i] = {c: cell for c, cell in row.items() if c != column}
                for c in made[i].keys() & set(images):
                    made[i][c] = os.path.relpath(file.parent / made[i][c], table.root)
            if not any(cells):
                spans = [f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (np.sort(times[at]), stamps[order])]
                raise ValueError(
                    f"{file} has no time of the images, {spans[0]}, but {spans[1]}: {text}+SECONDS shifts it"
                )
        names = dict.fromkeys(c for row in made for c in row)
        if twice := names.keys() & set(table.columns):
            raise ValueError(f"{table.path} and {name} both have a column {min(twice)!r}: rename one")
        there = [bool(row) for row in made]
        lost = f"; {there.count(False)} of {len(there)} rows are not within {tolerance:g} s of it and left out"
        note = f"{name} joined by {rest}, its largest gap is {gap:.3g} s{lost * (not all(there))}"
        rows = [{**row, **{c: more.get(c, "") for c in names}} for row, more in zip(table.rows, made, strict=True)]
        table = replace(table, rows=rows, digest=digest([table.digest, made]), notes=(*table.notes, note))
        table = table.kept(there, "")
        refs = [ref for ref, kept in zip(refs, there, strict=True) if kept]
    return table


def _files(table: Manifest, name: str, refs: Sequence[ImageRef | None]) -> dict[Path, list[int]]:
    """Return the log of each row -> the rows."""
    files: dict[Path, list[int]] = {}
    for i, ref in enumerate(refs):
        beside = Path(ref.path) if ref else table.root / "."
        own = name.replace("{}", os.path.relpath(beside.with_suffix(""), table.root)) if "{}" in name else name
        file = table.root / own
        files.setdefault(file if file.is_file() else beside.parent / own, []).append(i)
    return files


def joined(
    log: Manifest, order: np.ndarray, stamps: np.ndarray, times: np.ndarray, smooth: Collection[str], tolerance: float
) -> tuple[list[dict[str, str]], float]:
    """Return the cells of ``log`` at ``times`` [M], {} where it has none, and its largest gap in seconds.

    ``order`` [N] are its rows by time, ``stamps`` [N] their times.
    """
    inside = (stamps >= times.min() - tolerance) & (stamps <= times.max() + tolerance)
    gap = float(np.diff(stamps[inside]).max(initial=0))
    at, away = nearest(stamps, times)
    good = away <= tolerance + 1e-9
    columns = {name: [log.rows[row][name] for row in order[at]] if len(order) else [] for name in log.rows[0]}
    for name in columns.keys() & set(smooth):
        after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
        ends = np.abs(stamps[[after - 1, after]] - times).max(0)
        known = np.array([math.nan if (value := number_of(log.rows[row][name])) is None else value for row in order])
        good &= ((ends <= tolerance + 1e-9) & (times >= stamps[0]) & (times <= stamps[-1])) | (away == 0)
        columns[name] = [text_of(float(f"{value:.9g}")) for value in np.interp(times, stamps, known)]
    return [{name: cells[i] for name, cells in columns.items()} if good[i] else {} for i in range(len(times))], gap
