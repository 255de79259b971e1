"""What physics knows of a press, as numbers to predict: depth, position and size of the contact."""

import math

import numpy as np

from mvitac.sim.gel import GEL_STIFFNESS, F, pressure

KNOWN = ("depth_mm", "contact_x_mm", "contact_y_mm", "patch_mm2")


def contact(
    relief_mm: F, *, force_n: float, stiffness: float, pixel_mm: float, dome_radius_mm: float
) -> dict[str, float]:
    """Measure the contact that ``gel.press`` renders with these arguments, before the membrane smooths it.

    Returns "depth_mm", the deepest indentation of the gel; "contact_x_mm" and "contact_y_mm", the centre of pressure,
    right and down from the middle of the picture (NaN without contact); "patch_mm2", the area under pressure.
    """
    p = pressure(
        relief_mm, force_n=force_n, stiffness=stiffness, pixel_mm=pixel_mm, dome_radius_mm=dome_radius_mm
    ).astype(np.float64)
    if not (total := float(p.sum())):
        return dict(zip(KNOWN, (0.0, math.nan, math.nan, 0.0), strict=True))
    x, y = ((np.arange(n) - (n - 1) / 2) * pixel_mm for n in (p.shape[1], p.shape[0]))
    centre = float(p.sum(0) @ x) / total, float(p.sum(1) @ y) / total
    return dict(zip(KNOWN, (float(p.max()) / GEL_STIFFNESS, *centre, float((p > 0).sum()) * pixel_mm**2), strict=True))
