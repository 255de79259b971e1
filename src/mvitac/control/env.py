"""The closed-loop tasks as gymnasium environments (``pip install mvitac[control]``), so that others' policies run on them.

import gymnasium, mvitac.control.env
env = gymnasium.make("mvitac/Servo-v1", task="corner", condition="new sensor")
observation, _ = env.reset(seed=3)  # {"touch": uint8 [64, 64, 3]}
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from mvitac.control.ablate import suite_episodes
from mvitac.control.result import find_suite


class LoopEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """Episodes of a suite. The seed of ``reset`` is the episode's number: the first are those of the suite.

    An action in [-1, 1] is in parts of the largest: correction of the pose (servo), or set point of x and turn (insertion).
    The reward is by how much the episode's loss falls: minus a scored step's part of the mean error in mm, or 1 where an
    insertion succeeds. ``info`` has mm, deg and "known", the truth, which no policy may read.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - gymnasium's name and type

    def __init__(self, suite: str, task: str, condition: str, render_mode: str | None = "rgb_array") -> None:
        self.suite, self.cell, self.render_mode = find_suite(suite), (task, condition), render_mode
        self.world: Any = suite_episodes(self.suite, self.cell).begin[0]()
        images: Any = {sense: spaces.Box(0, 255, self.world.look(sense).shape, np.uint8) for sense in self.world.senses}
        self.observation_space: Any = spaces.Dict(images)
        self.action_space: Any = spaces.Box(-1, 1, self.world.most.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.world = self.suite.world(*self.cell, int(self.np_random.integers(2**31)) if seed is None else seed)
        return self._seen(), self._info()

    def step(self, action: np.ndarray) -> Any:
        """ValueError if ``action`` is of another shape, or no number."""
        action, before = np.asarray(action, float), self.world.loss
        if action.shape != self.action_space.shape or np.isnan(action).any():
            raise ValueError(f"action {action}: give {self.action_space.shape[0]} numbers, each from -1 to 1")
        self.world.step(self.world.most * np.clip(action, -1, 1))
        return self._seen(), float(before - self.world.loss), self.world.over, False, self._info()

    def render(self) -> np.ndarray:  # type: ignore[override]
        return np.hstack(list(self._seen().values()))

    def _seen(self) -> dict[str, np.ndarray]:
        return {sense: self.world.look(sense) for sense in self.world.senses}

    def _info(self) -> dict[str, Any]:
        return {"known": self.world.known.copy(), **dict(zip(("mm", "deg"), self.world.error, strict=True))}


for name, cell in {"Servo": ("straight", "known sensor"), "Insert": ("both", "100")}.items():
    about = {"suite": f"{name.lower()}-v1", "task": cell[0], "condition": cell[1]}
    gymnasium.register(f"mvitac/{name}-v1", entry_point=f"{__name__}:LoopEnv", kwargs=about)
