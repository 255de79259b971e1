"""Objects to grasp (shapes and masses), and the MJCF of the scene with one of them.

An object ("thing" in code) consists of a few primitive geoms. The camera sees a finish (`skin.py`), of dense parts metal.

Frames: the gripper closes along x, an object's long side is along y, z is up and the table is z = 0.
Shapes: N points. Units: metres, kilograms and newtons, except names that end in ``_mm``.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mvitac.sim.skin import Finish

OBJECT_TAG = 0x0B1EC7
"""First word of the seed sequence of object properties. Grasps use other tags, because trailing zeros are ignored."""
PAD_HALF_M = 0.0115  # half the side of a gel pad
DOME_RADIUS_MM = 20.0  # radius of curvature of the gels, in the physics and in the optics
PAD_DEPTH_M = PAD_HALF_M**2 / (DOME_RADIUS_MM / 1000)  # half depth of the ellipsoid with this radius at its apex
FINGER_M = (0.006, 0.009, 0.036)  # half sizes of a finger's bar: thickness, width, height
OPEN_M = 0.047  # distance of an open pad's apex from the hand's axis
MASS_KG = 0.25, 0.7  # smallest and largest mass of an object
CLUTTER = (("box", ".03 .02 .04"), ("sphere", ".028"), ("cylinder", ".022 .045"), ("capsule", ".015 .05"))
"""MuJoCo types and sizes of the clutter."""


@dataclass(frozen=True)
class Part:
    """One primitive of an object, in the object's frame."""

    shape: str  # MuJoCo geom type: box, cylinder, capsule or ellipsoid
    size: tuple[float, ...]  # MuJoCo half sizes in metres
    center: tuple[float, float, float]
    lying: bool = False  # whether the geom's axis is y instead of z
    density: float = 1.0  # multiple of the object's density; above 1.2 the part is drawn as metal

    def half(self) -> np.ndarray:
        """Return the half extents [3] of the axis-aligned box around the part."""
        if self.shape in ("box", "ellipsoid"):
            return np.array(self.size)
        radius, half = self.size
        half += radius if self.shape == "capsule" else 0.0
        return np.array([radius, half, radius] if self.lying else [radius, radius, half])

    def volume(self) -> float:
        if self.shape == "box":
            return 8 * float(np.prod(self.size))
        if self.shape == "ellipsoid":
            return 4 / 3 * np.pi * float(np.prod(self.size))
        radius, half = self.size
        return 2 * np.pi * radius**2 * half + (4 / 3 * np.pi * radius**3 if self.shape == "capsule" else 0.0)

    def pad_radius(self) -> float:
        """Return the effective radius of curvature between the pad's dome and the part's side, in metres.

        On a Winkler foundation, principal curvatures a, b have the contact area of a sphere of curvature sqrt(a b).
        """
        dome = 1000 / DOME_RADIUS_MM
        if self.shape == "box":
            across, along = 0.0, 0.0
        elif self.shape in ("cylinder", "capsule"):
            across, along = 1 / self.size[0], 0.0
        else:
            x, y, z = np.array(self.size)
            across, along = x / z**2, x / y**2
        return 1 / np.sqrt((dome + across) * (dome + along))


@dataclass(frozen=True, kw_only=True)
class Thing:
    """An object; it is the same in all its grasps."""

    name: str  # shape kind and number, such as box_010
    parts: tuple[Part, ...]
    finish: Finish
    density: float  # kilograms per cubic metre (objects are mostly hollow)
    softness: float  # 0 = hard, 1 = foam-like: determines stiffness and the time constant of the contact

    @property
    def mass(self) -> float:
        return sum(part.volume() * part.density * self.density for part in self.parts)

    @property
    def center_of_mass(self) -> np.ndarray:
        """Centre of mass [3] in the object's frame."""
        weights = [part.volume() * part.density for part in self.parts]
        return np.average([part.center for part in self.parts], axis=0, weights=weights)

    @property
    def stiffness(self) -> float:
        """Winkler modulus in N/mm^3: wood-like 10 down to foam-like 0.02."""
        return 10.0 * 0.002**self.softness

    def heights(self, y: float) -> tuple[float, float]:
        """Return the lowest and highest z of the parts that cross the plane at ``y``."""
        across = [part for part in self.parts if abs(y - part.center[1]) <= part.half()[1]] or list(self.parts)
        low = min(part.center[2] - part.half()[2] for part in across)
        return low, max(part.center[2] + part.half()[2] for part in across)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [3] in the object's frame."""
        center = np.array([part.center for part in self.parts])
        half = np.array([part.half() for part in self.parts])
        return (center - half).min(0), (center + half).max(0)


