"""The rows of ``servo-v1``: who estimates the pose, and how far from its target each episode then stays."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np

from mvitac.control.learn import Cells, Encode, Row, encoding, frozen_rows, train
from mvitac.control.servo import STEP_MS, TASKS, Episode, presses, task_of, touch_at
from mvitac.control.suite import ServoSuite
from mvitac.evaluation.regressors import fit_ridge
from mvitac.model import Model
from mvitac.system.progress import tick

Estimate = Callable[[str, np.ndarray], np.ndarray]  # task, images -> poses


class Servo:
    """The suite, and the presses that are rendered once for all rows."""

    sums: ClassVar[tuple[str, ...]] = ("mm", "deg", "lost")  # of the scored steps of one shape
    kinds: ClassVar[list[str]] = [kind for task in TASKS.values() for kind in task.kinds]
    true: ClassVar[str] = "true pose"
    note: ClassVar[str] = (
        "Mean error over scored steps with the 95 % interval over shapes (and seeds). Steps after contact was lost have"
        " the largest error"
    )

    def __init__(self, suite: ServoSuite, mapped: Callable[..., Iterable[Any]] = map) -> None:
        self.suite, self.map = suite, mapped  # ``map``, or that of a pool of processes

    @cached_property
    def presses(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        found, suite = {}, self.suite
        for name in TASKS:
            made = list(self.map(partial(presses, name, suite.seed, suite.fit_presses), range(suite.fit_shapes)))
            images, poses = (np.concatenate(parts) for parts in zip(*made, strict=True))
            found[name] = images, poses
        return found

    def data(self) -> dict[str, str]:
        """Digests of the presses."""
        return {name: hashlib.sha256(images.tobytes()).hexdigest() for name, (images, _) in self.presses.items()}

    def cells(self, source: str) -> list[tuple[str, str]]:
        """The tasks and conditions that a row has."""
        return [(kind, condition.name) for kind in self.kinds for condition in self.suite.conditions]

    def rows(self, models: Sequence[Model]) -> list[Row]:
        """The encoder's seeds first, then the controls."""
        suite, found = self.suite, []
        for source, seed, encode in frozen_rows(models, suite.untrained, suite.imagenet):
            found.append(Row(source, seed, lambda e=encode: self._probed(e)))
        own = encoding(models[0])
        shuffled = Row("touch shuffled", models[0].seed, lambda: self._probed(own, shuffle=True))
        blind = Row("no touch", None, lambda: self.run(lambda name, _: self.presses[name][1].mean(0), see=False))
        return [*found, shuffled, Row(self.true, None, self.again), blind, Row("end to end", None, self._trained)]

    def again(self) -> Cells:
        """The row of the true pose, which needs no picture."""
        return self.run(None)

    def _probed(self, encode: Encode, *, shuffle: bool = False) -> Cells:
        fitted = {}
        for name, (images, poses) in self.presses.items():
            fitted[name] = fit_ridge(encode("touch", images), poses, self.suite.fit_val * self.suite.fit_presses)[0]
        return self.run(lambda name, images: fitted[name](encode("touch", images)), shuffle=shuffle)

    def _trained(self) -> Cells:
        text, steps = self.suite.untrained[0], self.suite.train_steps
        known = {name: train(text, [images], poses, steps=steps) for name, (images, poses) in self.presses.items()}
        return self.run(lambda name, images: known[name]([images]))

    def run(self, estimate: Estimate | None, *, shuffle: bool = False, see: bool = True) -> Cells:
        """Sums of every kind and condition, by shape; ``estimate`` None: the true pose.

        With ``shuffle`` each episode gets the image of the next shape; without ``see`` no image is rendered.
        """
        cells: Cells = []
        for kind in self.kinds:
            cells += self._follow(kind, estimate, shuffle, see)
            tick("tasks")
        return cells

    def _follow(self, kind: str, estimate: Estimate | None, shuffle: bool, see: bool) -> Cells:
        """All episodes of one kind, in step, so that their images are rendered and encoded together."""
        suite, num, task = self.suite, self.suite.shapes, task_of(kind)
        name = next(key for key, known in TASKS.items() if known is task)
        asked = [{"new": one.new_sensor, "noise": one.noise} for one in suite.conditions for _ in range(num)]
        episodes = [Episode.begin(suite.seed, kind, i % num, **each) for i, each in enumerate(asked)]
        late = np.repeat([one.latency_ms // STEP_MS for one in suite.conditions], num)
        order = np.arange(len(episodes))
        other = order - order % num + (order + 1) % num  # the next shape under the same condition
        sums, bound = np.zeros((len(episodes), len(self.sums))), suite.most * task.limit
        known: list[np.ndarray] = []
        for step in range(suite.steps):
            poses = np.stack([episode.pose for episode in episodes])
            if estimate is None:
                known.append(poses)
            else:
                wanted = [(suite.seed, kind, i % num, asked[i], e.state, e.step) for i, e in enumerate(episodes)]
                images = np.stack(list(self.map(touch_at, wanted))) if see else np.zeros(len(episodes))
                known.append(np.broadcast_to(estimate(name, images[other] if shuffle else images), poses.shape))
            for i, episode in enumerate(episodes):
                away = known[max(0, step - late[i])][i] - task.target
                episode.move(np.clip(-suite.gain * away, -bound, bound))
                if step >= suite.settle:
                    sums[i] += (*episode.error(), episode.lost)
        found, n = [], [float(suite.steps - suite.settle)] * num
        for one, lines in zip(suite.conditions, sums.reshape(-1, num, len(self.sums)), strict=True):
            each = {key: [float(f"{x:.10g}") for x in line] for key, line in zip(self.sums, lines.T, strict=True)}
            found.append({"task": kind, "condition": one.name, "n": n, **each})
        return found

    def impossible(self, task: str, n: np.ndarray, sums: np.ndarray) -> bool:
        """Whether no episodes give these sums [3, shapes]: steps without contact have the limit."""
        mm, deg, lost = sums
        most, fits = task_of(task).limit, (n == self.suite.steps - self.suite.settle).all() and n.shape == mm.shape
        fits &= len(n) == self.suite.shapes and (lost >= 0).all() and (lost == lost.round()).all()
        for each, limit in ((mm, most[0]), (deg, np.hypot.reduce(most[1:]))):
            fits &= bool((each >= lost * limit - 1e-6).all() and (each <= n * limit + 1e-6).all())
        return not fits

    def text(self, means: dict[str, np.ndarray], interval: Sequence[float]) -> str:
        """A cell of a table, of means [seeds, shapes] and the interval of the first of ``sums``."""
        lost = 100 * means["lost"].mean()
        most = f"{interval[0]:.2f} [{max(interval[1], 0):.2f}, {interval[2]:.2f}] mm, {means['deg'].mean():.1f}°"
        return most + (f", {lost:.0f} % lost" if lost >= 0.5 else "")
