"""The board: one static page that compares results of one suite."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from scipy.stats import rankdata

from mvitac.bench.check import GUESS, problems
from mvitac.bench.result import pinned_of, read_result, records_of, suite_of
from mvitac.bench.suite import SuiteTask
from mvitac.evaluation import few_labels
from mvitac.evaluation.intervals import paired_difference
from mvitac.evaluation.leaks import UNKNOWN, leak_mark
from mvitac.evaluation.score_text import percent, score_name, tested_on, with_interval
from mvitac.evaluation.scores import by_cell, summarise
from mvitac.report.figures import STYLE, new_figure, to_svg
from mvitac.report.html import COLOURS
from mvitac.report.html import blocks as page
from mvitac.report.tables import probe_name
from mvitac.system.files import fields_of, write_atomic

CONTROLS = (GUESS, "border", "pixels", "untrained", "imagenet")
"""Controls from left to right; the data's own columns come after the first."""


@dataclass(frozen=True)
class Row:
    """A task by one modality, with scores by the name of the encoder or control."""

    task: str  # set and task
    about: str  # its test groups
    modality: str
    records: dict[str, list[dict[str, Any]]]  # of the probe, one for each seed
    cells: dict[str, dict[str, Any]]  # their summary (``scores.summarise``)
    few: dict[str, dict[float, dict[str, Any]]]  # name -> fraction of the labels -> summary, from few labels to all

    @cached_property
    def score(self) -> str:
        return score_name({self.modality: self.cells})


@dataclass(frozen=True)
class Board:
    """Results by the encoder's name, what they scored row by row, and a line for each task that a result lacks."""

    results: dict[str, dict[str, Any]]
    rows: list[Row]
    not_run: list[str]
    differ: list[str]  # a line for each control that is not the same in all results

    @property
    def controls(self) -> list[str]:
        found = dict.fromkeys(name for row in self.rows for name in row.cells if name not in self.results)
        return sorted(found, key=lambda name: CONTROLS.index(name) if name in CONTROLS else 0.5)

    @cached_property
    def encoders(self) -> list[str]:
        """Names of encoders by their mean rank over the rows that all of them have, the best one first."""
        common = [row for row in self.rows if all(name in row.cells for name in self.results)]
        # Equals share their mean rank.
        ranks = [rankdata([-row.cells[name]["mean"] for name in self.results]) for row in common]
        total = sum(ranks, np.zeros(len(self.results)))
        return [name for _, name in sorted(zip(total, self.results, strict=True))]


def write_board(files: Sequence[Path], out: Path) -> Path:
    """Write the page that compares the results in ``files``; ValueError if they do not hold or cannot be compared."""
    results: dict[str, dict[str, Any]] = {}
    for path in files:
        result = read_result(path)
        with fields_of(path):
            if found := problems(result):
                raise ValueError(f"{path}: {found[0]}")
        first = next(iter(results.values()), result)
        if first["suite_digest"] != result["suite_digest"]:
            versions = " and ".join(f"{r['suite']['name']} ({r['suite_digest'][:12]})" for r in (first, result))
            raise ValueError(f"{path} is of another suite than {files[0]}: {versions}; make a board for each")
        if (name := result["encoder"]["name"]) in results:
            raise ValueError(f"{path}: another result is of an encoder named {name!r}: bench one of them with --name")
        results[name] = result
    with fields_of(" or ".join(map(str, files))):
        text = _page(gather(results))
    write_atomic(out, lambda file: file.write(text.encode()))
    return out


