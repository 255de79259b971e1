# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
"""Simulated grasps: a parallel jaw with two gels and a camera tries to lift a thing; was it lifted and still held?

A stand-in for "The Feeling of Success" (Calandra et al., CoRL 2017) with the same shape: about 106 objects, 50 grasps
each, one camera picture and two tactile pictures before the fingers close, during the grip (closed, not lifted) and
after the lift. It is a simulation: numbers from it are never to be set beside the real data's. 'after' shows the
outcome and 'before' shows no contact, so a probe reads 'during'. Split by object, never by grasp.

The outcome is physics, and what decides it is half seen, half felt: how far from the centre of mass the fingers grip
(camera), and whether the patch of skin under them grips or slides (gels: `mvitac.sim.skin.Patch`). How big and bright
the imprint is says nothing: the hand knows the weight and presses as hard as a middling friction would need. Shape, mass,
sensor copy, lamp, colours, table, wall, clutter and viewpoint change and mean nothing by themselves.

The generator was made by one rule: supervised at least 20 points above an untrained trunk and below 97 %, touch and
vision, unseen objects (docs/simulator.md). It is frozen: a change of anything a picture or label depends on raises
VERSION.

Every item is a function of (seed, object, grasp) alone.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import mujoco
import numpy as np
from PIL import Image

from mvitac.sim import camera, gel, objects, physics, skin
from mvitac.sim.objects import object_name
from mvitac.sim.physics import PHASES

__all__ = ["NUM_GRASPS", "NUM_OBJECTS", "PHASES", "VERSION", "contact_sheet", "grasp", "object_name"]

VERSION = 2
NUM_OBJECTS = 106
NUM_GRASPS = 50
"""Grasps per object as in the original; an index may be larger."""

FIELD_MM = 22.0
"""Side of a gel's field of view."""

GRID = 144
"""Samples across a gel for pictures up to this size: print and relief are finer than a small picture's pixels."""

SHEAR_MM_PER_N = 0.35
SHEAR_LIMIT_MM = 1.2

FAR = 0.25
"""Part of the grips that miss the centre of mass along the thing."""

EXPECTED_FRICTION = 0.5
"""The hand knows what a thing weighs, not how slippery it is: it presses as hard as this friction would need."""

BEHIND_M = 3.0
"""Rays start so far behind the pad that they are parallel to within 0.2 degrees."""

# One stream per purpose, so that a change of the sensor or the picture size leaves physics and camera as they were.
_PLAN, _VIEW, _TOUCH = 0x67A50, 0x67A51, 0x67A52


def draw_plan(thing: objects.Thing, patch: skin.Patch, rng: np.random.Generator) -> physics.Plan:
    """Draw where, how hard and how high one grip of ``thing`` on ``patch`` is."""
    low, high = thing.bounds
    middle, half = (low + high) / 2, (high - low) / 2
    # Grips are careful or too far out, never in between: near the balance the outcome would be luck.
    away = rng.uniform(0.48, 0.8) if rng.random() < FAR else rng.uniform(0.0, 0.05)
    y = thing.center_of_mass[1] + rng.choice([-1, 1]) * away * half[1]
    y = float(np.clip(y, low[1] + 0.1 * half[1], high[1] - 0.1 * half[1]))
    bottom, top = thing.heights(y)
    z = bottom + (top - bottom) * rng.uniform(0.35, 0.6)
    force = 9.81 * thing.mass / (2 * EXPECTED_FRICTION) * np.exp(rng.normal(0, 0.08))
    return physics.Plan(
        force_n=float(force),
        offset_m=(float(rng.uniform(-0.003, 0.003)), float(y - middle[1]), float(z - middle[2])),
        yaw=float(rng.normal(0, 0.07)),
        lift_m=float(rng.uniform(0.045, 0.055)),
        friction=patch.friction,
    )


