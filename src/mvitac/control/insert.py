"""Put a peg into a slot: only the gel shows how it is held, with which offset and turn; only the camera shows the slot.

The hand moves in the plane of the gel: x to the right, z up, and a turn about the pad's normal. Its height follows a fixed
plan (first above the slot, then down), so a policy decides x and turn. MuJoCo computes the contact of peg and slot; the hand
follows its set point through a soft weld, and the peg does not slip in it. The camera is MuJoCo's ray casting with a lamp;
a shroud hides the peg from it.

Units: metres and radians inside, mm and degrees in names and results.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, ClassVar, Literal

import mujoco
import numpy as np

from mvitac.control.learn import Lesson
from mvitac.control.servo import SIZE, Copy, Shape, draw_shape, textured, textures
from mvitac.control.suite import SHUFFLED, Cell, LoopSuite
from mvitac.evaluation.intervals import interval
from mvitac.sim.camera import cast, rays_of

LENGTH_M, DEPTH_M, CLEAR_M = 0.024, 0.010, 0.0012  # of the peg below the hand; of the insertion; beside the peg
ABOVE_M, ALIGN, DOWN, SUBSTEPS = 0.016, 9, 9, 40  # height at the start; steps above the slot and down; steps of 2 ms
DEPTH_MM = 0.8  # of the peg in the gel
REACH = {"slot_mm": 7.0, "offset_mm": 2.5, "turn_deg": 9.0}
GAIN, MOST = 0.6, np.array([5.0, 6.0])  # part of the way, and largest change of x (mm) and turn (degrees), in one step
SENSES = {"vision": ("vision",), "touch": ("touch",), "both": ("vision", "touch")}
_TAG, _VIEW = 0x1A5E27, 0x1A5E28


@dataclass(frozen=True, kw_only=True, eq=False)
class Peg(Shape):
    """A bar that crosses the gel, ``half_mm`` wide on each side of its axis, which is turned by ``turn_deg``."""

    half_mm: float
    offset_mm: float

    def inside(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        turn = math.radians(self.turn_deg)
        return self.half_mm - np.abs(math.cos(turn) * (x - self.offset_mm) + math.sin(turn) * y)


@lru_cache(maxsize=4)
def _held(seed: int) -> tuple[Shape, Copy]:
    """The surface of the peg, and the gel: the same in all episodes, as in one robot's cell."""
    rng = np.random.default_rng([_TAG, seed])
    return draw_shape(rng, "straight", textures(True)), Copy(rng, new=False)


def draw_peg(seed: int, number: int, trained: bool) -> tuple[Peg, float]:
    """The peg of an episode in its hand, and the place of the slot in mm."""
    rng = np.random.default_rng([_TAG, seed, int(trained), number])
    slot, offset, turn = (float(rng.uniform(-most, most)) for most in REACH.values())
    return Peg(**{**vars(_held(seed)[0]), "half_mm": 3.5, "offset_mm": offset, "turn_deg": turn}), slot


class Insertion:
    """One episode. An action is the set point of x (mm) and turn (degrees), towards which the hand moves in its plan."""

    most = np.array([20.0, 30.0])

    def __init__(
        self, suite: "Insert", number: int, *, trained: bool = False, senses: tuple[str, ...] = SENSES["both"]
    ) -> None:
        self.suite, self.senses, self.key = suite, senses, (suite.seed, int(trained), number)
        self.peg, self.slot_mm = draw_peg(suite.seed, number, trained)
        turn = -self.peg.turn_deg  # with this set point the peg is upright above the slot
        self.known = np.array([self.slot_mm - self.peg.offset_mm * math.cos(math.radians(turn)), turn])
        self.model = mujoco.MjModel.from_xml_string(_scene(self.peg, self.slot_mm))
        self.data = mujoco.MjData(self.model)
        self._go(np.zeros(2), 0)

    @property
    def error(self) -> tuple[float, float]:
        """How far the peg is from the slot's axis, in mm at its tip and in degrees."""
        tip, up = self.data.site_xpos[0], self.data.site_xmat[0].reshape(3, 3)[:, 2]
        return abs(1000 * float(tip[0]) - self.slot_mm), abs(math.degrees(math.atan2(float(up[0]), float(up[2]))))

    @property
    def loss(self) -> float:
        return 1 - self.result()[0]

    def look(self, sense: str) -> np.ndarray:
        if sense == "touch":
            return touch_of(self.key).copy()
        mujoco.mj_kinematics(self.model, self.data)  # of where the last step ended
        return _photograph(self)

    def answer(self, estimate: np.ndarray) -> np.ndarray:
        return estimate

    def step(self, action: np.ndarray) -> None:
        self._go(self.place + np.clip(GAIN * (action - self.place), -MOST, MOST), self.steps + 1)

    def result(self) -> tuple[float, float, float]:
        (mm, deg), suite = self.error, self.suite
        deep = self.data.site_xpos[0, 2] < -suite.success_depth * DEPTH_M
        return float(mm <= suite.success_mm and deg <= suite.success_deg and deep), mm, deg

    def _go(self, place: np.ndarray, steps: int) -> None:
        self.place, self.steps, self.over = place, steps, steps == ALIGN + DOWN
        self.values = {"state": place.copy()}
        half, down = math.radians(place[1]) / 2, max(0, steps - ALIGN) / DOWN
        self.data.mocap_pos[0] = place[0] / 1000, 0, LENGTH_M + ABOVE_M - down * (ABOVE_M + DEPTH_M)
        self.data.mocap_quat[0] = math.cos(half), 0, math.sin(half), 0
        mujoco.mj_step(self.model, self.data, SUBSTEPS if steps else 1)


