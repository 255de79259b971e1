"""Optics of a camera-based tactile sensor: an object is pressed into a gel, and a camera behind the gel sees the imprint.

Shapes: H, W pixels of a height map, row 0 at the top, x to the right, y down; heights and imprints in mm, forces in N.

    pressure()    object relief [H, W] mm      ->  pressure [H, W] N/mm^2
    imprint()     pressure [H, W] N/mm^2       ->  imprint [H, W] mm (displacement of the gel towards the camera)
    contact()     pressure [H, W] N/mm^2       ->  depth, place and size of the contact
    render()      imprint [H, W] mm            ->  picture [H, W, 3] uint8 of one `Sensor`

The gel is a Winkler foundation, independent springs (Johnson, Contact Mechanics, 1985, section 4.3), under a membrane.
Colour is almost linear in slope and saturates: gels have matt paint and are lit at a grazing angle, with one colour of LED
per side. A Lambertian model with an overhead term is much too grey (compare Johnson and Adelson, CVPR 2009). Levels, colours
and dots of `SENSORS` were set by eye, by comparison with pictures of real sensors; `MEASURED` are real ones (`measured`).
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter

from mvitac.sim import measured
from mvitac.sim.sensors import Pair, Sensor

F = NDArray[Any]  # float32 [H, W] unless said otherwise; numpy's stubs lose the width on the way
GEL_STIFFNESS = 0.06  # Winkler modulus of the gel in N/mm^3: about 0.2 MPa over 3 to 4 mm
MEMBRANE_MM = (0.12, 0.35, 0.9)
"""Radii over which the membrane bridges gaps (set by eye, from the halo around real imprints)."""
MEMBRANE_SAG = 0.8
"""Relative height of the bridge: the gel behind pushes the membrane into the gap, so shallow grooves remain visible."""
Rng = np.random.Generator
_TAG = 0x6E1


def pressure(relief_mm: F, *, force_n: float, stiffness: float, pixel_mm: float, dome_radius_mm: float | None) -> F:
    """Press an object into the gel: the contact pressure [H, W] in N/mm^2 whose integral over the picture is `force_n`.

    Object and gel are springs in series at every pixel, so the contact of a soft object is wider, shallower and flatter.
    The approach that balances the force is exact: with sorted gaps, pressure is linear in it between two neighbouring gaps.

    Args:
        relief_mm: Object height [H, W]; higher = nearer to the gel, -inf = no object.
        stiffness: Winkler modulus of the object in N/mm^3 (foam 0.01, wood above 10; 1e3 is rigid).
        dome_radius_mm: Radius of the gel's dome; None = flat: on a flat face a nearly blank picture.
    """
    height = np.array(relief_mm, np.float64)
    if dome_radius_mm is not None:  # a domed gel touches first at its centre
        x, y = axes_mm(height.shape, pixel_mm)
        height -= (x * x + y * y) / (2 * dome_radius_mm)
    # -inf means "no object here"; a gap of 50 mm is equivalent and keeps the arithmetic finite
    gap = np.minimum(height.max() - height, 50.0)
    spring = stiffness * GEL_STIFFNESS / (stiffness + GEL_STIFFNESS) * pixel_mm**2  # N per mm and pixel
    gaps = np.sort(gap, axis=None)
    count = np.arange(1, gaps.size + 1)
    approach = (force_n / spring + np.cumsum(gaps)) / count  # if exactly the first `count` pixels touch
    touching = int(np.argmax(np.append(gaps[1:], np.inf) >= approach))  # first consistent count
    return (np.maximum(approach[touching] - gap, 0.0) * (spring / pixel_mm**2)).astype(np.float32)


def imprint(pressed: F, *, pixel_mm: float) -> F:
    """Return the imprint [H, W] in mm of a pressure [H, W] in N/mm^2."""
    return relax(pressed / np.float32(GEL_STIFFNESS), pixel_mm=pixel_mm)


def relax(indent_mm: F, *, pixel_mm: float) -> F:
    """Model the membrane, which bridges gaps: max(p, sag * blur(p)) from fine to coarse, [H, W] mm to [H, W] mm."""
    surface = indent_mm
    for radius in MEMBRANE_MM:
        surface = np.maximum(surface, np.float32(MEMBRANE_SAG) * _blur(surface, radius / pixel_mm))
    return gaussian_filter(surface, 0.07 / pixel_mm, mode="nearest")  # the paint layer smooths the rest


def contact(pressed: F, *, pixel_mm: float) -> dict[str, float]:
    """Measure the contact of a pressure [H, W] in N/mm^2, before the membrane smooths it.

    Returns "depth_mm", the deepest indentation of the gel; "contact_x_mm" and "contact_y_mm", the centre of pressure,
    right and down from the middle of the picture (NaN without contact); "patch_mm2", the area under pressure.
    """
    p = pressed.astype(np.float64)
    x, y = ((np.arange(n) - (n - 1) / 2) * pixel_mm for n in (p.shape[1], p.shape[0]))
    total = float(p.sum()) or math.nan
    centre = {"contact_x_mm": float(p.sum(0) @ x) / total, "contact_y_mm": float(p.sum(1) @ y) / total}
    return {"depth_mm": float(p.max()) / GEL_STIFFNESS, **centre, "patch_mm2": float((p > 0).sum()) * pixel_mm**2}


def render(
    imprint_mm: F,
    sensor: Sensor,
    rng: Rng,
    *,
    pixel_mm: float,
    unit: int,
    shear_mm: Pair = (0.0, 0.0),
    size: int | None = None,
    gain: float = 1.0,
) -> NDArray[np.uint8]:
    """Render an imprint [H, W] in mm as a sensor sees it: uint8 [h, w, 3].

    Args:
        rng: Random generator of camera noise.
        unit: Number of a physical copy of the sensor with its own dots, dirt, scratches and tint.
        shear_mm: Displacement (x, y) of the dots inside the contact.
        size: Side of the picture, h = w; default: (H, W).
        gain: Factor of the colour response to slope (LED current, paint).
    """
    # A copy has the same properties at every size.
    copy, paint = np.random.default_rng([_TAG, *sensor.name.encode(), unit]).spawn(2)
    imprint = imprint_mm.astype(np.float32)
    picture = (_measured if sensor.calibration else _illuminate)(imprint, sensor, copy, paint, pixel_mm, gain)
    if sensor.marker_pitch_mm:
        _draw_markers(picture, imprint, sensor, copy, pixel_mm, shear_mm)
    _soil(picture, sensor, copy, pixel_mm)
    if size is not None:
        picture = area_resize(picture, size, size)
    picture += rng.standard_normal(picture.shape, np.float32) * np.float32(sensor.noise)
    return np.clip(picture + 0.5, 0, 255).astype(np.uint8)


def area_resize(picture: F, height: int, width: int) -> F:
    """Average [H, W, C] to [height, width, C]; each source pixel is weighted by the area it covers."""
    if picture.shape[:2] == (2 * height, 2 * width):  # common case: the rounding does not depend on the order
        half = np.float32(0.5) * picture
        tall = half[0::2] + half[1::2]
        tall *= np.float32(0.5)
        return tall[:, 0::2] + tall[:, 1::2]
    rows, columns = _area_weights(picture.shape[0], height), _area_weights(picture.shape[1], width)
    return np.einsum("hH,HWc->hWc", rows, picture, optimize=True).transpose(0, 2, 1).dot(columns.T).transpose(0, 2, 1)


def _illuminate(imprint: F, sensor: Sensor, copy: Rng, paint: Rng, pixel_mm: float, gain: float) -> F:
    """Return float levels [H, W, 3]: light without contact, plus the response to slope, minus shadows of ridges."""
    u, v = _axes_unit(imprint.shape)
    # paint is uneven: a faint grain of slope; each copy has its own LED balance and a slightly shifted glow
    grain = gaussian_filter(paint.standard_normal(imprint.shape, np.float32), 1.0) * np.float32(0.0035)
    gy, gx = np.gradient(imprint + grain, np.float32(pixel_mm))
    balance = copy.normal(1.0, 0.05, 3) * copy.normal(1.0, 0.04)
    shift = copy.normal(0.0, 0.05, (3, 2))
    picture = np.empty((*imprint.shape, 3), np.float32)
    touched = bool(imprint.any())
    for c in range(3):
        height, cu, cv, su, sv = sensor.glow[c]
        spot = np.exp(-(((u - cu - shift[c, 0]) / su) ** 2)) * np.exp(-(((v - cv - shift[c, 1]) / sv) ** 2))
        rest = (sensor.base[c] + height * spot + sensor.tilt[c][0] * u + sensor.tilt[c][1] * v) * balance[c]
        rx, ry = sensor.response[c]
        lit = np.sqrt(np.maximum(rest, 4.0) / (sensor.base[c] + 0.6 * height))  # the response decreases with light
        slope = (gx * np.float32(rx * gain) + gy * np.float32(ry * gain)) / np.float32(sensor.saturation)
        change = np.tanh(slope) * lit.astype(np.float32) * np.float32(sensor.saturation)
        if touched and sensor.shadow:
            change -= _shadow(imprint, (-rx, -ry), pixel_mm) * (rest * sensor.shadow).astype(np.float32)
        picture[..., c] = rest + change
    return picture


def _measured(imprint: F, sensor: Sensor, copy: Rng, paint: Rng, pixel_mm: float, gain: float) -> F:
    """Return float levels [H, W, 3] of a real gel. A copy has its own LED balance and field of view on that gel."""
    gy, gx = np.gradient(imprint, np.float32(pixel_mm))
    balance = copy.normal(1.0, 0.05, 3) * copy.normal(1.0, 0.04)
    picture = measured.read(sensor.calibration).light(gx, gy, pixel_mm, copy.uniform(-1, 1, 2), gain)
    return picture * balance.astype(np.float32)


def _shadow(imprint: F, towards: Pair, pixel_mm: float) -> F:
    """Return 0..1 [H, W], the part of the LED in direction `towards` that is hidden by higher points."""
    length = float(np.hypot(*towards))
    blocked = np.zeros(imprint.shape, np.float32)
    for distance in (0.35, 0.8):
        dx = round(distance * towards[0] / length / pixel_mm)
        dy = round(distance * towards[1] / length / pixel_mm)
        ahead = np.roll(imprint, (-dy, -dx), axis=(0, 1))  # wrapped pixels at the rim are covered by the lens edge
        np.maximum(blocked, ahead - imprint - np.float32(0.3 * distance), out=blocked)
    return 1 - np.exp(blocked * np.float32(-4.0))


def _draw_markers(picture: F, imprint: F, sensor: Sensor, copy: Rng, pixel_mm: float, shear_mm: Pair) -> None:
    """Draw the dots into levels [H, W, 3] in place. They move with the gel, so contact drags and spreads them."""
    x, y = axes_mm(imprint.shape, pixel_mm)
    push = _blur(imprint, 0.8 / pixel_mm)
    grip = push / (push + np.float32(0.08))
    spread_y, spread_x = np.gradient(push, np.float32(pixel_mm))
    x = x - grip * np.float32(shear_mm[0]) + spread_x * np.float32(0.2)  # the gel flows away from the contact
    y = y - grip * np.float32(shear_mm[1]) + spread_y * np.float32(0.2)
    pitch = sensor.marker_pitch_mm * np.exp(copy.normal(0.0, 0.08))
    angle = np.deg2rad(sensor.marker_angle_deg + copy.normal(0.0, 2.0))
    place = copy.uniform(0, 64, 2)
    cos, sin = np.float32(np.cos(angle) / pitch), np.float32(np.sin(angle) / pitch)
    i, j = cos * x + sin * y + np.float32(place[0]), cos * y - sin * x + np.float32(place[1])
    fi, fj = np.floor(i), np.floor(j)
    cell = (fi.astype(np.int32) & 63) * 64 + (fj.astype(np.int32) & 63)
    wear, bound = sensor.marker_wear, 0.5 - sensor.marker_radius_mm / pitch  # a dot stays in its cell
    jitter = np.clip(copy.normal(0.0, sensor.marker_jitter, (2, 4096)), -bound, bound).astype(np.float32)
    radius = sensor.marker_radius_mm * np.clip(copy.normal(1.0, 0.05 + 0.25 * wear, 4096), 0.5, 1.5)
    squash = np.exp(copy.normal(0.0, 0.05 + 0.25 * wear, 4096))
    skew = copy.normal(0.0, 0.3 * wear, 4096)
    ink = np.clip(copy.normal(0.88 - 0.1 * wear, 0.04 + 0.2 * wear, 4096), 0.1, 1.0)
    bite = copy.uniform(-1.6, 1.6, (2, 4096))  # a worn dot has lost a disc of ink
    lost = copy.random(4096) < wear * 0.5
    dx, dy = (i - fi - np.float32(0.5) - jitter[0][cell]), (j - fj - np.float32(0.5) - jitter[1][cell])
    scale = np.float32(pitch) / radius.astype(np.float32)[cell]
    dx, dy = dx * scale, dy * scale  # in dot radii
    e, s = squash.astype(np.float32)[cell], skew.astype(np.float32)[cell]
    soft = np.float32(max(0.35 * pixel_mm, 0.035) / sensor.marker_radius_mm)
    cover = _disc(dx * dx * e + dy * dy / e + s * dx * dy, soft)
    if wear:
        hole = _disc((dx - bite[0].astype(np.float32)[cell]) ** 2 + (dy - bite[1].astype(np.float32)[cell]) ** 2, soft)
        cover = cover * (1 - hole * lost.astype(np.float32)[cell])
    cover = (cover * ink.astype(np.float32)[cell])[..., None]
    picture *= 1 - cover
    picture += cover * np.float32(26.0)


def _disc(square: F, soft: F | np.float32) -> F:
    """Return the inside of a disc of radius 1 with a soft edge, from squared distances [H, W]."""
    return np.clip((1 - np.sqrt(np.maximum(square, 0))) / (2 * soft) + np.float32(0.5), 0, 1)


def _soil(picture: F, sensor: Sensor, copy: Rng, pixel_mm: float) -> None:
    """Add dirt, scratches and the lens edge to levels [H, W, 3] in place."""
    h, w = picture.shape[:2]
    x, y = axes_mm((h, w), pixel_mm)
    reach = 3 * max(pixel_mm, 0.12)
    for _ in range(copy.poisson(sensor.dirt)):
        cx, cy = copy.uniform(-0.5, 0.5, 2) * (w, h) * pixel_mm
        r = 0.04 + 0.1 * copy.random() ** 3
        dark = copy.uniform(-0.55, 0.2)  # mostly dark, sometimes bright
        a, b = round((cy - r - reach) / pixel_mm + h / 2), round((cy + r + reach) / pixel_mm + h / 2)
        c, d = round((cx - r - reach) / pixel_mm + w / 2), round((cx + r + reach) / pixel_mm + w / 2)
        box = np.s_[max(a, 0) : max(b, 0), max(c, 0) : max(d, 0)]
        distance = ((x[:, box[1]] - cx) ** 2 + (y[box[0]] - cy) ** 2) / (r + 0.5 * pixel_mm) ** 2
        picture[box] *= 1 + np.float32(dark) * np.exp(-distance)[..., None]
    for _ in range(copy.poisson(sensor.scratches)):
        angle, bend = copy.uniform(0, np.pi), copy.normal(0, 0.02)
        cx, cy = copy.uniform(-0.4, 0.4, 2) * (w, h) * pixel_mm
        along = np.cos(angle) * (x - cx) + np.sin(angle) * (y - cy)
        across = np.cos(angle) * (y - cy) - np.sin(angle) * (x - cx)
        length, width = copy.uniform(0.6, 4.0), max(0.05, 0.5 * pixel_mm)
        exponent = ((across + bend * along**2) / width) ** 2
        where = (np.abs(along) < length) & (exponent < 746)  # exp(-746) is 0
        picture[where] += np.exp(-exponent[where])[:, None] * copy.normal(0, 10.0, 3).astype(np.float32)
    if sensor.edge:
        u, v = _axes_unit((h, w))
        du, dv, grow = copy.normal(0, 0.02), copy.normal(0, 0.02), copy.normal(0.0, 0.015)
        rim = (np.abs(u - du) ** 10 + np.abs(v - dv) ** 10) ** np.float32(0.1) * np.float32(0.955 - grow)
        picture *= 1 - sensor.edge * np.clip((rim - np.float32(0.955)) / 0.05, 0, 1)[..., None] * np.float32(0.6)
        glint = np.exp(-(((rim - 0.945) / 0.012) ** 2)) * np.clip(0.5 + 0.5 * v - 0.3 * u, 0, 1) * (14 * sensor.edge)
        picture += glint[..., None] * np.array([0.8, 1.1, 0.9], np.float32)


def _blur(surface: F, sigma_px: float) -> F:
    """Blur [H, W] by about `sigma_px` with two box filters, whose cost does not depend on the radius."""
    width = max(3, 2 * round(sigma_px * 1.22) + 1)
    return uniform_filter(uniform_filter(surface, width, mode="nearest"), width, mode="nearest")


def grid(size: int, width_mm: float) -> tuple[F, F, float]:
    """Return x, y [n, n] in mm and mm per pixel of the internal picture, which is twice as fine if `size` is small."""
    n = 2 * size if size <= 96 else max(192, size)
    pixel = width_mm / n
    x, y = np.meshgrid(*axes_mm((n, n), pixel))
    return x, y, pixel


@lru_cache(maxsize=16)
def axes_mm(shape: tuple[int, ...], pixel_mm: float) -> tuple[F, F]:
    """Return x [1, W] and y [H, 1] in mm from the centre of the picture."""
    h, w = shape
    x, y = ((np.arange(n, dtype=np.float32) - (n - 1) / 2) * np.float32(pixel_mm) for n in (w, h))
    return x[None], y[:, None]


@lru_cache(maxsize=16)
def _axes_unit(shape: tuple[int, ...]) -> tuple[F, F]:
    """Return u [1, W] and v [H, 1], both from -1 to 1."""
    h, w = shape
    u, v = ((np.arange(n, dtype=np.float32) + 0.5) * np.float32(2 / n) - 1 for n in (w, h))
    return u[None], v[:, None]


@lru_cache(maxsize=32)
def _area_weights(source: int, target: int) -> F:
    """Return weights [target, source]: row t averages the source pixels that target pixel t covers."""
    edges = np.linspace(0, source, target + 1)
    start, stop, pixel = edges[:-1, None], edges[1:, None], np.arange(source)[None]
    covered = np.clip(np.minimum(stop, pixel + 1) - np.maximum(start, pixel), 0, None)
    return (covered / covered.sum(1, keepdims=True)).astype(np.float32)
