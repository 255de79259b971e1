"""``--data slip_gsmini``: slip with two GelSight Minis on a gripper, no camera, by Parag and Misimi.

Layout of ``git clone https://github.com/amitparag/Incipient-Slip-Detection`` (both fingers of one shake, 25 fps):

    docs/**/base_data_for_training/<object>/exp_num_<n>/camera_0.avi  camera_2.avi  slip.txt (empty: it slipped)
    docs/**/base_data_for_validation/...                                            (our reading of the layout)

More than half of the folders are copies of others, some with slip.txt and some without. Folders are identified by the
content of their videos. If copies disagree, the recording has no label and label_conflict = 1.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from mvitac.data.video import num_frames, spread
from mvitac.datasets.table.manifest import Manifest, in_clone
from mvitac.datasets.table.splits import add_folds
from mvitac.datasets.table.table import RowsConfig
from mvitac.system.files import digest_file

NUM_FRAMES = 12  # per recording, evenly spaced from the first to the last
FINGERS = {"left": "camera_0.avi", "right": "camera_2.avi"}
ALIASES = {"bag_of_peanuts": "bag_peanuts"}  # names of the same object, which must not be in different splits


@dataclass(frozen=True, kw_only=True)
class SlipGSMiniConfig(RowsConfig):
    """Slip from two stacked GelSight Minis (github.com/amitparag/Incipient-Slip-Detection)."""

    name: ClassVar[str] = "slip_gsmini"

    path: Path = Path("Incipient-Slip-Detection")
    """Folder of the clone."""
    title: str | None = "slip_gsmini"
    labels: tuple[str, ...] = ("slip",)
    group: str | None = "object"
    touch_group: str | None = "experiment"
    split: str | None = "fold1"
    """fold1, fold2 or fold3: each object is tested in one of them; or by-group."""
    controls: tuple[str, ...] = ("recording length=n_frames",)
    licence: str = "BSD-2-Clause (the repository's LICENSE)"
    source_url: str = "https://github.com/amitparag/Incipient-Slip-Detection"

    def manifest(self) -> Manifest:
        root = in_clone(self.path, "docs", "**/exp_num_*/camera_0.avi", self.source_url)
        copies: dict[tuple[str, ...], list[Path]] = {}
        lonely: list[str] = []
        for folder in sorted({file.parent for name in FINGERS.values() for file in root.glob(f"**/exp_num_*/{name}")}):
            if not all((folder / name).is_file() for name in FINGERS.values()):
                lonely.append(folder.relative_to(root).as_posix())
            else:
                copies.setdefault(tuple(digest_file(folder / name) for name in FINGERS.values()), []).append(folder)
        rows: list[dict[str, str]] = []
        for folders in copies.values():  # of one recording
            folder = folders[0]
            slips = {(copy / "slip.txt").exists() for copy in folders}
            name = min(ALIASES.get(copy.parent.name, copy.parent.name) for copy in folders)
            where = {"base_data_for_training": "train", "base_data_for_validation": "val"}
            sides = {where.get(part) for copy in folders for part in copy.parts} - {None}
            length = min(num_frames(folder / video) for video in FINGERS.values())
            place = folder.relative_to(root)
            known = {
                **{finger: (place / video).as_posix() for finger, video in FINGERS.items()},
                **{"experiment": place.as_posix(), "object": name},
                "slip": str(int(slips.pop())) if len(slips) == 1 else "",
                **{"n_frames": str(length), "copies": str(len(folders))},
                "author_split": "train" if "train" in sides else "val" if sides else "extra",
            }
            known["label_conflict"] = str(int(not known["slip"]))
            rows += [{**known, "frame": str(at), "seq": str(i)} for i, at in enumerate(spread(NUM_FRAMES, length))]
        if not rows:
            raise ValueError(f"{root} has no folder with both {' and '.join(FINGERS.values())}: clone it whole")
        often: dict[str, list[int]] = {}
        for row in rows:
            often.setdefault(row["object"], []).append(int(row["slip"] or 0))
        add_folds(rows, [f"{sum(often[row['object']]) / len(often[row['object']]):.2f}" for row in rows], 3)
        note = f"{len(lonely)} folders without both videos are left out, such as {lonely[0]}" if lonely else ""
        return Manifest.of(root, rows, notes=(note,) * bool(note))