def _mm(rng: np.random.Generator, *ranges: tuple[float, float]) -> list[float]:
    """Draw a length from each range in millimetres; return them in metres."""
    return [rng.uniform(low, high) / 1000 for low, high in ranges]


def _single(shape: str, *ranges: tuple[float, float], lying: bool = False) -> Callable[..., tuple[Part, ...]]:
    """A function that draws an object of one part, with half sizes in ``ranges`` in mm, which stands on z = 0."""

    def draw(rng: np.random.Generator) -> tuple[Part, ...]:
        size = tuple(_mm(rng, *ranges))
        return (Part(shape, size, (0, 0, size[0] if lying else size[-1]), lying=lying),)

    return draw


def _hammer(rng: np.random.Generator) -> tuple[Part, ...]:
    r, h, x, y, z = _mm(rng, (11, 16), (45, 65), (16, 22), (7, 11), (15, 20))
    head = Part("box", (x, y, z), (0, rng.choice([-1, 1]) * (h + y), z), density=rng.uniform(1.0, 1.3))
    return Part("cylinder", (r, h), (0, 0, z), lying=True), head


def _mug(rng: np.random.Generator) -> tuple[Part, ...]:
    r, h, y, z = _mm(rng, (22, 31), (32, 48), (9, 14), (16, 26))
    side = rng.choice([-1, 1])
    return Part("cylinder", (r, h), (0, 0, h)), Part("box", (0.005, y, z), (0, side * (r + y - 0.001), h))


def _bottle(rng: np.random.Generator) -> tuple[Part, ...]:
    r, h, neck, tall = _mm(rng, (18, 30), (26, 44), (10, 14), (12, 20))
    return Part("cylinder", (r, h), (0, 0, h)), Part("cylinder", (neck, tall), (0, 0, 2 * h + tall))


def _tee(rng: np.random.Generator) -> tuple[Part, ...]:
    x, y, z, a, b, c = _mm(rng, (11, 20), (36, 62), (13, 20), (12, 26), (12, 22), (10, 22))
    shift = rng.choice([-1, 1]) * rng.uniform(0.3, 0.75) * y
    top = Part("box", (a, b, c), (0, shift, 2 * z + c), density=rng.uniform(0.8, 1.4))
    return Part("box", (x, y, z), (0, 0, z)), top


def _dumbbell(rng: np.random.Generator) -> tuple[Part, ...]:
    r, h, left, right = _mm(rng, (10, 15), (28, 48), (17, 28), (17, 28))
    z = max(left, right)
    first = Part("cylinder", (z, left / 2), (0, -h, z), lying=True, density=rng.choice([1.0, 1.5]))
    second = Part("cylinder", (z, right / 2), (0, h, z), lying=True)
    return Part("capsule", (r, h), (0, 0, z), lying=True), first, second


_DRAW = {
    "box": _single("box", (11, 27), (30, 72), (13, 32)),
    "can": _single("cylinder", (16, 31), (24, 52)),
    "rod": _single("cylinder", (12, 24), (38, 78), lying=True),
    "ellipsoid": _single("ellipsoid", (16, 30), (26, 58), (15, 28)),
    "capsule": _single("capsule", (13, 25), (22, 55), lying=True),
    **{draw.__name__[1:]: draw for draw in (_hammer, _mug, _bottle, _tee, _dumbbell)},
}
"""Shape kind -> function that draws its parts, which stand on z = 0."""
KINDS = tuple(_DRAW)  # shape kinds. Objects cycle through them, so that every split by object has all kinds.


def make_thing(seed: int, index: int) -> Thing:
    rng, kind = np.random.default_rng([OBJECT_TAG, seed, index]), KINDS[index % len(KINDS)]
    parts = _DRAW[kind](rng)
    finish = Finish(rng)
    density = rng.uniform(*MASS_KG) / sum(part.volume() * part.density for part in parts)
    softness = float(rng.choice([0.0, 0.0, rng.uniform(0.3, 1.0)]))
    return Thing(name=f"{kind}_{index:03d}", parts=parts, finish=finish, density=density, softness=softness)


