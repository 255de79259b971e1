"""A camera that uses MuJoCo's ray casting (no OpenGL) and its own shading: lamp, shadow, gloss, print, table and wall.

Only the object and the gripper's pose carry information. Viewpoint, lamp, colours, table, wall and clutter are random in
each grasp and independent of the outcome.

Shapes: P rays (pixels times samples). Colours are linear RGB in [0, 1] until the last step. Units: metres, radians.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from mvitac.sim import objects
from mvitac.sim.physics import Bench

SAMPLES = 2  # rays per pixel along each axis
TABLES: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "plain": lambda x, y: np.zeros(len(x)),
    "checker": lambda x, y: ((np.floor(x) + np.floor(y)) % 2).astype(float),
    "planks": lambda x, y: 0.5 + 0.3 * np.sin(9 * y + 1.5 * np.sin(0.7 * x)) - 0.5 * (np.abs(y - np.round(y)) < 0.05),
    "marble": lambda x, y: 0.5 + 0.5 * np.sin(2 * x + 3 * np.sin(1.3 * y + np.sin(2.1 * x))),
    "dots": lambda x, y: (np.hypot(x - np.round(x), y - np.round(y)) < 0.28).astype(float),
}
"""Pattern of a table -> the share of its second colour at x, y [P], in units of ``View.table_scale``."""
VISIBLE = np.array([1, 1, 1, 0, 0, 0], np.uint8)
"""Geom groups that the camera sees; the collision bars of the fingers are not drawn."""


class View:
    """The random properties of one picture that are independent of the outcome."""

    half_fov = 0.2  # tangent of half the field of view

    def __init__(self, rng: np.random.Generator) -> None:
        azimuth, elevation = np.deg2rad(-18 + rng.normal(0, 4)), np.deg2rad(33 + rng.normal(0, 3))
        distance = 0.46 * rng.uniform(0.95, 1.08)
        self.target = np.array([0.0, 0.0, 0.042]) + rng.normal(0, 0.004, 3)  # point in the centre of the picture
        flat = np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation)
        self.position = self.target + distance * np.array([*flat, np.sin(elevation)])  # of the camera
        angle = azimuth + rng.uniform(-1.6, 1.6)
        self.lamp = np.array([np.cos(angle), np.sin(angle), rng.uniform(0.7, 1.8)]) * rng.uniform(0.6, 1.0)  # position
        self.clutter_poses = _clutter(azimuth, rng)
        tint = rng.normal(1, 0.10, 3)
        self.roll = rng.normal(0, np.deg2rad(1.5))
        self.lamp_color = tint * rng.uniform(0.7, 1.15)
        self.ambient = rng.uniform(0.18, 0.45)
        self.exposure = rng.uniform(0.75, 1.25)
        self.table = str(rng.choice(list(TABLES)))
        color = rng.uniform(0.25, 0.85) * rng.normal(1, 0.12, 3)
        self.table_colors = np.clip([color, color * rng.uniform(0.7, 1.3) + rng.normal(0, 0.03, 3)], 0.02, 0.95)
        self.table_turn = rng.uniform(0, np.pi)
        self.table_scale = rng.uniform(0.02, 0.07)
        self.wall_colors = rng.uniform(0.05, 0.85, (3, 3))  # bottom, top, and a soft stain
        self.wall_stain = rng.normal(size=3)  # its direction
        self.gripper_color = np.clip(rng.uniform(0.02, 0.08) * rng.normal(1, 0.12, 3), 0.01, 1)
        self.gel_color = np.clip([0.25, 0.85, 1.0] * rng.normal(1, 0.1, 3), 0, 1)
        self.clutter_colors = rng.uniform(0.03, 0.9, (len(objects.CLUTTER), 3))
        self.noise = rng.uniform(1.0, 4.0)


def _clutter(azimuth: float, rng: np.random.Generator) -> np.ndarray:
    """Draw poses [clutter, 7] behind the gripper or at its side, seen from ``azimuth``: nothing hides the object. A
    pose is position and quaternion; absent objects are far below the table."""
    poses = np.zeros((len(objects.CLUTTER), 7))
    for pose in poses:
        where, far = azimuth + np.pi + rng.uniform(-1.15, 1.15), rng.uniform(0.15, 0.30)
        pose[:3] = far * np.cos(where), far * np.sin(where), rng.uniform(0.015, 0.05)
        if rng.random() < 0.7:
            pose[2] = -5.0
        pose[3:] = rng.normal(size=4)
        pose[3:] /= np.linalg.norm(pose[3:])
    return poses


def photograph(bench: Bench, view: View, rng: np.random.Generator, *, size: int) -> np.ndarray:
    """Return the picture, uint8 [size, size, 3]. Moves the clutter; ``rng`` is used for pixel noise only."""
    poses = view.clutter_poses
    bench.data.mocap_pos[:], bench.data.mocap_quat[:] = poses[:, :3], poses[:, 3:]
    mujoco.mj_kinematics(bench.model, bench.data)
    rays = rays_of(view.target - view.position, size * SAMPLES, view.half_fov, view.roll)
    geom, distance, normal = cast(bench, view.position, rays)
    points, hit = view.position + rays * distance[:, None], geom >= 0
    albedo, gloss, glow = _surface(bench, view, geom, points, rays)

    to_lamp = view.lamp - points
    to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
    facing = np.sum(normal * to_lamp, axis=1)
    direct = np.clip(facing, 0, None) * ~_shadow(bench, view.lamp, points, hit & (facing > 0))
    half = to_lamp - rays
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shine = np.clip(np.sum(normal * half, axis=1), 0, 1) ** 40 * gloss * (direct > 0)
    sky = view.ambient * (0.65 + 0.35 * normal[:, 2])
    light = np.where(hit, sky, 1.0)[:, None] + np.where(hit, direct, 0.0)[:, None] * view.lamp_color
    color = albedo * np.maximum(light, glow[:, None]) + shine[:, None] * view.lamp_color * hit[:, None]

    color = color.reshape(size, SAMPLES, size, SAMPLES, 3).mean((1, 3)) * view.exposure
    levels = 255 * np.clip(color, 0, 1) ** (1 / 2.2) + rng.normal(0, view.noise, color.shape)
    return np.clip(levels, 0, 255).astype(np.uint8)


def rays_of(ahead: np.ndarray, side: int, half_fov: float, roll: float = 0.0) -> np.ndarray:
    """Return unit directions [side * side, 3] around ``ahead``, row by row from the top left."""
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    cos, sin = np.cos(roll), np.sin(roll)
    right, up = cos * right + sin * up, cos * up - sin * right
    u = ((np.arange(side) + 0.5) / side * 2 - 1) * half_fov
    rays = (ahead + u[None, :, None] * right - u[:, None, None] * up).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def cast(
    bench: Any, origin: np.ndarray, rays: np.ndarray, groups: np.ndarray = VISIBLE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return geom [P] (-1: none), distance [P] (0 if none) and normal [P, 3] of the first hit of each ray.

    ``bench`` has MuJoCo's ``model`` and ``data``.
    """
    count, flat = len(rays), np.ascontiguousarray(rays).ravel()
    geom, distance, normal = np.full(count, -1, np.int32), np.zeros(count), np.zeros(3 * count)
    mujoco.mj_multiRay(bench.model, bench.data, origin, flat, groups, True, -1, geom, distance, normal, count, 10.0)
    return geom, np.where(geom >= 0, distance, 0.0), normal.reshape(-1, 3)


