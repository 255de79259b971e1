"""The table of a comparison as Markdown, LaTeX, CSV and a figure."""

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tabulate import SEPARATING_LINE, tabulate

from mvitac.evaluation.encoders import about_lines
from mvitac.evaluation.intervals import least_p, num_groups_of
from mvitac.evaluation.leaks import leak_mark
from mvitac.evaluation.score_text import covered, error_text, percent, pipes, with_interval
from mvitac.evaluation.scores import by_cell
from mvitac.experiments.plan import Plan
from mvitac.experiments.table import Cell, Line, as_printed, lines_of, target_lines
from mvitac.registry import from_json
from mvitac.report.figures import Dot, comparison, to_png
from mvitac.report.tables import RETRIEVAL, probe_name, retrieval_rows
from mvitac.system.files import write_atomic, write_json


def write_tables(result: dict[str, Any], out: Path) -> list[Path]:
    """Write result.json, table.md, table.tex, table.csv and table.png into ``out``; returns their paths."""
    lines = lines_of(result)
    write_json(out / "result.json", result)
    texts = {"table.md": markdown(result, lines), "table.tex": latex(result, lines), "table.csv": comma(result)}
    for name, text in texts.items():
        write_atomic(out / name, lambda file, text=text: file.write(text.encode()))
    write_atomic(out / "table.png", lambda file: file.write(figure(result, lines)))
    return [out / name for name in ("table.md", "table.tex", "table.csv", "table.png", "result.json")]


def _plan(result: dict[str, Any]) -> Plan:
    return from_json(Plan, result["plan"], "plan")


def markdown(result: dict[str, Any], lines: Sequence[Line]) -> str:
    """The whole comparison as Markdown: what was compared, the tables, AUROC, retrieval and cost."""
    plan = _plan(result)
    shown = any(cell["printed"] is not None for line in lines for cell in line.cells.values())
    text = [f"# {plan.title or plan.name}", "", *_preface(result, plan, lines, shown), ""]
    text += _table(lines, plan.reference, shown)
    for task, each in target_lines(result).items():
        rows = _table(each, plan.reference, False, targets=True)
        text += [f"**{task}**: every target, and its mean absolute error", "", *rows]
    text += _auroc(result, plan, lines)
    if rows := retrieval_rows(result["retrieval"]):
        text += pipes(["retrieval", "", *(f"{name} %" for name in RETRIEVAL)], rows)
    text += _cost(result)
    return "\n".join(text).rstrip() + "\n"


def _first_cells(line: Line) -> list[str]:
    """The row's name and modality; controls are in italics."""
    return [f"*{line.source}*" if line.control else line.source, "" if line.modality == "none" else line.modality]


def _table(lines: Sequence[Line], reference: str, shown: bool, *, targets: bool = False) -> list[str]:
    """Lines as a Markdown table, with the paper's numbers if ``shown``, and the error of ``targets``."""
    heads, rows = ["", "modality"], [_first_cells(line) for line in lines]
    for task, score in _columns(lines).items():
        heads += [f"{task} {'R2 ' * (score == 'R2')}%", *["error"] * targets, *["printed"] * shown, f"to {reference}"]
        for line, row in zip(lines, rows, strict=True):
            cell = line.cells.get(task, {})
            row.append(with_interval(cell["mean"], cell["low"], cell["high"], cell.get("leak", "")) if cell else "")
            if targets:
                row.append(error_text(cell["targets"][0]) if cell else "")
            if shown:
                row.append("" if cell.get("printed") is None else percent(cell["printed"]))
            row.append(_gap(cell))
    return pipes(heads, rows)


def _columns(lines: Sequence[Line]) -> dict[str, str]:
    """What each column scores: task or target -> "accuracy" or "R2"."""
    return {t: "R2" if "targets" in cell else "accuracy" for line in lines for t, cell in line.cells.items()}


