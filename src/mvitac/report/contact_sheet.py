"""A contact sheet of a pack, to check the data by eye: the suspicious rows, and a few pairs of each class or object."""

import textwrap
from collections import defaultdict
from collections.abc import Sequence
from itertools import count

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mvitac.data.checks.finding import Finding
from mvitac.data.images import fit, side_by_side
from mvitac.data.pack import Pack

Tile = tuple[np.ndarray, str]  # a picture, uint8 [H, W, 3], and the text below it
Block = tuple[str, Sequence[Tile]]  # pictures under one heading
SIDE, NUM_SHOWN, NUM_SAMPLE = 96, 8, 6  # pixels; rows shown of a finding; rows of a class
LIMIT = 40  # classes of a sheet
WIDTH, GAP = 1280, 8  # pixels: of a sheet (more for a picture that is wider); between pictures
MISSING, CROSS = 225, 150  # gray levels of the tile that stands for a missing image


def suspicious(pack: Pack, findings: Sequence[Finding]) -> list[Block]:
    """Return a block per finding of ``data check`` that lists rows."""
    wrong = [f for f in findings if f.rows and f.verdict in ("look", "broken")]
    order = f"each pair: {contents(pack)}"
    return [(f"{f.verdict}: {f.item}. {f.evidence} ({order})", _tiles(pack, f.rows[:NUM_SHOWN])) for f in wrong]


def samples(pack: Pack) -> list[Block]:
    """Return a block of random rows for each class of the first task, or for each group of a pack without labels.

    Rows of different groups (within one group: touches) come first. Of more than ``LIMIT`` classes, the first are shown.
    """
    words, order = pack.column("group").astype(str), sorted(set(pack.column("group").astype(str)))
    if pack.spec.tasks:
        task = pack.spec.tasks[0]
        order = [*task.classes, "(no label)"]
        words = np.array(order)[pack.column(f"label_{task.name}")]
    groups = np.unique(pack.column("group").astype(str), return_inverse=True)[1]
    rng, found = np.random.default_rng(0), []
    for name in order:
        if len(rows := np.flatnonzero(words == name)):
            num = len(set(groups[rows]))
            of = f", {num} {pack.spec.group_by}s" * (num > 1)
            chosen = _spread(rows, groups[rows] if num > 1 else pack.touch_groups[rows], rng)
            found.append((f"{name}: {len(rows)} row{'s' * (len(rows) > 1)}{of}", _tiles(pack, chosen)))
    return [*found[:LIMIT], *[(f"{len(found) - LIMIT} more are not shown", [])] * (len(found) > LIMIT)]


def _spread(rows: np.ndarray, groups: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    order = rng.permutation(len(rows))
    turns: defaultdict[int, count[int]] = defaultdict(count)
    turn = [next(turns[group]) for group in groups[order].tolist()]
    return rows[order[np.argsort(turn, kind="stable")][:NUM_SAMPLE]]


def _tiles(pack: Pack, rows: Sequence[int] | np.ndarray) -> list[Tile]:
    ids, splits = pack.column("id").astype(str), pack.column("split").astype(str)
    return [(pair(pack, int(row), SIDE), f"{ids[row]} {splits[row]}") for row in rows]


def pair(pack: Pack, row: int, side: int) -> np.ndarray:
    """One row of a pack: camera, then each tactile sensor, uint8 [side, n side, 3]. A missing image is crossed out."""
    blank, line = np.full((side, side, 3), MISSING, np.uint8), np.eye(side, dtype=bool)
    blank[line | line[::-1]] = CROSS
    images = []
    for m in pack.spec.modalities:
        sensors = pack.spec.channels(m) // 3
        images += [side_by_side(fit(np.asarray(pack.images[m][row]), side))] if pack.has(m)[row] else [blank] * sensors
    return np.concatenate(images, axis=1)


def contents(pack: Pack) -> str:
    """The images of a pair, from left to right."""
    sensors = pack.spec.touch_channels // 3
    touch = {0: [], 1: ["touch"], 2: ["left touch", "right touch"]}.get(sensors, [f"{sensors} touch images"])
    return ", ".join([*(["camera"] if pack.spec.vision_channels else []), *touch])


def draw(title: str, blocks: Sequence[Block]) -> Image.Image:
    """Draw ``blocks`` below each other: a heading, then pictures in rows of equal length, with their captions."""
    cell = GAP + max((image.shape[1] for _, tiles in blocks for image, _ in tiles), default=480)
    most = max([1, *(len(tiles) for _, tiles in blocks)])
    columns = -(-most // -(-most // max(1, WIDTH // cell)))
    room = max(columns * cell, 480)
    bands = [_text(title, room, 13)]
    for heading, tiles in blocks:
        bands.append(_text(heading, room, 14))
        bands += [_row(tiles[i : i + columns], cell, room) for i in range(0, len(tiles), columns)]
    sheet = Image.new("RGB", (room + GAP, GAP + sum(band.height + GAP for band in bands)), "white")
    top = GAP
    for band in bands:
        sheet.paste(band, (GAP, top))
        top += band.height + GAP
    return sheet


def _row(tiles: Sequence[Tile], cell: int, room: int) -> Image.Image:
    captions = [_text(caption, cell - GAP, 12) for _, caption in tiles]
    height = max(len(image) for image, _ in tiles)
    row = Image.new("RGB", (room, height + max(caption.height for caption in captions)), "white")
    for place, ((image, _), caption) in enumerate(zip(tiles, captions, strict=True)):
        row.paste(Image.fromarray(np.ascontiguousarray(image)), (place * cell, 0))
        row.paste(caption, (place * cell, height))
    return row


def _text(text: str, width: int, size: int) -> Image.Image:
    lines = textwrap.wrap(text, max(1, int(width / (0.6 * size))))
    picture = Image.new("RGB", (width, (size + 5) * len(lines)), "white")
    for number, line in enumerate(lines):
        ImageDraw.Draw(picture).text((0, number * (size + 5)), line, "#1d232b", ImageFont.load_default(size))
    return picture