@lru_cache(maxsize=1024)
def touch_of(key: tuple[int, int, int]) -> np.ndarray:
    """What the gel of an episode shows: the grasp does not change, so neither does its picture."""
    (peg, _), (_, copy) = draw_peg(key[0], key[2], bool(key[1])), _held(key[0])
    rng = np.random.default_rng([_TAG, *key, 1])
    return copy.press(lambda x, y: DEPTH_MM + peg.height(x, y) + textured(peg, x, y), rng)


def _scene(peg: Peg, slot_mm: float) -> str:
    """A block with a slot, and the hand at the pad's centre with shroud and peg; the block's top is z = 0."""
    half, slot = peg.half_mm / 1000, slot_mm / 1000
    gap, lean = half + CLEAR_M, math.radians(peg.turn_deg)
    beside, behind = gap + 0.015, 0.0135
    boxes = [(slot - beside, 0, 0.015, 0.018), (slot + beside, 0, 0.015, 0.018)]
    boxes += [(slot, -behind, gap, 0.0045), (slot, behind, gap, 0.0045)]
    wall = '<geom name="block{}" type="box" pos="{} {} -.01" size="{} {} .01"/>'
    walls = "".join(wall.format(i, *box) for i, box in enumerate(boxes))
    at, down = peg.offset_mm / 1000, LENGTH_M
    place = f"{at - math.sin(lean) * down / 2} 0 {-math.cos(lean) * down / 2}"
    return f"""
    <mujoco><option timestep=".002" gravity="0 0 0" integrator="implicitfast"/>
    <default><geom friction=".3" solref=".004 1"/></default>
    <worldbody>
      <geom name="table" type="plane" size="1 1 .1" pos="0 0 -.02" contype="0" conaffinity="0"/>
      {walls}
      <body name="target" mocap="true" pos="0 0 {LENGTH_M + ABOVE_M}"/>
      <body name="hand" pos="0 0 {LENGTH_M + ABOVE_M}"><freejoint/>
        <geom name="shroud" type="box" size=".011 .009 .016" pos="0 0 -.004" contype="0" conaffinity="0" mass=".2"/>
        <geom name="palm" type="box" size=".02 .012 .006" pos="0 0 .018" contype="0" conaffinity="0" mass=".2"/>
        <body pos="{place}" euler="0 {peg.turn_deg} 0">
          <geom name="peg" type="box" size="{half} .004 {down / 2}" group="4" mass=".02"/>
          <site name="tip" pos="0 0 {-down / 2}"/>
        </body>
      </body>
    </worldbody>
    <equality><weld body1="hand" body2="target" solref=".02 1"/></equality></mujoco>"""


