"""Write the manifests for docs/results/real.md from a folder of real datasets. That page lists the datasets.

    python examples/real_manifests.py ../shared/data runs/real/manifests

A written manifest has the columns of the dataset's own manifest, plus cross-validation columns ``fold1`` ... (by whole
objects; each object is in test once), the values for the control probes, and for vt60 the weak pairs. Labels are used
only to spread the classes over the folds. Images are not copied; the manifests point to them.
"""

import csv
import os
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from PIL import Image

from mvitac.data.video import frames

Rows = list[dict[str, str]]


def read(file: Path) -> Rows:
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def write(rows: Rows, file: Path, folder: Path, images: tuple[str, ...]) -> None:
    """Write ``rows``. Paths in the columns ``images`` are relative to ``folder`` and become relative to ``file``."""
    file.parent.mkdir(parents=True, exist_ok=True)
    back = os.path.relpath(folder.resolve(), file.parent.resolve())
    for row in rows:
        row.update({column: f"{back}/{row[column]}" for column in images})
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print(f"{file}: {len(rows)} rows")


def add_folds(rows: Rows, num: int, *, by: str, stratum: str, val_every: int = 2) -> None:
    """Add columns fold1..fold<num>. Each object is in test once. Every ``val_every``-th of the next fold is in val.

    Objects are assigned to folds round-robin, sorted by stratum, so that every stratum is spread over the folds.
    """
    names: dict[str, str] = {}
    for row in rows:
        names.setdefault(row[by], row[stratum])
    shuffled = np.random.default_rng(0).permutation(sorted(names)).tolist()
    order = {
        name: i for i, name in enumerate(sorted(shuffled, key=lambda name: names[name]))
    }  # stable: keeps the shuffle
    for fold in range(num):
        for row in rows:
            rank, home = divmod(order[row[by]], num)
            away = (home - fold) % num
            row[f"fold{fold + 1}"] = "test" if away == 0 else "val" if away == 1 and rank % val_every == 0 else "train"


def slip_grasp(folder: Path, out: Path) -> None:
    """Leave one object out. Add gripper widths relative to the mean width of the object."""
    rows = read(folder / "manifest.csv")
    widths: dict[str, dict[str, float]] = defaultdict(dict)
    for row in rows:
        widths[row["object"]][row["grasp"]] = float(row["width_mm"])
    for row in rows:
        mean = np.mean(list(widths[row["object"]].values()))
        row["width_in_sweep"] = f"{float(row['width_mm']) - mean:.3f}"
    add_folds(rows, 6, by="object", stratum="object", val_every=1)
    write(rows, out / "slip_grasp.csv", folder, ("vision", "touch"))


def slip_gsmini(folder: Path, out: Path) -> None:
    """Three folds of objects. Add the motion of each gel: mean absolute difference to the first frame."""
    rows = [row for row in read(folder / "manifest.csv") if row["label_conflict"] == "0"]
    slips: dict[str, list[float]] = defaultdict(list)
    first: dict[tuple[str, str], np.ndarray] = {}
    for row in rows:
        slips[row["object"]].append(float(row["slip"]))
        for gel in ("left", "right"):
            with Image.open(folder / row[gel]) as image:
                pixels = np.asarray(image.convert("L").resize((75, 56)), np.float32)
            start = first.setdefault((row["experiment"], gel), pixels)
            row[f"motion_{gel}"] = f"{np.abs(pixels - start).mean():.3f}"
    for row in rows:
        row["often"] = f"{np.mean(slips[row['object']]):.2f}"  # only to spread objects that slip over the folds
    add_folds(rows, 3, by="object", stratum="often")
    for row in rows:
        del row["often"]  # derived from the label
    write(rows, out / "slip_gsmini.csv", folder, ("left", "right"))


def physiclear(folder: Path, out: Path) -> None:
    """Keep the split of the dataset's owners. Their objects without labels become "unlabelled"."""
    rows = read(folder / "manifest.csv")
    for row in rows:
        row["owners_split"] = row.pop("split") or "unlabelled"
    write(rows, out / "physiclear.csv", folder, ("touch",))


def vt60(folder: Path, out: Path) -> None:
    """Pair touch k of an object with its photo (k mod 24). Each fold has two objects of each category."""
    photos: dict[str, list[str]] = defaultdict(list)
    everything = read(folder / "manifest.csv")
    for row in everything:
        if row["modality"] == "vision":
            photos[row["object"]].append(row["image"])
    rows, seen = [], defaultdict(int)
    for row in everything:
        if row["modality"] == "touch":
            names = photos[row["object"]]
            pair = {"vision": names[seen[row["object"]] % len(names)], "touch": row["image"]}
            seen[row["object"]] += 1
            rows.append({**pair, **{k: row[k] for k in ("category", "object", "x", "y", "z")}})
    add_folds(rows, 3, by="object", stratum="category")
    write(rows, out / "vt60.csv", folder, ("vision", "touch"))


def wedge_force(folder: Path, out: Path) -> None:
    """Leave one object out. Mark every third frame (``frame_kept``): neighbours of a video are nearly the same."""
    rows = read(folder / "manifest.csv")
    for row in rows:
        row["frame_kept"] = str(int(int(row["frame"]) % 3 == 0))
    add_folds(rows, len({row["object"] for row in rows}), by="object", stratum="object", val_every=1)
    write(rows, out / "wedge_force.csv", folder, ("touch",))


