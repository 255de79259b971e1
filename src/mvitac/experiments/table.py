"""A comparison's result as the lines and cells of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mvitac.evaluation.controls import CONTROLS
from mvitac.evaluation.evaluate import END_TO_END
from mvitac.evaluation.robustness import STRESSES
from mvitac.evaluation.scores import paired_difference, summarise
from mvitac.experiments.plan import Plan
from mvitac.registry import from_json
from mvitac.report.tables import MODALITY_ORDER


@dataclass(frozen=True)
class Cell:
    """One accuracy with everything that stands beside it; shares, not percent."""

    mean: float
    low: float
    high: float
    seeds: int
    printed: float | None
    difference: tuple[float, float, float, float] | None
    """To the reference row: mean, low, high, p."""


@dataclass(frozen=True)
class Line:
    """One line of the table: a source at one modality, and its cell per task."""

    source: str
    modality: str
    cells: dict[str, Cell]
    control: bool


def lines_of(result: dict[str, Any], probe: str | None = None) -> list[Line]:
    """The table's lines: rows in the plan's order, then controls; ``probe`` defaults to the plan's first."""
    plan: Plan = from_json(Plan, result["plan"], "plan")
    probe = probe or plan.probes[0]
    summary = summarise(result["records"], probe)
    records = _by_cell(result["records"], probe)
    tasks = list(summary)
    sources = [name for label in result["rows"] for name in (label, label + END_TO_END)]
    found = {source for task in summary.values() for m in task.values() for source in m}
    own = sorted(found - set(sources) - set(CONTROLS))  # the data's own
    rest = [*(s for s in CONTROLS[:-1] if s in found), *own, *(s for s in CONTROLS[-1:] if s in found)]
    printed = {row.label: row.printed for row in plan.rows}
    lines = []
    for source in (*sources, *rest):
        label = source.removesuffix(END_TO_END)
        for modality in MODALITY_ORDER:
            cells = {}
            for task in tasks:
                value = summary[task].get(modality, {}).get(source)
                if value is None:
                    continue
                paper = printed.get(label, {}).get(modality, {}).get(task)
                if source == label and label + END_TO_END in summary[task].get(modality, {}):
                    paper = None  # what was printed for it is its own classifier's score
                if source == "majority":
                    paper = plan.printed_majority.get(task)
                if probe in STRESSES:
                    paper = None  # nobody printed those
                against = records.get((task, modality, plan.reference))
                gap = None
                if against and source != plan.reference:
                    gap = paired_difference(records[task, modality, source], against)
                seeds = max(1, len(value["seeds"]))
                cells[task] = Cell(
                    value["mean"],
                    value["low"],
                    value["high"],
                    seeds,
                    None if paper is None else paper / 100,
                    gap,
                )
            if cells:
                lines.append(Line(source, modality, cells, control=source in rest))
    return lines


def _by_cell(records: Sequence[dict[str, Any]], probe: str) -> dict[tuple[str, str, str], list[dict[str, Any]]]:
    asked = {record["source"] for record in records if record["probe"] == probe}
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for record in records:
        if record["probe"] == probe or record["source"] not in asked:
            found.setdefault((record["task"], record["modality"], record["source"]), []).append(record)
    return found


def stresses_of(result: dict[str, Any]) -> dict[str, list[Line]]:
    """The lines of every stress (``mvitac.evaluation.robustness``) that was scored; of the controls only majority is comparable."""
    found = {}
    for kind in STRESSES:
        mine = [r for r in result["records"] if r["probe"] == kind]
        if mine:
            majority = [r for r in result["records"] if r["source"] == "majority"]
            found[kind] = lines_of({**result, "records": mine + majority}, kind)
    return found
