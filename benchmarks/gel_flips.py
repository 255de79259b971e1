"""Compare two flips of a touch image with the touch of a mirrored object, which the simulator can render.

The colour flip is fitted to a pack of simulated materials, as in training. Then one object of each class is pressed
twice, as it is and mirrored, into each sensor without dots, dirt and noise (these do not move when the object is
mirrored).

    mvitac data simulate materials --num 2000 --out PACK
    python -m benchmarks.gel_flips PACK [--world SEED] [--picture FILE.png]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mvitac.data.image_grid import Block, Tile, draw
from mvitac.data.pack import Pack
from mvitac.sim.gel import press, render
from mvitac.sim.materials import CLASSES, draw_instance
from mvitac.sim.sensors import SENSORS
from mvitac.transforms.gel_flip import GelMirror

WIDTH_MM = 12.8
SHOWN = "gravel"
ZOOM = 2
COLUMNS = ("touch", "plain flip", "colour flip", "mirrored touch")


def imprint(world: int, category: int, side: int) -> np.ndarray:
    """Press the first instance of a class with 6 N. Return the imprint in mm, [side, side]."""
    thing = draw_instance(world, category, 0)
    axis = ((np.arange(side) - (side - 1) / 2) * (WIDTH_MM / side)).astype(np.float32)
    x, y = np.meshgrid(axis, axis)
    relief = 2 * thing.amplitude_mm * thing.feel(x + 50, y + 50) - 0.1 * np.hypot(x - 1, y + 1)
    return press(relief.astype(np.float32), force_n=6.0, stiffness=1.0, pixel_mm=WIDTH_MM / side)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pack", type=Path, help="pack of simulated materials")
    parser.add_argument("--world", type=int, default=1, help="simulator seed of the pressed objects")
    parser.add_argument("--picture", type=Path, help="write a picture of the flips to this file")
    options = parser.parse_args()
    pack = Pack(options.pack)
    mirror, sensors = GelMirror(pack, torch.device("cpu")), pack.column("sensor").astype(str)
    imprints = [imprint(options.world, category, 2 * pack.size) for category in range(len(CLASSES))]
    blocks = []
    print("| sensor | no flip | plain flip | colour flip | gain, smallest to largest |\n|---|---:|---:|---:|---:|")
    for name in sorted(set(sensors)):
        clean = replace(SENSORS[name], marker_pitch_mm=0, dirt=0, scratches=0, noise=0)
        pixel = WIDTH_MM / (2 * pack.size)
        seen, true = (
            np.stack(
                [
                    render(flat[:, ::step], clean, np.random.default_rng(0), pixel_mm=pixel, size=pack.size, unit=unit)
                    for unit, flat in enumerate(imprints)
                ]
            )
            for step in (1, -1)
        )
        rows = np.full(len(seen), np.flatnonzero(sensors == name)[0])
        images = torch.from_numpy(seen).permute(0, 3, 1, 2)
        coloured = mirror(images, rows, torch.ones(len(seen), 1, dtype=torch.bool)).permute(0, 2, 3, 1).numpy()
        made = (seen, seen[:, :, ::-1], coloured)
        none, plain, colour = (np.sqrt(np.square(m.astype(float) - true).mean((1, 2, 3))) for m in made)
        ratio = plain / colour
        means = " | ".join(f"{errors.mean():.1f}" for errors in (none, plain, colour))
        print(f"| {name} | {means} | {ratio.min():.1f} to {ratio.max():.1f} |")
        shown = [pictures[CLASSES.index(SHOWN)].repeat(ZOOM, axis=0).repeat(ZOOM, axis=1) for pictures in (*made, true)]
        blocks.append(Block(name, [Tile(picture) for picture in shown]))
    if options.picture:
        title = f"One {SHOWN} in every simulated sensor. Right: the simulator pressed the mirrored object"
        draw(title, blocks, heads=COLUMNS).save(options.picture, optimize=True)


if __name__ == "__main__":
    main()
