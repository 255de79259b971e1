"""The explorer: a local page on gradio that shows what a run knows. The map itself is scatter.js, the facts Landscape's."""

from __future__ import annotations

import base64
import html
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gradio as gr
import numpy as np
from gradio.themes import Base
from PIL import Image

from mvitac.report.explorer_data import ExplorerData

os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")  # a local page tells nobody; read on import

K = 6
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
"""Of the galleries, whole: the label is what one looks for."""


def tip(land: ExplorerData, i: int) -> str:
    """What hovering over a point shows: the pair's two pictures and a line of text."""
    pictures = []
    for modality in land.x:
        data = io.BytesIO()
        Image.fromarray(land.picture(i, modality)).save(data, "PNG")
        text = base64.b64encode(data.getvalue()).decode()
        pictures.append(f'<img alt="{modality}" src="data:image/png;base64,{text}">')
    return "".join(pictures) + f"<div>{html.escape(land.describe(i))}</div>"


def page(lands: dict[str, ExplorerData]) -> Any:
    """The page of one run, or of several side by side, as ``gradio.Blocks``. They must show the same pack."""
    first = next(iter(lands.values()))
    tasks = list(first.classes)
    splits = ["all", *sorted(set(first.split))]

    def maps(modality: str, colour: str, task: str | None, split: str, mistakes: bool) -> list[str]:
        return [land.points(modality, colour, split, task, mistakes=mistakes) for land in lands.values()]

    def found(land: ExplorerData, pairs: Sequence[tuple[int, float]], modality: str) -> list[tuple[np.ndarray, str]]:
        return [(land.picture(i, modality), f"{land.name(i)} · {score:.2f}") for i, score in pairs]

    with gr.Blocks(title="mvitac explorer") as blocks:
        gr.Markdown(f"### {' | '.join(lands)} on {first.pack.spec.name}")
        with gr.Row():
            modality = gr.Dropdown(list(first.modalities), value=first.modalities[-1], label="features of")
            colour = gr.Dropdown(["label", "error", "split"], value="label" if tasks else "split", label="colour by")
            task = gr.Dropdown(tasks, value=tasks[0] if tasks else None, label="task")
            split = gr.Dropdown(splits, value="test" if "test" in splits else "all", label="split")
            mistakes = gr.Checkbox(False, label="mistakes only")
        controls = [modality, colour, task, split, mistakes]
        start = maps(*(c.value for c in controls))
        views = []
        with gr.Row():
            for (name, land), value in zip(lands.items(), start, strict=True):
                with gr.Column(min_width=300):
                    if len(lands) > 1:
                        gr.Markdown(f"**{name}**")

                    def hover(row: int, land: ExplorerData = land) -> str:
                        return tip(land, int(row))

                    hover.__name__ = "tip"  # scatter.js calls server.tip
                    script = (Path(__file__).parent / "scatter.js").read_text()
                    views.append(
                        gr.HTML(
                            value,
                            html_template=MAP,
                            css_template=STYLE,
                            js_on_load=script,
                            server_functions=[hover],
                            elem_classes=["mvitac-map"],
                        )
                    )
        chosen = gr.Markdown(
            "Click a point for its nearest neighbours; scroll or pinch to zoom, drag to pan, double-click to reset."
        )
        galleries = {
            m: gr.Gallery(label=f"nearest by {m}", columns=K, rows=1, height=220, object_fit="contain") for m in first.x
        }
        with gr.Row():
            with gr.Column(min_width=240):
                wants = (
                    "your picture (of touch: minus its background)" if first.model.spec.difference else "your picture"
                )
                given = gr.Image(label=wants, type="numpy", image_mode="RGB", sources=["upload", "clipboard"])
                kind = gr.Radio(list(first.x), value=next(iter(first.x)), label="it is a picture of")
                ask = gr.Button("Query and classify" + (f" by {next(iter(lands))}" if len(lands) > 1 else ""))
            with gr.Column(min_width=240):
                said = gr.Markdown()
                alike = gr.Gallery(label="most alike", columns=3, height=320, object_fit="contain")

        for control in controls:
            control.change(maps, controls, views)

        for view, land in zip(views, lands.values(), strict=True):

            def click(event: gr.EventData, land: ExplorerData = land) -> list[Any]:
                i = int(event.row)
                lists = [found(land, land.neighbours(land.x[m][i : i + 1], m, K, without=i), m) for m in galleries]
                return [f"**{land.describe(i)}**", *lists]

            view.click(click, None, [chosen, *galleries.values()])

        def query(image: np.ndarray | None, modality: str) -> tuple[str, list[tuple[np.ndarray, str]]]:
            if image is None:
                return "Give a picture first.", []
            answers, pairs = first.query(image, modality, K)
            lines = []
            for name, probabilities in answers.items():
                best = sorted(probabilities.items(), key=lambda item: -item[1])[:3]
                lines.append(f"- **{name}**: " + ", ".join(f"{c} {100 * p:.0f} %" for c, p in best))
            return "\n".join(lines) or "This run has no labels to classify by.", found(first, pairs, modality)

        ask.click(query, [given, kind], [said, alike])
    return blocks


def serve(blocks: Any, *, host: str = "127.0.0.1", port: int | None = None, wait: bool = True) -> str:
    """Serve the page and return its address; fonts come from the machine, nothing from the network."""
    theme = Base(font=["system-ui", "sans-serif"], font_mono=["monospace"])
    _, address, _ = blocks.launch(
        server_name=host,
        server_port=port,
        share=False,
        quiet=True,
        prevent_thread_lock=not wait,
        theme=theme,
        css=CAPTIONS,
    )
    return address
