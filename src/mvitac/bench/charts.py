"""The board's charts: all scores at a glance, and score against parameters and against the number of labels."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mvitac.report.figures import DASHES, LEAST, MARKERS, STYLE, legend_below, new_figure, shorten
from mvitac.report.palette import CONTROL_GREYS, HUES, colour


def _cut(value: float | None) -> float:
    """A score in percent, not below the axis."""
    return 100 * max(LEAST, LEAST if value is None else value)


@matplotlib.rc_context({**STYLE, "font.size": 8})
def at_a_glance(names: Sequence[str], columns: Sequence[tuple[str, str, Mapping[str, Mapping[str, Any]]]]) -> Figure:
    """A row for each encoder or control, a column for each task.

    The shade of a cell rises from the untrained trunk, or what is worse, to the best encoder of its column.

    Args:
        names: What the rows show, from top to bottom.
        columns: (set, task and modality, name -> cell) of each column. An absent name is left empty, and a score with a
            leak has an L and no shade.
    """
    figure = Figure(figsize=(max(9.2, 2.0 + 0.36 * len(columns)), 1.3 + 0.2 * len(names)))  # letters of one size
    axes = figure.subplots()
    for x, (one, _, cells) in enumerate(columns):
        clean = {name: cell["mean"] for name, cell in cells.items() if not cell.get("leak")}
        floor, best = clean.get("untrained", min(clean.values(), default=0)), max(clean.values(), default=0)
        for y, name in enumerate(names):
            if name in clean:
                shade = 0.55 * max(0.0, clean[name] - floor) / max(best - floor, 1e-9)
                axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=colour("blue"), alpha=shade, linewidth=0))
            if name in cells:
                text = f"{round(100 * cells[name]['mean'])}{'' if name in clean else ' L'}"
                axes.text(x, y, text, ha="center", va="center")
        if x and one != columns[x - 1][0]:
            axes.axvline(x - 0.5, color=colour("rule"), linewidth=1.2)
    axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(names) - 0.5, -0.5))
    axes.set_yticks(range(len(names)), [shorten(name, 34) for name in names])
    axes.set_xticks(
        range(len(columns)), [task for _, task, _ in columns], rotation=55, ha="left", rotation_mode="anchor"
    )
    axes.xaxis.tick_top()
    axes.spines[:].set_visible(False)
    starts = [x for x, (one, _, _) in enumerate(columns) if not x or one != columns[x - 1][0]]
    for x, end in zip(starts, [*starts[1:], len(columns)], strict=True):
        one = columns[x][0] if end - x > 1 else columns[x][0].replace("_", "\n")  # a single column is narrow
        axes.text((x + end - 1) / 2, len(names) - 0.2, one, ha="center", va="top", weight="bold")
    return figure


@matplotlib.rc_context(STYLE)
def against_parameters(
    title: str, points: Mapping[str, tuple[int, Mapping[str, Any]]], level: float | None, what: str
) -> Figure:
    """A dot with its interval for each encoder; ``points``: name -> (parameters, cell). ``level``: the untrained trunk."""
    figure, axes = new_figure(title, 2.6 + 0.16 * -(-len(points) // 2))
    handles = []
    for number, (num, cell) in enumerate(points.values()):
        look: dict[str, Any] = {"color": colour(HUES[number % len(HUES)])}
        axes.plot([num / 1e6] * 2, [_cut(cell["low"]), _cut(cell["high"])], linewidth=1.2, **look)
        marker = MARKERS[number // len(HUES) % len(MARKERS)]
        handles += axes.plot(num / 1e6, _cut(cell["mean"]), marker, markersize=5, **look)
    names = [shorten(name, 26) for name in points]
    if level is not None:
        handles.append(axes.axhline(_cut(level), color=colour("grey2"), linestyle=":", linewidth=1.2))
        names.append("untrained")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.margins(x=0.15)
    axes.set(xlabel="parameters in millions", ylabel=what)
    axes.grid(axis="y")
    legend_below(figure, handles, names, 2)
    return figure


@matplotlib.rc_context(STYLE)
def against_labels(title: str, lines: Mapping[str, Sequence[tuple[float, Mapping[str, Any]]]]) -> Figure:
    """A line for each encoder, grey for controls; ``lines``: name -> (fraction of the labels, cell)."""
    figure, axes = new_figure(title, 2.6 + 0.16 * -(-len(lines) // 2))
    handles = []
    for number, (name, line) in enumerate(lines.items()):
        hue = CONTROL_GREYS.get(name, HUES[number % len(HUES)])
        shares, scores = [100 * share for share, _ in line], [_cut(cell["mean"]) for _, cell in line]
        dash = DASHES[number // len(HUES) % len(DASHES)]
        handles += axes.plot(shares, scores, dash, marker="o", markersize=3.2, linewidth=1.6, color=colour(hue))
    axes.set_xscale("log")
    ticks = sorted({100 * share for line in lines.values() for share, _ in line})
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    score = "R2" if any("targets" in cell for line in lines.values() for _, cell in line) else "accuracy"
    axes.set(xlabel="labels used, % (log)", ylabel=f"{score} %")
    axes.grid(axis="y")
    legend_below(figure, handles, [shorten(name, 26) for name in lines], 2)
    return figure
