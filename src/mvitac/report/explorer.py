"""The explorer: a local gradio page about a run's features. scatter.js draws the map, ``ExplorerData`` has the data."""

import os
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import gradio as gr
from gradio.themes import Base
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware

from mvitac.data.spec import task_title
from mvitac.report.explorer_data import ExplorerData
from mvitac.report.html import blocks as html
from mvitac.report.html import picture

os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")  # no telemetry from a local page; read on import

K = 6  # neighbours shown, as in explorer.css
FILES = Path(__file__).parent
STYLE = (FILES / "explorer.css").read_text()
KEYS = "Arrow keys go from point to point, Enter shows its neighbours, + and - zoom, 0 resets."
MAP = (
    f'<div class="map"><canvas tabindex="0" role="application" aria-label="Map of features. {KEYS}"></canvas>'
    '<div class="tip" aria-live="polite"></div></div>'
    '<div class="legend" role="group" aria-label="Shown in colour"></div><div class="count"></div>'
)


def tip(land: ExplorerData, i: int) -> str:
    """The tooltip of a point as HTML: the pair's two images and a line of text."""
    pictures = [picture(land.picture(i, m), m) for m in land.x]
    return "".join(pictures) + f"<div>{escape(land.describe(i))}</div>"


def page(name: str, land: ExplorerData) -> gr.Blocks:
    """Build the page of one run."""
    with gr.Blocks(title="mvitac explorer") as blocks:
        gr.HTML(f"<h3>{escape(name)} on {escape(land.pack.spec.name)}</h3>")
        controls = _controls(land)

        def draw(modality: str, by: str, task: str | None, split: str, mistakes: bool) -> str:
            return land.points(modality, by, split, task, mistakes=mistakes)

        def hover(row: int) -> str:
            return tip(land, int(row))

        hover.__name__ = "tip"  # scatter.js calls server.tip
        view: Any = gr.HTML(
            draw(*(c.value for c in controls)),
            html_template=MAP,
            css_template=STYLE,
            js_on_load=(FILES / "scatter.js").read_text(),
            server_functions=[hover],
            elem_classes=["mvitac-map"],
        )
        chosen = gr.HTML(
            "Click a point for its nearest neighbours; scroll or pinch to zoom, drag to pan, double-click to reset. "
            f"Choose in the legend what is shown in colour. With the map in focus: {KEYS[0].lower()}{KEYS[1:]}"
        )
        galleries = [gr.HTML(css_template=STYLE) for _ in land.x]
        for control in controls:
            control.change(draw, controls, view)
        view.click(_on_click(land), controls[2], [chosen, *galleries])
    return blocks


def _controls(land: ExplorerData) -> list[Any]:
    """The choices above the map: features, colour, task, split, mistakes only. Two are side by side on a phone."""
    tasks, splits = [*land.classes, *land.values], ["all", *sorted(set(land.split))]
    with gr.Row():
        first = "label" if tasks else "split"
        return [
            gr.Dropdown(list(land.modalities), value=land.modalities[-1], label="features of", min_width=150),
            gr.Dropdown(["label", "split"], value=first, label="colour by", min_width=150),
            gr.Dropdown(tasks, value=tasks[0] if tasks else None, label="task", min_width=150),
            gr.Dropdown(splits, value="test" if "test" in splits else "all", label="split", min_width=150),
            gr.Checkbox(False, label="mistakes only", container=False),
        ]


def _on_click(land: ExplorerData) -> Callable[[str | None, gr.EventData], list[Any]]:

    def click(task: str | None, event: gr.EventData) -> list[str]:
        i = int(event.row)
        title = task_title(task, land.classes[task]) if task in land.labels else ""
        legend = f"; ✓ same {title}, ✕ another" if task in land.labels and land.labels[task][i] >= 0 else ""
        lists = [
            _found(land, f"nearest by {m}" + legend, land.neighbours(x[i : i + 1], m, K, without=i), m, i, task)
            for m, x in land.x.items()
        ]
        return [f"<b>{escape(land.describe(i))}</b>", *lists]

    return click


def _found(
    land: ExplorerData, title: str, pairs: Sequence[tuple[int, float]], modality: str, asked: int, task: str | None
) -> str:
    """Similar rows as HTML. Each is marked by its class in ``task``, and whether that is the class of row ``asked``."""
    cells = []
    for i, score in pairs:
        same = land.same_class(asked, i, task)
        css, mark = {None: ("", ""), True: ("right", "✓"), False: ("wrong", "✕")}[same]
        if task and mark:
            mark += f" {land.classes[task][land.labels[task][i]]}"
        image = picture(land.picture(i, modality), f"{modality} of {land.describe(i)}", 224)
        cells.append(html.cell(css, image, mark, f"{land.describe(i)} · {score:.2f}"))
    return f'<h4>{escape(title)}</h4><div class="found">{"".join(cells)}</div>'


def serve(blocks: gr.Blocks, *, host: str = "127.0.0.1", port: int | None = None, wait: bool = True) -> str:
    """Serve the page and return its address. Fonts come from the machine, nothing from the network.

    Only requests to names of this machine are answered: a site that lets its own name point to 127.0.0.1 (DNS rebinding)
    is not. On 0.0.0.0, which is open to the network, all are.
    """
    names = ["*"] if host in ("0.0.0.0", "::") else ["localhost", "127.0.0.1", host]
    theme = Base(font=["system-ui", "sans-serif"], font_mono=["monospace"])
    options: dict[str, Any] = {"share": False, "quiet": True, "theme": theme}
    options["app_kwargs"] = {"middleware": [Middleware(TrustedHostMiddleware, allowed_hosts=names)]}
    return blocks.launch(server_name=host, server_port=port, prevent_thread_lock=not wait, **options)[1]
