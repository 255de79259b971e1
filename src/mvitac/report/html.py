"""Blocks of a self-contained HTML page: macros of ``page.html.j2``, which escape all text. No scripts, no network."""

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup
from PIL import Image

from mvitac.data.images import side_by_side

COLOURS = {"card": "#ffffff", "ink": "#1d232b", "soft": "#5a6470", "rule": "#dde2e7", "panel": "#eef1f4"}
COLOURS |= {"blue": "#0072b2", "vermilion": "#d55e00", "green": "#009e73", "purple": "#b5629a", "amber": "#d18f00"}
COLOURS |= {"sky": "#4fb0e2", "olive": "#8d8a1e", "brown": "#7b5334"}
COLOURS |= {"grey1": "#6d7783", "grey2": "#8c95a0", "grey3": "#a8b0b9", "grey4": "#c2c8cf"}
"""Hues after Okabe and Ito, distinct with any colour vision."""
HUES = ("blue", "vermilion", "green", "amber", "purple", "sky", "olive", "brown")
MODALITY_HUES = {"touch": "blue", "vision": "vermilion", "both": "green"}
CONTROL_GREYS = {"imagenet": "grey1", "start": "soft", "untrained": "grey2", "pixels": "grey3", "border": "grey4"}
SIDE = 112  # pixels

_FILES = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True)
blocks: Any = _FILES.get_template("page.html.j2").make_module({"colours": COLOURS})


def data_uri(data: bytes, kind: str) -> str:
    """``data`` as an address of an image of MIME type image/``kind``."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def picture(image: np.ndarray, alt: str) -> Markup:
    """An <img> with uint8 ``image`` [H, W, C], at most ``SIDE`` high. Six channels are two sensors, side by side."""
    joined = Image.fromarray(np.ascontiguousarray(side_by_side(image)))
    if joined.height > SIDE:
        joined = joined.resize((joined.width * SIDE // joined.height, SIDE), Image.Resampling.LANCZOS)
    joined.save(buffer := io.BytesIO(), "JPEG", quality=86, subsampling=0)
    return blocks.image(data_uri(buffer.getvalue(), "jpeg"), alt, joined.size)
