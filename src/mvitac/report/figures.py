"""The report's figures: drawn once with matplotlib, kept as PNG files and as SVG that takes its colours from the page.

Every colour drawn here is one of ``COLOURS``; ``to_svg`` turns it into the CSS variable of that name, so one drawing is
legible on a light page and on a dark one. No pyplot: nothing global, nothing to close.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

COLOURS: dict[str, tuple[str, str]] = {
    "ink": ("#1d232b", "#e7eaee"),
    "soft": ("#5a6470", "#a0aab6"),
    "rule": ("#dde2e7", "#2d3540"),
    "panel": ("#eef1f4", "#20272f"),
    "blue": ("#0072b2", "#56aee8"),
    "vermilion": ("#d55e00", "#ff8a4c"),
    "green": ("#009e73", "#33c99d"),
    "purple": ("#b5629a", "#e2a0cb"),
    "amber": ("#d18f00", "#f0b840"),
    "sky": ("#4fb0e2", "#a5dbf9"),
    "olive": ("#8d8a1e", "#d9d45a"),
    "brown": ("#7b5334", "#bd936d"),
    "grey1": ("#6d7783", "#99a3af"),
    "grey2": ("#8c95a0", "#7c8692"),
    "grey3": ("#a8b0b9", "#626c78"),
    "grey4": ("#c2c8cf", "#4c5661"),
}
"""Name -> colour on a light page, on a dark page; hues after Okabe and Ito (told apart with any colour vision)."""
HUES = ("blue", "vermilion", "green", "amber", "purple", "sky", "olive", "brown")
MODALITY_HUES = {"touch": "blue", "vision": "vermilion", "both": "green"}
CONTROL_GREYS = {"imagenet": "grey1", "untrained": "grey2", "pixels": "grey3", "border": "grey4"}
MARKERS = ("o", "^", "s", "D", "v", "P", "X", "*")
DASHES = ("-", "--", ":", "-.")

WIDTH = 4.4
"""Inches. At a phone's width (340 px) its 9 pt letters are still 9 px high, hence many small figures and no big one."""
_STYLE: dict[Any, Any] = {
    "text.parse_math": False,  # class names may hold a dollar sign
    "font.size": 9,
    "svg.fonttype": "none",  # letters stay letters: small, sharp, in the page's own font
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
}


def colour(name: str) -> str:
    """The colour ``name`` as drawn (its light variant)."""
    return COLOURS[name][0]


def _figure(title: str, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots()
    axes.set_title(shorten(title, 48), color=colour("ink"))
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(colour("rule"))
    axes.tick_params(colors=colour("soft"), length=0)
    return figure, axes


def shorten(text: str, length: int) -> str:
    """``text`` in at most ``length`` characters."""
    return text if len(text) <= length else text[: length - 1] + "…"


def _below(figure: Figure, handles: Sequence[Any], labels: Sequence[str], columns: int) -> None:
    """A legend under the axes, where it can hide nothing."""
    options: dict[str, Any] = {"handlelength": 1.4, "columnspacing": 1.2, "fontsize": 8.5, "handletextpad": 0.5}
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, labelcolor=colour("ink"), **options)


# -- figures ----------------------------------------------------------------------------------------------------------


