"""The suite ``servo-v1``: who estimates the pose, and how far from its target each episode then stays."""

import hashlib
import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any, ClassVar, Literal

import numpy as np

from mvitac.control.learn import Estimate
from mvitac.control.servo import STEP_MS, TASKS, Episode, presses, task_of, touch_at
from mvitac.control.suite import SHUFFLED, Cells, LoopSuite, Row
from mvitac.evaluation.intervals import mean_interval


@cache
def _processes() -> ProcessPoolExecutor:
    """What renders; the processes import no torch, and end with this one."""
    return ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn"))


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What is different in some episodes of the same shapes."""

    name: str
    new_sensor: bool = False
    noise: float = 1.0  # multiplies the camera noise of the sensor
    latency_ms: int = 0


@dataclass(frozen=True, kw_only=True)
class Servo(LoopSuite):
    """Tasks of ``control.servo``, one controller, and what estimates its pose."""

    sums: ClassVar[tuple[str, ...]] = ("mm", "deg", "lost")  # of the scored steps of one shape
    kinds: ClassVar[list[str]] = [kind for task in TASKS.values() for kind in task.kinds]
    true: ClassVar[str] = "true pose"
    blind: ClassVar[str] = "no touch"
    note: ClassVar[str] = (
        "Mean error over scored steps with the 95 % interval over shapes (and seeds). Steps after contact was lost have"
        " the largest error"
    )

    kind: Literal["servo"]
    shapes: int
    steps: int
    settle: int
    gain: float
    most: float
    fit_shapes: int
    fit_presses: int
    fit_val: int
    conditions: tuple[Condition, ...]

    @cached_property
    def presses(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Images and poses of each task, rendered once for all rows."""
        found = {}
        for name in TASKS:
            made = _processes().map(partial(presses, name, self.seed, self.fit_presses), range(self.fit_shapes))
            images, poses = (np.concatenate(parts) for parts in zip(*made, strict=True))
            found[name] = images, poses
        return found

    def data(self) -> dict[str, str]:
        """Digests of the presses."""
        return {name: hashlib.sha256(images.tobytes()).hexdigest() for name, (images, _) in self.presses.items()}

    def cells(self, source: str) -> list[tuple[str, str]]:
        """The tasks and conditions that a row has."""
        return [(kind, condition.name) for kind in self.kinds for condition in self.conditions]

    def score(self, row: Row) -> Cells:
        """Sums of every kind and condition, by shape."""
        learned: dict[str, Estimate] = {}
        if row.learn:
            for name, (images, poses) in self.presses.items():
                learned[name] = row.learn({"touch": images}, poses, self.fit_val * self.fit_presses)
        each = [(kind, learned.get(name)) for name, task in TASKS.items() for kind in task.kinds]
        return [cell for kind, estimate in each for cell in self._follow(kind, estimate, row.source == SHUFFLED)]

    def _follow(self, kind: str, estimate: Estimate | None, shuffle: bool) -> Cells:
        """All episodes of one kind, in step, so that their images are rendered and encoded together.

        ``estimate`` None: the true pose. With ``shuffle`` each episode gets the image of the next shape.
        """
        num, task = self.shapes, task_of(kind)
        asked = [{"new": one.new_sensor, "noise": one.noise} for one in self.conditions for _ in range(num)]
        episodes = [Episode.begin(self.seed, kind, i % num, **each) for i, each in enumerate(asked)]
        late = np.repeat([one.latency_ms // STEP_MS for one in self.conditions], num)
        order = np.arange(len(episodes))
        other = order - order % num + (order + 1) % num  # the next shape under the same condition

        def look(modality: str) -> np.ndarray:
            wanted = [(self.seed, kind, i % num, asked[i], e.state, e.step) for i, e in enumerate(episodes)]
            images = np.stack(list(_processes().map(touch_at, wanted, chunksize=5)))
            return images[other] if shuffle else images

        sums, bound = np.zeros((len(episodes), len(self.sums))), self.most * task.limit
        known: list[np.ndarray] = []
        for step in range(self.steps):
            poses = np.stack([episode.pose for episode in episodes])
            known.append(np.broadcast_to(estimate(look), poses.shape) if estimate else poses)
            for i, episode in enumerate(episodes):
                away = known[max(0, step - late[i])][i] - task.target
                episode.move(np.clip(-self.gain * away, -bound, bound))
                if step >= self.settle:
                    sums[i] += (*episode.error(), episode.lost)
        n = [float(self.steps - self.settle)] * num
        parts = zip(self.conditions, sums.reshape(-1, num, len(self.sums)), strict=True)
        return [self.cell(kind, one.name, n, lines.T) for one, lines in parts]

    def impossible(self, task: str, n: np.ndarray, sums: np.ndarray) -> bool:
        """Whether no episodes give these sums [3, shapes]: steps without contact have the limit."""
        mm, deg, lost = sums
        most, fits = task_of(task).limit, (n == self.steps - self.settle).all() and n.shape == mm.shape
        fits &= len(n) == self.shapes and (lost >= 0).all() and (lost == lost.round()).all()
        for each, limit in ((mm, most[0]), (deg, np.hypot.reduce(most[1:]))):
            fits &= bool((each >= lost * limit - 1e-6).all() and (each <= n * limit + 1e-6).all())
        return not fits

    def text(self, cells: Sequence[dict[str, Any]]) -> str:
        """A cell of a table, of those of all seeds."""
        mm, deg, lost = (np.array([cell[key] for cell in cells]) / cells[0]["n"] for key in self.sums)
        mean, low, high = np.clip(mean_interval(mm)[:3], 0, task_of(cells[0]["task"]).limit[0])
        share = 100 * lost.mean()
        return f"{mean:.2f} [{low:.2f}, {high:.2f}] mm, {deg.mean():.1f}°" + (
            f", {share:.0f} % lost" if share >= 0.5 else ""
        )
