"""Figures of the report, drawn with matplotlib as PNG or SVG in the page's colours, without pyplot's global state."""

import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from sklearn.metrics import ConfusionMatrixDisplay

from mvitac.evaluation.leaks import leak_mark
from mvitac.evaluation.score_text import percent
from mvitac.report.html import COLOURS, CONTROL_GREYS, MODALITY_HUES, data_uri

DASHES = ("-", "--", ":", "-.")
BELOW: Any = "outside lower center"  # of legends, where they hide nothing

LEAST = -0.5  # where figures cut off R2, which has no lower limit
NUM_NUMBERED = 20  # largest number of classes of a confusion matrix with numbers
WIDTH = 3.8  # inches. In the report's columns of about 360 px, 9 pt letters are then about 12 px high.
STYLE: Any = matplotlib.rc_params_from_file(Path(__file__).with_suffix(".mplstyle"), use_default_template=False)


def new_figure(title: str, height: float, width: float = WIDTH) -> tuple[Figure, Axes]:
    """Axes with a title, in inches."""
    figure = Figure(figsize=(width, height))
    axes = figure.subplots()
    axes.set_title(shorten(title, 40))
    return figure, axes


def shorten(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


@matplotlib.rc_context(STYLE)
def bars(
    title: str, groups: Mapping[str, Mapping[str, Mapping[str, Any]]], lines: Mapping[str, float], what: str
) -> Figure:
    """Horizontal bars in percent with 95 % whiskers. Methods have their modality's colour, controls are grey.

    ``groups``: modality -> source -> mean, low and high, at most 1; ``low`` None: no whisker. ``lines``
    are vertical ones across all groups, such as majority or chance. ``what`` labels the axis.
    """
    figure, axes = new_figure(title, 0.85 + 0.21 * sum(len(group) + 1.25 for group in groups.values()))
    y, ticks, spans, top = 0.0, {}, [], max([0.0, *lines.values()])
    lows = [cell[k] for group in groups.values() for cell in group.values() for k in ("mean", "low")]
    least = max(LEAST, min(0.0, *(low for low in lows if low is not None)))
    for modality, cells in groups.items():
        hue = MODALITY_HUES[modality]
        axes.text(100 * least, y, modality, color=COLOURS[hue], fontweight="bold", va="center", ha="left")
        spans.append((y + 0.5, y + len(cells) + 0.5))
        for source, cell in cells.items():
            y += 1
            _bar(axes, y, source, cell, hue, least)
            ticks[y] = shorten(source, 22)
            top = max(top, cell["high"])
        y += 1.25
    axes.set_yticks(list(ticks), list(ticks.values()), color=COLOURS["ink"])
    axes.set(xlim=(100 * least, max(1.0, 100 * (top + 0.15 * (top - least)))), ylim=(y - 0.6, -0.7), xlabel=what)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.grid(axis="x")
    axes.spines["left"].set_visible(False)
    handles = []
    for number, (name, value) in enumerate(lines.items()):
        look: dict[str, Any] = {"color": COLOURS["soft"], "linestyle": DASHES[1 + number % 3]}
        for low, high in spans:  # not through the names of the groups
            axes.plot([100 * max(least, value)] * 2, [low, high], linewidth=1.2, zorder=0.9, **look)
        handles.append(Line2D([], [], label=f"{shorten(name, 28)} {percent(value)}", **look))
    if handles:
        figure.legend(handles=handles, loc=BELOW, ncols=3)
    return figure


def _bar(axes: Axes, y: float, source: str, cell: Mapping[str, Any], hue: str, least: float) -> None:
    ends = [cell["low"], cell["high"]] if cell["low"] is not None else [cell["mean"]] * 2
    mean, low, high = (100 * max(least, value) for value in (cell["mean"], *ends))
    axes.barh(y, mean, 0.74, color=COLOURS[CONTROL_GREYS.get(source, hue)])
    if low < high:
        axes.plot([low, high], [y, y], color=COLOURS["ink"], linewidth=1.1, solid_capstyle="butt")
        axes.plot([low, high], [y, y], "|", color=COLOURS["ink"], markersize=5, markeredgewidth=1.1)
    look: dict[str, Any] = {"va": "center", "textcoords": "offset points"}
    look["fontweight"] = "normal" if source in CONTROL_GREYS else "bold"
    look["bbox"] = {"facecolor": COLOURS["card"], "edgecolor": "none", "pad": 0.5}  # no line runs through the value
    axes.annotate(percent(cell["mean"]) + leak_mark(cell.get("leak", "")), (high, y), xytext=(5, 0), **look)


@dataclass(frozen=True)
class Line:
    """One curve: ``y`` over steps ``x``. Curves with the same label (seeds) share a legend entry."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    hue: str
    dash: str = "-"


@matplotlib.rc_context(STYLE)
def curves(title: str, lines: Sequence[Line], references: Mapping[str, float] | None = None) -> Figure:
    """Curves over steps; ``references`` are horizontal lines such as chance."""
    figure, axes = new_figure(title, 2.75)
    handles: dict[str, Any] = {}
    several = len({line.label for line in lines}) < len(lines)  # seeds: thinner lines
    for line in lines:
        marker = "o" if len(line.x) < 12 else ""
        look: dict[str, Any] = {"color": COLOURS[line.hue], "marker": marker, "markersize": 3.2}
        (drawn,) = axes.plot(line.x, line.y, line.dash, linewidth=1.2 if several else 1.8, **look)
        handles.setdefault(line.label, drawn)
        if line.x[0] == 0:  # the value before the first step
            look = {"color": COLOURS[line.hue], "linestyle": "--", "linewidth": 0.9, "alpha": 0.6}
            handles["start"] = axes.axhline(line.y[0], zorder=0.9, **look)
    for number, (name, value) in enumerate((references or {}).items()):
        look = {"color": COLOURS["soft"], "linestyle": DASHES[1 + number % 3], "linewidth": 1.1}
        handles[name] = axes.axhline(value, zorder=0.9, **look)
    axes.grid(axis="y")
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.margins(y=0.12)
    axes.set(xlim=(0, 1.04 * max(1, *(max(line.x) for line in lines))), xlabel="step")
    labels = [shorten(label, 30) for label in handles]
    figure.legend(list(handles.values()), labels, loc=BELOW, ncols=2 if max(map(len, labels)) > 18 else 3)
    return figure


@matplotlib.rc_context(STYLE)
def confusion(title: str, counts: np.ndarray, classes: Sequence[str]) -> Figure:
    """Confusion matrix of ``counts`` [true, predicted], each row in percent."""
    num = len(classes)
    figure, axes = new_figure(title, 3.4 if num <= 4 else 4.3)
    shares = 100 * counts / np.maximum(counts.sum(1, keepdims=True), 1)
    shown = ConfusionMatrixDisplay(shares, display_labels=[shorten(name, 14) for name in classes])
    look: dict[str, Any] = {"include_values": num <= NUM_NUMBERED, "values_format": ".0f", "colorbar": False}
    look["xticks_rotation"] = 0 if num <= 4 else 90
    look |= {"text_kw": {"fontsize": min(9, 110 / num)}, "im_kw": {"vmin": 0, "vmax": 100}}
    shown.plot(ax=axes, cmap="Blues", **look)
    for cell in [] if shown.text_ is None else shown.text_.ravel():
        cell.set_visible(cell.get_text() != "0")
    axes.tick_params(labelsize=9 if num <= 8 else 7.5 if num <= 24 else 5)
    if num > 40:
        axes.set(xticks=[], yticks=[])
    axes.set(xlabel="predicted", ylabel="true")
    return figure


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
    (exact,) = axes.plot(limits, limits, color=COLOURS["soft"], linewidth=1.1, linestyle=DASHES[1], zorder=0.9)
    axes.scatter(true, np.clip(guess, *limits), s=11, alpha=0.6, linewidths=0, color=COLOURS[hue])
    axes.set(xlim=limits, ylim=limits, aspect="equal", xlabel=f"true, {unit}", ylabel=f"predicted, {unit}")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5))
    axes.grid()
    figure.legend([exact], ["exact"], loc=BELOW)
    return figure


@matplotlib.rc_context(STYLE)
def _print(figure: Figure, kind: str, metadata: dict[str, Any], **options: Any) -> bytes:
    for axes in figure.axes:
        axes.set_facecolor("none")
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")  # class names in other scripts
        if (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)
            figure.set_layout_engine("none")
        figure.savefig(buffer, format=kind, metadata=metadata, **options)
    return buffer.getvalue()


def to_png(figure: Figure) -> bytes:
    figure.set_dpi(dpi := 200)
    return _print(figure, "png", {"Software": None}, facecolor="white", dpi=dpi)


def to_svg(figure: Figure) -> str:
    """The figure as the address of an image for HTML."""
    metadata: dict[str, Any] = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    return data_uri(_print(figure, "svg", metadata, facecolor="none"), "svg+xml")
