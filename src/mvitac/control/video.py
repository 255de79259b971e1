"""An episode of a suite as a film: what each sense is given, and how far the episode is from its goal."""

import io
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from mvitac.control.ablate import Episodes, Policy, act

SIDE = 144
Run = tuple[str, Policy | None, str]  # title, policy (None: who knows the truth), what replaces touch


def film(episodes: Episodes, runs: Sequence[Run]) -> list[Image.Image]:
    """The first episode by each run, one below the other: camera, gel and the trace of its error in mm and degrees."""
    shown: list[list[np.ndarray]] = [[] for _ in runs]
    errors: list[list[tuple[float, float]]] = [[] for _ in runs]
    for number, (_, policy, kind) in enumerate(runs):

        def watch(world: Any, given: dict[str, Any], run: int = number) -> None:
            shown[run].append(np.hstack([given[sense] for sense in world.senses]))
            errors[run].append(world.error)

        act(policy, replace(episodes, begin=episodes.begin[:1]), "touch" if kind else "", kind, watch)
    pictures = []
    for step in range(len(shown[0])):
        wide = shown[0][0].shape[1] // shown[0][0].shape[0] * SIDE
        picture = Image.new("RGB", (wide + SIDE, len(runs) * SIDE), "white")
        for run, (title, *_) in enumerate(runs):
            image = Image.fromarray(shown[run][step]).resize((wide, SIDE), Image.Resampling.NEAREST)
            picture.paste(image, (0, run * SIDE))
            _trace(picture, (wide, run * SIDE), title, np.array(errors[run]), step, np.max(errors, axis=(0, 1)))
        pictures.append(picture)
    return pictures


def _trace(image: Image.Image, at: tuple[int, int], name: str, errors: np.ndarray, step: int, most: np.ndarray) -> None:
    draw = ImageDraw.Draw(image)
    draw.text((at[0] + 6, at[1] + 2), name, "black")
    for line, (unit, colour) in enumerate((("mm", "#0072b2"), ("°", "#d55e00"))):
        draw.text((at[0] + 6 + 60 * line, at[1] + 14), f"{errors[step, line]:.1f} {unit}", colour)
        y = at[1] + SIDE - 6 - (SIDE - 40) * errors[: step + 1, line] / most[line]
        draw.line([(at[0] + 6 + (SIDE - 12) * x / len(errors), float(each)) for x, each in enumerate(y)], colour, 2)


def webp(pictures: Sequence[Image.Image]) -> bytes:
    """The film as a WebP file, ten steps a second."""
    buffer = io.BytesIO()
    pictures[0].save(buffer, "webp", save_all=True, append_images=pictures[1:], duration=100, loop=0)
    return buffer.getvalue()
