"""Results of closed-loop suites: one JSON file per encoder, as those of ``bench.result`` but for their own fields:

    data      digests of what is learned from
    rows      of the encoder and each control, for each task and condition: sums per shape or episode, no score

The row that needs no picture, of the true pose or the expert, is computed again when a result is checked.
"""

import hashlib
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.bench.check import FIELDS, are_digests, problems_of, unknown_fields
from mvitac.bench.encoder import About, measure
from mvitac.bench.result import read_signed
from mvitac.bench.score import kept_part
from mvitac.control.ablate import suite_episodes
from mvitac.control.insert import Insert
from mvitac.control.servo_rows import Servo
from mvitac.control.suite import OWN, SHUFFLED, Row, rows_of, score
from mvitac.control.video import film, webp
from mvitac.evaluation.intervals import paired_difference
from mvitac.model import Model
from mvitac.registry import check_known, from_json
from mvitac.report.html import blocks as page
from mvitac.report.html import data_uri
from mvitac.system.files import digest, fields_of, read_json, write_atomic
from mvitac.system.progress import work
from mvitac.system.provenance import provenance

FORM = "mvitac-control", 1
SUITES = Path(__file__).parent / "suites"
Suite = Servo | Insert
Scored = dict[str, dict[tuple[str, str], list[dict[str, Any]]]]  # source -> task, condition -> cells of its seeds


def shipped() -> list[str]:
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def find_suite(name: str) -> Suite:
    check_known("suite", [name], shipped())
    value = tomllib.loads((SUITES / f"{name}.toml").read_text())
    return from_json(Insert if value["kind"] == "insert" else Servo, value, "suite")


def run_suite(places: Sequence[str], suite: Suite, out: Path, about: About) -> Path:
    """Score an encoder (its seeds) on ``suite`` and write <out>/<suite>-<name>.json.

    The same call continues an interrupted one. Rows of controls, the same for every encoder, are kept in <out>/parts.
    """

    def measured(models: Sequence[Model], encoder: dict[str, Any]) -> dict[str, Any]:
        here, asked, rows = provenance(), rows_of(suite, models), []
        for problem in problems_of(encoder, [row.source for row in asked]):
            raise ValueError(problem)
        with work(f"{encoder['name']} on {suite.name}", len(asked), "rows") as advance:
            for row in asked:
                key = digest(encoder) if row.source in (OWN, SHUFFLED) else "controls"
                known = [suite.digest(), row.source, row.seed, here["versions"], here["commit"]]
                cells = kept_part(out / "parts", key, known, lambda one=row: score(suite, one))
                rows.append({"source": row.source, "seed": row.seed, "cells": cells})
                advance()
        data = {name: hashlib.sha256(images.tobytes()).hexdigest() for name, images in suite.shown[0].items()}
        return {"data": data, "rows": rows}

    return measure(places, suite, out, about, measured, FORM)


def is_result(path: Path) -> bool:
    value = read_json(path, "a result")
    return isinstance(value, dict) and value.get("format") == FORM[0]


def read_control(path: Path) -> tuple[Suite, dict[str, Any]]:
    """Read and check a result; ValueError if it was changed, is of another definition, lacks a row, or cannot be."""
    value = read_signed(path, FORM)
    with fields_of(path):
        name = value["suite"]["name"]
        suite = find_suite(name) if name in shipped() else None
        if not suite or (value["suite"], value["suite_digest"]) != (suite.definition(), suite.digest()):
            raise ValueError(f"{path} is not of this version's {name}: run the suite again")
        for problem in _problems(value, suite):
            raise ValueError(f"{path}: {problem}")
        return suite, value


