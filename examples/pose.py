"""Pose and shear from a TacTip without training, and whether two rigs see the same (docs/results/pose.md).

    python examples/pose.py DATA/tactip_shear/manifest.csv

The data is that of github.com/dexterousrobot/tactile_data_shear as a manifest: one row per tap with columns touch, sensor
(franka or cr), split and the six targets. Ridge regression on blurred pictures is fitted on franka's training taps. It is
scored on franka's test taps, and on cr's taps in all eight orientations of their pictures. In brackets: how alike the mean
pictures of both rigs are.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter
from sklearn.decomposition import PCA
from sklearn.linear_model import RidgeCV
from sklearn.metrics import r2_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

TARGETS = ("pose_z_mm", "pose_Rx_deg", "pose_Ry_deg", "shear_x_mm", "shear_y_mm", "shear_Rz_deg")


def picture(file: Path) -> np.ndarray:
    """A blurred picture [32, 32], so that a moved pin is a small change."""
    with Image.open(file) as opened:
        small = np.asarray(opened.convert("L").resize((64, 64)), np.float32) / 255
    return gaussian_filter(small, 1.0)[::2, ::2]


def layout(files: list[Path]) -> np.ndarray:
    """The mean of 300 whole pictures [128, 128]: where the pins are. It needs no label."""
    images = [np.asarray(Image.open(file).convert("L").resize((128, 128)), np.float32) for file in files[:300]]
    return np.mean(images, axis=0)


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    """The highest correlation of two blurred pictures over shifts of up to 6 pixels."""
    a, b = gaussian_filter(a, 1.0), gaussian_filter(b, 1.0)
    shifts = [np.roll(b, (x, y), axis=(0, 1)) for x in range(-6, 7, 2) for y in range(-6, 7, 2)]
    return max(np.corrcoef(a.ravel(), shifted.ravel())[0, 1] for shifted in shifts)


def shown(values: np.ndarray) -> str:
    return " ".join(f"{value:6.2f}" for value in values)


def main(manifest: Path) -> None:
    rows = list(csv.DictReader(manifest.open()))
    images = np.stack([picture(manifest.parent / row["touch"]) for row in rows])
    y = np.array([[float(row[target]) for target in TARGETS] for row in rows])
    here = {name: np.array([row["sensor"] == name for row in rows]) for name in ("franka", "cr")}
    test = np.array([row["split"] == "test" for row in rows])
    learn, same, cr = here["franka"] & ~test, here["franka"] & test, images[here["cr"]]
    mean, strengths = images[learn].mean(0), np.logspace(-1, 5, 7)
    flat = (images - mean).reshape(len(images), -1)
    print("R2 of", ", ".join(TARGETS))
    linear = make_pipeline(PCA(200, random_state=0), StandardScaler(), RidgeCV(strengths)).fit(flat[learn], y[learn])
    squares = make_pipeline(PCA(40, random_state=0), PolynomialFeatures(2), StandardScaler(), RidgeCV(strengths))
    for name, model in (("linear", linear), ("with products", squares.fit(flat[learn], y[learn]))):
        print(f"same rig, {name:21}", shown(r2_score(y[same], model.predict(flat[same]), multioutput="raw_values")))
    files = {name: [manifest.parent / row["touch"] for row in rows if row["sensor"] == name] for name in here}
    pins = {name: layout(files[name]) for name in files}
    truth = y[here["cr"]]
    for mirrored in (False, True):
        for turns in range(4):
            seen = np.rot90(cr[:, :, ::-1] if mirrored else cr, turns, axes=(1, 2))
            guess = linear.predict((seen - seen.mean(0)).reshape(len(seen), -1))  # its own mean: unlabelled pictures
            alike = likeness(pins["franka"], np.rot90(pins["cr"][:, ::-1] if mirrored else pins["cr"], turns))
            name = f"{'mirrored, ' if mirrored else ''}turned by {90 * turns} ({alike:.2f})"
            print(f"cr {name:27}", shown(r2_score(truth, guess, multioutput="raw_values")))
            agree = [np.corrcoef(truth[:, t], guess[:, t])[0, 1] for t in range(len(TARGETS))]
            print(f"{'':30}", shown(np.array(agree)), "(correlation)")


if __name__ == "__main__":
    main(Path(sys.argv[1])) if len(sys.argv) > 1 else sys.exit(__doc__)