def gather(results: dict[str, dict[str, Any]]) -> Board:
    """Put the blocks of all results side by side. Only those on the same rows of data are one row of the page."""
    suite = suite_of(next(iter(results.values())))
    rows, not_run, differ = list[Row](), list[str](), list[str]()
    for number, (one, ask) in enumerate((each, ask) for each in suite.sets for ask in each.tasks):
        forms: dict[tuple[str, str], list[tuple[str, dict[str, Any]]]] = {}
        for name, result in results.items():
            block = result["blocks"][number]
            if "not_run" in block:
                not_run.append(f"{one.name}, {ask.name}: {name} was not run: {block['not_run']}")
            else:
                forms.setdefault((block["form"], block["data"]["rows"]), []).append((name, block))
                left_out = block["left_out"].items()
                not_run += [f"{one.name}, {ask.name}, {m}: {name} was not run: {why}" for m, why in left_out]
        several = len({form for form, _ in forms}) > 1
        for (form, _), found in forms.items():
            task = f"{one.name}: {ask.name}{f' ({form})' if several else ''}"
            records = []
            # Controls are the same in all results, but that some lack ImageNet's weights: those of one are shown.
            told = [{r["source"]: r["sums"] for r in b["records"] if r["modality"] == "none"} for _, b in found]
            if any(sums != told[0] for sums in told):
                names = " and ".join(name for name, _ in found)
                wrong = min(k for sums in told for k in sums.keys() | told[0].keys() if sums.get(k) != told[0].get(k))
                raise ValueError(f"{task}: the control {wrong} differs between {names}, of the same rows")
            shown = next((b for _, b in found if any(r["source"] == "imagenet" for r in b["records"])), found[0][1])
            known = {_key(record): record["sums"] for record in shown["records"] if record["source"]}
            for name, block in found:
                if others := {k[0] for r in block["records"] if known.get(k := _key(r), r["sums"]) != r["sums"]}:
                    text = f"{task}: {', '.join(sorted(others))} of the result of {name} differ from those shown"
                    differ.append(f"{text}: that result was made on another machine, or edited.")
                mine = records_of(block, results[name]["encoder"])
                records += [r for r in mine if r["source"] == name or block is shown]
            rows += _rows(task, found[0][1]["group_by"], records, suite.probes[0], ask)
    return Board(results, rows, not_run, differ)


def _key(record: dict[str, Any]) -> tuple[Any, ...]:
    return record["source"], record["modality"], record["probe"], record["seed"]


def _rows(task: str, by: str, records: list[dict[str, Any]], probe: str, ask: SuiteTask) -> list[Row]:
    records = [{**r, "source": GUESS} if r["source"] in ("majority", "mean") else r for r in records]
    found, cells = summarise(records, probe)[ask.name], by_cell(records, probe)
    shares = {}
    for share in sorted(ask.labels):
        kind = few_labels.name(100 * share)
        shares[share] = summarise([r for r in records if r["probe"] == kind], kind).get(ask.name, {})
    rows, none = [], found.pop("none", {})
    for modality in (m for m in ask.modalities if m in found):
        own = {**none, **found[modality]}
        lists = {name: cells.get((ask.name, modality, name)) or cells[ask.name, "none", name] for name in own}
        few = {n: {s: at[modality][n] for s, at in shares.items() if n in at.get(modality, ())} for n in own}
        whole = {name: {**line, 1.0: own[name]} for name, line in few.items() if line}
        rows.append(Row(task, tested_on({modality: own}, by), modality, lists, own, whole))
    return rows


def order_of(row: Row, names: Sequence[str]) -> str:
    """Encoders that saw no test rows, best first: '>' where a step's paired 95 % interval excludes 0, '≈' where not."""
    clean = [name for name in names if name in row.cells and row.cells[name].get("leak", "") in ("", UNKNOWN)]
    found = sorted(clean, key=lambda name: -row.cells[name]["mean"])
    text = ""
    for ours, theirs in pairwise(found):
        mean, low, high, _ = paired_difference(row.records[ours], row.records[theirs])
        sign = ">" if low > 0 else "≈"
        text += f"{ours} {percent(row.cells[ours]['mean'])} {sign} ({percent(mean)} [{percent(low)}, {percent(high)}]) "
    left_out = [name for name in names if name in row.cells and name not in clean]
    text += f"{found[-1]} {percent(row.cells[found[-1]]['mean'])}" if found else "no encoder without a leak"
    return text + (f"; not ordered because of LEAK: {', '.join(left_out)}" if left_out else "")


