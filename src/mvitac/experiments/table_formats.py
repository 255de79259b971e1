"""The table of a comparison as Markdown, LaTeX and CSV."""

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tabulate import tabulate

from mvitac.evaluation.intervals import least_p, num_groups_of
from mvitac.evaluation.score_text import covered, error_text, percent, pipes, with_interval
from mvitac.experiments.plan import Plan, dotted
from mvitac.experiments.table import Line, as_printed, lines_of, plan_of, target_lines
from mvitac.report.tables import RETRIEVAL, probe_name, retrieval_rows
from mvitac.system.files import write_atomic, write_json

TARGETS = "every target, and its mean absolute error"


def write_tables(result: dict[str, Any], out: Path) -> list[Path]:
    """Write result.json, table.md, table.tex and table.csv into ``out``; returns their paths, the Markdown's first."""
    write_json(out / "result.json", result)
    lines = lines_of(result)
    texts = {"md": markdown(result, lines), "tex": latex(result, lines), "csv": comma(result)}
    for kind, text in texts.items():
        write_atomic(out / f"table.{kind}", lambda file, text=text: file.write(text.encode()))
    return [*(out / f"table.{kind}" for kind in texts), out / "result.json"]


def markdown(result: dict[str, Any], lines: Sequence[Line]) -> str:
    """The whole comparison as Markdown: what was compared, the tables, retrieval and cost."""
    plan = plan_of(result)
    text = ["\n\n".join([f"# {plan.title or plan.name}", *_preface(result, plan, lines)])]
    for task, heads, rows in _tables(result, lines):
        text += [f"**{task}**: {TARGETS}"] * bool(task) + ["", *pipes(heads, rows)]
    if rows := retrieval_rows(result["retrieval"]):
        text += pipes(["retrieval", "", *(f"{name} %" for name in RETRIEVAL)], rows)
    heads = ["cost of one run", "from", "seeds", "steps", "pairs", "images encoded", "trained weights", "seconds"]
    rows = []
    for c in result["cost"]:
        numbers = [str(c[key]) for key in ("row", "pairs_of", "seeds", "steps", "pairs", "images")]
        rows.append([*numbers, f"{c['trained_parameters'] / 1e6:.2f} M", f"{c['seconds']:.0f}"])
    # Names of the data are no HTML.
    return re.sub("<(?=[A-Za-z/!])", "&lt;", "\n".join([*text, *pipes(heads, rows)]).rstrip() + "\n")


def _tables(result: dict[str, Any], lines: Sequence[Line]) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Task, heads and rows: of the table of all tasks (named ""), then of the targets of each task with values."""
    reference = plan_of(result).reference
    yield "", *_table(lines, reference, _any_printed(lines), targets=False)
    for task, each in target_lines(result).items():
        yield task, *_table(each, reference, False, targets=True)


def _any_printed(lines: Sequence[Line]) -> bool:
    return any(cell["printed"] is not None for line in lines for cell in line.cells.values())


def _table(lines: Sequence[Line], reference: str, shown: bool, *, targets: bool) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of a table of ``lines``, with the paper's numbers if ``shown``, and the error of ``targets``."""
    heads, rows = ["", "modality"], []
    for line in lines:
        name = f"*{line.source}*" if line.control else line.source  # in italics
        rows.append([name, "" if line.modality == "none" else line.modality])
    scores = {t: "R2" if "targets" in cell else "accuracy" for line in lines for t, cell in line.cells.items()}
    for task, score in scores.items():
        heads += [f"{task} {'R2 ' * (score == 'R2')}%", *["error"] * targets, *["printed"] * shown, f"to {reference}"]
        for line, row in zip(lines, rows, strict=True):
            if cell := line.cells.get(task):
                paper = "" if cell["printed"] is None else percent(cell["printed"])
                row.append(with_interval(cell["mean"], cell["low"], cell["high"], cell.get("leak", "")))
                row += [*([error_text(cell["targets"][0])] if targets else ()), *[paper] * shown, _gap(cell)]
            else:
                row += [""] * (2 + targets + shown)
    return heads, rows