def _problems(value: dict[str, Any], suite: Suite) -> Iterator[str]:
    seeds = value["encoder"]["seeds"]
    want = [*((OWN, seed) for seed in seeds), ("pixels", None)]
    want += [("untrained", seed) for seed in range(len(suite.untrained))]
    rest = [(SHUFFLED, seeds[0]), (suite.true, None), (suite.blind, None), ("end to end", None)]
    have = [(row["source"], row["seed"]) for row in value["rows"]]
    if have not in ([*want, *rest], [*want, ("imagenet", None), *rest]):
        yield f"has the rows {have}, the suite asks for {want + rest}"
    parts = [(value, (*FIELDS, "data", "rows")), *((row, ("source", "seed", "cells")) for row in value["rows"])]
    cells = [cell for row in value["rows"] for cell in row["cells"]]
    yield from unknown_fields(value, [*parts, *((cell, ("task", "condition", "n", *suite.sums)) for cell in cells)])
    if value["data"].keys() != suite.shown[0].keys() or not are_digests(value["data"].values()):
        yield "it has no digests of what was learned from"
    yield from problems_of(value["encoder"], ["imagenet", *(source for source, _ in (*want, *rest))])
    for row in value["rows"]:
        who = row["source"] or "the encoder"
        if [(cell["task"], cell["condition"]) for cell in row["cells"]] != suite.cells(row["source"]):
            yield f"{who} has other tasks or conditions than the suite"
        for cell in row["cells"]:
            if {type(number) for key in ("n", *suite.sums) for number in cell[key]} - {int, float}:
                yield f"{who}, {cell['task']}, {cell['condition']}: a sum is no number"
                continue
            if {len(cell[key]) for key in ("n", *suite.sums)} != {suite.num}:
                yield f"{who}, {cell['task']}, {cell['condition']}: its sums are not of {suite.num} episodes"
                continue
            n, *sums = np.array([cell[key] for key in ("n", *suite.sums)], float)
            whole = (n == suite.scored).all() and np.isfinite(sums).all()
            if not whole or suite.impossible(cell["task"], n, np.array(sums)):
                yield f"{who}, {cell['task']}, {cell['condition']}: no episodes give these sums"
    told: dict[Any, Any] = {}
    free = suite.true, suite.blind  # which do not see what differs between conditions
    nothing = {c["task"]: c[suite.sums[0]] for r in value["rows"] if r["source"] == suite.blind for c in r["cells"]}
    for row in sorted(value["rows"], key=lambda row: row["source"] not in free):
        for cell in row["cells"]:
            who = f"{row['source'] or 'the encoder'}, seed {row['seed']}, {cell['task']}, {cell['condition']}"
            own = cell["task"], *(tuple(cell[key]) for key in suite.sums)
            same = told.setdefault(own, who) != who and row["source"] not in free
            # Not where all lose contact at once, nor of an encoder whose features are constant: it does as without senses.
            knows = not np.allclose(cell[suite.sums[0]], nothing.get(cell["task"], np.nan))
            if same and knows and any(len({*cell[key]}) > 1 for key in suite.sums):
                yield f"{who} has the sums of {told[own]}"
            key = row["source"], cell["task"], suite.lesson((cell["task"], cell["condition"]))
            if row["source"] == suite.blind and told.setdefault(key, own) != own:
                yield f"{who}: it sees nothing, and does otherwise than in another condition"
    true = next(row["cells"] for row in value["rows"] if row["source"] == suite.true)
    for cell, again in zip(true, score(suite, Row(suite.true, None, None)), strict=True):
        if not np.allclose(*([one[key] for key in suite.sums] for one in (cell, again)), rtol=1e-3, atol=1e-3):
            yield f"{suite.true} gives other sums here in {cell['task']}, {cell['condition']}"


def scores(values: Sequence[dict[str, Any]]) -> Scored:
    """The cells of all seeds of each row; "SOURCE, with ENCODER" where a control is not that of the results before."""
    found: Scored = {}
    for value in values:
        mine: Scored = {}
        for row in value["rows"]:
            for cell in row["cells"]:
                of = mine.setdefault(row["source"] or value["encoder"]["name"], {})
                of.setdefault((cell["task"], cell["condition"]), []).append({**cell, "seed": row["seed"]})
        for source, cells in mine.items():
            other = found.setdefault(source, cells) != cells
            found[f"{source}, with {value['encoder']['name']}" if other else source] = cells
    return found


def tables(suite: Suite, values: Sequence[dict[str, Any]]) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Condition -> columns and rows."""
    known, found = scores(values), {}
    for condition in dict.fromkeys(name for _, name in suite.cells(OWN)):
        rows = [[source, *(_cell(suite, known, source, (kind, condition)) for kind in suite.kinds)] for source in known]
        found[condition] = ["", *suite.kinds], rows
    return found


def _cell(suite: Suite, known: Scored, source: str, key: tuple[str, str]) -> str:
    if not (cells := known[source].get(key)):
        return ""
    beside = known.get(f"untrained, with {source.rpartition(', with ')[2]}", known["untrained"])  # of the same result
    ours, theirs = ([suite.record(cell) for cell in each] for each in (cells, beside[key]))
    _, low, high, _ = paired_difference(ours, theirs)
    return suite.text(cells) + " *" * (low > 0 or high < 0)


def note(suite: Suite, values: Sequence[dict[str, Any]]) -> str:
    pins = [f"{v['encoder']['name']} {'same' if v['data'] == suite.pins else 'others'}" for v in values]
    return (
        f"{suite.note}. * differs from the untrained trunks: the 95 % interval of the difference, paired by shape or"
        " episode, and over seeds, excludes 0. It leaves out the seeds of a row with one, and is not corrected for the"
        f" number of cells. Pixels that are learned from, beside the suite's own: {', '.join(pins)}."
    )


def write_page(files: Sequence[Path], out: Path) -> Path:
    """Write the page of results of one suite, with a film of who knows the truth and of no action at all."""
    suites, values = zip(*map(read_control, files), strict=True)
    suite, names = suites[0], [value["encoder"]["name"] for value in values]
    if any(one != suite for one in suites) or len(set(names)) < len(names):
        raise ValueError(f"{files[-1]} is of another suite or of an encoder of the same name: make a page for each")
    head = page.head(suite.name, "mvitac bench", {"definition": suite.digest()[:12]}, suite.title)
    each = enumerate(tables(suite, values).items())
    sections = [(f"table{n}", title, [page.table(*shown, words=True, label=title)]) for n, (title, shown) in each]
    sections[0][2].insert(0, page.paragraph(note(suite, values)))
    episodes = suite_episodes(suite, next(cell for cell in suite.cells(OWN) if cell[0] == suite.kinds[2]))
    still = np.zeros(len(episodes.begin[0]().most))
    shown = webp(film(episodes, [(suite.true, None, ""), ("no action", lambda given: still, "")]))
    image = page.image(data_uri(shown, "webp"), "What is seen, and the error in mm and degrees")
    sections.append(("film", "An episode", [page.figure(image)]))
    text = str(page.page(f"mvitac bench: {suite.name}", head, sections, "Made by mvitac bench board."))
    write_atomic(out, lambda file: file.write(text.encode()))
    return out
