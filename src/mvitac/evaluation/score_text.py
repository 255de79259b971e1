"""Scores as text: one wording for the terminal, tables, figures, the report and model cards.

A task's summary is modality -> method or control -> cell (``scores.summarise``).
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from mvitac.evaluation.leaks import leak_mark

MODALITY_ORDER = ("none", "touch", "vision", "both")


def percent(value: float) -> str:
    """A score in 0 .. 1 as text in percent, with one decimal. Every page, table, figure and card uses this."""
    return f"{100 * value:.1f}"


def pipes(heads: Sequence[str], rows: Iterable[Sequence[str]], words: int = 2) -> list[str]:
    """Lines of a Markdown table. The first ``words`` columns are left-aligned, the others right-aligned."""
    rule = "|---" * words + "|---:" * (len(heads) - words) + "|"
    first, *lines = (" | ".join(cell.replace("|", r"\|") for cell in row) for row in (heads, *rows))
    return [f"| {first} |", rule, *(f"| {line} |" for line in lines), ""]


def with_interval(mean: float, low: float | None, high: float, leak: str = "") -> str:
    """A score and its 95 % interval, such as '57.6 [55.1, 60.2]', with LEAK if there is one (``evaluation.leaks``).

    Without any interval (one test group) it is the score alone.
    """
    least = "-inf" if low is None or not math.isfinite(low) else percent(low)
    ends = "" if least == "-inf" and high >= 1 else f" [{least}, {percent(high)}]"
    return f"{percent(mean)}{ends}{leak_mark(leak)}"


def score_name(task: dict[str, Any]) -> str:
    """What one task's summary scores: "R2" of values, else "accuracy"."""
    return "R2" if any("targets" in cell for cells in task.values() for cell in cells.values()) else "accuracy"


def error_text(target: dict[str, Any], key: str = "mae") -> str:
    """An error of one target with its unit, such as '0.41 N'."""
    return f"{target[key]:.3g} {target['unit']}"


def clipped_text(task: dict[str, Any]) -> str:
    """Which sources of one task's summary have test features that ridge regression clipped; "" if none has."""
    cells = [(source, m, cell) for m, found in task.items() for source, cell in found.items() if cell.get("clipped")]
    found = [f"{source} {m} {num} of {of}" for source, m, cell in cells for num, of in [cell["clipped"]] if num]
    return f"test features far beyond the fitted rows were clipped: {', '.join(found)}" if found else ""


def covered(group_by: str, records: Sequence[dict[str, Any]]) -> str:
    """What the 95 % intervals of ``records`` cover (``interval``)."""
    seeds: dict[str, set[int]] = {}
    for record in records:
        if record["seed"] is not None:
            seeds.setdefault(record["source"], set()).add(record["seed"])
    single = [source for source, found in seeds.items() if len(found) == 1]
    if not single:
        return f"over test {group_by}s and seeds"
    if len(single) == len(seeds):
        return f"over test {group_by}s only, for this one seed: they leave out the variation between seeds"
    return f"over test {group_by}s and seeds; of {', '.join(single)} over test {group_by}s only, for one seed"


def tested_on(task: dict[str, Any], group_by: str) -> str:
    """The test groups of one task's summary, such as '24 test instances'; one group allows no interval."""
    nums = {cell["groups"] for cells in task.values() for cell in cells.values()}
    if nums == {1}:
        return f"1 test {group_by}, so no interval"
    return f"{' to '.join(str(num) for num in sorted({min(nums), max(nums)}))} test {group_by}s"


def columns_of(task: dict[str, Any]) -> list[str]:
    """The modalities of one task's summary in reading order, without "none" (majority and the like)."""
    return [m for m in MODALITY_ORDER if m in task and m != "none"]


def sources_of(task: dict[str, Any]) -> list[str]:
    """Methods in order of appearance, then controls from the strongest idea to the weakest."""
    last = ("imagenet", "start", "untrained", "pixels", "border")
    found = list(dict.fromkeys(source for modality in task.values() for source in modality))
    fixed = list(task.get("none", {}))
    own = [s for s in found if s not in last and s not in fixed]
    return [*own, *(s for s in last if s in found), *sorted(fixed, key=lambda s: s in ("majority", "mean"))]


def cell_text(task: dict[str, Any], source: str, modality: str) -> str:
    """The score of one source, or '' if it has none. Controls without features appear in every column."""
    value = task.get(modality, {}).get(source) or task.get("none", {}).get(source)
    return with_interval(value["mean"], value["low"], value["high"], value.get("leak", "")) if value else ""
