"""The explorer: a local gradio page about a run's features. scatter.js draws the map, ``ExplorerData`` has the data."""

from __future__ import annotations

import base64
import html
import io
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gradio as gr
import numpy as np
from gradio.themes import Base
from PIL import Image
from starlette.middleware import Middleware

from mvitac.data.images import to_rgb
from mvitac.report.explorer_data import ExplorerData
from mvitac.report.guard import MAX_BODY, Guard, as_text

os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")  # no telemetry from a local page; read on import

K = 6
KEPT = (60, 600)
"""Seconds between two deletions of uploaded pictures, and the age of those that are deleted."""
MAP = (
    '<div class="map"><canvas></canvas><div class="tip"></div></div><div class="legend"></div><div class="count"></div>'
)
STYLE = """
.map { position: relative; width: 100%; height: min(70vh, 560px, 110vw); }
canvas { width: 100%; height: 100%; border: 1px solid var(--border-color-primary); touch-action: none; cursor: crosshair;
         background: var(--background-fill-primary); color: var(--body-text-color); }
.tip { position: absolute; display: none; max-width: 260px; padding: 6px; font-size: 12px; pointer-events: none;
       background: var(--background-fill-primary); color: var(--body-text-color); border: 1px solid #888; z-index: 5; }
.tip img { width: 112px; height: 112px; object-fit: contain; image-rendering: pixelated; display: inline; }
.legend span { display: inline-block; margin: 2px 10px 2px 0; font-size: 12px; }
.legend i { display: inline-block; width: 10px; height: 10px; margin-right: 4px; }
.count { font-size: 12px; opacity: .7; }
"""
CAPTIONS = """
.caption-label { white-space: normal !important; max-width: 100% !important; line-height: 1.2 !important; }
@media (max-width: 600px) { .caption-label { font-size: 10px !important; padding: 1px 3px !important; } }
"""
"""Show the captions of galleries in full."""
Found = list[tuple[np.ndarray, str]]
"""Images with captions."""


def tip(land: ExplorerData, i: int) -> str:
    """The tooltip of a point as HTML: the pair's two images and a line of text."""
    pictures = []
    for modality in land.x:
        data = io.BytesIO()
        Image.fromarray(land.picture(i, modality)).save(data, "PNG")
        text = base64.b64encode(data.getvalue()).decode()
        pictures.append(f'<img alt="{modality}" src="data:image/png;base64,{text}">')
    return "".join(pictures) + f"<div>{html.escape(land.describe(i))}</div>"


def page(lands: dict[str, ExplorerData]) -> gr.Blocks:
    """Build the page of one run, or of several runs side by side. All must show the same pack.

    Args:
        lands: Name of each run -> its data.
    """
    first = next(iter(lands.values()))
    with gr.Blocks(title="mvitac explorer", delete_cache=KEPT) as blocks:
        gr.Markdown(f"### {as_text(' | '.join(lands))} on {as_text(first.pack.spec.name)}")
        controls = _controls(first)
        draw = partial(_maps, list(lands.values()))
        start = draw(*(c.value for c in controls))
        with gr.Row():
            views = [_map(name, land, s, len(lands) > 1) for (name, land), s in zip(lands.items(), start, strict=True)]
        chosen = gr.Markdown(
            "Click a point for its nearest neighbours; scroll or pinch to zoom, drag to pan, double-click to reset."
        )
        galleries = [
            gr.Gallery(label=f"nearest by {m}", columns=K, rows=1, height=220, object_fit="contain") for m in first.x
        ]
        _query_form(first, f" by {next(iter(lands))}" if len(lands) > 1 else "")
        for control in controls:
            control.change(draw, controls, views)
        for view, land in zip(views, lands.values(), strict=True):
            view.click(_on_click(land), None, [chosen, *galleries])
    return blocks


