"""The rows of ``insert-v1``: behaviour cloning of the expert, by vision, touch or both, from few or many demonstrations."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from mvitac.control.insert import ALIGN, DOWN, Insertion, photo_of, touch_of
from mvitac.control.learn import Cells, Encode, Row, encoding, frozen_rows, train
from mvitac.control.suite import InsertSuite
from mvitac.evaluation.regressors import fit_ridge
from mvitac.model import Model
from mvitac.system.progress import tick

SENSES = {"vision": ("vision",), "touch": ("touch",), "both": ("vision", "touch")}
BLIND = "no senses"
Images = dict[str, np.ndarray]
Policy = Callable[[Images], np.ndarray]  # images by sense -> set points [E, 2]


class Insert:
    """The suite, and the expert's demonstrations, which are recorded once for all rows."""

    sums: ClassVar[tuple[str, ...]] = ("success", "mm", "deg")  # of one episode
    kinds: ClassVar[list[str]] = list(SENSES)
    true: ClassVar[str] = "expert"
    note: ClassVar[str] = (
        "Share of insertions that succeed with the 95 % interval over episodes (and seeds), and the error at the end"
    )

    def __init__(self, suite: InsertSuite, mapped: Callable[..., Iterable[Any]] = map) -> None:
        self.suite, self.map = suite, mapped  # ``map``, or that of a pool of processes

    @cached_property
    def demonstrations(self) -> tuple[Images, np.ndarray]:
        """Images and the expert's set points of every step, demonstration after demonstration.

        Above the slot the hand goes elsewhere than the expert says, so that its own place in the picture tells nothing.
        """
        suite, actions, wanted = self.suite, [], []
        for number in range(max(suite.demonstrations)):
            world = Insertion(suite.seed, number, trained=True)
            rng = np.random.default_rng([suite.seed, 0xDE40, number])
            while not world.over:
                wanted.append((world.key, world.data.qpos.copy(), world.steps))
                actions.append(world.wanted)
                world.step(world.wanted + suite.noise * rng.standard_normal(2) * (world.steps < ALIGN))
        return self._images(wanted, SENSES["both"]), np.stack(actions)

    def _images(self, wanted: Sequence[Any], senses: Sequence[str]) -> Images:
        """The pictures of moments (key, physics, step)."""
        found = {}
        if "vision" in senses:
            found["vision"] = np.stack(list(self.map(photo_of, wanted)))
        if "touch" in senses:
            each = {key: None for key, *_ in wanted}
            felt = dict(zip(each, self.map(touch_of, each), strict=True))
            found["touch"] = np.stack([felt[key] for key, *_ in wanted])
        return found

    def data(self) -> dict[str, str]:
        """Digests of the demonstrations."""
        return {name: hashlib.sha256(images.tobytes()).hexdigest() for name, images in self.demonstrations[0].items()}

    def cells(self, source: str) -> list[tuple[str, str]]:
        """The senses and numbers of demonstrations that a row has."""
        if source in (self.true, BLIND):
            return [("both", f"{num}") for num in self.suite.demonstrations]
        senses = [sense for sense in SENSES if "shuffled" not in source or "touch" in SENSES[sense]]
        return [(sense, f"{num}") for sense in senses for num in self.suite.demonstrations]

    def rows(self, models: Sequence[Model]) -> list[Row]:
        """The encoder's seeds first, then the controls."""
        suite, found = self.suite, []
        for source, seed, encode in frozen_rows(models, suite.untrained, suite.imagenet):
            found.append(Row(source, seed, lambda e=encode, s=source: self._cloned(s, e)))
        own = encoding(models[0])
        shuffled = Row("touch shuffled", models[0].seed, lambda: self._cloned("touch shuffled", own))
        blind = Row(BLIND, None, lambda: self._cloned(BLIND, None))
        return [*found, shuffled, Row(self.true, None, self.again), blind, Row("end to end", None, self._trained)]

    def again(self) -> Cells:
        """The row of the expert, which needs no picture."""
        scored = self._run(None, ())
        return [{"task": task, "condition": condition, **scored} for task, condition in self.cells(self.true)]

    def _cloned(self, source: str, encode: Encode | None) -> Cells:
        """Ridge regression of the expert's set points on frozen features; their mean without any."""
        images, actions = self.demonstrations
        known = {sense: encode(sense, images[sense]) for sense in images} if encode else {}

        def fit(num: int, senses: Sequence[str]) -> Policy:
            rows = np.arange(num * (ALIGN + DOWN))
            if encode is None:
                return lambda _: np.tile(actions[rows].mean(0), (self.suite.episodes, 1))
            read = encode
            x = np.concatenate([known[sense][rows] for sense in senses], axis=1)
            fitted, _ = fit_ridge(x, actions[rows], max(2, num // 5) * (ALIGN + DOWN))
            return lambda seen: fitted(np.concatenate([read(sense, seen[sense]) for sense in senses], axis=1))

        return self._all(source, fit)

    def _trained(self) -> Cells:
        images, actions = self.demonstrations

        def fit(num: int, senses: Sequence[str]) -> Policy:
            rows = np.arange(num * (ALIGN + DOWN))
            own = [images[sense][rows] for sense in senses]
            known = train(self.suite.untrained[0], own, actions[rows], steps=self.suite.train_steps)
            return lambda seen: known([seen[sense] for sense in senses])

        return self._all("end to end", fit)

    def _all(self, source: str, fit: Callable[[int, Sequence[str]], Policy]) -> Cells:
        """Every cell of a row."""
        found: Cells = []
        for task, condition in self.cells(source):
            policy, seen = fit(int(condition), SENSES[task]), SENSES[task] if source != BLIND else ()
            scored = self._run(policy, seen, shuffle="shuffled" in source)
            found.append({"task": task, "condition": condition, **scored})
            tick("tasks")
        return found

    def _run(self, policy: Policy | None, senses: Sequence[str], *, shuffle: bool = False) -> dict[str, list[float]]:
        """Results of all episodes, in step; ``policy`` None: the expert. With ``shuffle`` touch is the next episode's."""
        worlds = [Insertion(self.suite.seed, number) for number in range(self.suite.episodes)]
        for _ in range(ALIGN + DOWN):
            if policy is None:
                actions = np.stack([world.wanted for world in worlds])
            else:
                images = self._images([(w.key, w.data.qpos.copy(), w.steps) for w in worlds], senses)
                if shuffle:
                    images["touch"] = np.roll(images["touch"], 1, axis=0)
                actions = policy(images)
            for world, action in zip(worlds, actions, strict=True):
                world.step(action)
        asked = self.suite.success_mm, self.suite.success_deg, self.suite.success_depth
        lines = np.array([world.result(*asked) for world in worlds], float).T
        each = {key: [float(f"{x:.10g}") for x in line] for key, line in zip(self.sums, lines, strict=True)}
        return {"n": [1.0] * len(worlds), **each}

    def impossible(self, task: str, n: np.ndarray, sums: np.ndarray) -> bool:
        """Whether no episodes give these sums [3, episodes]: success needs a small error."""
        success, mm, deg = sums
        fits = n.shape == mm.shape == (self.suite.episodes,) and (n == 1).all() and np.isin(success, (0, 1)).all()
        small = (mm <= self.suite.success_mm) & (deg <= self.suite.success_deg)
        return not (fits and (sums >= 0).all() and (small | (success == 0)).all())

    def text(self, means: dict[str, np.ndarray], interval: Sequence[float]) -> str:
        """A cell of a table, of means [seeds, episodes] and the interval of the first of ``sums``."""
        mean, low, high = (100 * min(max(value, 0), 1) for value in interval[:3])
        return f"{mean:.0f} [{low:.0f}, {high:.0f}] %, {means['mm'].mean():.1f} mm, {means['deg'].mean():.1f}°"
