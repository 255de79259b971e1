"""The table of a comparison as Markdown, LaTeX, CSV and a figure."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mvitac.evaluation.scores import least_p
from mvitac.experiments.plan import Plan
from mvitac.experiments.table import Cell, Line, _by_cell, lines_of, stresses_of
from mvitac.registry import from_json
from mvitac.report.tables import MODALITY_ORDER, PROBE_NAMES, retrieval_means
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


# -- Markdown ---------------------------------------------------------------------------------------------------------


def markdown(result: dict[str, Any], lines: Sequence[Line]) -> str:
    """The whole comparison as Markdown: what it is, the table, retrieval, cost."""
    plan: Plan = from_json(Plan, result["plan"], "plan")
    shown = any(cell.printed is not None for line in lines for cell in line.cells.values())
    text = [f"# {plan.title or plan.name}", "", *_preface(result, plan, shown), ""]
    text += _table(lines, plan.reference, shown)
    for kind, worse in stresses_of(result).items():
        text += [f"**{kind}**", "", *_table(worse, plan.reference, False)]
    text += [*_auroc(result, plan, lines), *_retrieval(result), *_cost(result)]
    return "\n".join(text).rstrip() + "\n"


def _table(lines: Sequence[Line], reference: str, shown: bool) -> list[str]:
    """Lines as a Markdown table, with the printed numbers if ``shown``."""
    tasks = _tasks(lines)
    heads = ["", "modality"]
    for task in tasks:
        heads += [f"{task} %", *(["printed"] if shown else []), f"to {reference}"]
    text = [f"| {' | '.join(heads)} |", f"|---|---{'|---:' * (len(heads) - 2)}|"]
    for line in lines:
        row = [f"*{line.source}*" if line.control else line.source, "" if line.modality == "none" else line.modality]
        for task in tasks:
            cell = line.cells.get(task)
            row += [_score(cell), *([_printed(cell)] if shown else []), _gap(cell)]
        text.append(f"| {' | '.join(row)} |")
    return [*text, ""]


def _tasks(lines: Sequence[Line]) -> list[str]:
    return list(dict.fromkeys(task for line in lines for task in line.cells))


def _preface(result: dict[str, Any], plan: Plan, shown: bool) -> list[str]:
    steps = {(c["steps"], c["pairs"]) for c in result["cost"]}
    if len(steps) == 1:
        num, pairs = next(iter(steps))
        budget = f"equal budget: every run saw {pairs} pairs in {num} steps"
    else:
        budget = "budgets differ (see cost)"
    if len({c["pairs_of"] for c in result["cost"]}) > 1:
        budget += ", **pairs are not from the same rows (see cost)**"
    seeds = max((c["seeds"] for c in result["cost"]), default=0)
    least = least_p(max((len(record["group_sizes"]) for record in result["records"]), default=1))
    text = [
        f"Data {result['data']} (pack {result['pack'][:12]}), recipe {plan.recipe}, {seeds} seed{'s' * (seeds != 1)},"
        f" {budget}; {PROBE_NAMES.get(plan.probes[0], plan.probes[0])} on frozen features;"
        f" {_made(result)}.",
        f"95 % intervals and p: bootstrap over test {result['group_by']}s and seeds; p of the difference to {plan.reference}"
        f" on the same test rows, {least:.3f} the least it can say, not corrected for the number of rows. Controls are"
        " in italics.",
    ]
    if plan.folds:
        unseen = "" if result["leaks"] else ", by encoders and probes that never saw it"
        text.append(
            f"{len(plan.folds)} fold{'s' * (len(plan.folds) > 1)}: every test {result['group_by']} is scored once{unseen}."
        )
    if shown:
        text.append(
            f'"printed" is the paper\'s number on {plan.printed_on}'
            + ("." if _papers(result, plan) else ", which is other data: compare orders, never values.")
        )
    text += [f"Note: {note}." for note in _notes(result)]
    if result["leaks"]:
        text.append(f"**LEAK: {result['leaks']}.**")
    text += [f"Diverged: {name} ({error})." for name, error in result["failed"].items()]
    text += [f"Left out: {label} ({reason})." for label, reason in result["left_out"].items()]
    if result["unfinished"]:
        text.append(f"**Not finished: {', '.join(result['unfinished'])}.**")
    return [line for part in text for line in (part, "")][:-1]


def _notes(result: dict[str, Any]) -> list[str]:
    """What must be said beside the table: the data's own notes, and which runs computed in another precision than most."""
    runs: dict[str, str] = result.get("run_precisions", {})  # by name; older results do not say
    most, *others = [precision for precision, _ in Counter(runs.values()).most_common()] or [""]
    told = [f"{', '.join(f'{name!r}' for name in runs if runs[name] == other)} in {other}" for other in others]
    return [
        *result.get("notes", ()),
        *([f"the networks of {' and of '.join(told)}, those of all other runs in {most}"] if told else []),
    ]


