"""Results of closed-loop suites: one JSON file per encoder, like those of ``bench.result``.

    format, suite (definition), suite_digest, encoder, versions, data (digests of what is learned from)
    rows      of the encoder and each control, for each task and condition: sums per shape or episode, no score
    digest    sha256 of all of this; ``about`` (time, machine, commit) is not in it

The row that needs no picture, of the true pose or the expert, is computed again when a result is checked.
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
from tabulate import tabulate

from mvitac.bench.encoder import About, describe
from mvitac.bench.result import VOLATILE, write_result
from mvitac.control.insert_rows import Insert
from mvitac.control.servo_rows import Servo
from mvitac.control.suite import InsertSuite, ServoSuite, find_suite, read_suite, shipped
from mvitac.deploy.artifact import load
from mvitac.evaluation.intervals import mean_interval
from mvitac.experiments.plan import slug
from mvitac.report.html import blocks as page
from mvitac.system.files import check_place, digest, fields_of, read_json, write_atomic, write_json
from mvitac.system.locks import hold_lock
from mvitac.system.progress import work
from mvitac.system.provenance import provenance

FORMAT, FORMAT_VERSION = "mvitac-control", 1
OWN = ("", "touch shuffled")  # rows of the encoder that is scored
ALL = "all"
Means = dict[tuple[str, str, str], np.ndarray]  # task, condition, sum -> [seeds, shapes or episodes]


def loop(suite: ServoSuite | InsertSuite, mapped: Callable[..., Any] = map) -> Servo | Insert:
    """What scores the rows of ``suite``."""
    return Insert(suite, mapped) if isinstance(suite, InsertSuite) else Servo(suite, mapped)


@contextlib.contextmanager
def pool(num: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """``map`` over ``num`` processes, in order; they import no torch."""
    with ProcessPoolExecutor(num, multiprocessing.get_context("spawn")) as processes:
        yield partial(processes.map, chunksize=5)


def run_suite(places: Sequence[str], suite: ServoSuite | InsertSuite, out: Path, about: About) -> Path:
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
        runner = loop(suite, mapped)
        asked = runner.rows(models)
        with work(f"{encoder['name']} on {suite.name}", len(asked), "rows") as advance:
            for row in asked:
                known = [suite.digest(), row.source, row.seed, here["versions"], here["commit"]]
                key = digest([*known, encoder if row.source in OWN else ""])
                kept = out / "parts" / f"{suite.name}-{key[:24]}.json"
                if not kept.exists():
                    write_json(kept, {"cells": row.score()}, sealed=True)
                found = read_json(kept, "a part of a suite")["cells"]
                rows.append({"source": row.source, "seed": row.seed, "cells": found})
                advance()
        now = {"time": datetime.now(UTC).isoformat(timespec="seconds"), "seconds": round(time.perf_counter() - start)}
        value = {"format": FORMAT, "format_version": FORMAT_VERSION, "suite": suite.definition()}
        value |= {"suite_digest": suite.digest(), "encoder": encoder, "versions": here.pop("versions")}
        value |= {"data": runner.data(), "rows": rows}
        write_result(path, {**value, "digest": digest(value), "about": {**here, **now}})
    return path


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
        if (
            suite.name not in shipped()
            or not find_suite(suite.name).digest() == suite.digest() == value["suite_digest"]
        ):
            raise ValueError(f"{path} is not of this version's {suite.name}: run the suite again")
        if found := next(_problems(value, loop(suite)), ""):
            raise ValueError(f"{path}: {found}")
    return value


def pinned(value: dict[str, Any]) -> str:
    """Whether its data is what the suite was measured on: same, other pixels (another machine), not pinned."""
    pins = find_suite(value["suite"]["name"]).pins
    return "not pinned" if not pins else "same" if pins == value["data"] else "other pixels"


def _problems(value: dict[str, Any], runner: Servo | Insert) -> Iterator[str]:
    seeds = value["encoder"]["seeds"]
    want = [*(("", seed) for seed in seeds), ("pixels", None)]
    want += [("untrained", seed) for seed in range(len(runner.suite.untrained))]
    rest = [("touch shuffled", seeds[0]), (runner.true, None)]
    have = [(row["source"], row["seed"]) for row in value["rows"]]
    blind = "no touch" if isinstance(runner, Servo) else "no senses"
    rest += [(blind, None), ("end to end", None)]
    if have not in ([*want, *rest], [*want, ("imagenet", None), *rest]):
        yield f"has the rows {have}, the suite asks for {want + rest}"
    for row in value["rows"]:
        who = row["source"] or "the encoder"
        if [(cell["task"], cell["condition"]) for cell in row["cells"]] != runner.cells(row["source"]):
            yield f"{who} has other tasks or conditions than the suite"
        for cell in row["cells"]:
            sums = np.array([cell[key] for key in runner.sums], float)
            if not np.isfinite(sums).all() or runner.impossible(cell["task"], np.array(cell["n"]), sums):
                yield f"{who}, {cell['task']}, {cell['condition']}: no episodes give these sums"
    true = next(row["cells"] for row in value["rows"] if row["source"] == runner.true)
    for cell, again in zip(true, runner.again(), strict=True):
        if not np.allclose(*([one[key] for key in runner.sums] for one in (cell, again)), rtol=1e-3, atol=1e-3):
            yield f"{runner.true} gives other sums here in {cell['task']}, {cell['condition']}"


def scores(value: dict[str, Any]) -> dict[str, Means]:
    """Source -> means by task, condition and sum. Condition ``ALL`` is the mean over conditions."""
    found: dict[str, dict[tuple[str, str, str], list[np.ndarray]]] = {}
    for row in value["rows"]:
        mine = found.setdefault(row["source"] or value["encoder"]["name"], {})
        of_seed: dict[tuple[str, str, str], list[np.ndarray]] = {}
        for cell in row["cells"]:
            for key in (name for name in cell if name not in ("task", "condition", "n")):
                each = np.array(cell[key]) / np.array(cell["n"])
                of_seed[cell["task"], cell["condition"], key] = [each]
                of_seed.setdefault((cell["task"], ALL, key), []).append(each)
        for key, parts in of_seed.items():
            mine.setdefault(key, []).append(np.mean(parts, axis=0))
    return {source: {key: np.stack(lines) for key, lines in mine.items()} for source, mine in found.items()}


def tables(values: Sequence[dict[str, Any]]) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Title -> columns and rows: one table over all conditions, then one for each. Controls are those of the last file."""
    runner = loop(find_suite(values[0]["suite"]["name"]))
    known: dict[str, Means] = {}
    for value in values:
        known |= scores(value)
    found = {}
    for condition in (ALL, *dict.fromkeys(name for _, name in runner.cells(""))):
        rows = [[source, *(_cell(runner, known, source, k, condition) for k in runner.kinds)] for source in known]
        found["all conditions" if condition == ALL else condition] = (["", *runner.kinds], rows)
    return found