def _gap(cell: dict[str, Any]) -> str:
    if cell["difference"] is None:
        return ""
    mean, *_, p = cell["difference"]
    return f"{100 * mean:+.1f}" if p is None else f"{100 * mean:+.1f} (p {_p(p)})"


def _p(p: float) -> str:
    return f"{p:.3f}" if p >= 0.0005 else "< .001"


def _preface(result: dict[str, Any], plan: Plan, lines: Sequence[Line]) -> list[str]:
    seeds = max((c["seeds"] for c in result["cost"]), default=0)
    scores = dict.fromkeys("R2" if "targets" in record else "accuracy" for record in result["records"])
    bare = any("[" not in with_interval(c["mean"], c["low"], c["high"]) for line in lines for c in line.cells.values())
    few = f" Too few test {result['group_by']}s for some intervals." * bare
    probes = " or ".join(dict.fromkeys(probe_name(plan.probes[0], score) for score in scores))
    text = [
        f"Data {result['data']} (pack {result['pack'][:12]}), recipe {plan.recipe}, {seeds} seed{'s' * (seeds != 1)},"
        f" {_budget(result)}; {probes} on frozen features; {_made(result)}.",
        f"95 % intervals: {covered(result['group_by'], result['records'])}. {_significance(result, plan, lines)}"
        f" Controls are in italics.{few}",
    ]
    if plan.folds:
        unseen = "" if result["leaks"] else ", by encoders and probes that never saw it"
        folds = f"{len(plan.folds)} fold{'s' * (len(plan.folds) > 1)}"
        text.append(f"{folds}: every test {result['group_by']} is scored once{unseen}.")
    if _any_printed(lines):
        text.append(f'"printed" is the paper\'s number on {plan.printed_on}, by the same probe and positives.')
    elif as_printed(result, plan) and plan.probes[0] != "paper":
        text.append("The paper's numbers are of its own probe: `--probes paper` shows them.")
    text += [f"Note: {note}." for note in _notes(result)]
    text += [f"**LEAK: {result['leaks']}.**"] if result["leaks"] else []
    text += [f"Diverged: {name} ({error})." for name, error in result["failed"].items()]
    text += [f"Left out: {label} ({reason})." for label, reason in result["left_out"].items()]
    return text + ([f"**Not finished: {', '.join(result['unfinished'])}.**"] if result["unfinished"] else [])


def _significance(result: dict[str, Any], plan: Plan, lines: Sequence[Line]) -> str:
    """What p is, and its smallest possible value for each task."""
    if all((cell["difference"] or [None])[-1] is None for line in lines for cell in line.cells.values()):
        return f"Differences to {plan.reference} have no p, which needs several seeds."
    groups = {record["task"]: num_groups_of(record) for record in result["records"]}
    least = ", ".join(f"{task} {_p(least_p(num))} ({result['group_by']}s: {num})" for task, num in groups.items())
    return (
        f"p is of the difference to {plan.reference} on the same test rows, where it has several seeds, not corrected for"
        f" the number of rows. Smallest possible p: {least}."
    )


def _notes(result: dict[str, Any]) -> list[str]:
    precisions: dict[str, str] = result["run_precisions"]  # by name of the run
    if len(set(precisions.values())) < 2:
        return result["notes"]
    most, *others = [precision for precision, _ in Counter(precisions.values()).most_common()]
    runs = {other: ", ".join(repr(name) for name in precisions if precisions[name] == other) for other in others}
    different = " and of ".join(f"{names} in {other}" for other, names in runs.items())
    return [*result["notes"], f"the networks of {different}, those of all other runs in {most}"]


def _budget(result: dict[str, Any]) -> str:
    budgets = {(c["pairs"], c["steps"]) for c in result["cost"]}
    text = "budgets differ (see cost)"
    if len(budgets) == 1:
        text = "equal budget: every run saw {} pairs in {} steps".format(*budgets.pop())
    fields = ((row.label, name) for row in plan_of(result).rows for name, _ in dotted(row.set))
    begun = dict.fromkeys(label for label, name in fields if name.startswith("init") or name.endswith("weights"))
    text += f"; not counted is what the weights that {', '.join(begun)} started from had seen" * bool(begun)
    same_rows = len({c["pairs_of"] for c in result["cost"]}) < 2
    return text if same_rows else f"{text}, **pairs are not from the same rows (see cost)**"