def _gap(cell: Cell) -> str:
    if not cell or cell["difference"] is None:
        return ""
    mean, _, _, p = cell["difference"]
    return f"{100 * mean:+.1f}" if p is None else f"{100 * mean:+.1f} (p {_p(p)})"


def _p(p: float) -> str:
    return f"{p:.3f}" if p >= 0.0005 else "< .001"


def _preface(result: dict[str, Any], plan: Plan, lines: Sequence[Line], shown: bool) -> list[str]:
    """Paragraphs about data, budget, statistics, and everything that limits the comparison."""
    seeds = max((c["seeds"] for c in result["cost"]), default=0)
    text = [
        f"Data {result['data']} (pack {result['pack'][:12]}), recipe {plan.recipe}, {seeds} seed{'s' * (seeds != 1)},"
        f" {_budget(result)}; {_probes(result, plan)} on frozen features;"
        f" {_made(result)}.",
        f"95 % intervals: {covered(result['group_by'], result['records'])}. {_significance(result, plan, lines)}"
        " Controls are in italics.",
    ]
    if plan.folds:
        unseen = "" if result["leaks"] else ", by encoders and probes that never saw it"
        folds = f"{len(plan.folds)} fold{'s' * (len(plan.folds) > 1)}"
        text.append(f"{folds}: every test {result['group_by']} is scored once{unseen}.")
    if shown:
        text.append(f'"printed" is the paper\'s number on {plan.printed_on}, by the same probe and positives.')
    elif as_printed(result, plan) and plan.probes[0] != "paper":
        text.append("The paper's numbers are of its own probe: `--probes paper` shows them.")
    text += [f"Note: {note}." for note in _notes(result)]
    if result["leaks"]:
        text.append(f"**LEAK: {result['leaks']}.**")
    text += [f"Diverged: {name} ({error})." for name, error in result["failed"].items()]
    text += [f"Left out: {label} ({reason})." for label, reason in result["left_out"].items()]
    if result["unfinished"]:
        text.append(f"**Not finished: {', '.join(result['unfinished'])}.**")
    return [line for part in text for line in (part, "")][:-1]


def _probes(result: dict[str, Any], plan: Plan) -> str:
    """The probes of the main table: those of classes and of values."""
    scores = ("R2" if "targets" in record else "accuracy" for record in result["records"])
    return " or ".join(dict.fromkeys(probe_name(plan.probes[0], score) for score in scores))


def _significance(result: dict[str, Any], plan: Plan, lines: Sequence[Line]) -> str:
    """What p is, and its smallest possible value for each task."""
    if all((cell["difference"] or [None])[-1] is None for line in lines for cell in line.cells.values()):
        return f"Differences to {plan.reference} have no p, which needs several seeds."
    groups = {record["task"]: num_groups_of(record) for record in result["records"]}
    least = ", ".join(f"{task} {_p(least_p(num))} ({num} {result['group_by']}s)" for task, num in groups.items())
    return (
        f"p is of the difference to {plan.reference} on the same test rows, where both have several seeds, not corrected"
        f" for the number of rows. Smallest possible p: {least}."
    )


def _notes(result: dict[str, Any]) -> list[str]:
    """Notes of the data, and the runs whose precision differs from that of most runs."""
    precisions: dict[str, str] = result["run_precisions"]  # by name of the run
    notes = list(result["notes"])
    if len(set(precisions.values())) > 1:
        most, *others = [precision for precision, _ in Counter(precisions.values()).most_common()]
        runs = {other: ", ".join(repr(name) for name in precisions if precisions[name] == other) for other in others}
        different = " and of ".join(f"{names} in {other}" for other, names in runs.items())
        notes.append(f"the networks of {different}, those of all other runs in {most}")
    return notes


def _budget(result: dict[str, Any]) -> str:
    steps = {(c["steps"], c["pairs"]) for c in result["cost"]}
    budget = "budgets differ (see cost)"
    if len(steps) == 1:
        num, pairs = next(iter(steps))
        budget = f"equal budget: every run saw {pairs} pairs in {num} steps"
    if len({c["pairs_of"] for c in result["cost"]}) > 1:
        budget += ", **pairs are not from the same rows (see cost)**"
    return budget


