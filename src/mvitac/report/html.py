"""Blocks of a self-contained HTML page: the macros of ``page.html.j2``, which escape all text. No scripts, no network."""

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup
from PIL import Image

from mvitac.data.images import side_by_side
from mvitac.report.palette import COLOURS

_FILES = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True)
blocks: Any = _FILES.get_template("page.html.j2").make_module({"colours": COLOURS})


def data_uri(data: bytes, kind: str) -> str:
    """``data`` as an address of an image of MIME type image/``kind``."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def picture(image: np.ndarray, alt: str, side: int = 112) -> Markup:
    """An <img> with uint8 ``image`` [H, W, C] embedded. Six channels are two sensors, shown side by side."""
    joined = Image.fromarray(np.ascontiguousarray(side_by_side(image)))
    if joined.height > side:
        joined = joined.resize((joined.width * side // joined.height, side), Image.Resampling.LANCZOS)
    joined.save(buffer := io.BytesIO(), "JPEG", quality=86, subsampling=0)
    return blocks.image(data_uri(buffer.getvalue(), "jpeg"), alt, joined.size)
