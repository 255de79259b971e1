"""What closed-loop suites share (``suites/*.toml``): a definition with every criterion as data, and the rows to score."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from mvitac.bench.score import trunks
from mvitac.control.learn import Learn, blind, encoding, end_to_end, pixels, ridge
from mvitac.model import Model
from mvitac.registry import to_json
from mvitac.system.files import digest

Cells = list[dict[str, Any]]  # task, condition, n, and a list for each of ``LoopSuite.sums``
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
        """The suite as JSON, without its pins."""
        return {name: value for name, value in to_json(self).items() if name != "pins"}

    def digest(self) -> str:
        return digest(self.definition())

    def rows(self, models: Sequence[Model]) -> list[Row]:
        """The encoder's seeds first, then the controls; ImageNet only where its weights can be had."""
        own = [Row(OWN, model.seed, ridge(encoding(model))) for model in models]
        beside = [
            Row(name, None if name == "imagenet" else model.seed, ridge(encoding(model)))
            for name, model in trunks(self)
        ]
        known = Row(self.true, None, None), Row(self.blind, None, blind)
        trained = Row("end to end", None, end_to_end(self.untrained[0], self.train_steps))
        return [*own, Row("pixels", None, ridge(pixels)), *beside, replace(own[0], source=SHUFFLED), *known, trained]

    def cell(self, task: str, condition: str, n: Sequence[float], sums: np.ndarray) -> dict[str, Any]:
        """A cell of a row, from the sums [len(self.sums), N] of its shapes or episodes in ten digits."""
        each = {key: [float(f"{x:.10g}") for x in line] for key, line in zip(self.sums, sums.tolist(), strict=True)}
        return {"task": task, "condition": condition, "n": list(n), **each}

    def record(self, cell: dict[str, Any]) -> dict[str, Any]:
        """A cell as ``evaluation.intervals`` takes it: the score, by shape or episode."""
        return {"seed": cell["seed"], "group_sizes": cell["n"], "group_correct": cell[self.sums[0]]}