@matplotlib.rc_context(_STYLE)
def bars(
    title: str, groups: Mapping[str, Mapping[str, Mapping[str, float]]], lines: Mapping[str, float], what: str
) -> Figure:
    """Bars in percent with 95 % whiskers: group (modality or direction) -> source -> mean, low, high in 0 .. 1.

    Methods carry their modality's colour, controls are grey; ``lines`` (majority, chance) cross all groups.
    """
    num_rows = sum(len(group) + 1.25 for group in groups.values())
    figure, axes = _figure(title, 0.85 + 0.21 * num_rows)
    y, ticks, names, top = 0.0, [], [], max([0.0, *lines.values()])
    for number, (group, cells) in enumerate(groups.items()):
        hue = MODALITY_HUES.get(group, HUES[2 + 2 * (number % 2)])
        axes.text(0, y, group.replace("->", "→"), color=colour(hue), fontweight="bold", va="center", ha="left")
        for source, cell in cells.items():
            y += 1
            mean, low, high = (100 * cell[k] for k in ("mean", "low", "high"))
            axes.barh(y, mean, 0.74, color=colour(CONTROL_GREYS.get(source, hue)))
            # whiskers with a halo, or they would drown in the dark bars
            axes.plot([low, high], [y, y], color=colour("ink"), linewidth=1.1, solid_capstyle="butt")
            axes.plot([low, high], [y, y], "|", color=colour("ink"), markersize=5, markeredgewidth=1.1)
            weight = "normal" if source in CONTROL_GREYS else "bold"
            look: dict[str, Any] = {"va": "center", "fontsize": 8.5, "color": colour("ink"), "fontweight": weight}
            axes.annotate(f"{mean:.1f}", (high, y), xytext=(5, 0), textcoords="offset points", **look)
            ticks.append(y)
            names.append(shorten(source, 22))
            top = max(top, high / 100)
        y += 1.25
    axes.set_yticks(ticks, names, color=colour("ink"))
    axes.set_ylim(y - 0.6, -0.7)
    axes.set_xlim(0, max(1.0, 100 * top * 1.15))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.grid(axis="x", color=colour("rule"), linewidth=0.7)
    axes.set_axisbelow(True)
    axes.set_xlabel(what, color=colour("soft"), fontsize=8.5)
    axes.spines["left"].set_visible(False)
    handles = []
    for number, (name, value) in enumerate(lines.items()):
        dash = DASHES[1 + number % 3]
        axes.axvline(100 * value, color=colour("soft"), linestyle=dash, linewidth=1.2, zorder=0.9)
        handles.append((Line2D([], [], color=colour("soft"), linestyle=dash), f"{shorten(name, 28)} {100 * value:.1f}"))
    if handles:
        _below(figure, [h for h, _ in handles], [label for _, label in handles], 3)
    return figure


