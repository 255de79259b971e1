"""Simulated grasps: a parallel gripper with two gels and a camera tries to lift an object; the label is success.

The format is that of "The Feeling of Success" (Calandra et al., CoRL 2017): about 106 objects with 50 grasps each, one
camera picture and two tactile pictures before the fingers close, during the grip (closed, not lifted) and after the lift.

The outcome is computed by physics and has two factors: the distance of the grip from the centre of mass (camera), and
whether the skin under the fingers grips or slides (gels: `mvitac.sim.skin.Patch`). What else is random, and by which rule
the generator was designed, is in docs/simulator.md. It is frozen: every change of a picture or label increases VERSION.

Every item is a function of (seed, object, grasp).
"""

from functools import lru_cache
from typing import Any

import numpy as np

from mvitac.sim import camera, gel, objects, physics, skin
from mvitac.sim.sensors import SENSORS

VERSION = 2
NUM_OBJECTS = 106
FIELD_MM = 22.0  # width of a gel's field of view
GRID = 144  # smallest number of samples across a gel, because the relief is finer than the pixels of a small picture
SHEAR_MM_PER_N = 0.35
SHEAR_LIMIT_MM = 1.2
FAR = 0.25  # fraction of grips that miss the centre of mass
EXPECTED_FRICTION = 0.5
"""The hand knows the weight of an object, not its friction; it presses as hard as this friction needs."""
BEHIND_M = 3.0  # rays start this far behind the pad, so that they are parallel to within 0.2 degrees

# One random stream per purpose, so that sensor and picture size do not affect physics and camera.
_PLAN, _VIEW, _TOUCH = 0x67A50, 0x67A51, 0x67A52


def draw_plan(thing: objects.Thing, patch: skin.Patch, rng: np.random.Generator) -> physics.Plan:
    """Draw position, force and lift height of one grip of ``thing`` on ``patch``."""
    low, high = thing.bounds
    middle, half = (low + high) / 2, (high - low) / 2
    # Grips are central or far from the centre, never in between, where the outcome would be random.
    away = rng.uniform(0.48, 0.8) if rng.random() < FAR else rng.uniform(0.0, 0.05)
    y = thing.center_of_mass[1] + rng.choice([-1, 1]) * away * half[1]
    y = float(np.clip(y, low[1] + 0.1 * half[1], high[1] - 0.1 * half[1]))
    bottom, top = thing.heights(y)
    z = bottom + (top - bottom) * rng.uniform(0.35, 0.6)
    force = 9.81 * thing.mass / (2 * EXPECTED_FRICTION) * np.exp(rng.normal(0, 0.08))
    offset = float(rng.uniform(-0.003, 0.003)), float(y - middle[1]), float(z - middle[2])
    yaw, lift = float(rng.normal(0, 0.07)), float(rng.uniform(0.045, 0.055))
    return physics.Plan(force_n=float(force), offset_m=offset, yaw=yaw, lift_m=lift, friction=patch.friction)


def grasp(
    seed: int, obj: int, index: int, *, size: int, held_out_sensor: bool = False, measured: bool = False
) -> list[dict[str, Any]]:
    """Simulate grasp number ``index`` of object number ``obj``.

    Args:
        held_out_sensor: Use the sensor that is not used otherwise.
        measured: Also return what physics knows of the contact of each gel: ``gel.contact`` and the shear force in N,
            right and down in the gel's picture, with names such as ``depth_left_mm`` and ``shear_x_right_n``.

    Returns:
        A dict per phase with ``vision``, ``touch_left``, ``touch_right`` (uint8 [size, size, 3]), ``phase``,
        ``success`` (0 or 1, equal in all phases), the names ``object`` and ``sensor``, and numbers: the inputs
        (``mass_kg``, ``friction``, ``force_n`` the set grip force, ``offset_mm`` from the centre of mass along the
        object, ``height_mm`` of the grip above it, ``yaw_deg``, ``peaks``, ``amplitude_mm``, ``softness``), the result
        (``lift_mm``, ``unstable``) and the contact (``normal_*_n``; ``contact_*``, the gel's mean imprint in mm, a control).
    """
    bench, key = _bench(seed, obj), (seed, obj, index)
    thing, rng = bench.thing, np.random.default_rng([_PLAN, *key])
    patch = skin.draw_patch(rng)
    plan = draw_plan(thing, patch, rng)
    view = camera.View(np.random.default_rng([_VIEW, *key]))
    feel = np.random.default_rng([_TOUCH, *key])
    sensors = [sensor for sensor in SENSORS.values() if sensor.held_out == held_out_sensor]
    sensor = sensors[int(feel.random() * len(sensors))]
    units, gain = feel.integers(2**31, size=2).tolist(), feel.uniform(0.75, 1.3)
    known = {"object": thing.name, "sensor": sensor.name, **_latents(thing, patch, plan)}
    rows, outcome = [], dict[str, float]()
    for order, moment in enumerate(bench.moments(plan), 1):
        touch_rng, view_rng = (np.random.default_rng([tag, *key, order]) for tag in (_TOUCH, _VIEW))
        row: dict[str, Any] = {"phase": moment.phase, **known}
        for side, name, touch in ((0, "left", moment.left), (1, "right", moment.right)):
            imprint, contacts = _pressed(bench, patch, touch, side, max(GRID, size))
            copy: Any = {"unit": units[side], "gain": gain, "pixel_mm": FIELD_MM / len(imprint)}
            x, y = (SHEAR_LIMIT_MM * float(np.tanh(n * SHEAR_MM_PER_N / SHEAR_LIMIT_MM)) for n in touch.shear_n)
            row[f"touch_{name}"] = gel.render(imprint, sensor, touch_rng, shear_mm=(x, y), size=size, **copy)
            row[f"contact_{name}"] = float(imprint.mean())
            row[f"normal_{name}_n"] = touch.normal_n
            if measured:
                row |= {side_name(known_as, name): value for known_as, value in contacts.items()}
        row["vision"] = camera.photograph(bench, view, view_rng, size=size)
        rows.append(row)
        outcome = {"success": moment.success, "lift_mm": 1000 * moment.rise_m, "unstable": float(moment.unstable)}
    return [{**row, **outcome} for row in rows]  # the outcome of the last moment


