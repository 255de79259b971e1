"""A self-contained HTML page and the pieces it is built from. No scripts, no network.

All text is escaped. Only arguments named ``html``, ``svg`` or ``image`` are trusted.
"""

import base64
import io
from collections.abc import Collection, Iterable, Sequence
from html import escape

import numpy as np
from PIL import Image

from mvitac.data.image_grid import side_by_side
from mvitac.report.palette import COLOURS

_STYLE = """
:root { color-scheme: light dark; --page: #f6f7f9;
  --font: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
  --mono: ui-monospace, "SF Mono", "Cascadia Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace; LIGHT }
@media (prefers-color-scheme: dark) { :root { --page: #0f1318; DARK } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 16px/1.55 var(--font); overflow-wrap: anywhere;
  -webkit-text-size-adjust: 100%; }
main, header, footer { max-width: 1240px; margin: 0 auto; padding: 0 clamp(14px, 3vw, 32px); }
header { padding-top: clamp(24px, 5vw, 56px); }
h1 { font-size: clamp(28px, 4vw, 40px); line-height: 1.15; letter-spacing: -.02em; margin: 0 0 12px; }
h2 { font-size: 22px; letter-spacing: -.01em; line-height: 1.25; margin: 60px 0 4px; scroll-margin-top: 12px; }
h3 { font-size: 16px; margin: 0 0 6px; }
p { margin: 4px 0 12px; max-width: 76ch; }
.soft, figcaption, small { color: var(--soft); }
.eyebrow { color: var(--soft); font-size: 14px; margin: 0 0 6px; }
.chips { display: flex; flex-wrap: wrap; gap: 6px; padding: 0; margin: 0 0 18px; list-style: none; font-size: 14px; }
.chips li { padding: 2px 10px; border: 1px solid var(--rule); border-radius: 99px; background: var(--card);
  color: var(--soft); }
.chips b { color: var(--ink); font-weight: 600; }
.verdict { font-size: clamp(18px, 2.2vw, 22px); line-height: 1.4; max-width: 62ch; margin: 0 0 20px; }
nav { display: flex; flex-wrap: wrap; gap: 4px 18px; font-size: 14px; margin: 22px 0 0; padding-top: 12px;
  border-top: 1px solid var(--rule); }
a { color: var(--blue); text-decoration: none; }
a:hover { text-decoration: underline; }
.grid { display: grid; gap: 14px; grid-template-columns: repeat(auto-fill, minmax(min(100%, 340px), 1fr));
  margin: 14px 0; }
.grid.large { grid-template-columns: repeat(auto-fill, minmax(min(100%, 460px), 1fr)); }
.pillars { columns: 340px; column-gap: 14px; margin: 14px 0; }
.pillars .scroll { margin: 0 0 14px; break-inside: avoid; }
.beside { display: flex; flex-wrap: wrap; gap: 14px; align-items: flex-start; margin: 14px 0; }
.beside > figure { flex: 0 1 405px; }
.beside > .scroll { margin: 0; flex: 0 1 auto; }
.card, figure { margin: 0; background: var(--card); border: 1px solid var(--rule); border-radius: 12px; padding: 14px; }
.tiles { display: grid; gap: 14px; grid-template-columns: repeat(auto-fill, minmax(min(100%, 280px), 1fr)); }
.tile .big { font-size: 36px; font-weight: 650; letter-spacing: -.02em; line-height: 1.15;
  font-variant-numeric: tabular-nums; }
.tile .big small { font-size: 15px; font-weight: 400; letter-spacing: 0; }
.tile small { font-weight: 400; }
.tile p { margin: 6px 0 0; font-size: 14px; line-height: 1.4; }
.yes { color: var(--green); font-weight: 600; }
.no { color: var(--vermilion); }
figcaption { font-size: 13px; line-height: 1.4; margin-top: 6px; }
svg.figure { display: block; width: 100%; height: auto; max-width: 600px; margin: 0 auto; }
svg.figure * { stroke-linejoin: round; }
svg.figure text { fill: var(--ink); }
.scroll { overflow-x: auto; max-width: 100%; width: fit-content; border: 1px solid var(--rule); border-radius: 12px;
  background: var(--card); margin: 14px 0; }
.pillars .scroll { width: auto; }
table { border-collapse: collapse; width: 100%; font-size: 14px; font-variant-numeric: tabular-nums;
  overflow-wrap: normal; }
th, td { padding: 6px 16px; text-align: right; white-space: nowrap; border-top: 1px solid var(--rule); }
.words th, .words td { text-align: left; vertical-align: top; }
.words td { white-space: normal; overflow-wrap: anywhere; min-width: 12em; max-width: 44em; }
th { font-weight: 600; }
thead th { color: var(--soft); border-top: 0; font-weight: 500; }
tbody th, thead th:first-child { text-align: left; position: sticky; left: 0; background: var(--card); }
tr.muted td, tr.muted th, .words tbody th { color: var(--soft); font-weight: 400; }
tr.part th { padding-top: 18px; }
tr.part:first-child th { padding-top: 6px; }
.queries { display: grid; gap: 14px; grid-template-columns: repeat(auto-fit, minmax(min(100%, 480px), 1fr)); }
.query { display: grid; grid-template-columns: 1.3fr repeat(5, 1fr); gap: 8px; align-items: start; font-size: 12px;
  line-height: 1.3; padding: 12px 0; border-top: 1px solid var(--rule); }
.query img { display: block; width: 100%; height: auto; border-radius: 6px; border: 2px solid var(--rule); }
.query span, .query b { display: block; margin-top: 3px; }
.query b + span { margin-top: 0; }
.asked { padding-right: 8px; border-right: 1px dashed var(--rule); }
.right img { border-color: var(--green); }
.right b { color: var(--green); }
.same img { border: 2px dashed var(--amber); }
.same b { color: var(--amber); }
.wrong b { color: var(--vermilion); font-weight: 400; }
pre { overflow-x: auto; background: var(--card); border: 1px solid var(--rule); border-radius: 12px; padding: 14px;
  margin: 14px 0; font: 13px/1.7 var(--mono); }
details { margin: 10px 0; }
summary { cursor: pointer; color: var(--blue); font-size: 14px; }
footer { margin-top: 64px; padding-top: 16px; padding-bottom: 40px; font-size: 13px; }
@media (max-width: 560px) {
  .query { grid-template-columns: repeat(5, 1fr); gap: 6px; font-size: 11px; }
  .query .asked { grid-column: 1 / -1; display: grid; grid-template-columns: 76px 1fr; gap: 10px; align-items: center;
    border-right: 0; padding-right: 0; font-size: 13px; }
  table { font-size: 12px; }
  th, td { padding: 6px; }
  td, thead th { white-space: normal; }
  h2 { margin-top: 44px; }
  figure, .card { padding: 10px; }
}
@media print { body { background: #fff; } figure, .card, .query { break-inside: avoid; } nav { display: none; } }
"""


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
        # On a phone a cell wraps, but not within an interval.
        inner = "".join(
            f"<td>{escape(cell) if words else escape(cell).replace(', ', ',&nbsp;')}</td>" for cell in cells
        )
        body.append(f'<tr{look}><th scope="row">{escape(name)}</th>{inner}</tr>')
    box = f'<div class="scroll{" words" * words}" tabindex="0" role="region" aria-label="{escape(label)}">'
    return f"{box}<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"


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
