"""Probe results as tables for a terminal 80 columns wide, and the rows that every table of results shares."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from mvitac.evaluation.leaks import leak_mark
from mvitac.evaluation.scores import (
    cell_text,
    columns_of,
    covered,
    interval,
    leaks_in,
    percent,
    sources_of,
    tested_on,
)
from mvitac.system.console import Console

PROBE_NAMES = {"linear": "logistic regression", "paper": "the paper's probe", "knn": "20 nearest neighbours"}
RETRIEVAL = ("R@1", "R@5", "R@10", "chance R@5")
"""Columns of a retrieval table, in percent."""


def unseen_groups(group_by: str, records: Sequence[dict[str, Any]]) -> str:
    """The test groups of ``records``: unseen ones, unless a source was trained on some of them or may have been."""
    return f"{'test' if leaks_in(records) else 'unseen'} {group_by}s"


def print_summary(result: dict[str, Any], console: Console, *, probe: str = "linear") -> None:
    """Print one table per task: accuracy in percent, mean and 95 % interval."""
    for name, task in result["summary"].items():
        modalities = columns_of(task)
        seeds = max((len(v["seeds"]) for m in task.values() for v in m.values()), default=0)
        about = (
            f"{PROBE_NAMES.get(probe, probe)}; {seeds} seed{'s' * (seeds != 1)}; {tested_on(task, result['group_by'])}"
        )
        title = f"{result['data']}: {name} ({about})"
        table = Table(title=title, title_justify="left", title_style="bold")
        table.add_column("accuracy %")
        for modality in modalities:
            table.add_column(modality, justify="right", no_wrap=True)
        for source in sources_of(task):
            # LEAK on a line of its own, else the table is too wide.
            table.add_row(source, *(cell_text(task, source, m).replace(" LEAK", "\nLEAK") for m in modalities))
        console.print(table)
    console.print(f"95 % intervals: {covered(result['group_by'], _seeds_of(result['summary']))}.", style="dim")
    for note in result.get("notes", ()):
        console.print(f"note: {note}", markup=False, highlight=False)
    for leak in result.get("leaks", ()):
        console.print(f"LEAK: {leak}", markup=False, highlight=False)


def _seeds_of(summary: dict[str, Any]) -> list[dict[str, Any]]:
    """Source and seed of everything in ``summary``, as for ``covered``."""
    cells = ((name, cell) for task in summary.values() for column in task.values() for name, cell in column.items())
    return [{"source": name, "seed": seed} for name, cell in cells for seed in cell["seeds"]]


def print_retrieval(result: dict[str, Any], console: Console) -> None:
    """Print cross-modal retrieval as one table, if the methods have a shared space."""
    if not result["retrieval"]:
        return
    unseen = unseen_groups(result["group_by"], result["retrieval"])
    table = Table(title=f"retrieval over {unseen}", title_justify="left", title_style="bold")
    table.add_column("")
    table.add_column("query -> found")
    for column in RETRIEVAL:
        table.add_column(f"{column} %", justify="right")
    for row in retrieval_rows(result["retrieval"]):
        table.add_row(*row)
    console.print(table)


def retrieval_rows(records: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Rows of source, direction and ``RETRIEVAL`` in percent, averaged over seeds."""
    rows = []
    for (source, direction), found in by_direction(records).items():
        mark = leak_mark(leaks_in(found))
        rows.append([source, direction, *(percent(recall(found, key)) + mark for key in RETRIEVAL[:-1])])
        rows[-1].append(percent(recall(found, RETRIEVAL[-1])))
    return rows


def recall(records: Sequence[dict[str, Any]], key: str) -> float:
    """Mean over seeds of one of ``RETRIEVAL``; R@5 from its counts, so that it equals the mean of its interval."""
    if key == "R@5":
        return interval(records)[0]
    return sum(r[key] for r in records) / len(records)


def by_direction(records: Sequence[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """(source, direction) -> the retrieval records of its seeds."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for record in records:
        found.setdefault((record["source"], record["direction"]), []).append(record)
    return found
