"""A self-contained HTML page and the pieces it is built from. No scripts, no network.

All text is escaped. Only arguments named ``html``, ``svg`` or ``image`` are trusted.
"""

import base64
import io
from collections.abc import Collection, Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image

from mvitac.data.image_grid import side_by_side
from mvitac.report.palette import COLOURS

_STYLE = "\n" + (Path(__file__).parent / "page.css").read_text(encoding="utf-8")


def html_page(title: str, head: str, sections: Sequence[tuple[str, str, str]], foot: str) -> str:
    """The whole page from sections (anchor, heading, html). Its content security policy forbids requests and scripts."""
    colours = [" ".join(f"--{name}: {pair[i]};" for name, pair in COLOURS.items()) for i in (0, 1)]
    style = _STYLE.replace("LIGHT", colours[0]).replace("DARK", colours[1])
    links = "".join(f'<a href="#{anchor}">{escape(heading)}</a>' for anchor, heading, _ in sections)
    body = "".join(
        f'<section><h2 id="{anchor}">{escape(heading)}</h2>{html}</section>\n' for anchor, heading, html in sections
    )
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}"><meta name="color-scheme" content="light dark">
<title>{escape(title)}</title><style>{style}</style></head><body>
<header>{head}<nav aria-label="Sections">{links}</nav></header>
<main>{body}</main>
<footer>{foot}</footer></body></html>
"""


def paragraph(text: str, css: str = "soft") -> str:
    """A paragraph. A non-breaking space precedes each per cent sign."""
    return f'<p class="{css}">{escape(text).replace(" %", "&nbsp;%")}</p>'


def fold(summary: str, html: str) -> str:
    """``html`` folded behind ``summary``."""
    return f"<details><summary>{escape(summary)}</summary>{html}</details>"


def grid(figures: Iterable[str], css: str = "grid") -> str:
    """Pieces side by side, as many as fit in a row."""
    return f'<div class="{css}">{"".join(figures)}</div>'


def figure(svg: str, caption: str = "") -> str:
    """A drawing and its caption."""
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{svg}{below}</figure>"


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    muted: Collection[str] = (),
    words: bool = False,
    label: str = "table",
) -> str:
    """A table that scrolls in its own box. A row of one cell is a heading.

    ``muted``: first cells of rows to show in grey. With ``words``, cells are text, left-aligned and wrapped, instead of
    numbers. ``label`` is the accessible name.
    """
    head = "".join(f'<th scope="col">{escape(column)}</th>' for column in columns)
    body = []
    for name, *cells in rows:
        if not cells:
            body.append(f'<tr class="part"><th colspan="{len(columns)}">{escape(name)}</th></tr>')
            continue
        look = ' class="muted"' if name in muted else ""
        inner = "".join(f"<td>{escape(cell) if words else _unbroken(cell)}</td>" for cell in cells)
        body.append(f'<tr{look}><th scope="row">{escape(name)}</th>{inner}</tr>')
    box = f'<div class="scroll{" words" * words}" tabindex="0" role="region" aria-label="{escape(label)}">'
    return f"{box}<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"


def _unbroken(cell: str) -> str:
    """A score as HTML: on a phone it wraps, but not within its interval."""
    return escape(cell).replace(", ", ",&nbsp;").replace("-inf", "&#8209;inf")


def picture(image: np.ndarray, alt: str, side: int = 112) -> str:
    """An <img> with uint8 ``image`` [H, W, C] embedded. Six channels are two sensors, shown side by side."""
    joined = Image.fromarray(np.ascontiguousarray(side_by_side(image)))
    if joined.height > side:
        joined = joined.resize((joined.width * side // joined.height, side), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    joined.save(buffer, "JPEG", quality=86, subsampling=0)
    data = base64.b64encode(buffer.getvalue()).decode()
    size = f'width="{joined.width}" height="{joined.height}"'
    return f'<img alt="{escape(alt)}" {size} src="data:image/jpeg;base64,{data}">'


def cell(css: str, image: str, mark: str, text: str) -> str:
    """One image of the gallery with its mark and caption."""
    bold = f"<b>{escape(mark)}</b>" if mark else ""
    return f'<div class="{css}">{image}{bold}<span>{escape(text)}</span></div>'


def code(text: str) -> str:
    """Preformatted text."""
    return f'<pre tabindex="0">{escape(text)}</pre>'