def _cell(runner: Servo | Insert, known: dict[str, Means], source: str, kind: str, condition: str) -> str:
    """Errors and interval, and * where the difference to the untrained trunk has p < .05."""
    means = {key: known[source][kind, condition, key] for key in runner.sums if (kind, condition, key) in known[source]}
    if not means:
        return ""
    first = next(iter(means.values()))
    text = runner.text(means, mean_interval(first))
    other = known["untrained"][kind, condition, runner.sums[0]].mean(0)
    return text + " *" * (source != "untrained" and mean_interval(first - other)[3] < 0.05)


STAR = "* differs from the untrained trunk, p < .05, paired by shape or episode, not corrected for the number of cells."


def print_result(value: dict[str, Any]) -> None:
    """Print the tables of one result."""
    for title, (columns, rows) in tables([value]).items():
        print(f"{value['suite']['name']}, {title}\n{tabulate(rows, columns)}\n")
    print(f"{loop(find_suite(value['suite']['name'])).note}. {STAR} Data: {pinned(value)}.")


def write_page(files: Sequence[Path], out: Path) -> Path:
    """Write the page of results of one suite."""
    values = [read_control(path) for path in files]
    if len({value["suite_digest"] for value in values}) > 1:
        raise ValueError(f"{files[-1]} is of another suite than {files[0]}: make a page for each")
    suite = find_suite(values[0]["suite"]["name"])
    head = page.head(suite.name, "mvitac bench", {"definition": suite.digest()[:12]}, suite.title)
    note = page.paragraph(f"{loop(suite).note}. {STAR}")
    sections = [
        (f"table{number}", title, [*([note] * (not number)), page.table(columns, rows, words=True, label=title)])
        for number, (title, (columns, rows)) in enumerate(tables(values).items())
    ]
    text = str(page.page(f"mvitac bench: {suite.name}", head, sections, "Made by mvitac bench board."))
    write_atomic(out, lambda file: file.write(text.encode()))
    return out