def grasp(
    seed: int,
    obj: int,
    index: int,
    *,
    size: int,
    held_out_sensor: bool = False,
    phases: tuple[str, ...] = PHASES,
) -> list[dict[str, Any]]:
    """Simulate one grasp; return its moments 'before', 'during' and 'after', or those in ``phases`` (cheaper).

    Each is a dict of ``vision``, ``touch_left``, ``touch_right`` (uint8 [size, size, 3]), ``phase``, ``success`` (0
    or 1, the same in all three), the names ``object`` and ``sensor``, and floats: what the simulator knew
    (``mass_kg``, ``friction``, ``force_n`` the set grip force, ``offset_mm`` from the centre of mass along the
    thing, ``height_mm`` of the grip above it, ``yaw_deg``, ``roughness``, ``softness``), what came of it
    (``lift_mm``, ``unstable``) and the moment's contact (``normal_*_n``; ``contact_*``: the mean imprint of that
    gel in mm, the control any use of touch has to beat).
    """
    if not 0 <= obj < NUM_OBJECTS:
        raise ValueError(f"obj must be in 0..{NUM_OBJECTS - 1}, got {obj}")
    if index < 0 or seed < 0:
        raise ValueError(f"seed and index must be 0 or larger, got seed {seed} and index {index}")
    if unknown := set(phases) - set(PHASES):
        raise ValueError(f"phases must be among {PHASES}, got {sorted(unknown)}")
    if not 16 <= size <= 1024:
        raise ValueError(f"size must be in 16..1024 pixels, got {size}")
    bench = _bench(seed, obj)
    rng = np.random.default_rng([_PLAN, seed, obj, index])
    patch = skin.draw_patch(rng)
    return _record(
        bench,
        patch,
        draw_plan(bench.thing, patch, rng),
        (seed, obj, index),
        size=size,
        held_out_sensor=held_out_sensor,
        phases=phases,
    )


@lru_cache(maxsize=4)
def _bench(seed: int, obj: int) -> physics.Bench:
    return physics.Bench(objects.make_thing(seed, obj))


def _record(
    bench: physics.Bench,
    patch: skin.Patch,
    plan: physics.Plan,
    key: tuple[int, int, int],
    *,
    size: int,
    held_out_sensor: bool,
    phases: tuple[str, ...],
) -> list[dict[str, Any]]:
    """Carry out a plan and photograph it; ``key`` is (seed, object, grasp) and decides the nuisances."""
    thing = bench.thing
    look = np.random.default_rng([_VIEW, *key])
    feel = np.random.default_rng([_TOUCH, *key])
    view = camera.draw_view(look)
    sensor = _sensor(feel.random(), held_out_sensor)
    units = feel.integers(2**31, size=2)
    gain = feel.uniform(0.75, 1.3)
    low, high = thing.bounds
    grip = (low + high) / 2 + plan.offset_m
    known = {
        "object": thing.name,
        "sensor": sensor.name,
        "mass_kg": thing.mass * plan.mass_scale,
        "friction": plan.friction,
        "force_n": plan.force_n,
        "offset_mm": 1000 * float(grip[1] - thing.center_of_mass[1]),
        "height_mm": 1000 * float(grip[2] - thing.center_of_mass[2]),
        "yaw_deg": float(np.rad2deg(plan.yaw)),
        "peaks": float(patch.peaks),
        "amplitude_mm": patch.amplitude_mm,
        "softness": thing.softness,
    }
    rows = []
    moment = None
    for order, moment in enumerate(bench.moments(plan), 1):
        if moment.phase not in phases:
            continue
        # Noise has a stream per moment, so that leaving one out changes no other.
        feel, look = (np.random.default_rng([tag, *key, order]) for tag in (_TOUCH, _VIEW))
        row: dict[str, Any] = {"phase": moment.phase, **known}
        for side, name, touch in ((0, "left", moment.left), (1, "right", moment.right)):
            imprint = _imprint(bench, patch, moment.data, side, touch.normal_n, size)
            shear = [SHEAR_LIMIT_MM * float(np.tanh(n * SHEAR_MM_PER_N / SHEAR_LIMIT_MM)) for n in touch.shear_n]
            row[f"touch_{name}"] = gel.render(
                imprint,
                sensor,
                feel,
                pixel_mm=FIELD_MM / len(imprint),
                shear_mm=(shear[0], shear[1]),
                size=size,
                unit=int(units[side]),
                gain=gain,
            )
            row[f"contact_{name}"] = float(imprint.mean())
            row[f"normal_{name}_n"] = touch.normal_n
        row["vision"] = camera.photograph(bench.model, moment.data, thing, view, look, size=size)
        rows.append(row)
    assert moment is not None, "there are three phases"
    for row in rows:
        row["success"] = moment.success
        row["lift_mm"] = 1000 * moment.rise_m
        row["unstable"] = float(moment.unstable)
    return rows


