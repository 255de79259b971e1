"""Follow an edge or a surface by touch alone: shapes, what the gel sees of them, and how a correction moves the sensor.

Frames: the sensor moves along its own x axis; its picture has x to the right and y down. Lengths in mm, angles in degrees.
Every task has a *pose*, what a controller must know, and a correction of the same length that it adds to the pose:

    edge      offset    distance of the gel's centre from the edge, > 0 on the object        angle   of the edge to x
    surface   depth     of the surface above the gel's apex                  tilt_x, tilt_y   of the surface to the gel

The gel is pressed by position, not by force, and the object is rigid. Its dome, and the optics, are those of ``sim.gel``.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, ClassVar

import numpy as np
from scipy.ndimage import map_coordinates

from mvitac.sim import gel
from mvitac.sim.relief import KINDS, Relief, draw_tables
from mvitac.sim.sensors import SENSORS

FIELD_MM, DOME_MM, SIZE = 12.8, 25.0, 64
STEP_MM, STEP_MS = 0.5, 50  # advance and duration of one step: 10 mm/s at 20 Hz
MAP_MM = 0.1  # pixel of a texture's map
_DRAW, _TOUCH = 0x5E270, 0x5E271


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """One object. ``kind`` is straight, curved or corner (edges), or surface."""

    kind: str
    texture: np.ndarray  # heights [512, 512] in mm, mirrored beyond its ends
    roll_mm: float = 0.5  # over which an edge is rounded
    radius_mm: float = math.inf  # of a curved edge; < 0: hollow
    corner_mm: float = 0.0  # place of the corner along the edge
    turn_deg: float = 0.0  # of a corner; < 0: hollow
    waves: np.ndarray  # of a surface, [W, 4]: height, waves per mm along x and y, phase
    drift: tuple[float, float] = (0.6, 0.0)  # depth at which an edge is pressed, and how much it changes

    def inside(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Signed distance from the edge, > 0 on the object. The edge passes (0, 0) along x."""
        if self.kind == "straight":
            return y
        if self.kind == "curved":
            return np.sign(self.radius_mm) * (abs(self.radius_mm) - np.hypot(x, y - self.radius_mm))
        turn, soft = math.radians(self.turn_deg), -0.4 * np.sign(self.turn_deg)
        second = math.cos(turn) * y - math.sin(turn) * (x - self.corner_mm)
        return soft * np.logaddexp(y / soft, second / soft)  # a minimum (maximum, if hollow) with a round corner

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        if self.kind == "surface":
            return sum(h * np.sin(2 * math.pi * (u * x + v * y) + p) for h, u, v, p in self.waves)  # type: ignore[return-value]
        beyond, roll = np.maximum(-self.inside(x, y), 0), self.roll_mm
        return -np.where(beyond < roll, beyond * beyond / (2 * roll), beyond - roll / 2)


def draw_shape(rng: np.random.Generator, kind: str, kinds: list[str]) -> Shape:
    """Draw an object of ``kind`` with a texture of one of ``kinds``."""
    feel = Relief(
        kind=str(rng.choice(kinds)),
        wavelength_mm=float(rng.uniform(0.9, 2.4)),
        irregularity=float(rng.uniform(0.1, 0.6)),
        asperity=float(rng.uniform(-0.8, 0.8)),
        tables=draw_tables(rng),
    )
    axis = np.arange(512, dtype=np.float32) * np.float32(MAP_MM)
    texture = np.float32(rng.uniform(0.02, 0.08)) * feel(*np.meshgrid(axis, axis))
    length = rng.uniform(30, 70, 4)
    slope, way = rng.uniform(0.03, 0.09, 4), rng.uniform(0, 2 * math.pi, 4)
    return Shape(
        kind=kind,
        texture=texture,
        roll_mm=float(rng.uniform(0.2, 0.8)),
        radius_mm=float(rng.choice((-1, 1)) * rng.uniform(12, 40)),
        corner_mm=float(rng.uniform(9, 15)),
        turn_deg=float(rng.choice((-1, 1)) * rng.uniform(25, 60)),
        waves=np.stack([slope * length / (2 * math.pi), np.cos(way) / length, np.sin(way) / length, 9 * way], axis=1),
        drift=(float(rng.uniform(0.5, 0.8)), float(rng.uniform(0, 0.12))),
    )


