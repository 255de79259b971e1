"""Scores as text: one wording for the terminal, tables, figures, the report and model cards.

A task's summary is modality -> method or control -> cell (``scores.summarise``).
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from mvitac.evaluation.leaks import leak_mark

MODALITY_ORDER = ("none", "touch", "vision", "both")
WORDS = {"touch": "touch", "vision": "vision", "both": "touch + vision"}  # the input of a probe, in words
SHARED = ("imagenet", "start", "untrained", "pixels", "border")  # controls that see images


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

    An interval of all possible scores (R2 of one or two test groups) is left out.
    """
    least, most = "-inf" if low is None or not math.isfinite(low) else percent(low), percent(high)
    ends = "" if least == "-inf" and most == "100.0" else f" [{least}, {most}]"
    return f"{percent(mean)}{ends}{leak_mark(leak)}"


def score_name(task: dict[str, Any]) -> str:
    """What one task's summary scores: "R2" of values, else "accuracy"."""
    return "R2" if any("targets" in cell for cells in task.values() for cell in cells.values()) else "accuracy"


def error_text(target: dict[str, Any]) -> str:
    """The mean absolute error of one target with its unit, such as '0.41 N'."""
    return f"{target['mae']:.3g} {target['unit']}"


def clipped_text(task: dict[str, Any]) -> str:
    """Which sources of one task's summary have test features that ridge regression clipped; "" if none has."""
    cells = [(source, m, cell) for m, found in task.items() for source, cell in found.items() if cell.get("clipped")]
    found = [f"{source} {m} {num} of {of}" for source, m, cell in cells for num, of in [cell["clipped"]] if num]
    return f"test features far beyond the fitted rows were clipped: {', '.join(found)}" if found else ""


def covered(group_by: str, records: Sequence[dict[str, Any]]) -> str:
    """What the 95 % intervals of ``records`` cover (``interval``)."""
    pairs = dict.fromkeys((record["source"], record["seed"]) for record in records if record["seed"] is not None)
    seeds = Counter(source for source, _ in pairs)
    if not (single := [source for source, num in seeds.items() if num == 1]):
        return f"over test {group_by}s and seeds"
    if len(single) == len(seeds):
        return f"over test {group_by}s only, for this one seed: they leave out the variation between seeds"
    return f"over test {group_by}s and seeds; of {', '.join(single)} over test {group_by}s only, for one seed"


def tested_on(task: dict[str, Any], group_by: str) -> str:
    """The test groups of one task's summary, such as '24 test instances'; too few allow no interval."""
    nums = {cell["groups"] for cells in task.values() for cell in cells.values()}
    text = f"{' to '.join(str(num) for num in sorted({min(nums), max(nums)}))} test {group_by}{'s' * (nums != {1})}"
    ends = ((cell["low"], percent(cell["high"])) for cells in task.values() for cell in cells.values())
    endless = any(low is None and high == "100.0" for low, high in ends)
    return text + (", so no interval" if nums == {1} else ", too few for some intervals" * endless)


def columns_of(task: dict[str, Any]) -> list[str]:
    """The modalities of one task's summary in reading order, without "none" (majority and the like)."""
    return [m for m in MODALITY_ORDER if m in task and m != "none"]


def sources_of(task: dict[str, Any]) -> list[str]:
    """Methods in order of appearance, then controls from the strongest idea to the weakest."""
    shared = [source for source in SHARED if any(source in cells for cells in task.values())]
    return [*methods_of(task), *shared, *sorted(task.get("none", {}), key=lambda s: s in ("majority", "mean"))]


def methods_of(task: dict[str, Any]) -> list[str]:
    """The sources of one task's summary that are no controls, in order of appearance."""
    found = dict.fromkeys(source for modality in task.values() for source in modality)
    return [source for source in found if source not in SHARED and source not in task.get("none", {})]


def headline(task: dict[str, Any], source: str, methods: Sequence[str]) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """The modality to show of a task's summary (both, or the best of ``source``), its score and controls beside it."""
    have = [m for m in columns_of(task) if source in task[m]]
    modality = "both" if "both" in have else max(have, key=lambda m: task[m][source]["mean"])
    found = {**task.get("none", {}), **task[modality]}
    controls = {name: found[name] for name in sources_of(task) if name in found and name not in methods}
    return modality, task[modality][source], controls


def above(own: dict[str, Any], controls: dict[str, dict[str, Any]]) -> str:
    """Which of ``controls`` the interval of a score is not above: "below a, overlaps b", or "above every control"."""
    below = [name for name, cell in controls.items() if _low(cell) > own["high"]]
    level = [name for name, cell in controls.items() if cell["high"] >= _low(own) and name not in below]
    found = [f"{word} {', '.join(names)}" for word, names in (("below", below), ("overlaps", level)) if names]
    return " and ".join(found) or "above every control"


def _low(cell: dict[str, Any]) -> float:
    return -math.inf if cell["low"] is None else cell["low"]


def verdicts(task: dict[str, Any]) -> list[str]:
    """A sentence on each method of one task's summary: whether it is above every control, or not above which.

    A second one says by which modalities it is not above the frozen ImageNet trunk.
    """
    said, methods = [], methods_of(task)
    for source in methods:
        modality, own, controls = headline(task, source, methods)
        if not controls:
            continue
        said.append(f"{source} by {WORDS[modality]}: interval {above(own, controls)}")
        cells = {WORDS[m]: (task[m][source], task[m].get("imagenet")) for m in columns_of(task) if source in task[m]}
        if level := [m for m, (mine, frozen) in cells.items() if frozen and _low(mine) <= frozen["high"]]:
            said.append(f"{source}: not above a frozen ImageNet trunk beyond the intervals, by {', '.join(level)}")
    return said


def score_rows(task: dict[str, Any], modalities: Sequence[str]) -> list[list[str]]:
    """Rows of source and its score at each of ``modalities``, of one task's summary; of uneven classes balanced ones too."""
    rows = [[source, *(cell_text(task, source, m) for m in modalities)] for source in sources_of(task)]
    for source in sources_of(task):
        cells = [task.get(m, {}).get(source) or task.get("none", {}).get(source, {}) for m in modalities]
        if any("balanced" in cell for cell in cells):
            rows.append([f"{source}, balanced", *(percent(c["balanced"]) if "balanced" in c else "" for c in cells)])
    return rows


def cell_text(task: dict[str, Any], source: str, modality: str) -> str:
    """The score of one source, or '' if it has none. Controls without features appear in every column."""
    value = task.get(modality, {}).get(source) or task.get("none", {}).get(source)
    return with_interval(value["mean"], value["low"], value["high"], value.get("leak", "")) if value else ""