GLANCE = """Accuracy, or R2 of values, in percent. The shade rises from the untrained trunk to the best of its column. L:
LEAK or LEAK?, see below. Encoders come first, by their mean rank; controls stand below the line."""
SCORES = """Mean and 95 % interval over test groups (and seeds, where an encoder has several), in percent: accuracy, or R2
of values. Encoders come first, by their mean rank, which is for reading only: the order of each task is below. An empty
cell was not run."""
ORDER = """'>' means that the 95 % interval of the difference to the next encoder, paired over test groups, excludes 0; '≈'
that this order is not resolved. If either has one seed, the interval leaves out the variation between seeds.
Differences are in points, not corrected for the number of comparisons."""
LEAKS = """Leaks compare the rows and groups that an encoder was trained on with the test rows, where a list of them came
with the encoder. LEAK? stands where there is none, and no list of its training data is given either."""
DATA = """Rows with another digest are never compared. 'same': the images, too, are those that the suite was measured on.
'other pixels', 'other rows': made or decoded on another machine. 'not pinned': the suite has no digest of this form."""


def _page(board: Board) -> str:
    suite = suite_of(next(iter(board.results.values())))
    probes = dict.fromkeys(probe_name(suite.probes[0], row.score) for row in board.rows)
    chips = {"definition": suite.digest()[:12], "encoders": len(board.results), "probe": " or ".join(probes)}
    head = page.head(suite.name, "mvitac bench", chips, suite.title)
    orders = [[f"{row.task}, {row.modality}", order_of(row, board.encoders)] for row in board.rows]
    few = [row for row in board.rows if row.few]
    drawn = page.image(to_svg(_glance(board)), "scores of encoders and controls; the numbers are in the table")
    sections = [
        ("glance", "At a glance", [page.paragraph(" ".join(GLANCE.split())), page.grid([page.figure(drawn)], "wide")]),
        ("scores", "Scores", _scores(board)),
        *([("labels", "Few labels", _few(board, few))] if few else []),
        ("order", "Order", _text_table(ORDER, ["", "from best to worst"], orders)),
        ("encoders", "Encoders and leaks", _encoders(board)),
        ("data", "Data", _data(board)),
    ]
    foot = "Made by mvitac bench board. The digest of a result shows changes; it does not prove who measured it."
    return str(page.page(f"mvitac bench: {suite.name}", head, sections, foot))


