"""``--data slip_grasp``: grasps that hold or slip, with one GelSight and a camera, by Li et al. (ICRA 2018).

Layout of ``git clone https://github.com/wkoa/slip_detection``:

    data/object004_result.dat           a grasp per line: width in mm, outcome in words, 1 held or 0 slipped, first, last
                                        and key frame of its recording, name of its folder, infix of its files
    data/object004/040_40_mm/external_imgw040_40_s010_00003368.jpg         the camera at frame 3368, 640 x 480
                             gelsight_imgw040_40_s010_00003368.jpg         the GelSight at the same frame
                             gelsight_lab_imgw...                          a colour conversion; not used
"""

import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from mvitac.data.stamps import number_of
from mvitac.datasets.table.manifest import Manifest, in_clone
from mvitac.datasets.table.splits import add_folds
from mvitac.datasets.table.table import RowsConfig


@dataclass(frozen=True, kw_only=True)
class SlipGraspConfig(RowsConfig):
    """Grasp success from one GelSight and a camera (github.com/wkoa/slip_detection), predicted from seq <= 4."""

    name: ClassVar[str] = "slip_grasp"

    path: Path = Path("slip_detection")
    """Folder of the clone."""
    title: str | None = "slip_grasp"
    labels: tuple[str, ...] = ("success",)
    group: str | None = "object"
    touch_group: str | None = "grasp"
    split: str | None = "fold1"
    """fold1, fold2, ...: leave one object out; or by-group."""
    label_only: tuple[str, ...] = ("seq<=4",)
    """Late frames of a failed grasp show the object sliding; by default only the five before the key frame are labelled."""
    controls: tuple[str, ...] = ("width=width_mm", "width in sweep=width_in_sweep")
    licence: str = "MIT (the repository's LICENSE)"
    source_url: str = "https://github.com/wkoa/slip_detection"

    def manifest(self) -> Manifest:
        root = in_clone(self.path, "data", "object*_result.dat", self.source_url)
        rows = [row for file in sorted(root.glob("object*_result.dat")) for row in _grasps(root, file)]
        objects = [row["object"] for row in rows]
        add_folds(rows, objects, len(set(objects)), val_every=1)
        bare = [each.name for each in sorted(root.glob("object*")) if not each.suffix and each.name[6:] not in objects]
        notes = (f"{name} is left out: {name}_result.dat says nothing of it" for name in bare)
        return Manifest.of(root, rows, notes=tuple(notes))


def _grasps(root: Path, file: Path) -> list[dict[str, str]]:
    name = file.name[len("object") : -len("_result.dat")]
    rows: list[dict[str, str]] = []
    widths: dict[str, float] = {}
    for number, line in enumerate(file.read_text(encoding="utf-8-sig", errors="replace").splitlines(), 1):
        if not (words := line.split()):
            continue
        good = len(words) == 8 and number_of(words[0]) is not None and words[5].isdecimal()
        if not good or words[2] not in ("0", "1") or "/" in words[6]:  # the folder, which is one of the object's
            raise ValueError(f"{file} line {number}: {line!r} is not a grasp of eight words")
        width, _, success, _, _, key, folder, _ = words
        pairs: dict[int, dict[str, str]] = defaultdict(dict)
        for path in sorted((root / f"object{name}" / f"{folder}_mm").glob("*.jpg")):
            if found := re.fullmatch(r"(external|gelsight)_img.*_(\d+)\.jpg", path.name):
                modality = {"external": "vision", "gelsight": "touch"}[found[1]]
                pairs[int(found[2])][modality] = path.relative_to(root).as_posix()
        if not pairs:
            raise ValueError(f"{file} line {number}: no images in object{name}/{folder}_mm: clone it whole")
        if not int(key) - 5 <= min(pairs) <= max(pairs) <= int(key) + 15:  # else late frames would count as early ones
            shown = f"frames {min(pairs)} to {max(pairs)} of {folder}_mm"
            raise ValueError(f"{file} line {number}: {shown} are not 5 before key frame {key} to 15 after it")
        grasp = f"{name}_{folder}"
        widths[grasp] = float(width)
        for frame, images in sorted(pairs.items()):
            known = {"object": name, "grasp": grasp, "width_mm": width, "success": success}
            away = frame - int(key)  # recordings begin five frames before the key frame, even if some are lost
            counted = {"frame_rel_key": str(away), "seq": str(away + 5), "frame": str(frame)}
            rows.append({"vision": "", "touch": "", **images, **known, **counted})
    for row in rows:  # the width was swept to change the outcome, so its position in the sweep is a control
        row["width_in_sweep"] = f"{widths[row['grasp']] - sum(widths.values()) / len(widths):.3f}"
    return rows
