"""Contact sheets of the simulators: everything they make, to check by eye."""

from typing import Any

import numpy as np
from PIL import Image

from mvitac.data.image_grid import Block, Tile, draw
from mvitac.data.spec import PHASES
from mvitac.report.palette import colour
from mvitac.sim import grasps, materials, objects


def materials_sheet(seed: int, side: int) -> Image.Image:
    """Three instances of every class of the simulated materials of a world."""
    blocks = []
    for category, name in enumerate(materials.CLASSES):
        tiles = []
        for instance in range(3):
            made = materials.touch(seed, category, instance, 0, size=side)
            words = f"{'soft' if made['soft'] else 'hard'}, {'rough' if made['rough'] else 'smooth'}"
            tiles.append(Tile(np.concatenate([made["vision"], made["touch"]], axis=1), words))
        blocks.append(Block(name, tiles))
    title = "Simulated materials: three objects of each class; each pair: camera, touch"
    return draw(title, blocks, across=2)


def grasps_sheet(seed: int, side: int) -> Image.Image:
    """A failed and a successful simulated grasp of an object of every shape, each in its three phases."""
    blocks = []
    for kind, name in enumerate(objects.KINDS):
        found = _grasps(seed, kind, side)
        tiles = []
        for success, frame in enumerate(("vermilion", "green")):
            phases = found.get(success)
            for phase in range(len(PHASES)):
                blank = np.full((side, 3 * side, 3), 255, np.uint8)
                parts = [phases[phase][k] for k in ("vision", "touch_left", "touch_right")] if phases else [blank]
                tiles.append(Tile(np.concatenate(parts, axis=1), frame=colour(frame)))
        blocks.append(Block(name, tiles))
    heads = [f"{outcome}: {phase}" for outcome in ("failed", "held") for phase in PHASES]
    title = (
        "Simulated grasps of every shape, before, during and after the lift; each time: camera, left touch, right touch"
    )
    return draw(title, blocks, heads=heads, width=6 * (3 * side + 16))


def _grasps(seed: int, kind: int, side: int) -> dict[int, list[dict[str, Any]]]:
    """One grasp per outcome, 0 = failed, 1 = held, of objects of a shape, if found in 40 grasps."""
    found: dict[int, list[dict[str, Any]]] = {}
    for index in range(40):
        phases = grasps.grasp(seed, kind + len(objects.KINDS) * (index % 4), index, size=side)
        found.setdefault(int(phases[0]["success"]), phases)
        if len(found) == 2:
            break
    return found