class Edge:
    """Follow an edge. The state is the sensor's place x, y and direction (radians) in the frame of the shape."""

    kinds: ClassVar[tuple[str, ...]] = ("straight", "curved", "corner")
    names: ClassVar[tuple[str, ...]] = ("offset_mm", "angle_deg")
    target: ClassVar[np.ndarray] = np.zeros(2)
    limit: ClassVar[np.ndarray] = np.array([5.0, 60.0])  # contact is lost beyond
    reach: ClassVar[np.ndarray] = np.array([4.0, 45.0])  # of the presses that probes are fitted on
    start: ClassVar[np.ndarray] = np.array([2.0, 20.0])  # of an episode

    @staticmethod
    def state(shape: Shape, pose: np.ndarray, along_mm: float) -> np.ndarray:
        """The state with this pose, if the edge were straight at ``along_mm``."""
        return np.array([along_mm, pose[0], -math.radians(pose[1])])

    @staticmethod
    def pose(shape: Shape, state: np.ndarray) -> np.ndarray:
        x, y, way = state
        step = 1e-3 * np.array([[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]])
        s, right, left, below, above = shape.inside(x + step[0], y + step[1])
        slope = np.array([right - left, below - above]) / 2e-3
        away = math.atan2(-slope[0], slope[1]) - way
        return np.array([s / np.hypot(*slope), math.degrees((away + math.pi) % (2 * math.pi) - math.pi)])

    @staticmethod
    def moved(shape: Shape, state: np.ndarray, change: np.ndarray) -> np.ndarray:
        """One step along x, ``change`` of the offset along y, and of the angle by turning."""
        x, y, way = state
        cos, sin = math.cos(way), math.sin(way)
        ahead, across = STEP_MM, change[0]
        return np.array([x + cos * ahead - sin * across, y + sin * ahead + cos * across, way - math.radians(change[1])])

    @staticmethod
    def indent(shape: Shape, state: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        cos, sin = math.cos(state[2]), math.sin(state[2])
        wx, wy = state[0] + cos * x - sin * y, state[1] + sin * x + cos * y
        mean, swing = shape.drift
        return mean + swing * math.sin(0.3 * state[0]) + shape.height(wx, wy) + textured(shape, wx, wy)


class Surface:
    """Follow a surface at a depth of .5 mm. The state is x, the height of the gel's apex, and its two slopes."""

    kinds: ClassVar[tuple[str, ...]] = ("surface",)
    names: ClassVar[tuple[str, ...]] = ("depth_mm", "tilt_x_deg", "tilt_y_deg")
    target: ClassVar[np.ndarray] = np.array([0.5, 0.0, 0.0])
    limit: ClassVar[np.ndarray] = np.array([0.5, 15.0, 15.0])  # from the target: no contact, or a crash
    reach: ClassVar[np.ndarray] = np.array([0.45, 10.0, 10.0])
    start: ClassVar[np.ndarray] = np.array([0.25, 5.0, 5.0])

    @staticmethod
    def _plane(shape: Shape, x: float) -> np.ndarray:
        """Height and slopes of the surface at x on the path."""
        h, u, v, p = shape.waves.T
        turn = 2 * math.pi * u * x + p
        return np.array([(h * np.sin(turn)).sum(), *(2 * math.pi * (h * np.cos(turn) * w).sum() for w in (u, v))])

    @classmethod
    def state(cls, shape: Shape, pose: np.ndarray, along_mm: float) -> np.ndarray:
        height, *slopes = cls._plane(shape, along_mm)
        tilts = np.degrees(np.arctan(slopes)) - pose[1:]
        return np.array([along_mm, height - pose[0], *np.tan(np.radians(tilts))])

    @classmethod
    def pose(cls, shape: Shape, state: np.ndarray) -> np.ndarray:
        height, *slopes = cls._plane(shape, state[0])
        return np.array([height - state[1], *np.degrees(np.arctan(slopes) - np.arctan(state[2:]))])

    @staticmethod
    def moved(shape: Shape, state: np.ndarray, change: np.ndarray) -> np.ndarray:
        """One step along x, at the height and tilt that ``change`` the pose by so much where the surface is flat."""
        tilts = np.arctan(state[2:]) - np.radians(change[1:])
        return np.array([state[0] + STEP_MM, state[1] - change[0], *np.tan(tilts)])

    @staticmethod
    def indent(shape: Shape, state: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        plane = state[1] + state[2] * x + state[3] * y
        return shape.height(state[0] + x, y) - plane + textured(shape, state[0] + x, y)


TASKS: dict[str, Any] = {"edge": Edge, "surface": Surface}


def task_of(kind: str) -> Any:
    return next(task for task in TASKS.values() if kind in task.kinds)


def textured(shape: Shape, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return map_coordinates(shape.texture, [(y + 25) / MAP_MM, (x + 25) / MAP_MM], order=1, mode="mirror")


class Copy:
    """One physical sensor, drawn: a known one, or a copy of the ``new`` one that no probe learned on."""

    def __init__(self, rng: np.random.Generator, *, new: bool, noise: float = 1.0) -> None:
        choice = [s for s in SENSORS.values() if s.held_out == new]
        sensor = choice[int(rng.random() * len(choice))]
        self.gain = float(np.exp(rng.uniform(*np.log((0.5, 1.2)))))
        self.sensor, self.unit = replace(sensor, noise=sensor.noise * noise), int(rng.integers(2**31))

    def press(self, height_mm: Callable[[np.ndarray, np.ndarray], np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """What it sees, uint8 [64, 64, 3], of heights in mm above the apex of its gel, by place in mm."""
        x, y, pixel = gel.grid(SIZE, FIELD_MM)
        indent = height_mm(x, y) - (x * x + y * y) / (2 * DOME_MM)
        imprint = gel.relax(np.clip(indent, 0, 2.5).astype(np.float32), pixel_mm=pixel)
        return gel.render(imprint, self.sensor, rng, pixel_mm=pixel, size=SIZE, unit=self.unit, gain=self.gain)


def textures(trained: bool) -> list[str]:
    """Kinds of texture of the shapes that probes are fitted on, or the five of those that are followed."""
    kinds = sorted(KINDS)
    unseen = kinds[:: len(kinds) // 5][:5]
    return [kind for kind in kinds if (kind in unseen) != trained]


def presses(name: str, seed: int, each: int, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Presses of training shape ``number`` of a task: images uint8 [each, 64, 64, 3], poses [each, T]."""
    task, images, poses = TASKS[name], [], []
    rng = np.random.default_rng([_DRAW, seed, 0, list(TASKS).index(name), number])
    shape = draw_shape(rng, task.kinds[number % len(task.kinds)], textures(True))
    for _ in range(each):
        along = float(rng.uniform(-6, 25))
        state = _near(task, shape, task.target + rng.uniform(-1, 1, len(task.target)) * task.reach, along)
        images.append(Copy(rng, new=False).press(partial(task.indent, shape, state), rng))
        poses.append(task.pose(shape, state))
    return np.stack(images), np.stack(poses)


def _near(task: Any, shape: Shape, asked: np.ndarray, along: float) -> np.ndarray:
    state = task.state(shape, task.target, 0.0)
    for _ in range(max(0, round(along / STEP_MM))):
        state = task.moved(shape, state, task.target - task.pose(shape, state))
    there = task.moved(shape, state, asked - task.pose(shape, state))
    return task.moved(shape, there, asked - task.pose(shape, there))


@lru_cache(maxsize=128)
def begun(kind: str, key: tuple[int, ...]) -> tuple[Shape, np.ndarray]:
    """Shape and first state of an episode, the same with every sensor; its texture is one that no press had."""
    task, rng = task_of(kind), np.random.default_rng([_DRAW, *key])
    shape = draw_shape(rng, kind, textures(False))
    return shape, task.state(shape, task.target + rng.uniform(-1, 1, len(task.target)) * task.start, 0.0)


def picture(asked: tuple[str, tuple[int, ...], bool, float, np.ndarray, int]) -> np.ndarray:
    """What the sensor of an episode sees at a step: of kind, key, whether it is new, its noise, state and step."""
    kind, key, new, noise, state, step = asked
    sensor = Copy(np.random.default_rng([_TOUCH, *key]), new=new, noise=noise)
    height = partial(task_of(kind).indent, begun(kind, key)[0], state)
    return sensor.press(height, np.random.default_rng([_TOUCH, *key, 1 + step]))
