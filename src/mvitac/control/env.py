"""The closed-loop tasks as gymnasium environments (``pip install mvitac[control]``), so that others' policies run on them.

import gymnasium, mvitac.control.env
env = gymnasium.make("mvitac/Servo-v1", kind="corner")
observation, _ = env.reset(seed=3)  # {"touch": uint8 [64, 64, 3]}
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from mvitac.control.insert import Insertion
from mvitac.control.result import find_suite
from mvitac.control.servo import SIZE, Episode, task_of

FARTHEST = np.array([20.0, 30.0])  # set points of an insertion, in mm and degrees


class _Env(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """Pictures as observations, an action of numbers in [-1, 1], and one episode for each seed of ``reset``."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - gymnasium's name and type
    render_mode = "rgb_array"

    def __init__(self, suite: str, senses: tuple[str, ...], num: int) -> None:
        self.suite: Any = find_suite(suite)
        self.observation_space: Any = spaces.Dict(
            {sense: spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8) for sense in senses}
        )
        self.action_space: Any = spaces.Box(-1, 1, (num,), np.float32)

    def number(self, seed: int | None) -> int:
        """The episode's number: the seed of ``reset``, else one drawn."""
        super().reset(seed=seed)
        return int(self.np_random.integers(2**31)) if seed is None else seed


class ServoEnv(_Env):
    """Follow the edge or the surface of one object of ``servo-v1``, kind straight, curved, corner or surface.

    The seed of ``reset`` is the number of the object: 0 to 7 are those of the suite. An action in [-1, 1] is the part of
    the largest correction of each component of the pose. The reward is minus the error in parts of the limit; the
    episode is terminated when contact is lost. ``info`` has pose, mm and deg: no policy may read them.
    """

    def __init__(self, kind: str = "straight", *, new_sensor: bool = False, noise: float = 1.0) -> None:
        self.kind, self.task, self.asked = kind, task_of(kind), {"new": new_sensor, "noise": noise}
        super().__init__("servo-v1", ("touch",), len(self.task.names))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.episode = Episode.begin(self.suite.seed, self.kind, self.number(seed), **self.asked)
        return {"touch": self.render()}, self._info()

    def step(self, action: np.ndarray) -> Any:
        self.episode.move(self.suite.most * np.clip(action, -1, 1) * self.task.limit)
        info, limit = self._info(), self.task.limit
        reward = -(info["mm"] / limit[0] + info["deg"] / np.hypot.reduce(limit[1:]))
        over = self.episode.step >= self.suite.steps
        return {"touch": self.render()}, float(reward), self.episode.lost, over, info

    def render(self) -> np.ndarray:  # type: ignore[override]
        return self.episode.touch()

    def _info(self) -> dict[str, Any]:
        mm, deg = self.episode.error()
        return {"pose": self.episode.pose, "mm": mm, "deg": deg}


class InsertEnv(_Env):
    """Insert one peg of ``insert-v1``; seeds 0 to 29 of ``reset`` are the episodes of the suite.

    An action in [-1, 1] is the set point of x and turn, in parts of ``FARTHEST``. The reward is 1 at the end
    if the insertion succeeds; then ``info`` has success, mm and deg.
    """

    def __init__(self) -> None:
        super().__init__("insert-v1", ("vision", "touch"), 2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.world = Insertion(self.suite.seed, self.number(seed))
        return self._seen(), {}

    def step(self, action: np.ndarray) -> Any:
        self.world.step(FARTHEST * np.asarray(action, float))
        if not self.world.over:
            return self._seen(), 0.0, False, False, {}
        info = dict(zip(("success", "mm", "deg"), self.suite.result(self.world), strict=True))
        return self._seen(), float(info["success"]), True, False, info

    def render(self) -> np.ndarray:  # type: ignore[override]
        return self.world.see()

    def _seen(self) -> dict[str, np.ndarray]:
        return {"vision": self.world.see(), "touch": self.world.touch().copy()}


gymnasium.register("mvitac/Servo-v1", entry_point=f"{__name__}:ServoEnv")
gymnasium.register("mvitac/Insert-v1", entry_point=f"{__name__}:InsertEnv")
