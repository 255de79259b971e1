"""The board's charts: score against parameters, and against the number of labels."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from mvitac.report.figures import DASHES, LEAST, MARKERS, STYLE, legend_below, new_figure, shorten
from mvitac.report.palette import CONTROL_GREYS, HUES, colour


def _cut(value: float | None) -> float:
    """A score in percent, not below the axis."""
    return 100 * max(LEAST, LEAST if value is None else value)


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
