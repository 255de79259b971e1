"""Probe results as tables for a terminal 80 columns wide, and as Markdown for docs/results."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

MODALITY_ORDER = ("none", "touch", "vision", "both")
PROBE_NAMES = {"linear": "logistic regression", "paper": "the paper's probe", "knn": "20 nearest neighbours"}


def columns_of(task: dict[str, Any]) -> list[str]:
    """The modalities of one task's summary, in reading order; "none" (majority and the like) has no column of its own."""
    return [m for m in MODALITY_ORDER if m in task and m != "none"]


def sources_of(task: dict[str, Any]) -> list[str]:
    """Methods first (in order of appearance), then controls from the strongest idea to the weakest."""
    last = ("imagenet", "untrained", "pixels", "border")
    found = list(dict.fromkeys(source for modality in task.values() for source in modality))
    fixed = list(task.get("none", {}))
    own = [s for s in found if s not in last and s not in fixed]
    return [*own, *(s for s in last if s in found), *sorted(fixed, key=lambda s: s == "majority")]


def cell(task: dict[str, Any], source: str, modality: str) -> str:
    """'57.6 [55.1, 60.2]' in percent, or '' where there is nothing; controls without features stand in every column."""
    value = task.get(modality, {}).get(source) or task.get("none", {}).get(source)
    if value is None:
        return ""
    return f"{100 * value['mean']:.1f} [{100 * value['low']:.1f}, {100 * value['high']:.1f}]"


def print_summary(result: dict[str, Any], console: Console, *, probe: str = "linear") -> None:
    """One table per task: accuracy in percent, mean and 95 % interval."""
    for name, task in result["summary"].items():
        modalities = columns_of(task)
        seeds = max((len(v["seeds"]) for m in task.values() for v in m.values()), default=0)
        title = f"{result['data']}: {name} ({PROBE_NAMES.get(probe, probe)}; {seeds} seed{'s' * (seeds != 1)})"
        table = Table(title=title, title_justify="left", title_style="bold")
        table.add_column("accuracy %")
        for modality in modalities:
            table.add_column(modality, justify="right", no_wrap=True)
        for source in sources_of(task):
            table.add_row(source, *(cell(task, source, m) for m in modalities))
        console.print(table)
    console.print(f"95 % intervals: bootstrap over test {result['group_by']}s and seeds.", style="dim")
    for note in result.get("notes", ()):
        console.print(f"note: {note}", markup=False, highlight=False)


def print_retrieval(result: dict[str, Any], console: Console) -> None:
    """Cross-modal retrieval as one table, if the methods have a shared space."""
    if not result["retrieval"]:
        return
    table = Table(title=f"retrieval over unseen {result['group_by']}s", title_justify="left", title_style="bold")
    for column in ("", "query -> found", "R@1 %", "R@5 %", "R@10 %", "chance R@5 %"):
        table.add_column(column, justify="left" if column in ("", "query -> found") else "right")
    for (source, direction), values in retrieval_means(result["retrieval"]).items():
        numbers = [f"{100 * values[k]:.1f}" for k in ("R@1", "R@5", "R@10", "chance R@5")]
        table.add_row(source, direction, *numbers)
    console.print(table)


def retrieval_means(records: list[dict[str, Any]]) -> dict[tuple[str, str], dict[str, float]]:
    """(source, direction) -> R@k averaged over seeds."""
    gathered: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for record in records:
        gathered.setdefault((record["source"], record["direction"]), []).append(record)
    keys = ("R@1", "R@5", "R@10", "chance R@5")
    return {key: {k: sum(r[k] for r in found) / len(found) for k in keys} for key, found in gathered.items()}


def markdown(result: dict[str, Any]) -> str:
    """The same tables as Markdown."""
    lines = []
    for name, task in result["summary"].items():
        modalities = columns_of(task)
        lines += [
            f"**{name}** (accuracy %)",
            "",
            f"| | {' | '.join(modalities)} |",
            f"|---{'|---:' * len(modalities)}|",
        ]
        for source in sources_of(task):
            lines.append(f"| {source} | {' | '.join(cell(task, source, m) for m in modalities)} |")
        lines.append("")
    if result["retrieval"]:
        lines += ["| retrieval | | R@1 % | R@5 % | R@10 % | chance R@5 % |", "|---|---|---:|---:|---:|---:|"]
        for (source, direction), values in retrieval_means(result["retrieval"]).items():
            numbers = " | ".join(f"{100 * values[k]:.1f}" for k in ("R@1", "R@5", "R@10", "chance R@5"))
            lines.append(f"| {source} | {direction} | {numbers} |")
        lines.append("")
    lines += [f"Note: {note}." for note in result.get("notes", ())]
    return "\n".join(lines)