def _text_table(intro: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[Markup]:
    return [page.paragraph(" ".join(intro.split())), page.table(columns, rows, words=True, label=columns[1])]


def _scores(board: Board) -> list[Markup]:
    columns, rows, errors, above = [*board.encoders, *board.controls[::-1]], [], [], ""
    for row in board.rows:
        if row.task != above:
            rows.append([f"{(above := row.task)} ({row.about})"])
        cells = [row.cells.get(name) for name in columns]
        shown = [with_interval(c["mean"], c["low"], c["high"], c.get("leak", "")) if c else "" for c in cells]
        rows.append([f"{row.modality}{', R2' * (row.score == 'R2')}", *shown])
        for t, target in enumerate(next(filter(None, cells)).get("targets", ())):
            what = f"{row.task}, {row.modality}: {target['name']} ({target['unit']})"
            errors.append([what, *(f"{c['targets'][t]['mae']:.3g}" if c else "" for c in cells)])
    intro = [page.paragraph(text) for text in (" ".join(SCORES.split()), *board.differ)]
    found = [*intro, page.table(["", *columns], rows, label="scores")]
    table = page.table(["", *columns], errors, label="errors")
    return [*found, page.fold("Mean absolute errors in their units", table)] if errors else found


def _encoders(board: Board) -> list[Markup]:
    columns = ["", "leak", "parameters", "images seen", "licence", "trained on", "notes"]
    columns += ["seeds, input", "weights", "versions"]
    rows = []
    for name in board.encoders:
        result, encoder = board.results[name], board.results[name]["encoder"]
        sizes = ", ".join(f"{m} {num / 1e6:.1f} M" for m, num in encoder["parameters"].items())
        seen = "not known" if encoder["images_seen"] is None else f"{encoder['images_seen']:,}"
        notes = dict.fromkeys(note for block in result["blocks"] for note in block.get("notes", ()))
        known = [*(encoder[key] or "not given" for key in ("licence", "trained_on")), "; ".join(notes)]
        read = f"{', '.join(map(str, encoder['seeds']))}; {encoder['size']} px"
        versions = ", ".join(f"{library} {result['versions'].get(library, '')}" for library in ("mvitac", "torch"))
        weights = ", ".join(one[:12] for one in encoder["weights"])
        rows.append([name, _leaks(result), sizes, seen, *known, read, weights, versions])
    return _text_table(LEAKS, columns, rows)


def _leaks(result: dict[str, Any]) -> str:
    marks: dict[str, list[str]] = {}
    for block in result["blocks"]:
        for leak in dict.fromkeys(block.get("leaks", ())):
            marks.setdefault(leak, []).append(f"{block['set']}, {block['task']}")
    found = [f"LEAK: {leak}: {'; '.join(tasks)}" for leak, tasks in marks.items() if leak not in ("", UNKNOWN)]
    return ". ".join([*found, *(["LEAK? not known"] if UNKNOWN in marks else [])]) or "none found"


@matplotlib.rc_context(STYLE)
def _glance(board: Board) -> Figure:
    """All scores as one picture. The shade of a column goes from its untrained row, or its lowest, to its best score."""
    names, rows = [*board.encoders, *board.controls[::-1]], board.rows
    scores = np.array([[row.cells[n]["mean"] if n in row.cells else np.nan for row in rows] for n in names])
    lowest = zip(rows, np.nanmin(scores, 0), strict=True)
    least = [row.cells.get("untrained", {"mean": low})["mean"] for row, low in lowest]
    shades = np.clip((scores - least) / np.maximum(np.nanmax(scores, 0) - least, 1e-9), 0, 1)
    figure, axes = new_figure("", 2.2 + 0.3 * len(names), 3 + 0.6 * len(rows))
    axes.imshow(shades, cmap=LinearSegmentedColormap.from_list("", ["white", COLOURS["blue"]]), aspect="auto", vmax=1.6)
    for (line, column), score in np.ndenumerate(scores):
        if np.isfinite(score):
            leak = leak_mark(rows[column].cells[names[line]].get("leak", ""))
            axes.text(column, line, f"{round(100 * score)}{'L' * bool(leak)}", ha="center", va="center", fontsize=11)
    axes.set_yticks(range(len(names)), names)
    axes.set_xticks(range(len(rows)), [f"{r.task}, {r.modality}" for r in rows], rotation=50, ha="left")
    axes.tick_params(labelsize=11, top=True, labeltop=True, bottom=False, labelbottom=False, length=0)
    axes.axhline(len(board.encoders) - 0.5, color=COLOURS["ink"], linewidth=0.8)
    axes.spines[:].set_visible(False)
    return figure


def _few(board: Board, rows: Sequence[Row]) -> list[Markup]:
    names = [*board.encoders, *board.controls[::-1]]
    found = []
    for row in rows:
        found.append([f"{row.task}, {row.modality}{', R2' * (row.score == 'R2')}"])
        for share in dict.fromkeys(share for line in row.few.values() for share in line):
            cells = [row.few.get(name, {}).get(share) for name in names]
            found.append([f"{100 * share:g} % of labels", *(percent(c["mean"]) if c else "" for c in cells)])
    return [page.table(["", *names], found, label="few labels")]


def _data(board: Board) -> list[Markup]:
    rows: dict[tuple[str, str, str], dict[str, None]] = {}
    for name, result in board.results.items():
        for block in (block for block in result["blocks"] if "not_run" not in block):
            key = (block["set"], block["form"], block["data"]["rows"][:12])
            rows.setdefault(key, {})[f"{name} ({pinned_of(suite_of(result), block)})"] = None
    table = _text_table(DATA, ["", "form", "digest of rows", "results"], [[*k, ", ".join(v)] for k, v in rows.items()])
    lost = page.fold(f"{len(board.not_run)} tasks that were not run", page.code("\n".join(board.not_run)))
    return [*table, lost] if board.not_run else table