@dataclass(frozen=True)
class Line:
    """One curve: ``y`` over ``x`` steps; curves of one label (seeds) share their look and one legend entry."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    hue: str
    dash: str = "-"


@matplotlib.rc_context(_STYLE)
def curves(title: str, lines: Sequence[Line], references: Mapping[str, float] | None = None) -> Figure:
    """Curves over the steps; ``references`` are level lines such as chance."""
    figure, axes = _figure(title, 2.75)
    handles: dict[str, Any] = {}
    several = len({line.label for line in lines}) < len(lines)  # seeds: thinner, so that they stay apart
    for line in lines:
        marker = "o" if len(line.x) < 12 else ""
        (drawn,) = axes.plot(
            line.x,
            line.y,
            line.dash,
            color=colour(line.hue),
            marker=marker,
            markersize=3.2,
            linewidth=1.2 if several else 1.8,
        )
        handles.setdefault(line.label, drawn)
    for number, (name, value) in enumerate((references or {}).items()):
        handles[name] = axes.axhline(
            value, color=colour("soft"), linestyle=DASHES[1 + number % 3], linewidth=1.1, zorder=0.9
        )
    axes.grid(axis="y", color=colour("rule"), linewidth=0.7)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.margins(y=0.12)
    axes.set_xlim(0, 1.04 * max(max(line.x) for line in lines))
    axes.set_xlabel("step", color=colour("soft"), fontsize=8.5)
    labels = [shorten(label, 30) for label in handles]
    _below(figure, list(handles.values()), labels, 2 if max(map(len, labels)) > 18 else 3)
    return figure


@matplotlib.rc_context(_STYLE)
def confusion(title: str, counts: np.ndarray, classes: Sequence[str]) -> Figure:
    """Row-normalised confusion of ``counts`` [true, predicted]: the diagonal (right) blue, mistakes vermilion."""
    num = len(classes)
    figure, axes = _figure(title, 3.4 if num <= 4 else 4.3)
    totals = counts.sum(1, keepdims=True)
    shares = counts / np.maximum(totals, 1)
    axes.add_patch(Rectangle((-0.5, -0.5), num, num, facecolor=colour("panel"), edgecolor="none"))
    for true, guess in zip(*np.nonzero(shares), strict=True):
        share = shares[true, guess]
        hue = colour("blue" if true == guess else "vermilion")
        gap = 0.03 if num <= 40 else 0.0
        box = (guess - 0.5 + gap, true - 0.5 + gap)
        # under a number never opaque: it must stay readable, in light and in dark
        alpha = round(0.12 + (0.58 if num <= 8 else 0.88) * share, 2)
        axes.add_patch(Rectangle(box, 1 - 2 * gap, 1 - 2 * gap, facecolor=hue, alpha=alpha, edgecolor="none"))
        if num <= 8:
            percent = f"{100 * share:.0f} %" if num <= 4 else f"{100 * share:.0f}"
            axes.text(guess, true, percent, ha="center", va="center", color=colour("ink"))
    axes.set_xlim(-0.5, num - 0.5)
    axes.set_ylim(num - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.spines[["left", "bottom"]].set_visible(False)
    if num <= 40:
        size = 9 if num <= 8 else 7.5 if num <= 24 else 5
        names = [shorten(name, 14) for name in classes]
        axes.set_xticks(range(num), names, rotation=0 if num <= 4 else 90, fontsize=size)
        axes.set_yticks(range(num), names, fontsize=size)
    else:
        axes.set_xticks([])
        axes.set_yticks([])
    axes.set_xlabel("predicted", color=colour("soft"), fontsize=8.5)
    axes.set_ylabel("true", color=colour("soft"), fontsize=8.5)
    return figure


@matplotlib.rc_context(_STYLE)
def feature_map(title: str, points: np.ndarray, labels: np.ndarray, classes: Sequence[str]) -> Figure:
    """Points [N, 2] by label [N] (-1 = unlabelled): eight hues, then the same hues with another marker."""
    shown = [label for label in range(-1, len(classes)) if (labels == label).any()]
    longest = max((len(shorten(classes[label], 16)) for label in shown if label >= 0), default=0)
    columns = 4 if longest <= 10 else 3
    num_entries = min(len(shown), 40)
    figure, axes = _figure(title, 3.5 + 0.16 * -(-num_entries // columns))
    handles, names = [], []
    for label in shown:
        look: dict[str, Any] = {"color": colour("grey3"), "marker": "."}
        if label >= 0:
            marker = MARKERS[label // len(HUES) % len(MARKERS)]
            look = {"color": colour(HUES[label % len(HUES)]), "marker": marker}
        at = points[labels == label]
        axes.scatter(at[:, 0], at[:, 1], s=11, alpha=0.8, linewidths=0, **look)
        if len(handles) < num_entries:
            handles.append(Line2D([], [], linestyle="", markersize=5, markeredgewidth=0, **look))
            names.append(shorten(classes[label], 16) if label >= 0 else "no label")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[["top", "right"]].set_visible(True)
    for spine in axes.spines.values():
        spine.set_color(colour("rule"))
    if classes or len(shown) > 1:
        _below(figure, handles, names, columns)
    return figure


# -- to files and into the page ---------------------------------------------------------------------------------------


@matplotlib.rc_context(_STYLE)
def _print(figure: Figure, canvas: type[FigureCanvasAgg | FigureCanvasSVG], face: str, **options: Any) -> bytes:
    """What ``canvas`` prints of the figure, which is laid out once for all canvases (savefig would do it each time)."""
    figure.set_facecolor(face)
    for axes in figure.axes:
        axes.set_facecolor("none")
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")  # class names in scripts that matplotlib's font lacks
        if figure.get_layout_engine() is not None:
            figure.draw_without_rendering()
            figure.set_layout_engine(None)
        printed = canvas(figure)
        (printed.print_svg if isinstance(printed, FigureCanvasSVG) else printed.print_png)(buffer, **options)
    return buffer.getvalue()


def to_png(figure: Figure) -> bytes:
    """The figure on white at 200 dpi."""
    figure.set_dpi(200)
    return _print(figure, FigureCanvasAgg, "white", metadata={"Software": None})


_VARIABLES = {light: f"var(--{name})" for name, (light, _) in COLOURS.items()}


def to_svg(figure: Figure, name: str, alt: str) -> str:
    """The figure as an <svg> for HTML: no outer references, no fixed size, the page's colours and font."""
    metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    # The salt keeps the ids of several drawings on one page apart, and a drawing byte-identical when drawn again.
    with matplotlib.rc_context({"svg.hashsalt": name}):
        text = _print(figure, FigureCanvasSVG, "none", metadata=metadata).decode()
    box = re.search(r'viewBox="[^"]*"', text)
    assert box is not None
    body = text[text.index(">", box.end()) + 1 :]
    body = re.sub(r"<style.*?</style>", "", body, count=1, flags=re.DOTALL)  # it would style the whole page
    body = re.sub(r'<g id="[^"]*"', "<g", body)  # figure_1, axes_1, ... of every figure: nothing points there
    body = re.sub(r"font-family: [^;\"]*", "font-family: var(--font)", body)
    body = re.sub(r"(font: [^;\"]*?[0-9.]+px) [^;\"]*", r"\1 var(--font)", body)
    body = re.sub(r"#[0-9a-f]{6}", lambda found: _VARIABLES.get(found[0], found[0]), body)
    body = re.sub(r"\s+", " ", body)
    return f'<svg class="figure" role="img" aria-label="{escape(alt)}" {box[0]}>{body}'
