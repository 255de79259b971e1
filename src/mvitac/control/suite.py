"""What closed-loop suites share: a definition with every criterion as data (``suites/*.toml``), and the rows to score.

A suite makes *worlds*, episodes that begin, of a task under a condition:

    world = find_suite("servo-v1").world("corner", "known sensor", 3)
    while not world.over:
        world.step(world.answer(world.known))

``look(sense)``, uint8 [64, 64, 3], and ``values`` are all that a policy gets. ``known`` is the truth about what a row
estimates, ``answer`` the action that an estimate leads to, ``most`` the largest action. ``error`` is that of now, in mm and
degrees, ``loss`` and ``result()``, the suite's sums, are those of the episode.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, ClassVar

import numpy as np

from mvitac.bench.external import open_model
from mvitac.bench.score import trunks
from mvitac.control.learn import Estimate, Learn, blind, encoding, pixels, ridge, trained
from mvitac.model import Model
from mvitac.registry import to_json
from mvitac.system.files import digest

Cell = tuple[str, str]  # task and condition
OWN, SHUFFLED = "", "touch shuffled"  # rows of the encoder that is scored


@dataclass(frozen=True)
class Row:
    """One row of a suite: its source, and how it learns; None knows the truth."""

    source: str
    seed: int | None
    learn: Learn | None


@dataclass(frozen=True, kw_only=True)
class LoopSuite:
    """A suite; its file says what each field means."""

    sums: ClassVar[tuple[str, ...]]  # what is added up over a shape or an episode; the first is the score
    kinds: ClassVar[list[str]]  # of tasks: the columns of a table
    true: ClassVar[str]
    blind: ClassVar[str]
    other: ClassVar[int]  # which next episode's touch the row "touch shuffled" gets
    failure: ClassVar[str]  # what ``loss`` counts
    note: ClassVar[str]

    name: str
    title: str
    seed: int
    train_steps: int
    untrained: tuple[str, ...]
    imagenet: str
    pins: dict[str, str] = field(default_factory=dict)
    """Digests of what is learned from, where the suite was measured. Not in the digest of the definition."""

    def definition(self) -> dict[str, Any]:
        return {name: value for name, value in to_json(self).items() if name != "pins"}

    def digest(self) -> str:
        return digest(self.definition())

    def look(self, worlds: Sequence[Any], sense: str) -> np.ndarray:
        """What all episodes show now, uint8 [E, 64, 64, 3]."""
        return np.stack([world.look(sense) for world in worlds])

    def record(self, cell: dict[str, Any]) -> dict[str, Any]:
        """A cell as ``evaluation.intervals`` takes it: the score, by shape or episode."""
        return {"seed": cell["seed"], "group_sizes": cell["n"], "group_correct": cell[self.sums[0]]}


def rows_of(suite: Any, models: Sequence[Model]) -> list[Row]:
    """The encoder's seeds first, then the controls; ImageNet only where its weights can be had."""
    own = [Row(OWN, model.seed, ridge(encoding(model))) for model in models]
    beside = [Row(n, None if n == "imagenet" else m.seed, ridge(encoding(m))) for n, m in trunks(suite)[0]]
    scratch = Row("end to end", None, trained(open_model(suite.untrained[0]), suite.train_steps))
    known = replace(own[0], source=SHUFFLED), Row(suite.true, None, None), Row(suite.blind, None, blind)
    return [*own, Row("pixels", None, ridge(pixels)), *beside, *known, scratch]


def score(suite: Any, row: Row) -> list[dict[str, Any]]:
    """The cells of a row: task, condition, n, and for each of the suite's sums a list of its episodes, in ten digits."""
    found, num = [], suite.num
    for lesson, each in groupby(suite.cells(row.source), suite.lesson):
        cells = list(each)
        worlds = [suite.world(*cell, number) for cell in cells for number in range(num)]
        _run(suite, worlds, row.learn(*suite.taught(lesson)) if row.learn else None, row.source == SHUFFLED)
        sums = np.array([world.result() for world in worlds], float).reshape(len(cells), num, -1)
        for (task, condition), lines in zip(cells, sums, strict=True):
            lists = [[float(f"{x:.10g}") for x in line] for line in lines.T]
            about = {"task": task, "condition": condition, "n": [float(suite.scored)] * num}
            found.append(about | dict(zip(suite.sums, lists, strict=True)))
    return found


def _run(suite: Any, worlds: Sequence[Any], estimate: Estimate | None, shuffle: bool) -> None:
    """All episodes in step, so that images are made and encoded together. ``estimate`` None knows the truth."""

    def look(sense: str) -> np.ndarray:
        images = suite.look(worlds, sense)
        if not shuffle or sense != "touch":
            return images
        return np.roll(images.reshape(-1, suite.num, *images.shape[1:]), -suite.other, axis=1).reshape(images.shape)

    while not worlds[0].over:
        known = np.stack([world.known for world in worlds])
        found = np.broadcast_to(estimate(look), known.shape) if estimate else known
        for world, each in zip(worlds, found, strict=True):
            world.step(world.answer(each))
