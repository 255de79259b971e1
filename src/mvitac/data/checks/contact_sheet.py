"""An image of the suspicious rows: one strip per finding, vision next to touch, the row's id below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import BinaryIO

import numpy as np
from PIL import Image, ImageDraw

from mvitac.data.checks.finding import Finding
from mvitac.data.images import fit
from mvitac.data.pack import Pack

SIDE, NUM_SHOWN, LINE = 96, 8, 14
MISSING = 225
"""Gray level shown for a missing image."""
Strips = dict[str, list[tuple[str, np.ndarray]]]
"""Finding -> (caption, uint8 [SIDE, width, 3]) of its first rows."""


def strips_of(pack: Pack, findings: Sequence[Finding]) -> Strips:
    """Return the strips of the findings that list rows."""
    ids, splits = pack.column("id").astype(str), pack.column("split").astype(str)
    strips: Strips = {}
    for finding in findings:
        if finding.rows and finding.verdict in ("look", "broken"):
            title = f"{finding.verdict}: {finding.item} - {finding.evidence}"
            strips[title] = [(f"{ids[row]} {splits[row]}", _row(pack, row)) for row in finding.rows[:NUM_SHOWN]]
    return strips


def _row(pack: Pack, row: int) -> np.ndarray:
    images = [
        fit(np.asarray(pack.images[m][row]), SIDE)
        if pack.has(m)[row]
        else np.full((SIDE, SIDE, pack.spec.channels(m)), MISSING, np.uint8)
        for m in pack.spec.modalities
    ]
    return np.concatenate([part for image in images for part in np.split(image, image.shape[2] // 3, axis=2)], axis=1)


def draw(file: BinaryIO, strips: Strips) -> None:
    """Write ``strips`` as a PNG; without any, write a note that nothing is suspicious."""
    width = max([720, *(sum(image.shape[1] + 6 for _, image in strip) for strip in strips.values())])
    height = (SIDE + 2 * LINE + 12) * len(strips) or 2 * LINE
    sheet = Image.new("RGB", (width, height), "white")
    pen = ImageDraw.Draw(sheet)
    if not strips:
        pen.text((4, 4), "nothing suspicious to show", fill="black")
    for number, (title, strip) in enumerate(strips.items()):
        top, left = number * (SIDE + 2 * LINE + 12), 0
        pen.text((4, top), title[: width // 6], fill="black")
        for caption, image in strip:
            sheet.paste(Image.fromarray(image), (left, top + LINE + 2))
            pen.text((left, top + LINE + 2 + SIDE), caption[-(image.shape[1] // 6) :], fill="black")
            left += image.shape[1] + 6
    sheet.save(file, format="PNG")