def _photograph(world: Insertion) -> np.ndarray:
    """One ray per pixel from over the shoulder. Colours are those of one place; the lamp changes between episodes."""
    rng, own = np.random.default_rng([_VIEW, *world.key]), np.random.default_rng([_VIEW, world.key[0]])
    eye, rays = np.array([0.0, -0.13, 0.1]), rays_of(np.array([0.0, 0.13, -0.095]), SIZE, 0.13)
    geom, distance, normal = cast(world, eye, rays, np.array([1, 1, 1, 1, 0, 0], np.uint8))
    table, block, shroud, palm, wall = own.uniform(0.1, 0.9, (5, 3))
    colours = np.array([table, *[block] * 4, shroud, palm, palm, wall])[geom]
    lamp = rng.normal((0.2, -0.4, 1.0), 0.3)
    facing = np.clip(normal @ (lamp / np.linalg.norm(lamp)), 0, 1)
    light = np.where(geom >= 0, rng.uniform(0.2, 0.5) + 0.7 * facing, 1.0)
    # A slot is dark: its walls and floor below the block's top get less light with their depth.
    height = eye[2] + rays[:, 2] * distance
    light *= np.where(np.isin(geom, range(5)) & (height < -1e-4) & (height > -0.0199), np.exp(height / 0.006), 1.0)
    noise = np.random.default_rng([_VIEW, *world.key, world.steps]).normal(0, 2.0, rays.shape)
    levels = 255 * np.clip(colours * light[:, None], 0, 1) ** (1 / 2.2) + noise
    return np.clip(levels, 0, 255).astype(np.uint8).reshape(SIZE, SIZE, 3)


@dataclass(frozen=True, kw_only=True)
class Insert(LoopSuite):
    """The suite ``insert-v1``: behaviour cloning of an expert, by vision, touch or both, from few or many demonstrations."""

    sums: ClassVar[tuple[str, ...]] = ("success", "mm", "deg")  # of one episode
    kinds: ClassVar[list[str]] = list(SENSES)
    true: ClassVar[str] = "expert"
    blind: ClassVar[str] = "no senses"
    other: ClassVar[int] = -1
    failure: ClassVar[str] = "failures"
    scored: ClassVar[int] = 1
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

    @property
    def num(self) -> int:
        return self.episodes

    @cached_property
    def shown(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Images and the expert's set points of every step, demonstration after demonstration, for all rows.

        Above the slot the hand goes elsewhere than the expert says, so that its own place in the picture tells nothing.
        """
        seen, felt, actions = [], [], []
        for number in range(max(self.demonstrations)):
            world = Insertion(self, number, trained=True)
            rng = np.random.default_rng([self.seed, 0xDE40, number])
            while not world.over:
                seen.append(world.look("vision"))
                felt.append(world.look("touch"))
                actions.append(world.known)
                world.step(world.known + self.noise * rng.standard_normal(2) * (world.steps < ALIGN))
        return {"vision": np.stack(seen), "touch": np.stack(felt)}, np.stack(actions)

    def cells(self, source: str) -> list[Cell]:
        """The senses and numbers of demonstrations that a row has."""
        only = {self.true: ("both",), self.blind: ("both",), SHUFFLED: ("touch", "both")}.get(source, tuple(SENSES))
        return [(senses, f"{num}") for senses in only for num in self.demonstrations]

    def world(self, task: str, condition: str, number: int) -> Insertion:
        return Insertion(self, number, senses=SENSES[task])

    def lesson(self, cell: Cell) -> Cell:
        return cell

    def taught(self, lesson: Cell) -> Lesson:
        (images, actions), num = self.shown, int(lesson[1])
        given, steps = {sense: images[sense] for sense in SENSES[lesson[0]]}, ALIGN + DOWN
        return given, actions[: num * steps], max(2, num // 5) * steps

    def impossible(self, task: str, n: np.ndarray, sums: np.ndarray) -> bool:
        """Whether no episodes give these sums [3, episodes]: success needs a small error."""
        success, mm, deg = sums
        small = (mm <= self.success_mm) & (deg <= self.success_deg)
        possible = np.isin(success, (0, 1)) & (small | (success == 0)) & (deg <= 180) & (mm <= 1000)
        differ = len(n) == 1 or np.ptp(sums, axis=1).any()  # each episode begins elsewhere
        return not (possible.all() and differ and (sums >= 0).all())

    def text(self, cells: Sequence[dict[str, Any]]) -> str:
        """A cell of a table, of those of all seeds."""
        mean, low, high = (100 * value for value in interval([self.record(cell) for cell in cells]))
        mm, deg = (np.mean([cell[key] for cell in cells]) for key in self.sums[1:])
        return f"{mean:.0f} [{low:.0f}, {high:.0f}] %, {mm:.1f} mm, {deg:.1f}°"
