"""A comparison's result as the lines and cells of a table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mvitac.evaluation.controls import CONTROLS
from mvitac.evaluation.evaluate import END_TO_END
from mvitac.evaluation.robustness import STRESSES
from mvitac.evaluation.scores import MODALITY_ORDER, by_cell, interval, paired_difference
from mvitac.experiments.plan import Plan
from mvitac.registry import from_json


@dataclass(frozen=True)
class Cell:
    """One accuracy with its interval, the printed number and the difference to the reference; in 0 .. 1."""

    mean: float
    low: float
    high: float
    seeds: int
    printed: float | None
    difference: tuple[float, float, float, float | None] | None
    """To the reference row: mean, low, high, p (``paired_difference``)."""


@dataclass(frozen=True)
class Line:
    """One line of the table: a source at one modality, with a cell per task."""

    source: str
    modality: str
    cells: dict[str, Cell]
    control: bool


def lines_of(result: dict[str, Any], probe: str | None = None) -> list[Line]:
    """The lines of the table: rows in the plan's order, then controls. ``probe`` defaults to the plan's first."""
    plan: Plan = from_json(Plan, result["plan"], "plan")
    probe = probe or plan.probes[0]
    records = by_cell(result["records"], probe)
    tasks = list(dict.fromkeys(task for task, _, _ in records))
    rows = [name for label in result["rows"] for name in (label, label + END_TO_END)]
    found = {source for _, _, source in records}
    own = sorted(found - set(rows) - set(CONTROLS))  # the data's own controls
    controls = [*(s for s in CONTROLS[:-2] if s in found), *own, *(s for s in CONTROLS[-2:] if s in found)]
    lines = []
    for source in (*rows, *controls):
        for modality in MODALITY_ORDER:
            cells = {}
            for task in tasks:
                if mine := records.get((task, modality, source)):
                    against = records.get((task, modality, plan.reference)) if source != plan.reference else None
                    trained = (task, modality, source + END_TO_END) in records
                    # The paper printed the score of a supervised row's own classifier; it has no stress tests.
                    paper = None if trained or probe in STRESSES else _printed(plan, task, modality, source)
                    seeds = max(1, sum(record["seed"] is not None for record in mine))
                    gap = paired_difference(mine, against) if against else None
                    cells[task] = Cell(*interval(mine), seeds, None if paper is None else paper / 100, gap)
            if cells:
                lines.append(Line(source, modality, cells, control=source in controls))
    return lines


def _printed(plan: Plan, task: str, modality: str, source: str) -> float | None:
    """The paper's number in percent, if it has one."""
    if source == "majority":
        return plan.printed_majority.get(task)
    printed = {row.label: row.printed for row in plan.rows}
    return printed.get(source.removesuffix(END_TO_END), {}).get(modality, {}).get(task)


def stresses_of(result: dict[str, Any]) -> dict[str, list[Line]]:
    """The lines of every stress test that was scored (``robustness``). Majority is the only comparable control."""
    majority = [r for r in result["records"] if r["source"] == "majority"]
    scored = {kind: [r for r in result["records"] if r["probe"] == kind] for kind in STRESSES}
    return {kind: lines_of({**result, "records": mine + majority}, kind) for kind, mine in scored.items() if mine}