def _made(result: dict[str, Any]) -> str:
    """Commits and devices of the runs, and the commit of the tables if it differs."""

    def short(commit: str | None) -> str:
        return f"{commit[:12]}{'+' * commit.endswith('+')}" if commit else "unknown"  # +: with local changes

    tables = short(result["commit"])
    runs = list(dict.fromkeys(short(commit) for commit in result["run_commits"]))
    code = f"code {tables}" if runs == [tables] else f"runs at commits {', '.join(runs)}; tables at {tables}"
    return ", ".join([code, *result["run_devices"]])


def _auroc(result: dict[str, Any], plan: Plan, lines: Sequence[Line]) -> list[str]:
    """AUROC of tasks with two classes in percent: mean over seeds (and folds), lowest and highest."""
    records = by_cell(result["records"], plan.probes[0])
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for line in lines:
        for task in line.cells:
            values = [r["auroc"] for r in records[task, line.modality, line.source] if r.get("auroc") is not None]
            if values and line.source != "majority":
                spread = f" ({percent(min(values))}-{percent(max(values))})" if len(values) > 1 else ""
                row = found.setdefault(tuple(_first_cells(line)), {})
                row[task] = f"{percent(sum(values) / len(values))}{spread}"
    if not found:
        return []
    tasks = list(dict.fromkeys(task for row in found.values() for task in row))
    rows = [[*first, *(row.get(task, "") for task in tasks)] for first, row in found.items()]
    return pipes(["AUROC %", "modality", *tasks], rows)


def _cost(result: dict[str, Any]) -> list[str]:
    heads = ["cost of one run", "from", "seeds", "steps", "pairs", "images seen", "trained weights", "seconds"]
    rows = []
    for c in result["cost"]:
        peak = f"{c['peak_gpu_bytes'] / 2**20:.0f}" if c["peak_gpu_bytes"] else "not measured"
        numbers = [f"{c[key]}" for key in ("seeds", "steps", "pairs", "images")]
        weights = f"{c['trained_parameters'] / 1e6:.2f} M"
        rows.append([c["row"], c["pairs_of"], *numbers, weights, f"{c['seconds']:.0f}", peak])
    text = pipes([*heads, "peak GPU MiB"], rows)
    return [*text, *(f"- {line}" for line in about_lines(result["encoders"]))]


NAMES = {"touch": "Tactile", "vision": "Visual", "both": "Tactile + Visual", "none": "-"}


def latex(result: dict[str, Any], lines: Sequence[Line]) -> str:
    """A booktabs table in the paper's layout: method, modality, score per task, the paper's in parentheses.

    A further table for each task with values has its targets.
    """
    plan = _plan(result)
    tables = [_tabular(lines)]
    for task, each in target_lines(result).items():
        tables.append(f"% {task}: every target, and its mean absolute error\n{_tabular(each, targets=True)}")
    note = f"% {plan.title or plan.name}; data {result['data']}"
    if any(cell["printed"] is not None for line in lines for cell in line.cells.values()):
        note += f"; in parentheses: printed in the paper on {plan.printed_on}"
    intervals = f"% 95 % intervals: {covered(result['group_by'], result['records'])}"
    notes = [note, *(f"% Note: {note}." for note in _notes(result)), intervals]
    if result["leaks"]:
        notes.append(f"% LEAK: {result['leaks']}.")
    return "\n".join([*(" ".join(line.split()) for line in notes), "\n\n".join(tables)]) + "\n"