@lru_cache(maxsize=4)
def _bench(seed: int, obj: int) -> physics.Bench:
    return physics.Bench(objects.make_thing(seed, obj))


def _latents(thing: objects.Thing, patch: skin.Patch, plan: physics.Plan) -> dict[str, float]:
    low, high = thing.bounds
    _, along, above = (1000 * ((low + high) / 2 + plan.offset_m - thing.center_of_mass)).tolist()
    known = {"mass_kg": thing.mass, "friction": plan.friction, "force_n": plan.force_n}
    known |= {"offset_mm": along, "height_mm": above, "yaw_deg": float(np.rad2deg(plan.yaw))}
    return {**known, "peaks": float(patch.peaks), "amplitude_mm": patch.amplitude_mm, "softness": thing.softness}


def _pressed(
    bench: physics.Bench, patch: skin.Patch, touch: physics.Touch, side: int, grid: int
) -> tuple[np.ndarray, dict[str, float]]:
    """Return the imprint [grid, grid] in mm of the object in one gel, seen from behind the gel; row 0 is up. The dict
    is what physics knows of the contact: depth_mm, shear_x_n, ..."""
    pixel, pressed = FIELD_MM / grid, np.zeros((grid, grid), np.float32)
    if touch.normal_n > 0 and (relief := _relief(bench, patch, side, grid)) is not None:
        spring = {"stiffness": bench.thing.stiffness, "pixel_mm": pixel, "dome_radius_mm": objects.DOME_RADIUS_MM}
        pressed = gel.pressure(relief, force_n=touch.normal_n, **spring)
    # Thickness of the gel; only corners at the rim come near it.
    imprint = np.minimum(gel.imprint(pressed, pixel_mm=pixel), np.float32(2.5))
    shear = dict(zip(("shear_x_n", "shear_y_n"), touch.shear_n, strict=True))
    return imprint, {**gel.contact(pressed, pixel_mm=pixel), **shear}


def _relief(bench: physics.Bench, patch: skin.Patch, side: int, grid: int) -> np.ndarray | None:
    """Return the height [grid, grid] in mm of the object in front of one gel; None if there is nothing."""
    sign = 1.0 if side == 0 else -1.0  # the left gel looks along +x, the right one along -x
    apex = bench.data.geom_xpos[bench.pads[side]] + [sign * objects.PAD_DEPTH_M, 0, 0]
    axis = ((np.arange(grid) + 0.5) / grid - 0.5) * FIELD_MM / 1000
    rays = np.empty((grid, grid, 3))
    rays[..., 0], rays[..., 1], rays[..., 2] = sign * BEHIND_M, -sign * axis[None, :], -axis[:, None]
    rays = rays.reshape(-1, 3) / BEHIND_M
    origin = apex - [sign * BEHIND_M, 0, 0]
    geom, distance, _ = camera.cast(bench, origin, rays, np.array([0, 0, 1, 0, 0, 0], np.uint8))
    points = origin + rays * distance[:, None]
    local = (points - bench.data.xpos[bench.body]) @ bench.data.xmat[bench.body].reshape(3, 3)
    hit = geom >= 0
    relief = np.full(grid * grid, -np.inf, np.float32)
    relief[hit] = 1000 * (BEHIND_M - distance[hit]) + patch.relief_mm(1000 * local[hit])
    return relief.reshape(grid, grid) if hit.any() else None


def side_name(name: str, side: str) -> str:
    """Return the column of one gel: depth_mm of left is depth_left_mm."""
    start, _, unit = name.rpartition("_")
    return f"{start}_{side}_{unit}"
