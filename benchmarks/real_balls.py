"""Draw Taxim's real frames above the same presses by the measured sensors, and say how far they are apart in levels.

python -m benchmarks.real_balls docs/balls.png
"""

import sys

import numpy as np
from PIL import Image

from mvitac.datasets.taxim import TaximConfig
from mvitac.sim import ball, measured
from mvitac.sim.gel import area_resize
from mvitac.sim.sensors import MEASURED

SIDE, SHOWN = 96, 7


def simulated(make: str, columns: dict[str, float]) -> np.ndarray:
    """The same press by the measured sensor as it is: no copies, gains or noise. Levels [SIDE, SIDE, 3]."""
    pixel = ball.FIELD_MM / (2 * SIDE)
    imprint = ball.imprint(2 * SIDE, columns["contact_x_mm"], columns["contact_y_mm"], columns["radius_mm"])
    gy, gx = np.gradient(imprint, np.float32(pixel))
    return area_resize(measured.read(make).light(gx, gy, pixel, np.zeros(2), 1.0), SIDE, SIDE)


def main() -> None:
    rows = []
    for make in MEASURED:
        source = TaximConfig(makes=(make,)).source()
        samples = [source.read(i)[0] for i in range(len(source.items()))]
        at_rest = simulated(make, {"contact_x_mm": 0.0, "contact_y_mm": 0.0, "radius_mm": 0.0})
        axis = (np.arange(SIDE) - (SIDE - 1) / 2) * ball.FIELD_MM / SIDE
        levels, pairs = [], []
        for sample in samples:
            known, real = sample.columns, area_resize(sample.touch.astype(np.float32), SIDE, SIDE)
            away = np.hypot(axis[None] - known["contact_x_mm"], axis[:, None] - known["contact_y_mm"])
            parts = away < known["radius_mm"], (away >= known["radius_mm"]) & (away < 2 * known["radius_mm"])
            pairs.append((real, simulated(make, known)))
            apart = [np.abs(real - other).mean(2) for other in (pairs[-1][1], at_rest)]
            levels.append([[a[part].mean() for part in (*parts, away >= 2 * known["radius_mm"])] for a in apart])
        for name, means in zip(("simulated press", "gel at rest"), np.mean(levels, axis=0), strict=True):
            inside, around, beyond = means
            print(f"{make}: real frames and {name}: inside {inside:.1f}, around {around:.1f}, elsewhere {beyond:.1f}")
        shown = np.linspace(0, len(pairs) - 1, SHOWN).round().astype(int)
        rows += [np.hstack([pairs[i][side] for i in shown]) for side in (0, 1)]
    picture = np.clip(np.vstack(rows) + 0.5, 0, 255).astype(np.uint8)
    Image.fromarray(picture).save(sys.argv[1], optimize=True)


if __name__ == "__main__":
    main()
