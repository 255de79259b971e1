"""The suite ``insert-v1``: behaviour cloning of the expert, by vision, touch or both, from few or many demonstrations."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from mvitac.control.insert import ALIGN, DOWN, Insertion
from mvitac.control.learn import Estimate
from mvitac.control.suite import SHUFFLED, Cells, LoopSuite, Row
from mvitac.evaluation.intervals import interval

SENSES = {"vision": ("vision",), "touch": ("touch",), "both": ("vision", "touch")}


@dataclass(frozen=True, kw_only=True)
class Insert(LoopSuite):
    """The task of ``control.insert``, and when it has succeeded."""

    sums: ClassVar[tuple[str, ...]] = ("success", "mm", "deg")  # of one episode
    kinds: ClassVar[list[str]] = list(SENSES)
    true: ClassVar[str] = "expert"
    blind: ClassVar[str] = "no senses"
    note: ClassVar[str] = (
        "Share of insertions that succeed with the 95 % interval over episodes (and seeds), and the error at the end"
    )

    kind: Literal["insert"]
    episodes: int
    demonstrations: tuple[int, ...]
    noise: float
    success_mm: float
    success_deg: float
    success_depth: float

    @cached_property
    def recorded(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Images and the expert's set points of every step, demonstration after demonstration, for all rows.

        Above the slot the hand goes elsewhere than the expert says, so that its own place in the picture tells nothing.
        """
        seen, felt, actions = [], [], []
        for number in range(max(self.demonstrations)):
            world = Insertion(self.seed, number, trained=True)
            rng = np.random.default_rng([self.seed, 0xDE40, number])
            while not world.over:
                seen.append(world.see())
                felt.append(world.touch())
                actions.append(world.wanted)
                world.step(world.wanted + self.noise * rng.standard_normal(2) * (world.steps < ALIGN))
        return {"vision": np.stack(seen), "touch": np.stack(felt)}, np.stack(actions)

    def data(self) -> dict[str, str]:
        """Digests of the demonstrations."""
        return {name: hashlib.sha256(images.tobytes()).hexdigest() for name, images in self.recorded[0].items()}

    def cells(self, source: str) -> list[tuple[str, str]]:
        """The senses and numbers of demonstrations that a row has."""
        only = {self.true: ("both",), self.blind: ("both",), SHUFFLED: ("touch", "both")}.get(source, tuple(SENSES))
        return [(senses, f"{num}") for senses in only for num in self.demonstrations]

    def score(self, row: Row) -> Cells:
        """Results of all episodes, for each sense and number of demonstrations."""
        found: Cells = []
        for senses, num in self.cells(row.source):
            policy = None
            if row.learn:
                images, actions = self.recorded
                asked, val = int(num) * (ALIGN + DOWN), max(2, int(num) // 5) * (ALIGN + DOWN)
                policy = row.learn({sense: images[sense] for sense in SENSES[senses]}, actions[:asked], val)
            lines = self._insert(policy, row.source == SHUFFLED)
            found.append(self.cell(senses, num, [1.0] * len(lines), lines.T))
        return found

    def _insert(self, policy: Estimate | None, shuffle: bool) -> np.ndarray:
        """Results [episodes, 3], in step; ``policy`` None: the expert. With ``shuffle`` touch is the next episode's."""
        worlds = [Insertion(self.seed, number) for number in range(self.episodes)]

        def look(sense: str) -> np.ndarray:
            images = np.stack([world.see() if sense == "vision" else world.touch() for world in worlds])
            return np.roll(images, 1, axis=0) if shuffle and sense == "touch" else images

        for _ in range(ALIGN + DOWN):
            wanted = np.stack([world.wanted for world in worlds])
            actions = np.broadcast_to(policy(look), wanted.shape) if policy else wanted
            for world, action in zip(worlds, actions, strict=True):
                world.step(action)
        return np.array([self.result(world) for world in worlds], float)

    def result(self, world: Insertion) -> tuple[bool, float, float]:
        """Success, and the error in mm and degrees, of an episode at its end."""
        return world.result(self.success_mm, self.success_deg, self.success_depth)

    def impossible(self, task: str, n: np.ndarray, sums: np.ndarray) -> bool:
        """Whether no episodes give these sums [3, episodes]: success needs a small error."""
        success, mm, deg = sums
        fits = n.shape == mm.shape == (self.episodes,) and (n == 1).all() and np.isin(success, (0, 1)).all()
        small = (mm <= self.success_mm) & (deg <= self.success_deg)
        return not (fits and (sums >= 0).all() and (small | (success == 0)).all())

    def text(self, cells: Sequence[dict[str, Any]]) -> str:
        """A cell of a table, of those of all seeds."""
        mean, low, high = (100 * value for value in interval([self.record(cell) for cell in cells]))
        mm, deg = (np.mean([cell[key] for cell in cells]) for key in self.sums[1:])
        return f"{mean:.0f} [{low:.0f}, {high:.0f}] %, {mm:.1f} mm, {deg:.1f}°"