def wedge_force_pairs(folder: Path, out: Path) -> None:
    """Every third frame, four folds of two objects. Add control ``moved`` (mean absolute difference to the first frame) and
    label ``contact`` (.5 N or more)."""
    rows = [row for row in read(folder / "manifest.csv") if int(row["frame"]) % 3 == 0]
    videos: dict[str, dict[int, np.ndarray]] = {}
    for row in rows:
        if row["touch"] not in videos:
            wanted = [int(r["frame"]) for r in rows if r["touch"] == row["touch"]]
            videos[row["touch"]] = {
                i: image.astype(np.float32) for i, image in frames(folder / row["touch"], wanted, 72)
            }
        seen = videos[row["touch"]]
        row["moved"] = f"{np.abs(seen[int(row['frame'])] - seen[0]).mean():.3f}"
        row["contact"] = "yes" if float(row["force_n"]) >= 0.5 else "no"
    add_folds(rows, 4, by="object", stratum="object")
    write(rows, out / "wedge_force_pairs.csv", folder, ("touch",))


def tactip_shear(folder: Path, out: Path) -> None:
    """Every tap is independent. Blocks of ten keep records of scores per group small."""
    rows = read(folder / "manifest.csv")
    for i, row in enumerate(rows):
        row["block"] = f"{row['sensor']}-{row['split']}-{i // 10:04d}"
    write(rows, out / "tactip_shear.csv", folder, ("touch",))


def tactip_pairs(folder: Path, out: Path) -> None:
    """Pose by the pins alone, of taps on a surface and on an edge, whose angle is asked for as sine and cosine.

    ``sim``, the depth image of the same pose, is left out: it is nearly the answer. Every tap is independent.
    """
    rows = [{name: value for name, value in row.items() if name != "vision"} for row in _taps(folder, "tap")]
    write(rows, out / "tactip_pairs.csv", folder, ("touch",))


def tactip_depth(folder: Path, out: Path) -> None:
    """The same taps, and those with shear without values, with ``sim`` as vision: to pre-train on, not to probe vision."""
    sheared = [
        row | dict.fromkeys([name for name in row if name[:4] in ("surf", "edge")], "")
        for row in _taps(folder, "shear")
    ]
    write(_taps(folder, "tap") + sheared, out / "tactip_depth.csv", folder, ("touch", "vision"))


def _taps(folder: Path, motion: str) -> list[dict[str, str]]:
    rows = []
    for i, row in enumerate(row for row in read(folder / "manifest.csv") if row["motion"] == motion):
        angle, on_edge = np.deg2rad(float(row["Rz_deg"])), row["surface"] == "edge_2d"
        surface = {f"surface_{name}": row[name] for name in ("z_mm", "Rx_deg", "Ry_deg")}
        edge = {f"edge_{name}": row[name] for name in ("y_mm", "z_mm")}
        edge |= {"edge_sine": f"{np.sin(angle):.6f}", "edge_cosine": f"{np.cos(angle):.6f}"}
        about = {"touch": row["real"], "split": row["split"], "block": f"{row['surface']}-{row['split']}-{i // 10:04d}"}
        about["block"] += "-shear" * (motion == "shear")
        asked = surface | edge | dict.fromkeys(surface if on_edge else edge, "")
        rows.append(about | asked | {"vision": row["sim"]})
    return rows


def tactip_rigs(folder: Path, out: Path) -> None:
    """One set for both questions: columns ``same_`` and ``other_`` hold the values of the taps that each of them uses.

    A fifth of franka's training taps is val. franka's test taps have values of the same rig only, cr's of the other only.
    """
    rows = read(folder / "manifest.csv")
    for i, row in enumerate(rows):
        row["block"] = f"{row['sensor']}-{row['split']}-{i // 10:04d}"
        row["split"] = "val" if row["split"] == "train" and i // 10 % 5 == 4 else row["split"]
        for target in [name for name in row if name.startswith(("pose_", "shear_"))]:
            value = row.pop(target)
            row[f"same_{target}"] = value if row["sensor"] == "franka" else ""
            row[f"other_{target}"] = value if row["sensor"] == "cr" or row["split"] != "test" else ""
    write(rows, out / "tactip_rigs.csv", folder, ("touch",))


MANIFESTS = {
    make: make.__name__ for make in (slip_grasp, slip_gsmini, physiclear, vt60, wedge_force, tactip_shear, tactip_pairs)
}
MANIFESTS |= {wedge_force_pairs: "wedge_force", tactip_rigs: "tactip_shear", tactip_depth: "tactip_pairs"}
"""What makes a manifest -> the dataset's folder."""

if __name__ == "__main__":
    if len(sys.argv) != 3 or not Path(sys.argv[1]).is_dir():
        sys.exit(f"usage: python {sys.argv[0]} DATA_FOLDER OUT_FOLDER; DATA_FOLDER must exist")
    for make, name in MANIFESTS.items():
        source = Path(sys.argv[1]) / name
        if (source / "manifest.csv").is_file():
            make(source, Path(sys.argv[2]))
        else:
            print(f"{source}: no manifest.csv, skipped")
