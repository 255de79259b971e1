"""Simulates one grasp in MuJoCo: settle, close, lift, hold. The scene is returned at three moments, to be rendered.

Frames and units as in :mod:`mvitac.sim.objects`: metres, kilograms, newtons, radians, seconds.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from mvitac.sim import gel, objects

STEP_S = 0.002
CHUNK = 5  # time steps between changes of the set points
SETTLE_S, CLOSE_S, LIFT_S, HOLD_S = 0.10, 0.30, 0.36, 0.24
CLOSE_SPEED = 0.14  # metres per second of each finger
HELD_PART = 0.7  # an object is lifted if its centre of mass has risen by this fraction of the hand's path
RUNAWAY = 30.0  # a velocity (m/s or rad/s) that occurs only if the solver diverges


@dataclass(frozen=True, kw_only=True)
class Plan:
    force_n: float  # limit of the grip force, per finger
    offset_m: tuple[float, float, float]  # of the grip in the object's frame, from the centre of its bounds
    yaw: float  # angle in radians between the object's long side and the pads
    lift_m: float
    friction: float


@dataclass(frozen=True, kw_only=True)
class Touch:
    """Contact forces on one gel."""

    normal_n: float
    shear_n: tuple[float, float]  # tangential force along x (right) and y (down) of the gel's picture


@dataclass(frozen=True, kw_only=True)
class Moment:
    """The forces at one moment. The scene, ``Bench.data``, stays until the next moment is requested."""

    phase: str
    left: Touch
    right: Touch
    unstable: int
    success: int = 0  # valid at 'after', as is the rise
    rise_m: float = 0.0


def contact_radius_m(part: objects.Part, force_n: float, stiffness: float) -> float:
    """Return the radius of the contact between a pad and a part (Winkler: F = pi k R d^2, a^2 = 2 R d), at most the pad's.

    ``stiffness`` is that of the part in N/mm^3. Part and gel are springs in series, as in :func:`mvitac.sim.gel.pressure`.
    """
    spring = 1e9 * stiffness * gel.GEL_STIFFNESS / (stiffness + gel.GEL_STIFFNESS)
    return float(min((4 * force_n * part.pad_radius() / (np.pi * spring)) ** 0.25, objects.PAD_HALF_M))


class Bench:
    """The compiled scene of one object, reused for all its grasps."""

    def __init__(self, thing: objects.Thing) -> None:
        self.thing = thing
        self.model = mujoco.MjModel.from_xml_string(objects.scene(thing))
        self.data = mujoco.MjData(self.model)
        self.body = self.model.body("thing").id
        self.parts = np.flatnonzero(self.model.geom_bodyid == self.body)
        self.pads = (self.model.geom("left_pad").id, self.model.geom("right_pad").id)
        self.address = self.model.joint("thing").qposadr[0]

    def moments(self, plan: Plan) -> Iterator[Moment]:
        """Yield the three moments of a grasp. The result depends only on ``plan``, not on earlier grasps."""
        data = self.data
        height, start = self._place(plan)
        unstable = self._run(SETTLE_S, lambda _: height, lambda _: start)
        yield Moment(phase="before", left=self._touch(0), right=self._touch(1), unstable=unstable)

        # The set point continues into the object: the force limit determines where the fingers stop.
        unstable |= self._run(CLOSE_S, lambda _: height, lambda t: min(start + CLOSE_SPEED * t, objects.OPEN_M))
        yield Moment(phase="during", left=self._touch(0), right=self._touch(1), unstable=unstable)

        lowest = float(data.xipos[self.body, 2])
        closed = min(start + CLOSE_SPEED * CLOSE_S, objects.OPEN_M)
        unstable |= self._run(LIFT_S + HOLD_S, lambda t: height + _lifted(plan.lift_m, t), lambda _: closed)
        rise = float(data.xipos[self.body, 2]) - lowest
        left, right = self._touch(0), self._touch(1)
        on_table = any(0 in pair for pair in data.contact.geom[: data.ncon])
        held = left.normal_n > 0 and right.normal_n > 0 and rise > HELD_PART * plan.lift_m and not on_table
        success = int(held and not unstable)
        yield Moment(phase="after", left=left, right=right, unstable=unstable, success=success, rise_m=rise)

    def _place(self, plan: Plan) -> tuple[float, float]:
        """Reset the scene for ``plan``; return the height of the hand and the position of the open fingers."""
        model, data, thing = self.model, self.data, self.thing
        mujoco.mj_resetData(model, data)
        for part, geom in zip(thing.parts, self.parts, strict=True):
            # A round contact with a paraboloid of pressure rotates at a torque of 8/15 mu a F.
            patch = 8 / 15 * contact_radius_m(part, plan.force_n, thing.stiffness)
            model.geom_friction[geom] = plan.friction, plan.friction * patch, 2e-4
        model.actuator_forcerange[1] = -plan.force_n, plan.force_n
        low, high = thing.bounds
        grip = (low + high) / 2 + plan.offset_m
        height = max(float(grip[2]), objects.PAD_HALF_M + 0.002)
        cos, sin = np.cos(plan.yaw), np.sin(plan.yaw)
        place = -np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ [grip[0], grip[1], 0.0]
        data.qpos[self.address : self.address + 3] = place[0], place[1], 0.0003 - low[2]
        data.qpos[self.address + 3 : self.address + 7] = np.cos(plan.yaw / 2), 0, 0, np.sin(plan.yaw / 2)
        data.qpos[0] = height
        half = (high - low)[:2] / 2
        reach = abs(cos) * half[0] + abs(sin) * min(half[1], 0.02) + abs(plan.offset_m[0]) + 0.008
        start = objects.OPEN_M - min(reach, objects.OPEN_M - 0.002)
        data.qpos[1:3] = start
        return height, start

    def _run(self, seconds: float, lift: Callable[[float], float], close: Callable[[float], float]) -> int:
        """Advance the simulation; return 1 if the solver diverged, with the scene reset to the last valid state."""
        model, data = self.model, self.data
        for chunk in range(round(seconds / STEP_S / CHUNK)):
            time = (chunk + 1) * CHUNK * STEP_S
            data.ctrl[0] = lift(time)
            data.ctrl[1] = 2 * close(time)
            good = data.qpos.copy()
            mujoco.mj_step(model, data, CHUNK)
            if any(data.warning[i].number for i in _LOST) or not np.all(np.abs(data.qvel) < RUNAWAY):
                mujoco.mj_resetData(model, data)
                data.qpos[:] = good
                mujoco.mj_forward(model, data)
                return 1
        return 0

    def _touch(self, side: int) -> Touch:
        total, force = np.zeros(3), np.zeros(6)
        for i in range(self.data.ncon):
            if self.pads[side] in (pair := self.data.contact.geom[i]):
                mujoco.mj_contactForce(self.model, self.data, i, force)
                world = self.data.contact.frame[i].reshape(3, 3).T @ force[:3]
                total += world if pair[1] == self.pads[side] else -world
        out = -1.0 if side == 0 else 1.0
        return Touch(normal_n=max(float(out * total[0]), 0.0), shear_n=(float(out * total[1]), float(-total[2])))


def _lifted(lift_m: float, time: float) -> float:
    """Return the height of the hand at ``time`` (s): a smooth step from 0 to ``lift_m`` in ``LIFT_S``."""
    x = min(time / LIFT_S, 1.0)
    return lift_m * x * x * (3 - 2 * x)


_LOST = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
