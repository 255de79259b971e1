"""Results of closed-loop suites: one JSON file per encoder, like those of ``bench.result``.

    format, suite (definition), suite_digest, encoder, versions, data (digests of what probes are fitted on)
    rows      of the encoder and each control, for each task and condition: sums per shape. It holds no score
    digest    sha256 of all of this; ``about`` (time, machine, commit) is not in it

A row that needs no picture, the true pose, is computed again when a result is checked.
"""

import contextlib
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from tabulate import tabulate

from mvitac.bench.encoder import About, describe
from mvitac.bench.result import VOLATILE, write_result
from mvitac.control.servo import TASKS
from mvitac.control.servo_rows import SUMS, TRUE, Servo
from mvitac.control.suite import ServoSuite, find_suite, read_suite, shipped
from mvitac.deploy.artifact import load
from mvitac.evaluation.intervals import mean_interval
from mvitac.experiments.plan import slug
from mvitac.report.html import blocks as page
from mvitac.system.files import check_place, digest, fields_of, read_json, write_atomic, write_json
from mvitac.system.locks import hold_lock
from mvitac.system.progress import work
from mvitac.system.provenance import provenance

FORMAT, FORMAT_VERSION = "mvitac-control", 1
ALL = "all"
Scores = np.ndarray  # [seeds, shapes]


def run_suite(places: Sequence[str], suite: ServoSuite, out: Path, about: About) -> Path:
    """Score an encoder (its seeds) on ``suite`` and write <out>/<suite>-<name>.json.

    The same call continues an interrupted one. Rows of controls, the same for every encoder, are kept in <out>/parts.
    """
    models = [load(place) for place in places]
    encoder = describe(models, places, about)
    path = out / f"{suite.name}-{slug(encoder['name'])}.json"
    check_place(path)
    start, here = time.perf_counter(), provenance()
    rows, busy = [], f"another process writes {path}: wait for it, or give another --out"
    with hold_lock(path, busy, wait=False), pool(os.cpu_count() or 1) as mapped:
        servo = Servo(suite, mapped)
        asked = servo.rows(models)
        with work(f"{encoder['name']} on {suite.name}", len(asked) * len(_kinds()), "kinds"):
            for row in asked:
                known = [suite.digest(), row.source, row.seed, here["versions"], here["commit"]]
                key = digest([*known, encoder if row.source in OWN else ""])
                kept = out / "parts" / f"{suite.name}-{key[:24]}.json"
                if not kept.exists():
                    write_json(kept, {"cells": row.score()}, sealed=True)
                found = read_json(kept, "a part of a suite")["cells"]
                rows.append({"source": row.source, "seed": row.seed, "cells": found})
        now = {"time": datetime.now(UTC).isoformat(timespec="seconds"), "seconds": round(time.perf_counter() - start)}
        value = {"format": FORMAT, "format_version": FORMAT_VERSION, "suite": suite.definition()}
        value |= {"suite_digest": suite.digest(), "encoder": encoder, "versions": here.pop("versions")}
        value |= {"data": servo.data(), "rows": rows}
        write_result(path, {**value, "digest": digest(value), "about": {**here, **now}})
    return path