def _sensor(draw: float, held_out: bool) -> gel.Sensor:
    """Pick one of the sensors by a number in [0, 1)."""
    some = [sensor for sensor in gel.SENSORS.values() if sensor.held_out == held_out]
    return some[int(draw * len(some))]


def _imprint(
    bench: physics.Bench, patch: skin.Patch, data: mujoco.MjData, side: int, normal_n: float, size: int
) -> np.ndarray:
    """Return the imprint [grid, grid] in mm of the thing in one gel; row 0 is up, seen from behind the gel."""
    grid = max(GRID, size)
    if normal_n <= 0:
        return np.zeros((grid, grid), np.float32)
    sign = 1.0 if side == 0 else -1.0  # the left gel looks along +x, the right one along -x
    apex = data.geom_xpos[bench.pads[side]] + [sign * objects.PAD_DEPTH_M, 0, 0]
    axis = ((np.arange(grid) + 0.5) / grid - 0.5) * FIELD_MM / 1000
    rays = np.empty((grid, grid, 3))
    rays[..., 0], rays[..., 1], rays[..., 2] = sign * BEHIND_M, -sign * axis[None, :], -axis[:, None]
    rays = rays.reshape(-1, 3) / BEHIND_M
    origin = apex - [sign * BEHIND_M, 0, 0]
    groups = np.array([0, 0, 1, 0, 0, 0], np.uint8)
    geom, distance, _ = camera.cast(bench.model, data, origin, rays, groups)
    points = origin + rays * distance[:, None]
    local = (points - data.xpos[bench.body]) @ data.xmat[bench.body].reshape(3, 3)
    hit = geom >= 0
    relief = np.full(grid * grid, -np.inf, np.float32)
    relief[hit] = 1000 * (BEHIND_M - distance[hit]) + patch.relief_mm(1000 * local[hit])
    if not hit.any():
        return np.zeros((grid, grid), np.float32)
    imprint = gel.press(
        relief.reshape(grid, grid),
        force_n=normal_n,
        stiffness=bench.thing.stiffness,
        pixel_mm=FIELD_MM / grid,
        dome_radius_mm=objects.DOME_RADIUS_MM,
    )
    return np.minimum(imprint, np.float32(2.5))  # a gel is no thicker; only a corner on the rim comes near


def contact_sheet(path: str | Path | BinaryIO, size: int = 132, seed: int = 0) -> None:
    """Write one PNG: per row a shape kind, a failed and a held grasp of it, each with its three moments.

    Every moment is camera, left gel, right gel; the frame is red where the grasp fails and green where it holds.
    """
    edge = 3
    size = min(size, (1600 - 4 * edge) // 18)
    sheet = []
    for kind in range(len(objects.KINDS)):
        found: dict[int, list[dict[str, Any]]] = {}
        for index in range(40):
            obj = kind + len(objects.KINDS) * (index % 4)
            rows = grasp(seed, obj, index, size=size)
            found.setdefault(rows[0]["success"], rows)
            if len(found) == 2:
                break
        row = []
        for success, frame in ((0, (200, 30, 30)), (1, (30, 160, 60))):
            strip = np.full((size, 9 * size, 3), 255, np.uint8)
            if success in found:
                strip = np.hstack([r[k] for r in found[success] for k in ("vision", "touch_left", "touch_right")])
            row.append(np.stack([np.pad(strip[..., c], edge, constant_values=frame[c]) for c in range(3)], -1))
        sheet.append(np.hstack(row))
    Image.fromarray(np.vstack(sheet)).save(path, format="PNG")
