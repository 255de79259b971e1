"""Contact sheet of the simulated materials: a few instances of every class, camera and gel side by side."""

from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image, ImageDraw

from mvitac.sim.materials import CLASSES, touch

_LABEL = 14  # height of a class name in pixels


def contact_sheet(
    path: str | Path | BinaryIO, *, size: int = 96, instances: int = 3, seed: int = 0, columns: int = 2
) -> None:
    """Write a PNG of `columns` classes per row, each with `instances` vision|touch pairs, at most 1600 pixels wide."""
    wide = instances * (2 * size + 4) + 8
    if wide * columns > 1600:
        raise ValueError(
            f"{columns} classes of {instances} pairs at {size} px need {wide * columns} > 1600 px: reduce one of them"
        )
    rows = -(-len(CLASSES) // columns)
    sheet = Image.new("RGB", (wide * columns, rows * (size + _LABEL + 4)), "white")
    draw = ImageDraw.Draw(sheet)
    for category, name in enumerate(CLASSES):
        left, top = category % columns * wide, category // columns * (size + _LABEL + 4)
        words = []
        for instance in range(instances):
            pair = touch(seed, category, instance, 0, size=size)
            both = np.concatenate([pair["vision"], pair["touch"]], axis=1)
            sheet.paste(Image.fromarray(both), (left + instance * (2 * size + 4), top + _LABEL))
            words.append(f"{'soft' if pair['soft'] else 'hard'} {'rough' if pair['rough'] else 'smooth'}")
        draw.text((left + 2, top + 1), f"{name}:  {',  '.join(words)}", fill="black")
    sheet.save(path, format="PNG")
