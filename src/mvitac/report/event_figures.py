"""Figures of events: the score of each frame over a recording, with threshold, alarm and onset."""

from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from mvitac.report.figures import DASHES, STYLE, WIDTH, legend_below, shorten
from mvitac.report.palette import colour


@matplotlib.rc_context(STYLE)
def traces(title: str, event: dict[str, Any], hue: str) -> Figure:
    """Scores over time of some recordings with the ``event`` (above, in ``hue``) and without it (below).

    ``event`` is of ``evaluation.events.score_event``. Times in ms are drawn in seconds.
    """
    figure = Figure(figsize=(WIDTH, 4.4))
    figure.suptitle(shorten(title, 44), fontsize=10, fontweight="bold", x=0.02, ha="left")
    scale, unit = (1000, "s") if event["unit"] == "ms" else (1, event["unit"])
    onset: dict[str, Any] = {"marker": "v", "linestyle": "", "color": colour("ink"), "markersize": 6}
    alarm: dict[str, Any] = {"marker": "o", "linestyle": "", "color": colour("ink"), "markersize": 4.5}
    line: dict[str, Any] = {"color": colour("soft"), "linewidth": 1.1, "linestyle": DASHES[1]}
    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    for axes, with_it in zip(panels, (True, False), strict=True):
        shown = [t for t in event["traces"] if (t["onset"] is not None) == with_it]
        for number, trace in enumerate(shown):
            times = [time / scale for time in trace["times"]]
            look: dict[str, Any] = {"linestyle": DASHES[number % len(DASHES)], "linewidth": 1.3}
            axes.plot(times, trace["scores"], color=colour(hue if with_it else "soft"), **look)
            if trace["alarm"] is not None:
                at = trace["times"].index(trace["alarm"])
                axes.plot(times[at], trace["scores"][at], **alarm)
            if trace["onset"] is not None:
                axes.plot(trace["onset"] / scale, 1.0, clip_on=False, zorder=3, **onset)
        axes.axhline(event["threshold"], **line)
        axes.set(ylim=(0, 1), ylabel="with it" if with_it else "without it")
        axes.xaxis.set_major_locator(MaxNLocator(5))
    panels[1].set_xlabel(f"time, {unit}")
    handles = [Line2D([], [], **look) for look in (line, alarm, onset)]
    legend_below(figure, handles, ["threshold", "alarm", "onset or end"], 3)
    return figure