def scene(thing: Thing) -> str:
    """Return the MJCF of table, gripper, clutter and one object.

    Geom groups: 0 scenery, 1 gripper, 2 the object (what the gels see), 3 the collision bars of the fingers (not drawn,
    because the camera would see them twice).
    """
    height = FINGER_M[2]
    clutter = "\n".join(
        f'<body name="clutter{i}" mocap="true"><geom type="{shape}" size="{size}" class="scenery"/></body>'
        for i, (shape, size) in enumerate(CLUTTER)
    )
    return f"""<mujoco model="{thing.name}">
      <compiler angle="degree" autolimits="true"/>
      <option timestep=".002" integrator="implicitfast" cone="elliptic" impratio="8" iterations="30" tolerance="1e-9"/>
      <default>
        <default class="scenery"><geom contype="0" conaffinity="0" group="0"/></default>
        <default class="shown"><geom contype="0" conaffinity="0" group="1"/></default>
      </default>
      <worldbody>
        <geom name="table" type="plane" size="2 2 .1" group="0" contype="2" conaffinity="1" friction=".5 .002 .0001"/>
        {clutter}
        <body name="hand" pos="0 0 0" gravcomp="1">
          <joint name="lift" type="slide" axis="0 0 1" armature="1"/>
          <geom class="shown" type="box" size=".062 .018 .014" pos="0 0 {0.022 + height + 0.014}" mass=".4"/>
          <geom class="shown" type="cylinder" size=".02 .06" pos="0 0 {0.022 + height + 0.085}" mass=".1"/>
          {_fingers()}
        </body>
        <body name="thing"><freejoint name="thing"/>{_geoms(thing)}</body>
      </worldbody>
      <tendon><fixed name="grip"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed></tendon>
      <equality><joint joint1="left" joint2="right" solref=".004 1"/></equality>
      <actuator>
        <position name="lift" joint="lift" kp="4000" kv="200"/>
        <position name="grip" tendon="grip" kp="1500" kv="4" forcerange="-1 1"/>
      </actuator>
    </mujoco>"""


def _geoms(thing: Thing) -> str:
    """Return the MJCF of the object's parts. With priority 1 their friction counts, not the pad's, which is larger."""
    # A soft object's contact responds more slowly; MuJoCo limits the time constant to 2.5 time steps anyway.
    solref = f"{0.006 + 0.014 * thing.softness:.5f} 1"
    return "\n".join(
        f'<geom name="part{i}" type="{part.shape}" size="{_numbers(part.size)}" pos="{_numbers(part.center)}"'
        f' euler="{90 if part.lying else 0} 0 0" mass="{part.volume() * part.density * thing.density:.9g}"'
        f' group="2" priority="1" condim="6" solref="{solref}" contype="1" conaffinity="1"/>'
        for i, part in enumerate(thing.parts)
    )


def _fingers() -> str:
    bar = f'type="box" size="{_numbers(FINGER_M)}" pos="{PAD_DEPTH_M + 0.003 + FINGER_M[0]} 0 0.022"'
    dome = f'size="{PAD_DEPTH_M} {PAD_HALF_M} {PAD_HALF_M}" pos="{PAD_DEPTH_M} 0 0"'
    return "\n".join(
        f'''<body name="{name}" pos="{sign * OPEN_M} 0 0" euler="0 0 {turn}">
          <joint name="{name}" type="slide" axis="-1 0 0" range="0 {OPEN_M - 0.004}" damping="3" armature="0.05"/>
          <geom class="shown" {bar} mass=".05"/>
          <geom class="shown" type="box" size=".0025 {PAD_HALF_M} {PAD_HALF_M}" pos="{PAD_DEPTH_M} 0 0" mass=".01"/>
          <geom name="{name}_pad" type="ellipsoid" {dome} group="1" mass=".01" condim="6" contype="2" conaffinity="1"/>
          <geom name="{name}_bar" {bar} group="3" mass=".001" condim="3" contype="2" conaffinity="1"/>
        </body>'''
        for name, sign, turn in (("left", -1, 180), ("right", 1, 0))
    )


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.9g}" for value in values)