def _made(result: dict[str, Any]) -> str:
    """By which code, on what: the runs', and the tables' where that is another; older results know the tables' alone."""

    def short(commit: str | None) -> str:
        return f"{commit[:12]}{'+' * commit.endswith('+')}" if commit else "unknown"  # +: with changes

    tables = short(result["commit"])
    runs = list(dict.fromkeys(short(commit) for commit in result.get("run_commits", ()))) or [tables]
    code = f"code {tables}" if runs == [tables] else f"runs at commits {', '.join(runs)}; tables at {tables}"
    return ", ".join([code, *(result.get("run_devices") or [result["device"]])])


def _papers(result: dict[str, Any], plan: Plan) -> bool:
    """Whether the paper's numbers are about this data, whose name may go on with its split: touch-and-go (official)."""
    return result["data"].split(" ")[0] == plan.printed_on


def _score(cell: Cell | None) -> str:
    return "" if cell is None else f"{100 * cell.mean:.1f} [{100 * cell.low:.1f}, {100 * cell.high:.1f}]"


def _printed(cell: Cell | None) -> str:
    return "" if cell is None or cell.printed is None else f"{100 * cell.printed:.1f}"


def _gap(cell: Cell | None) -> str:
    if cell is None or cell.difference is None:
        return ""
    mean, _, _, p = cell.difference
    return f"{100 * mean:+.1f} (p {p:.3f})" if p >= 0.0015 else f"{100 * mean:+.1f} (p .001)"


def _auroc(result: dict[str, Any], plan: Plan, lines: Sequence[Line]) -> list[str]:
    """Area under the ROC curve of tasks with two classes, mean over seeds (and folds), with the least and the most."""
    records = _by_cell(result["records"], plan.probes[0])
    found: dict[tuple[str, str], dict[str, str]] = {}
    for line in lines:
        for task in line.cells:
            values = [r["auroc"] for r in records[task, line.modality, line.source] if r["auroc"] is not None]
            if values and line.source != "majority":
                spread = f" ({min(values):.2f}-{max(values):.2f})" if len(values) > 1 else ""
                name = f"*{line.source}*" if line.control else line.source
                row = found.setdefault((name, "" if line.modality == "none" else line.modality), {})
                row[task] = f"{sum(values) / len(values):.2f}{spread}"
    if not found:
        return []
    tasks = list(dict.fromkeys(task for row in found.values() for task in row))
    text = [f"| AUROC | modality | {' | '.join(tasks)} |", f"|---|---{'|---:' * len(tasks)}|"]
    text += [f"| {' | '.join([*which, *(row.get(task, '') for task in tasks)])} |" for which, row in found.items()]
    return [*text, ""]


def _retrieval(result: dict[str, Any]) -> list[str]:
    if not result["retrieval"]:
        return []
    text = ["| retrieval | | R@1 % | R@5 % | R@10 % | chance R@5 % |", "|---|---|---:|---:|---:|---:|"]
    for (source, direction), values in retrieval_means(result["retrieval"]).items():
        numbers = " | ".join(f"{100 * values[k]:.1f}" for k in ("R@1", "R@5", "R@10", "chance R@5"))
        text.append(f"| {source} | {direction} | {numbers} |")
    return [*text, ""]


def _cost(result: dict[str, Any]) -> list[str]:
    text = [
        "| cost of one run | seeds | steps | pairs | from | images seen | trained weights | seconds | peak GPU MiB |",
        "|---|---:|---:|---:|---|---:|---:|---:|---:|",
    ]
    for c in result["cost"]:
        peak = f"{c['peak_gpu_bytes'] / 2**20:.0f}" if c["peak_gpu_bytes"] else "not measured"
        text.append(
            f"| {c['row']} | {c['seeds']} | {c['steps']} | {c['pairs']} | {c['pairs_of']} | {c['images']} |"
            f" {c['trained_parameters'] / 1e6:.2f} M | {c['seconds']:.0f} | {peak} |"
        )
    return [*text, ""]


# -- LaTeX, CSV, figure -----------------------------------------------------------------------------------------------

NAMES = {"touch": "Tactile", "vision": "Visual", "both": "Tactile + Visual", "none": "-"}


