"""A comparison's result as the lines and cells of a table."""

from dataclasses import dataclass
from typing import Any

from mvitac.datasets.pack import ON_VAL
from mvitac.evaluation.controls import CONTROLS
from mvitac.evaluation.evaluate import END_TO_END
from mvitac.evaluation.intervals import paired_difference
from mvitac.evaluation.score_text import MODALITY_ORDER
from mvitac.evaluation.scores import by_cell, summarise
from mvitac.evaluation.value_scores import one_target
from mvitac.experiments.plan import ONE_ROW, Plan
from mvitac.registry import from_json


@dataclass(frozen=True)
class Line:
    """One line of the table: a source at one modality. ``cells``: task -> cell of ``scores.summarise``, in 0 .. 1, with
    "printed" (the paper's number, or None) and "difference" to the reference row (``paired_difference``, or None)."""

    source: str
    modality: str
    cells: dict[str, dict[str, Any]]
    control: bool


def plan_of(result: dict[str, Any]) -> Plan:
    return from_json(Plan, result["plan"], "plan")


def lines_of(result: dict[str, Any], probe: str | None = None) -> list[Line]:
    """The lines of the table: rows in the plan's order, then controls. ``probe`` defaults to the plan's first.

    The paper's numbers stand beside scores of the same split, positives and probe only (``_printed``).
    """
    plan = plan_of(result)
    probe = probe or plan.probes[0]
    records, summary = by_cell(result["records"], probe), summarise(result["records"], probe)
    rows = [name for label in result["rows"] for name in (label, label + END_TO_END)]
    found = {source for _, _, source in records}
    own = sorted(found - set(rows) - set(CONTROLS))  # the data's own controls
    controls = [*(s for s in CONTROLS[:-2] if s in found), *own, *(s for s in CONTROLS[-2:] if s in found)]
    lines = []
    for source in (*rows, *controls):
        for modality in MODALITY_ORDER:
            cells = {}
            for task in dict.fromkeys(task for task, _, _ in records):
                if mine := records.get((task, modality, source)):
                    against = records.get((task, modality, plan.reference)) if source != plan.reference else None
                    trained = (task, modality, source + END_TO_END) in records
                    # The paper printed the score of a supervised row's own classifier.
                    paper = None if trained or probe != "paper" else _printed(result, plan, task, modality, source)
                    beside = {"printed": paper, "difference": paired_difference(mine, against) if against else None}
                    cells[task] = {**summary[task][modality][source], **beside}
            if cells:
                lines.append(Line(source, modality, cells, source in controls))
    return lines


def target_lines(result: dict[str, Any], probe: str | None = None) -> dict[str, list[Line]]:
    """Of each task with values, its lines with a cell for each target instead of each task."""
    found: dict[str, list[dict[str, Any]]] = {}
    for record in result["records"]:
        for t, target in enumerate(record.get("targets", ())):
            found.setdefault(record["task"], []).append({**one_target(record, t), "task": target["name"]})
    return {task: lines_of({**result, "records": records}, probe) for task, records in found.items()}


def as_printed(result: dict[str, Any], plan: Plan) -> bool:
    """Whether the test rows are the paper's: its split, scored on test, one frame at a time."""
    windows = plan.data is not None and plan.data.frame_window().active
    return result["data"] == plan.printed_on and ON_VAL not in result.get("notes", ()) and not windows


def _printed(result: dict[str, Any], plan: Plan, task: str, modality: str, source: str) -> float | None:
    """The paper's number, if it has one for this split, of positives from the same image."""
    label = source.removesuffix(END_TO_END)
    one_row = {cost["row"] for cost in result["cost"] if cost["pairs_of"] == ONE_ROW}
    if source == "majority":
        printed = plan.printed_majority
    else:
        printed = {row.label: row.printed for row in plan.rows if row.label in one_row}.get(label, {}).get(modality, {})
    return printed[task] / 100 if as_printed(result, plan) and task in printed else None