def _made(result: dict[str, Any]) -> str:
    tables, *runs = (
        f"{commit[:12]}{'+' * commit.endswith('+')}" if commit else "unknown"  # +: with local changes
        for commit in (result["commit"], *result["run_commits"])
    )
    runs = list(dict.fromkeys(runs))
    code = f"code {tables}" if runs == [tables] else f"runs at commits {', '.join(runs)}; tables at {tables}"
    return ", ".join([code, *result["run_devices"]])


def latex(result: dict[str, Any], lines: Sequence[Line]) -> str:
    """The tables of ``markdown`` in LaTeX (booktabs), after comments about the data, the intervals and leaks."""
    plan = plan_of(result)
    notes = [f"{plan.title or plan.name}; data {result['data']}"]
    notes += [f"printed: in the paper on {plan.printed_on}"] if _any_printed(lines) else []
    notes += [f"Note: {note}." for note in _notes(result)]
    notes.append(f"95 % intervals: {covered(result['group_by'], result['records'])}")
    notes += [f"LEAK: {result['leaks']}."] if result["leaks"] else []
    each = _tables(result, lines)
    tables = [f"% {task}: {TARGETS}\n" * bool(task) + _tabular(heads, rows) for task, heads, rows in each]
    return "\n".join([*(f"% {' '.join(note.split())}" for note in notes), "\n\n".join(tables)]) + "\n"


def _tabular(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    align = ["left", "left", *["right"] * (len(heads) - 2)]
    text = tabulate(rows, heads, "latex_booktabs", disable_numparse=True, colalign=align)
    text = re.sub(r"(?m)^ *\*(.*?)\*", r" \\textit{\1}", text).replace("|", r"\textbar{}")  # controls
    return re.sub(r"(?m)^ *\[", " {}[", text)  # else an option of the line break before


def comma(result: dict[str, Any]) -> str:
    """Every cell of every probe as one CSV line, in 0 .. 1. A source with one probe (majority) appears once.

    Of values, the last columns name the target, with its unit and errors. A line without one is the mean over targets.
    """
    probes: dict[tuple[str, str], list[str]] = {}  # of a source and a task
    for record in result["records"]:
        probes.setdefault((record["source"], record["task"]), []).append(record["probe"])
    asked = plan_of(result).probes
    tables = [("", probe, lines_of(result, probe)) for probe in asked]
    tables += [(task, probe, lines) for probe in asked for task, lines in target_lines(result, probe).items()]
    rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for whole, probe, lines in tables:
        for line in lines:
            for name, cell in line.cells.items():
                known = probes[line.source, whole or name]
                key = line.source, probe if probe in known else known[0], line.modality, whole or name, name
                rows.setdefault(key, _csv_row(key, cell, line.control, bool(whole)))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, next(iter(rows.values())), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows.values())
    return buffer.getvalue()


def _csv_row(key: Sequence[str], cell: dict[str, Any], control: bool, target: bool) -> dict[str, Any]:
    source, probe, modality, task, name = key
    row = {"row": source, "control": int(control), "probe": probe, "modality": modality, "task": task}
    row |= {"accuracy": cell["mean"], "low": cell["low"], "high": cell["high"], "seeds": max(1, len(cell["seeds"]))}
    gap = zip(("difference", "difference_low", "difference_high", "p"), cell["difference"] or ("",) * 4, strict=True)
    row |= {"printed": cell["printed"], **dict(gap), "leak": cell.get("leak", "")}
    row |= {"score": "R2" if "targets" in cell else "accuracy", "target": name if target else ""}
    row |= {key: cell["targets"][0][key] if target else "" for key in ("unit", "mae", "rmse")}
    return {name: "" if value in (math.inf, -math.inf) else value for name, value in row.items()}