def _tabular(lines: Sequence[Line], *, targets: bool = False) -> str:
    """Lines as one LaTeX table, with the error of ``targets``; controls are below a rule."""
    heads, rows = ["Method", "Modality"], [[line.source, NAMES[line.modality]] for line in lines]
    for task, score in _columns(lines).items():
        heads += [f"{task} ({'R2, ' * (score == 'R2')}%)", *["error"] * targets]
        for line, row in zip(lines, rows, strict=True):
            row.append(_tex_cell(line, task, lines))
            if targets:
                row.append(error_text(line.cells[task]["targets"][0]) if task in line.cells else "")
    num = sum(not line.control for line in lines)
    shown = [*rows[:num], *([SEPARATING_LINE] if 0 < num < len(rows) else ()), *rows[num:]]
    align = ["left", "left", *["right"] * (len(heads) - 2)]
    text = tabulate(shown, heads, "latex_booktabs", disable_numparse=True, colalign=align)
    return re.sub(r"\*\*(.*?)\*\*", r"\\textbf{\1}", text).replace("(R2, ", "($R^2$, ")


def _tex_cell(line: Line, task: str, lines: Sequence[Line]) -> str:
    """A score and its interval; the best method of a modality is bold, between asterisks."""
    cell = line.cells.get(task)
    if cell is None:
        return ""
    best = max(x.cells[task]["mean"] for x in lines if x.modality == line.modality and task in x.cells)
    number, _, ends = with_interval(cell["mean"], cell["low"], cell["high"]).partition(" ")
    number = f"**{number}**" if not line.control and cell["mean"] == best else number
    paper = f" ({percent(cell['printed'])})" if cell["printed"] is not None else ""
    return f"{number} {ends}{paper}{leak_mark(cell.get('leak', ''))}"


def comma(result: dict[str, Any]) -> str:
    """Every cell of every probe as one CSV line, in 0 .. 1. A source with one probe (majority) appears once.

    If there are tasks with values, further columns name the score and the target, with its unit and errors. A line without
    a target is the mean over targets.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    heads = ("row", "control", "probe", "modality", "task", "accuracy", "low", "high", "seeds", "printed")
    values = any("targets" in record for record in result["records"])
    more = ("score", "target", "unit", "mae", "rmse") if values else ()
    writer.writerow((*heads, "difference", "difference_low", "difference_high", "p", "leak", *more))
    probes = _plan(result).probes
    tables = [("", probe, lines_of(result, probe)) for probe in probes]
    tables += [(task, probe, lines) for probe in probes for task, lines in target_lines(result, probe).items()]
    scored: dict[tuple[str, str], dict[str, None]] = {}  # source and task -> its probes
    for record in result["records"]:
        scored.setdefault((record["source"], record["task"]), {})[record["probe"]] = None
    written: set[tuple[str, ...]] = set()
    for whole, table, lines in tables:
        for line in lines:
            for name, cell in line.cells.items():
                known = scored[line.source, task := whole or name]
                key = line.source, table if table in known else next(iter(known)), line.modality, task, name
                if key not in written:
                    written.add(key)
                    writer.writerow(_csv_row(key, cell, line.control, bool(whole))[: len(heads) + 5 + len(more)])
    return buffer.getvalue()


def _csv_row(key: Sequence[str], cell: Cell, control: bool, target: bool) -> list[Any]:
    """One line of the CSV. An interval without an end is empty."""
    source, probe, modality, task, name = key
    seeds, gap = max(1, len(cell["seeds"])), cell["difference"] or ("",) * 4
    numbers = [cell["mean"], cell["low"], cell["high"], seeds, cell["printed"], *gap]
    ends = ["" if value in (math.inf, -math.inf) else value for value in numbers]
    about = [name, *(cell["targets"][0][key] for key in ("unit", "mae", "rmse"))] if target else [""] * 4
    score = "R2" if "targets" in cell else "accuracy"
    return [source, int(control), probe, modality, task, *ends, cell.get("leak", ""), score, *about]


def figure(result: dict[str, Any], lines: Sequence[Line]) -> bytes:
    """The table as a PNG (``figures.comparison``)."""
    panels: dict[str, list[Dot]] = {}
    for line in lines:
        for task, cell in line.cells.items():
            panels.setdefault(task, []).append(Dot(line.source, line.modality, line.control, cell))
    return to_png(comparison(panels), dpi=110)