def _controls(land: ExplorerData) -> list[Any]:
    """The choices above the map: features, colour, task, split, mistakes only."""
    tasks, splits = list(land.classes), ["all", *sorted(set(land.split))]
    with gr.Row():
        return [
            gr.Dropdown(list(land.modalities), value=land.modalities[-1], label="features of"),
            gr.Dropdown(["label", "error", "split"], value="label" if tasks else "split", label="colour by"),
            gr.Dropdown(tasks, value=tasks[0] if tasks else None, label="task"),
            gr.Dropdown(splits, value="test" if "test" in splits else "all", label="split"),
            gr.Checkbox(False, label="mistakes only"),
        ]


def _maps(
    lands: Sequence[ExplorerData], modality: str, colour: str, task: str | None, split: str, mistakes: bool
) -> list[str]:
    return [land.points(modality, colour, split, task, mistakes=mistakes) for land in lands]


def _map(name: str, land: ExplorerData, value: str, several: bool) -> Any:
    """The map of one run, with its name if there are several."""

    def hover(row: int) -> str:
        return tip(land, int(row))

    hover.__name__ = "tip"  # scatter.js calls server.tip
    with gr.Column(min_width=300):
        if several:
            gr.Markdown(f"**{as_text(name)}**")
        return gr.HTML(
            value,
            html_template=MAP,
            css_template=STYLE,
            js_on_load=(Path(__file__).parent / "scatter.js").read_text(),
            server_functions=[hover],
            elem_classes=["mvitac-map"],
        )


def _on_click(land: ExplorerData) -> Callable[[gr.EventData], list[Any]]:
    """A handler that shows the neighbours of the clicked point by each modality."""

    def click(event: gr.EventData) -> list[Any]:
        i = int(event.row)
        lists = [_found(land, land.neighbours(x[i : i + 1], m, K, without=i), m) for m, x in land.x.items()]
        return [f"**{as_text(land.describe(i))}**", *lists]

    return click


def _found(land: ExplorerData, pairs: Sequence[tuple[int, float]], modality: str) -> Found:
    return [(land.picture(i, modality), f"{land.name(i)} · {score:.2f}") for i, score in pairs]


def _query_form(land: ExplorerData, by: str) -> None:
    """The form for an image of one's own."""
    wants = "your picture (of touch: minus its background)" if land.model.spec.difference else "your picture"
    with gr.Row():
        with gr.Column(min_width=240):
            given = gr.Image(label=wants, type="pil", image_mode=None, sources=["upload", "clipboard"])
            kind = gr.Radio(list(land.x), value=next(iter(land.x)), label="it is a picture of")
            ask = gr.Button(f"Query and classify{by}")
        with gr.Column(min_width=240):
            answer = gr.Markdown()
            alike = gr.Gallery(label="most similar", columns=3, height=320, object_fit="contain")
    ask.click(partial(_query, land), [given, kind], [answer, alike])


def _query(land: ExplorerData, image: Image.Image | None, modality: str) -> tuple[str, Found]:
    """Classify an image and find the rows most similar to it."""
    if image is None:
        return "Give a picture first.", []
    try:
        answers, pairs = land.query(np.asarray(to_rgb(image)), modality, K)
    except ValueError as error:
        return as_text(f"This picture cannot be used: {error}"), []
    lines = []
    for name, probabilities in answers.items():
        best = sorted(probabilities.items(), key=lambda item: -item[1])[:3]
        lines.append(f"- **{as_text(name)}**: " + ", ".join(f"{as_text(c)} {100 * p:.0f} %" for c, p in best))
    return "\n".join(lines) or "This run has no labels to classify by.", _found(land, pairs, modality)


def serve(blocks: gr.Blocks, *, host: str = "127.0.0.1", port: int | None = None, wait: bool = True) -> str:
    """Serve the page and return its address. Fonts come from the machine, nothing from the network.

    Only names of this machine and the page's own origin are answered (``guard.Guard``).
    """
    theme = Base(font=["system-ui", "sans-serif"], font_mono=["monospace"])
    options: dict[str, Any] = {"share": False, "quiet": True, "theme": theme, "css": CAPTIONS}
    options |= {"max_file_size": MAX_BODY, "app_kwargs": {"middleware": [Middleware(Guard, host=host)]}}
    return blocks.launch(server_name=host, server_port=port, prevent_thread_lock=not wait, **options)[1]
