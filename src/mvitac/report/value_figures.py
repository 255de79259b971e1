"""Figures of predicted values: predicted against true, and the error by range of the true value."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from mvitac.report.figures import DASHES, STYLE, legend_below, new_figure, shorten
from mvitac.report.palette import CONTROL_GREYS, colour


@matplotlib.rc_context(STYLE)
def predicted(title: str, points: Sequence[Sequence[float]], unit: str, hue: str) -> Figure:
    """Predicted against true values (``points`` [N, 2]: true, predicted), with the line on which predictions are exact.

    Predictions far outside the true range are drawn at the edge.
    """
    figure, axes = new_figure(title, 3.5)
    true, guess = np.array(points, float).T
    low, high = float(true.min()), float(true.max())
    margin = 0.3 * max(high - low, 1e-9)
    limits = low - margin, high + margin
    axes.plot(limits, limits, color=colour("soft"), linewidth=1.1, linestyle=DASHES[1], zorder=0.9)
    axes.scatter(true, np.clip(guess, *limits), s=11, alpha=0.6, linewidths=0, color=colour(hue))
    axes.set(xlim=limits, ylim=limits, aspect="equal", xlabel=f"true, {unit}", ylabel=f"predicted, {unit}")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5))
    axes.grid()
    exact = Line2D([], [], color=colour("soft"), linestyle=DASHES[1], linewidth=1.1)
    legend_below(figure, [exact], ["exact"], 1)
    return figure


@matplotlib.rc_context(STYLE)
def error_ranges(title: str, ranges: Mapping[str, Sequence[Mapping[str, Any]]], unit: str, hue: str) -> Figure:
    """Mean absolute error by range of the true value (``value_scores.error_by_range``), for each source.

    The first source is drawn in ``hue``, the others are controls. ``unit`` is that of values and errors.
    """
    figure, axes = new_figure(title, 3.5)
    handles = {}
    for number, (source, parts) in enumerate(ranges.items()):
        look: dict[str, Any] = {"color": colour(CONTROL_GREYS.get(source, "soft")), "linewidth": 1.3}
        look["linestyle"] = DASHES[number % len(DASHES)]
        if not number:
            look = {"color": colour(hue), "linewidth": 1.8}
        middles = [(part["low"] + part["high"]) / 2 for part in parts]
        (handles[shorten(source, 22)],) = axes.plot(
            middles, [part["mae"] for part in parts], marker="o", markersize=3.5, **look
        )
    axes.set_ylim(bottom=0)
    axes.margins(y=0.12)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(axis="y")
    axes.set(xlabel=f"true, {unit}", ylabel=f"mean absolute error, {unit}")
    legend_below(figure, list(handles.values()), list(handles), 3)
    return figure
