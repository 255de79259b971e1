"""Labelled grids of images, drawn as one picture: contact sheets."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from mvitac.data.images import fit
from mvitac.data.pack import Pack

GAP = 8  # pixels between pictures
INK, SOFT = "#1d232b", "#5a6470"
MISSING, CROSS = (225, 225, 225), (150, 150, 150)  # colours of the tile that stands for a missing image


@dataclass(frozen=True)
class Tile:
    """One picture, uint8 [H, W, 3]; ``caption`` is printed below it."""

    image: np.ndarray
    caption: str = ""


@dataclass(frozen=True)
class Block:
    """Pictures under one heading."""

    heading: str
    tiles: Sequence[Tile] = ()


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib."""
    import matplotlib  # imported here: it is slow, and few commands draw

    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)


def draw(title: str, blocks: Sequence[Block], *, width: int = 1280) -> Image.Image:
    """Draw ``blocks`` below each other as one picture.

    Within a block, pictures fill rows of equal length. ``width`` in pixels is kept if it has room for one picture.
    """
    cell = max((tile.image.shape[1] for block in blocks for tile in block.tiles), default=width - GAP)
    most = max((len(block.tiles) for block in blocks), default=1)
    fitting = max(1, (width - GAP) // (cell + GAP))
    columns = -(-most // -(-most // fitting)) if most else 1
    room = max(columns * (cell + GAP), min(width, 480))
    drawn = [_block(block, cell, columns, room) for block in blocks]
    return ImageOps.expand(_stack([_text(title, room, 13, SOFT), *drawn], GAP), GAP, "white")


def _block(block: Block, cell: int, columns: int, room: int) -> Image.Image:
    captions = [[_text(tile.caption, cell, 12, INK)] if tile.caption else [] for tile in block.tiles]
    images = [Image.fromarray(np.ascontiguousarray(tile.image)) for tile in block.tiles]
    cells = [_stack([image, *under], 2) for image, under in zip(images, captions, strict=True)]
    rows = [_row(cells[i : i + columns], cell) for i in range(0, len(cells), columns)]
    heading = [_text(block.heading, room, 14, INK)] if block.heading else []
    return _stack([*heading, *rows], 4)


def _row(images: Sequence[Image.Image], step: int) -> Image.Image:
    """Images side by side, one every ``step + GAP`` pixels."""
    width = (len(images) - 1) * (step + GAP) + max(step, images[-1].width)
    row = Image.new("RGB", (width, max(image.height for image in images)), "white")
    for place, image in enumerate(images):
        row.paste(image, (place * (step + GAP), 0))
    return row


def _stack(images: Sequence[Image.Image], gap: int = 0) -> Image.Image:
    """Images below each other."""
    height = sum(image.height for image in images) + gap * (len(images) - 1)
    stack = Image.new("RGB", (max(image.width for image in images), height), "white")
    top = 0
    for image in images:
        stack.paste(image, (0, top))
        top += image.height + gap
    return stack


def _text(text: str, width: int, size: int, colour: str) -> Image.Image:
    """Text in lines of at most ``width`` pixels."""
    face = font(size)
    lines = wrap(text, width, face)
    picture = Image.new("RGB", (width, len(lines) * (size + 5)), "white")
    pen = ImageDraw.Draw(picture)
    for number, line in enumerate(lines):
        pen.text((0, number * (size + 5)), line, colour, face)
    return picture


def wrap(text: str, width: int, face: ImageFont.FreeTypeFont) -> list[str]:
    """Break ``text`` between words into lines of at most ``width`` pixels; a longer word is broken anywhere."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if face.getlength(longer) <= width:
            lines[-1] = longer
            continue
        if lines[-1]:
            lines.append("")
        for letter in word:
            if lines[-1] and face.getlength(lines[-1] + letter) > width:
                lines.append("")
            lines[-1] += letter
    return lines


def side_by_side(image: np.ndarray) -> np.ndarray:
    """Sensors stacked on channels, uint8 [H, W, 3 n], next to each other: [H, n W, 3]."""
    return np.concatenate([image[..., c : c + 3] for c in range(0, image.shape[2], 3)], axis=1)


def pair(pack: Pack, row: int, side: int) -> np.ndarray:
    """One row of a pack: camera, then each tactile sensor, uint8 [side, n side, 3]. A missing image is crossed out."""
    images = []
    for m in pack.spec.modalities:
        there = pack.has(m)[row]
        blank = np.concatenate([_missing(side)] * (pack.spec.channels(m) // 3), axis=1)
        images.append(side_by_side(fit(np.asarray(pack.images[m][row]), side)) if there else blank)
    return np.concatenate(images, axis=1)


def _missing(side: int) -> np.ndarray:
    tile = Image.new("RGB", (side, side), MISSING)
    pen, width = ImageDraw.Draw(tile), max(1, side // 40)
    pen.line([(0, 0), (side, side)], fill=CROSS, width=width)
    pen.line([(0, side), (side, 0)], fill=CROSS, width=width)
    return np.asarray(tile)


def contents(pack: Pack) -> str:
    """The images of a pair, from left to right."""
    sensors = pack.spec.touch_channels // 3
    touch = {0: [], 1: ["touch"], 2: ["left touch", "right touch"]}.get(sensors, [f"{sensors} touch images"])
    return ", ".join([*(["camera"] if pack.spec.vision_channels else []), *touch])
