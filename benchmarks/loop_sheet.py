"""Draw docs/closed-loop.png: one episode of each closed-loop suite, by what knows the truth and by what knows nothing.

python -m benchmarks.loop_sheet
"""

import numpy as np
from matplotlib.figure import Figure

from mvitac.control.insert import Insertion
from mvitac.control.servo import Episode

OUT, COLUMNS = "docs/closed-loop.png", 8


def follow(kind: str, number: int, gain: float) -> tuple[list[np.ndarray], np.ndarray, Episode]:
    """Pictures and places of an episode of servo-v1, corrected by this part of the true error."""
    episode, images, places = Episode.begin(0, kind, number), [], []
    for step in range(40):
        if step % 5 == 0:
            images.append(episode.touch())
        places.append(episode.state[:2])
        episode.move(-gain * (episode.pose - episode.task.target))
    return images[:COLUMNS], np.stack(places), episode


def draw() -> Figure:
    figure = Figure(figsize=(11, 2.9), dpi=100)
    axes = figure.subplots(
        2, COLUMNS + 1, gridspec_kw={"width_ratios": [1.0] * COLUMNS + [1.6], "wspace": 0.05, "hspace": 0.15}
    )
    images, known, episode = follow("corner", 1, 0.5)
    blind = follow("corner", 1, 0.0)[1]
    world, seen, trace = Insertion(0, 2), [], []
    while not world.over:
        if world.steps in (0, 1, 2, 9, 12, 14, 17):
            seen.append(world.see())
        trace.append([world.x_mm - world.wanted[0], world.turn_deg - world.wanted[1]])
        world.step(world.wanted)
    rows = (("gel, corner", images), ("camera; gel in the hand", [*seen, world.touch()]))
    for line, (name, pictures) in zip(axes, rows, strict=True):
        line[0].set_ylabel(name, fontsize=8)
        for axis, picture in zip(line, pictures, strict=False):
            axis.imshow(picture)
        for axis in line[:-1]:
            axis.set(xticks=[], yticks=[])
    low, high = known.min(0) - 4, known.max(0) + 4
    x, y = np.meshgrid(np.linspace(low[0], high[0], 200), np.linspace(low[1], high[1], 200))
    axes[0, -1].contour(x, y, episode.shape.inside(x, y), [0], colors="0.6")
    axes[0, -1].plot(*known.T, "C0", *blind.T, "C3--", lw=1)
    axes[0, -1].set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), title="edge; true pose; no touch")
    axes[1, -1].plot(trace, lw=1)
    axes[1, -1].set_title("expert: mm and degrees to go")
    for axis in axes[:2, -1]:
        axis.tick_params(labelsize=6)
        axis.title.set_size(7)
        axis.title.set_y(0.97)
        axis.yaxis.tick_right()
    return figure


if __name__ == "__main__":
    draw().savefig(OUT, bbox_inches="tight", pil_kwargs={"optimize": True})
