"""Figures of predicted values: predicted against true, the error by range of the true value, and values over time."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from mvitac.report.figures import DASHES, STYLE, legend_below, new_figure, shorten
from mvitac.report.palette import CONTROL_GREYS, MODALITY_HUES, colour


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


@matplotlib.rc_context(STYLE)
def over_time(predictions: Iterable[Mapping[str, Any]]) -> Figure:
    """Predicted values against time, one panel per value, with a band of the usual error. A line is one touch.

    ``predictions`` are lines of `mvitac live --predictions`: "time" in s, "touch", and by task the values with unit and
    spread. ValueError if they have no values.
    """
    panels: dict[tuple[str, str], dict[int, list[tuple[float, float, float]]]] = {}
    for line in predictions:
        for task, found in line.items():
            for name, value in found.items() if isinstance(found, Mapping) else ():
                if isinstance(value, Mapping):
                    label = f"{name if name == task else f'{task}: {name}'}, {value['unit']}"
                    point = line["time"], value["value"], value["spread"]
                    panels.setdefault((task, label), {}).setdefault(line["touch"], []).append(point)
    if not panels:
        raise ValueError(
            "these predictions have no values to draw: no touch was seen, or the model predicts classes only"
        )
    figure = Figure(figsize=(7, 0.8 + 1.7 * len(panels)))
    hue = colour(MODALITY_HUES["touch"])
    each = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, ((_, label), touches) in zip(each, panels.items(), strict=True):
        for points in touches.values():
            times, values, spreads = np.array(points, float).T
            axes.fill_between(times, values - spreads, values + spreads, color=hue, alpha=0.2, linewidth=0)
            axes.plot(times, values, color=hue, linewidth=1.4, marker="o" if len(times) == 1 else None, markersize=3)
        axes.set_ylabel(shorten(label, 28), color=colour("ink"))
        axes.grid(axis="y")
    each[-1].set_xlabel("time, s")
    return figure