def latex(result: dict[str, Any], lines: Sequence[Line]) -> str:
    """A booktabs table in the paper's layout: method, modality, accuracy per task, the printed value in brackets."""
    plan: Plan = from_json(Plan, result["plan"], "plan")
    tasks = _tasks(lines)
    best = {
        (task, m): max((x.cells[task].mean for x in lines if x.modality == m and task in x.cells), default=0)
        for task in tasks
        for m in MODALITY_ORDER
    }
    text = [
        r"\begin{tabular}{ll" + "r" * len(tasks) + "}",
        r"\toprule",
        " & ".join(["Method", "Modality", *(f"{_tex(t)} (\\%)" for t in tasks)]) + r" \\",
        r"\midrule",
    ]
    controls = False
    for line in lines:
        if line.control and not controls:
            text.append(r"\midrule")
            controls = True
        row = [_tex(line.source), NAMES[line.modality]]
        for task in tasks:
            cell = line.cells.get(task)
            if cell is None:
                row.append("")
                continue
            half = 50 * (cell.high - cell.low)
            number = f"{100 * cell.mean:.1f}"
            bold = not line.control and cell.mean == best[task, line.modality]
            number = rf"\textbf{{{number}}}" if bold else number
            paper = f" [{100 * cell.printed:.1f}]" if cell.printed is not None else ""
            row.append(f"{number} $\\pm$ {half:.1f}{paper}")
        text.append(" & ".join(row) + r" \\")
    note = f"% {plan.title or plan.name}; data {result['data']}"
    if plan.printed_on:
        note += f"; in brackets: printed in the paper on {plan.printed_on}"
    notes = [note, *(f"% Note: {said}." for said in _notes(result))]
    if result["leaks"]:
        notes.append(f"% LEAK: {result['leaks']}.")
    return "\n".join([*notes, *text, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _tex(text: str) -> str:
    for sign in "&%_#":
        text = text.replace(sign, "\\" + sign)
    return text


def comma(result: dict[str, Any]) -> str:
    """Every cell of every probe as one CSV line, in shares; what has one probe only, as majority has, once by that."""
    plan: Plan = from_json(Plan, result["plan"], "plan")
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    heads = ("row", "control", "probe", "modality", "task", "accuracy", "low", "high", "seeds", "printed")
    writer.writerow((*heads, "difference", "difference_low", "difference_high", "p"))
    tables = {**{probe: lines_of(result, probe) for probe in plan.probes}, **stresses_of(result)}
    scored: dict[str, dict[str, None]] = {}  # source -> the probes it was scored by
    for record in result["records"]:
        scored.setdefault(record["source"], {})[record["probe"]] = None
    written: set[tuple[str, ...]] = set()
    for table, lines in tables.items():
        for line in lines:
            probe = table if table in scored[line.source] else next(iter(scored[line.source]))
            for task, cell in line.cells.items():
                if (key := (line.source, probe, line.modality, task)) in written:
                    continue
                written.add(key)
                values = (line.source, int(line.control), probe, line.modality, task, cell.mean, cell.low, cell.high)
                writer.writerow((*values, cell.seeds, cell.printed, *(cell.difference or ("",) * 4)))
    return buffer.getvalue()


COLOURS = {"touch": "#c1440e", "vision": "#2f6690", "both": "#3a3a3a"}


def figure(result: dict[str, Any], lines: Sequence[Line]) -> bytes:
    """A PNG: a panel per task, a line per row, a dot with its interval per modality.

    Crosses are the paper's numbers, where the data is the paper's: elsewhere they would be on another scale.
    """
    from matplotlib.figure import Figure

    plan: Plan = from_json(Plan, result["plan"], "plan")
    tasks = _tasks(lines)
    sources = list(dict.fromkeys(line.source for line in lines if line.modality != "none"))[::-1]
    figure = Figure(figsize=(3.2 + 3.6 * len(tasks), 1.6 + 0.36 * len(sources)), dpi=110, layout="constrained")
    axes = figure.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
    for axis, task in zip(axes, tasks, strict=True):
        for line in lines:
            cell = line.cells.get(task)
            if cell is None:
                continue
            if line.modality == "none":
                if line.source == "majority":
                    axis.axvline(100 * cell.mean, color="#999999", lw=1, ls=":", label="majority")
                continue
            y = sources.index(line.source) + {"touch": 0.22, "vision": 0.0, "both": -0.22}[line.modality]
            axis.plot([100 * cell.low, 100 * cell.high], [y, y], color=COLOURS[line.modality], lw=1.6)
            axis.plot(100 * cell.mean, y, "o", ms=4.5, color=COLOURS[line.modality], label=line.modality)
            if cell.printed is not None and _papers(result, plan):
                axis.plot(100 * cell.printed, y, "x", ms=6, color=COLOURS[line.modality], alpha=0.6, label="printed")
        axis.set_title(task, fontsize=10, loc="left")
        axis.set_xlabel("accuracy %", fontsize=9)
        axis.set_yticks(range(len(sources)), sources, fontsize=9)
        axis.set_ylim(-0.7, len(sources) - 0.3)
        axis.grid(axis="x", color="#e5e5e5", lw=0.6)
        axis.tick_params(length=0, labelsize=8)
        for side in ("top", "right", "left"):
            axis.spines[side].set_visible(False)
    entries = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    order = [name for name in ("touch", "vision", "both", "printed", "majority") if name in entries]
    figure.legend([entries[n] for n in order], order, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
