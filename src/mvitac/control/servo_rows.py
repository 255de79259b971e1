"""The suite ``servo-v1``: one controller follows a shape by a pose that a row estimates, and how far it then is from it."""

import hashlib
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
        """The tasks and conditions that a row has."""
        return [(kind, condition.name) for kind in self.kinds for condition in self.conditions]

    def world(self, task: str, condition: str, number: int) -> "Episode":
        return Episode(self, task, next(one for one in self.conditions if one.name == condition), number)

    def lesson(self, cell: Cell) -> str:
        return next(name for name, task in TASKS.items() if cell[0] in task.kinds)

    def taught(self, lesson: str) -> Lesson:
        images, poses = self.presses[lesson]
        return {"touch": images}, poses, self.fit_val * self.fit_presses

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

    def look(self, worlds: Sequence[Any], sense: str) -> np.ndarray:
        return np.stack(list(_processes().map(picture, [world.moment for world in worlds], chunksize=5)))

    def impossible(self, task: str, n: np.ndarray, sums: np.ndarray) -> bool:
        """Whether no episodes give these sums [3, shapes]: steps without contact have the limit."""
        mm, deg, lost = sums
        most, fits = task_of(task).limit, (n == self.scored).all() and n.shape == mm.shape
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


class Episode:
    """One shape, followed by one sensor. An action is the correction of the pose; contact that is lost stays lost."""

    senses = ("touch",)

    def __init__(self, suite: Servo, kind: str, condition: Condition, number: int) -> None:
        self.suite, self.kind, self.condition, self.task = suite, kind, condition, task_of(kind)
        self.key = suite.seed, 1 + suite.kinds.index(kind), number
        self.shape, first = begun(kind, self.key)
        self.states, self.lost, self.sums = [first], False, np.zeros(3)
        self.most = suite.most * self.task.limit

    @property
    def pose(self) -> np.ndarray:
        return self.task.pose(self.shape, self.states[-1])

    @property
    def shown(self) -> int:
        """The step that is seen now."""
        return max(0, len(self.states) - 1 - self.condition.latency_ms // STEP_MS)

    @property
    def moment(self) -> Any:
        """What ``servo.picture`` takes."""
        condition = self.condition
        return self.kind, self.key, condition.new_sensor, condition.noise, self.states[self.shown], self.shown

    @property
    def values(self) -> dict[str, np.ndarray]:
        return {"state": np.array([STEP_MM * (len(self.states) - 1)])}

    @property
    def known(self) -> np.ndarray:
        return self.task.pose(self.shape, self.states[self.shown])

    @property
    def over(self) -> bool:
        return len(self.states) > self.suite.steps

    @property
    def error(self) -> tuple[float, float]:
        """Distance from the target; the limits once contact is lost."""
        away = self.task.limit if self.lost else np.abs(self.pose - self.task.target)
        return float(away[0]), float(np.hypot.reduce(away[1:]))

    @property
    def loss(self) -> float:
        return self.sums[0] / self.suite.scored

    @property
    def reward(self) -> float:
        """Minus the error, in parts of the limit."""
        mm, deg = self.error
        return -float(mm / self.task.limit[0] + deg / np.hypot.reduce(self.task.limit[1:]))

    def look(self, sense: str) -> np.ndarray:
        return picture(self.moment)

    def answer(self, estimate: np.ndarray) -> np.ndarray:
        return np.clip(-self.suite.gain * (estimate - self.task.target), -self.most, self.most)

    def step(self, action: np.ndarray) -> None:
        state = self.states[-1] if self.lost else self.task.moved(self.shape, self.states[-1], action)
        self.states.append(state)
        self.lost |= bool((np.abs(self.pose - self.task.target) > self.task.limit).any())
        if len(self.states) - 1 > self.suite.settle:
            self.sums += (*self.error, self.lost)

    def result(self) -> tuple[float, ...]:
        return tuple(self.sums)
