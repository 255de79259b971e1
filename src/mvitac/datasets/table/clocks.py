"""Joins what has another clock to the rows of a table by time stamps: logs of numbers, and lists of another camera's images.

``FILE:COLUMN`` names a log (.csv, .parquet, .jsonl) and its column of stamps; ``FILE:COLUMN-0.35`` sets its clock back by
.35 s. FILE is beside the table, or else beside the row's video; {} in it stands for the path of that, without the suffix.
"""

import math
import os
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvitac.data.stamps import STAMPS, number_of, seconds
from mvitac.data.video import frame_times
from mvitac.datasets.table.columns import with_elements
from mvitac.datasets.table.image_refs import Frame, ImageRef
from mvitac.datasets.table.manifest import READERS, Manifest, Row, read_manifest, text_of
from mvitac.system.files import check_ordinary, digest

SLACK = 1e-6  # s: doubles of stamps since 1970 are 2.4e-7 s apart


def nearest(times: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index in ascending ``times`` [N] nearest to each of ``wanted`` [M], and the distance in seconds."""
    if not len(times):
        return np.zeros(len(wanted), int), np.full(len(wanted), np.inf)
    after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
    before = np.maximum(after - 1, 0)
    at = np.where(np.abs(times[after] - wanted) < np.abs(times[before] - wanted), after, before)
    return at, np.abs(times[at] - wanted)


def times_of(video: Path) -> np.ndarray:
    """Return the times [N] of the frames in seconds: of the file VIDEO_timestamps.csv or .txt, else of the container."""
    times = frame_times(video)
    beside = [video.with_name(f"{video.stem}_timestamps{suffix}") for suffix in (".txt", *READERS)]
    found = [file for file in beside if os.path.lexists(file)]  # also a link to nothing
    if not found:
        return times
    if len(found) > 1:
        raise ValueError(f"{found[0]} and {found[1].name} both have the times of {video.name}: remove one")
    check_ordinary(file := found[0])  # a pipe never ends
    if file.suffix == ".txt":
        stamps = seconds([line.strip() for line in file.read_text(errors="replace").splitlines() if line.strip()], file)
    else:
        table = read_manifest(file)
        table.check(column := next((name for name in STAMPS if name in table.columns), STAMPS[0]))
        stamps = seconds(table.filled(column, "time"), file)
    if len(stamps) != len(times):
        raise ValueError(f"{file} has {len(stamps)} times, {video.name} has {len(times)} frames")
    if (np.diff(stamps) < 0).any():
        raise ValueError(f"{file}: time {np.argmax(np.diff(stamps) < 0) + 2} is before the one above it")
    check_moves(stamps, file)
    return stamps


def check_moves(stamps: np.ndarray, where: object) -> None:
    """Raise ValueError if a clock stands still: everything would be joined to one image or measurement."""
    if len(stamps) > 1 and np.ptp(stamps) == 0:
        same = f"all {len(stamps)} times are {stamps[0]:.10g} s"
        raise ValueError(f"{where}: {same}: a clock that stands still pairs nothing")


def row_times(table: Manifest, column: str, refs: Sequence[ImageRef | None]) -> tuple[np.ndarray, list[str]]:
    """Return when the rows were seen [N], in seconds, and the recording of each.

    The time is in ``column``, else in one of ``STAMPS``; else videos say it, and then each is a recording.
    """
    recordings = [row.get(table.group or "", "") for row in table.rows]
    if name := next((name for name in (column, *STAMPS) if name in table.columns), None):
        times = seconds(table.filled(name, "time"), where := f"{table.path}, column {name}")
        check_moves(times, where)
        return times, recordings
    known: dict[str, np.ndarray] = {}
    times = np.full(len(refs), np.nan)
    for i, ref in enumerate(refs):
        if not isinstance(ref, Frame):
            raise ValueError(f"{table.at(i)} has no time: give the table a column {column!r} or {' or '.join(STAMPS)}")
        if ref.path not in known:
            known[ref.path] = times_of(Path(ref.path))
        if ref.index < len(known[ref.path]):
            times[i] = known[ref.path][ref.index]
        recordings[i] = ref.path
    return times, recordings


def join(
    table: Manifest,
    logs: Sequence[str],
    images: Sequence[str],
    *,
    numbers: Collection[str],
    smooth: Collection[str],
    tolerance: float,
) -> Manifest:
    """Return the rows of ``table`` with the columns of ``logs`` at their time, and a note about each log.

    Rows without a measurement within ``tolerance`` seconds are left out; nothing is extrapolated. ``images``: names that
    columns of images may have, the most important first. ``numbers`` may be elements of lists. Those of ``smooth`` are
    interpolated; then both neighbours must be near enough. Others are nearest.
    """
    shown = next((column for column in images if column in table.columns), None)
    refs: list[ImageRef | None] = table.refs(shown) if shown else [None] * len(table.rows)
    for text in logs:
        name, column, shift = _parsed(text)
        times, recordings = row_times(table, column, refs)
        made: list[Row] = [{} for _ in table.rows]
        gap, same, apart = 0.0, 0, 0
        for file, at in _files(table, name, refs).items():
            log = with_elements(read_manifest(file), numbers)
            if (whole := text.removeprefix(f"{name}:")) != column and whole in log.columns:
                raise ValueError(f"{file} has a column {whole!r}, which reads as {column!r} and a shift: rename it")
            log.check(column)
            _check_apart(file, times[at], [recordings[i] for i in at])
            stamps = seconds(log.filled(column, "time"), f"{file}, column {column}") + shift
            check_moves(stamps, f"{file}, column {column}")
            if len(back := np.flatnonzero(np.diff(stamps) < -0.1)) not in (0, len(stamps) - 1):  # s
                where = f"{file}: the clock goes back after row {back[0] + 1}"
                raise ValueError(f"{where}: mend it, or sort the rows by time")
            same += len(stamps) - (distinct := len(np.unique(stamps)))
            apart += len({(at, *row.values()) for at, row in zip(stamps, log.rows, strict=True)}) - distinct
            cells, largest = joined(log, stamps, times[at], smooth, tolerance)
            gap = max(gap, largest)
            if not any(cells):
                own, theirs = (f"{np.nanmin(t):.3f} to {np.nanmax(t):.3f} s" for t in (stamps, times[at]))
                how = f"{name}:{column}+SECONDS shifts it, or write the times of each video into NAME_timestamps.csv"
                raise ValueError(f"{file} has no time within {tolerance:g} s of the images, {theirs}, but {own}: {how}")
            for i, row in zip(at, cells, strict=True):
                made[i] = {c: cell for c, cell in row.items() if c != column}
                for c in [c for c in images if made[i].get(c)]:
                    made[i][c] = os.path.relpath(file.parent / made[i][c], table.root)
        names = dict.fromkeys(c for row in made for c in row)
        if twice := names.keys() & set(table.columns):
            raise ValueError(f"{table.path} and {name} both have a column {min(twice)!r}: rename one")
        there = [bool(row) for row in made]
        sides = " before and after" * any(name in smooth for name in names)
        lost = f"; {there.count(False)} of {len(there)} rows left out: no measurement within {tolerance:g} s{sides}"
        note = f"{name} joined by {text.removeprefix(f'{name}:')}, its largest gap is {gap:.3g} s"
        note += lost * (not all(there))
        note += f"; {same} of its rows have the stamp of another, of which one counts" * bool(same)
        note += f", and {apart} of these say something else than another" * bool(apart)
        rows = [{**row, **{c: more.get(c, "") for c in names}} for row, more in zip(table.rows, made, strict=True)]
        table = replace(table, rows=rows, digest=digest([table.digest, made]), notes=(*table.notes, note))
        table = table.filtered(there, "")
        refs = [ref for ref, kept in zip(refs, there, strict=True) if kept]
    return table


def _parsed(text: str) -> tuple[str, str, float]:
    name, _, rest = text.rpartition(":")
    if not name or not rest:
        raise ValueError(f"log {text!r}: write FILE:COLUMN, where COLUMN has the time stamps")
    found = re.fullmatch(r"(.+?)([+-]\d*\.?\d+)", rest)
    return (name, found[1], float(found[2])) if found else (name, rest, 0.0)


def _files(table: Manifest, name: str, refs: Sequence[ImageRef | None]) -> dict[Path, list[int]]:
    files: dict[Path, list[int]] = {}
    for i, ref in enumerate(refs):
        beside = Path(ref.path) if ref else table.root / "."
        own = name.replace("{}", os.path.relpath(beside.with_suffix(""), table.root)) if "{}" in name else name
        file = table.root / own
        files.setdefault(file if file.is_file() else beside.parent / own, []).append(i)
    return files


def _check_apart(file: Path, times: np.ndarray, recordings: Sequence[str]) -> None:
    """Raise ValueError if recordings that each begin at 0 s share the log ``file``, whose values fit only one of them."""
    names = np.array(recordings)[np.argsort(times, kind="stable")]
    if np.nanmax(times, initial=0) < 1e9 and (names[1:] != names[:-1]).sum() >= len({*recordings}):
        what = f"{file} would be the log of {len({*recordings})} recordings at the same times"
        raise ValueError(f"{what}: give each its own, beside its video, or stamps since 1970")


def joined(
    log: Manifest, stamps: np.ndarray, times: np.ndarray, smooth: Collection[str], tolerance: float
) -> tuple[list[Row], float]:
    """Return the cells of ``log``, whose rows are of ``stamps`` [N], at ``times`` [M], and its largest gap in seconds.

    Cells are {} where there is no measurement within ``tolerance``. Columns of ``smooth`` are interpolated, others nearest;
    empty cells do not count.
    """
    order = np.argsort(stamps, kind="stable")
    stamps = stamps[order]
    at, away = nearest(stamps, times)
    if not (good := away <= tolerance + SLACK).any():
        return [{} for _ in times], 0.0
    gaps = np.diff(stamps)[np.diff(np.searchsorted(np.sort(times), stamps)) > 0]  # of those between recordings none
    columns = {name: [log.rows[row][name] for row in order[at]] for name in log.rows[0]}
    for name in columns:
        linear, texts = name in smooth, np.array([log.rows[row][name] for row in order], object)
        known = np.array([_number(log, row, name) for row in order.tolist()]) if linear else np.zeros(len(order))
        own = stamps[filled := np.isfinite(known) & (texts != "")]
        if (filled.all() and not linear) or not len(own):
            continue
        at, away = nearest(own, times)
        near, cells = away <= tolerance + SLACK, texts[filled][at].tolist()
        if linear:
            after = np.clip(np.searchsorted(own, times), min(1, len(own) - 1), len(own) - 1)
            ends = np.abs(own[[after - 1, after]] - times).max(0)
            near &= ((ends <= tolerance + SLACK) & (times >= own[0]) & (times <= own[-1])) | (away <= SLACK)
            cells = [text_of(float(f"{value:.9g}")) for value in np.interp(times, own, known[filled])]
        good &= near | ~filled.all()
        columns[name] = [cell if here else "" for cell, here in zip(cells, near, strict=True)]
    step = np.median(np.diff(stamps, append=stamps[-1]))
    if columns.keys() & set(smooth) and good.mean() < 0.5 and step > 2 * tolerance:
        far = f"{log.path}: stamps are {step:g} s apart"
        raise ValueError(f"{far}, more than --data.tolerance {tolerance:g} on both sides: are they seconds?")
    rows = [{name: texts[i] for name, texts in columns.items()} if good[i] else {} for i in range(len(times))]
    return rows, float(gaps.max(initial=0.0))


def _number(log: Manifest, i: int, name: str) -> float:
    cell = log.rows[i][name]
    value = number_of(cell) if cell else math.nan
    if value is None:
        raise ValueError(f"{log.at(i)}: {name} is {cell!r}: give a finite number (a field of a message), or nothing")
    return value
