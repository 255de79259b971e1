"""The suite ``servo-v1``: one controller follows a shape by a pose that a row estimates, and how far it then is from it."""

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any, ClassVar, Literal

import numpy as np

from mvitac.control.learn import Lesson
from mvitac.control.servo import STEP_MM, STEP_MS, TASKS, begun, picture, presses, task_of
from mvitac.control.suite import Cell, LoopSuite
from mvitac.data.read_samples import one_thread
from mvitac.evaluation.intervals import mean_interval


@cache
def _processes() -> ProcessPoolExecutor:
    """What renders; the processes import no torch, and end with this one."""
    return ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn"), one_thread)


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
    other: ClassVar[int] = 1
    failure: ClassVar[str] = "mm"
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

    @property
    def num(self) -> int:
        return self.shapes

    @property
    def scored(self) -> int:
        return self.steps - self.settle

    def cells(self, source: str) -> list[Cell]:
        return [(kind, condition.name) for kind in self.kinds for condition in self.conditions]

    def world(self, task: str, condition: str, number: int) -> "Episode":
        return Episode(self, task, next(one for one in self.conditions if one.name == condition), number)

    def lesson(self, cell: Cell) -> str:
        return next(name for name, task in TASKS.items() if cell[0] in task.kinds)

    def taught(self, lesson: str) -> Lesson:
        images, poses = self.shown
        return {"touch": images[lesson]}, poses[lesson], self.fit_val * self.fit_presses

    @cached_property
    def shown(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Images and poses of the presses of each task, rendered once for all rows."""
        images, poses = {}, {}
        for name in TASKS:
            made = _processes().map(partial(presses, name, self.seed, self.fit_presses), range(self.fit_shapes))
            images[name], poses[name] = (np.concatenate(parts) for parts in zip(*made, strict=True))
        return images, poses

    def look(self, worlds: Sequence[Any], sense: str) -> np.ndarray:
        return np.stack(list(_processes().map(picture, [world.moment for world in worlds], chunksize=5)))

    def impossible(self, task: str, n: np.ndarray, sums: np.ndarray) -> bool:
        """Whether no episodes give these sums [3, shapes]: steps without contact have the limit."""
        limit, lost = task_of(task).limit, sums[2]
        most = np.array([limit[:1], [np.hypot.reduce(limit[1:])]])
        inside = (sums[:2] >= lost * most - 1e-6) & (sums[:2] <= n * most + 1e-6)
        inside &= (lost > 0) | (sums[:2] < n * most - 1e-6)
        differ = len(n) == 1 or (lost == n).all() or np.ptp(sums, axis=1).any()  # each shape begins elsewhere
        return not (inside.all() and differ and (lost >= 0).all() and (lost == lost.round()).all())

    def text(self, cells: Sequence[dict[str, Any]]) -> str:
        """A cell of a table, of those of all seeds."""
        mm, deg, lost = (np.array([cell[key] for cell in cells]) / cells[0]["n"] for key in self.sums)
        mean, low, high = np.clip(mean_interval(mm, level=True)[:3], 0, task_of(cells[0]["task"]).limit[0])
        share = f", {100 * lost.mean():.0f} % lost" if lost.mean() >= 0.005 else ""
        return f"{mean:.2f} [{low:.2f}, {high:.2f}] mm, {deg.mean():.1f}°{share}"


class Episode:
    """One shape, followed by one sensor. An action is the correction of the pose; contact that is lost stays lost."""

    senses = ("touch",)

    def __init__(self, suite: Servo, kind: str, condition: Condition, number: int) -> None:
        self.suite, self.kind, self.condition, self.task = suite, kind, condition, task_of(kind)
        self.key, self.most = (suite.seed, 1 + suite.kinds.index(kind), number), suite.most * self.task.limit
        self.shape, first = begun(kind, self.key)
        self.states: list[np.ndarray] = []
        self.poses: list[np.ndarray] = []
        self.lost, self.sums = False, np.zeros(3)
        self._go(first)

    def _go(self, state: np.ndarray) -> None:
        self.states.append(state)
        self.poses.append(self.task.pose(self.shape, state))
        self.lost |= bool((np.abs(self.poses[-1] - self.task.target) > self.task.limit).any())
        steps, condition = len(self.states) - 1, self.condition
        if steps > self.suite.settle:
            self.sums += (*self.error, self.lost)
        self.over, self.values = steps >= self.suite.steps, {"state": np.array([STEP_MM * steps])}
        shown = max(0, steps - condition.latency_ms // STEP_MS)
        self.known = self.poses[shown]
        self.moment = self.kind, self.key, condition.new_sensor, condition.noise, self.states[shown], shown

    @property
    def error(self) -> tuple[float, float]:
        """Distance from the target; the limits once contact is lost."""
        away = self.task.limit if self.lost else np.abs(self.poses[-1] - self.task.target)
        return float(away[0]), float(np.hypot.reduce(away[1:]))

    @property
    def loss(self) -> float:
        return self.sums[0] / self.suite.scored

    def look(self, sense: str) -> np.ndarray:
        return picture(self.moment)

    def answer(self, estimate: np.ndarray) -> np.ndarray:
        return np.clip(-self.suite.gain * (estimate - self.task.target), -self.most, self.most)

    def step(self, action: np.ndarray) -> None:
        self._go(self.states[-1] if self.lost else self.task.moved(self.shape, self.states[-1], action))

    def result(self) -> tuple[float, ...]:
        return tuple(self.sums)