def _shadow(bench: Bench, lamp: np.ndarray, points: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return which of the points [P, 3] are in shadow; only those in ``lit`` are tested."""
    away = points[lit] - lamp
    length = np.linalg.norm(away, axis=1)
    geom, distance, _ = cast(bench, lamp, away / length[:, None])
    shadowed = np.zeros(len(points), bool)
    shadowed[lit] = (geom >= 0) & (distance < length - 1e-3)
    return shadowed


def _surface(
    bench: Bench, view: View, geom: np.ndarray, points: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colour [P, 3], gloss [P] and emitted light [P] of the surface that each ray hits."""
    albedo, gloss, glow = (values[geom] for values in _finishes(bench.model, view))
    finish, data = bench.thing.finish, bench.data
    for part, i in zip(bench.thing.parts, bench.parts, strict=True):
        if not (seen := geom == i).any():
            continue
        if part.density > 1.2:
            albedo[seen], gloss[seen] = [0.42, 0.43, 0.45], 1.0
            continue
        local = (points[seen] - data.xpos[bench.body]) @ data.xmat[bench.body].reshape(3, 3)
        mix = 0.5 + 0.5 * np.tanh(3 * finish.printed(1000 * local))
        albedo[seen] = finish.color + (finish.accent - finish.color) * mix[:, None]
        gloss[seen] = finish.gloss
    table = geom == bench.model.geom("table").id
    albedo[table] = _table(view, points[table])
    wall = geom < 0
    albedo[wall] = _wall(view, rays[wall])
    gloss[wall] = glow[wall] = 0.0
    return albedo, gloss, glow


def _finishes(model: mujoco.MjModel, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colour [geoms, 3], gloss [geoms] and emitted light [geoms] of gripper, gels, table and clutter."""
    color = np.tile(view.gripper_color, (model.ngeom, 1))
    gloss, glow = np.full(model.ngeom, 0.25), np.zeros(model.ngeom)
    pads = [model.geom(f"{side}_pad").id for side in ("left", "right")]
    color[pads], glow[pads], gloss[model.geom("table").id] = view.gel_color, 0.6, 0.05
    mocap = model.body_mocapid[model.geom_bodyid]
    color[mocap >= 0] = view.clutter_colors[mocap[mocap >= 0]]
    return color, gloss, glow


def _table(view: View, points: np.ndarray) -> np.ndarray:
    """Return the colour [P, 3] of the table at points of its plane."""
    cos, sin = np.cos(view.table_turn), np.sin(view.table_turn)
    x = (cos * points[:, 0] + sin * points[:, 1]) / view.table_scale
    y = (cos * points[:, 1] - sin * points[:, 0]) / view.table_scale
    first, second = view.table_colors
    return first + (second - first) * TABLES[view.table](x, y)[:, None]


def _wall(view: View, rays: np.ndarray) -> np.ndarray:
    """Return the colour [P, 3] of the background in the direction of the rays."""
    bottom, top, stain = view.wall_colors
    height = np.clip(rays[:, 2:] * 1.5 + 0.6, 0, 1)
    spot = np.exp(-6 * (1 - rays @ (view.wall_stain / np.linalg.norm(view.wall_stain))))[:, None]
    return (bottom + (top - bottom) * height) * (1 - 0.5 * spot) + 0.5 * spot * stain
