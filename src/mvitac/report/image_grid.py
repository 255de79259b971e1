"""Pictures with captions under headings, drawn as one, such as pairs of a pack: camera and touch side by side."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mvitac.data.images import fit
from mvitac.data.pack import Pack

GAP = 8  # pixels between pictures
MISSING, CROSS = 225, 150  # gray levels of the tile that stands for a missing image


@dataclass(frozen=True)
class Tile:
    """One picture, uint8 [H, W, 3], and the text below it."""

    image: np.ndarray
    caption: str = ""


@dataclass(frozen=True)
class Block:
    """Pictures under one heading."""

    heading: str
    tiles: Sequence[Tile] = ()


def side_by_side(image: np.ndarray) -> np.ndarray:
    """Sensors stacked on channels, uint8 [H, W, 3 n], next to each other: [H, n W, 3]."""
    return np.concatenate([image[..., c : c + 3] for c in range(0, image.shape[2], 3)], axis=1)


def pair(pack: Pack, row: int, side: int) -> np.ndarray:
    """One row of a pack: camera, then each tactile sensor, uint8 [side, n side, 3]. A missing image is crossed out."""
    blank = np.full((side, side, 3), MISSING, np.uint8)
    line = np.eye(side, dtype=bool)
    blank[line | line[::-1]] = CROSS
    images = []
    for m in pack.spec.modalities:
        sensors = pack.spec.channels(m) // 3
        there = pack.has(m)[row]
        images += [side_by_side(fit(np.asarray(pack.images[m][row]), side))] if there else [blank] * sensors
    return np.concatenate(images, axis=1)


def contents(pack: Pack) -> str:
    """The images of a pair, from left to right."""
    sensors = pack.spec.touch_channels // 3
    touch = {0: [], 1: ["touch"], 2: ["left touch", "right touch"]}.get(sensors, [f"{sensors} touch images"])
    return ", ".join([*(["camera"] if pack.spec.vision_channels else []), *touch])


def draw(title: str, blocks: Sequence[Block], *, width: int = 1280) -> Image.Image:
    """Draw ``blocks`` below each other: a heading, then pictures in rows of equal length, with their captions.

    ``width`` in pixels is kept if it has room for one picture.
    """
    cell = GAP + max((tile.image.shape[1] for block in blocks for tile in block.tiles), default=480)
    most = max([1, *(len(block.tiles) for block in blocks)])
    columns = -(-most // -(-most // max(1, width // cell)))
    room = max(columns * cell, min(width, 480))
    bands = [_text(title, room, 13)]
    for block in blocks:
        bands.append(_text(block.heading, room, 14))
        bands += [_row(block.tiles[i : i + columns], cell, room) for i in range(0, len(block.tiles), columns)]
    sheet = Image.new("RGB", (room + GAP, GAP + sum(band.height + GAP for band in bands)), "white")
    top = GAP
    for band in bands:
        sheet.paste(band, (GAP, top))
        top += band.height + GAP
    return sheet


def _row(tiles: Sequence[Tile], cell: int, room: int) -> Image.Image:
    captions = [_text(tile.caption, cell - GAP, 12) for tile in tiles]
    height = max(len(tile.image) for tile in tiles)
    row = Image.new("RGB", (room, height + max(caption.height for caption in captions)), "white")
    for place, (tile, caption) in enumerate(zip(tiles, captions, strict=True)):
        row.paste(Image.fromarray(np.ascontiguousarray(tile.image)), (place * cell, 0))
        row.paste(caption, (place * cell, height))
    return row


def _text(text: str, width: int, size: int) -> Image.Image:
    """Text in lines of about ``width`` pixels, at ``size`` pixels."""
    lines = textwrap.wrap(text, max(1, int(width / (0.6 * size))))
    picture = Image.new("RGB", (width, (size + 5) * len(lines)), "white")
    for number, line in enumerate(lines):
        ImageDraw.Draw(picture).text((0, number * (size + 5)), line, "#1d232b", _font(size))
    return picture


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib."""
    import matplotlib  # imported here: it is slow, and few commands draw

    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)