@contextlib.contextmanager
def pool(num: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """``map`` over ``num`` processes, in order; they import no torch."""
    with ProcessPoolExecutor(num, multiprocessing.get_context("spawn")) as processes:
        yield partial(processes.map, chunksize=5)


OWN = ("", "touch shuffled")  # rows of the encoder that is scored


def _kinds() -> list[str]:
    return [kind for task in TASKS.values() for kind in task.kinds]


def is_result(path: Path) -> bool:
    """Whether ``path`` is a result of a closed-loop suite."""
    value = read_json(path, "a result")
    return isinstance(value, dict) and value.get("format") == FORMAT


def read_control(path: Path) -> dict[str, Any]:
    """Read and check a result; ValueError if it was changed, is of another definition, lacks a row, or cannot be."""
    value = read_json(path, "a result of a closed-loop suite")
    if value.get("digest") != digest({key: part for key, part in value.items() if key not in VOLATILE}):
        raise ValueError(f"{path} does not match its digest: it was changed after it was written, run the suite again")
    with fields_of(path):
        suite = read_suite(value["suite"])
        if suite.name not in shipped() or find_suite(suite.name).digest() != value["suite_digest"] != "":
            raise ValueError(f"{path} is not of this version's {suite.name}: run the suite again")
        if suite.digest() != value["suite_digest"]:
            raise ValueError(f"{path}: the suite inside does not have the digest that the file says")
        if found := next(_problems(value, suite), ""):
            raise ValueError(f"{path}: {found}")
    return value


def pinned(value: dict[str, Any]) -> str:
    """Whether the presses are those that the suite was measured on: same, other pixels (another machine), not pinned."""
    pins = find_suite(value["suite"]["name"]).pins
    return "not pinned" if not pins else "same" if pins == value["data"] else "other pixels"


def _problems(value: dict[str, Any], suite: ServoSuite) -> Iterator[str]:
    seeds = value["encoder"]["seeds"]
    want = [("", seed) for seed in seeds] + [("touch shuffled", seeds[0]), (TRUE, None), ("no touch", None)]
    want += [("pixels", None), *(("untrained", seed) for seed in range(len(suite.untrained))), ("end to end", None)]
    have = [(row["source"], row["seed"]) for row in value["rows"]]
    if have not in (want, [*want, ("imagenet", None)]):
        yield f"has the rows {have}, the suite asks for {want}"
    cells = [(kind, condition.name) for kind in _kinds() for condition in suite.conditions]
    limits = {kind: (t.limit[0], np.hypot.reduce(t.limit[1:])) for t in TASKS.values() for kind in t.kinds}
    steps = suite.steps - suite.settle
    for row in value["rows"]:
        if [(cell["task"], cell["condition"]) for cell in row["cells"]] != cells:
            yield f"{row['source'] or 'the encoder'} has other tasks or conditions than the suite"
        for cell in row["cells"]:
            n, mm, deg, lost = (np.array(cell[key], float) for key in ("n", *SUMS))
            most, possible = limits[cell["task"]], np.isfinite([mm, deg, lost]).all() and (n == steps).all()
            possible &= {len(mm), len(deg), len(lost), len(n)} == {suite.shapes} and (lost == lost.round()).all()
            for each, limit in ((mm, most[0]), (deg, most[1])):  # steps without contact have the limit
                possible &= bool((each >= lost * limit - 1e-6).all() and (each <= n * limit + 1e-6).all())
            if not (possible and (lost >= 0).all()):
                yield f"{row['source'] or 'the encoder'}, {cell['task']}, {cell['condition']}: no episodes give these sums"
    true = next(row["cells"] for row in value["rows"] if row["source"] == TRUE)
    for cell, again in zip(true, Servo(suite).run(None), strict=True):
        if not np.allclose([cell[key] for key in SUMS], [again[key] for key in SUMS], rtol=1e-4, atol=1e-4):
            yield f"the true pose gives other sums here in {cell['task']}, {cell['condition']}"


def scores(value: dict[str, Any]) -> dict[str, dict[tuple[str, str, str], Scores]]:
    """Source -> (task, condition, sum) -> means of each step, [seeds, shapes]. ``ALL`` is the mean over conditions."""
    found: dict[str, dict[tuple[str, str, str], list[np.ndarray]]] = {}
    for row in value["rows"]:
        mine = found.setdefault(row["source"] or value["encoder"]["name"], {})
        of_seed: dict[tuple[str, str, str], list[np.ndarray]] = {}
        for cell in row["cells"]:
            for key in SUMS:
                each = np.array(cell[key]) / np.array(cell["n"])
                of_seed[cell["task"], cell["condition"], key] = [each]
                of_seed.setdefault((cell["task"], ALL, key), []).append(each)
        for key, parts in of_seed.items():
            mine.setdefault(key, []).append(np.mean(parts, axis=0))
    return {source: {key: np.stack(lines) for key, lines in mine.items()} for source, mine in found.items()}


def tables(values: Sequence[dict[str, Any]]) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Title -> columns and rows: one table over all conditions, with p against the untrained trunk, then each condition."""
    known: dict[str, dict[tuple[str, str, str], Scores]] = {}
    for value in values:
        known = {**scores(value), **known}
    suite, kinds = find_suite(values[0]["suite"]["name"]), _kinds()
    found = {}
    for condition in (ALL, *(c.name for c in suite.conditions)):
        rows = [[source, *(_cell(known, source, kind, condition) for kind in kinds)] for source in known]
        title = "all conditions" if condition == ALL else condition
        found[title] = (["", *kinds], rows)
    return found


def _cell(known: dict[str, dict[tuple[str, str, str], Scores]], source: str, kind: str, condition: str) -> str:
    mine = known[source]
    mm, low, high, _ = mean_interval(mine[kind, condition, "mm"])
    text = f"{mm:.2f} [{max(low, 0):.2f}, {high:.2f}] mm, {mine[kind, condition, 'deg'].mean():.1f} deg"
    if lost := mine[kind, condition, "lost"].mean():
        text += f", {100 * lost:.0f} % lost"
    if source != "untrained":
        p = mean_interval(mine[kind, condition, "mm"] - known["untrained"][kind, condition, "mm"].mean(0))[3]
        text += "" if p >= 0.05 else " *"
    return text


NOTE = """Mean error over scored steps, with the 95 % interval over shapes (and seeds). Steps after contact was lost have the
largest error. * differs from the untrained trunk, p < .05, paired by shape, not corrected for the number of cells."""


def print_result(value: dict[str, Any]) -> None:
    """Print the tables of one result."""
    for title, (columns, rows) in tables([value]).items():
        print(f"{value['suite']['name']}, {title}\n{tabulate(rows, columns)}\n")
    print(f"{' '.join(NOTE.split())} Presses: {pinned(value)}.")


def write_page(files: Sequence[Path], out: Path) -> Path:
    """Write the page of results of one suite."""
    values = [read_control(path) for path in files]
    if len({value["suite_digest"] for value in values}) > 1:
        raise ValueError(f"{files[-1]} is of another suite than {files[0]}: make a page for each")
    suite = find_suite(values[0]["suite"]["name"])
    head = page.head(suite.name, "mvitac bench", {"definition": suite.digest()[:12]}, suite.title)
    note = page.paragraph(" ".join(NOTE.split()))
    sections: list[tuple[str, str, list[Markup]]] = [
        (f"table{number}", title, [*([note] * (not number)), page.table(columns, rows, words=True, label=title)])
        for number, (title, (columns, rows)) in enumerate(tables(values).items())
    ]
    text = str(page.page(f"mvitac bench: {suite.name}", head, sections, "Made by mvitac bench board."))
    write_atomic(out, lambda file: file.write(text.encode()))
    return out
