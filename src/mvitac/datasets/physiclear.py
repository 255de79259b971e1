"""``--data physiclear``: videos of a GelSight Mini with ratings of how objects feel, by Yu et al. (RSS 2024).

Layout of ``git clone https://github.com/clear-nus/octopi``:

    dataset/<object>_<k>.mov            one touch per video; it begins without contact
    utils/constants.py                  MATERIALS, HARDNESS_RANK, ROUGHNESS_RANK, TEXTURE_RANK: physiclear_<object> -> label;
    (later src/utils/constants.py)      TRAIN_OBJECTS, VAL_OBJECTS, TEST_OBJECTS: the owners' split

The labels are read from the owners' Python file without running it.
"""

import ast
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from tyro.conf import Fixed

from mvitac.data.video import num_frames, spread
from mvitac.datasets.table.manifest import Manifest, in_clone
from mvitac.datasets.table.table import RowsConfig
from mvitac.system.files import brief

LABELS = {"material": "MATERIALS", "hardness": "HARDNESS_RANK"}
LABELS |= {"roughness": "ROUGHNESS_RANK", "bumpiness": "TEXTURE_RANK"}
SPAN = (0.3, 0.6)  # part of a video's length that frames are from: it begins and ends without contact
SPLIT = {"train": "TRAIN_OBJECTS", "val": "VAL_OBJECTS", "test": "TEST_OBJECTS"}


@dataclass(frozen=True, kw_only=True)
class PhysiclearConfig(RowsConfig):
    """Material, hardness, roughness and bumpiness from one GelSight Mini (github.com/clear-nus/octopi)."""

    name: ClassVar[str] = "physiclear"

    path: Path = Path("octopi")
    """Folder of the clone."""
    frames: Fixed[int] = 8
    """Number of frames per video."""
    title: str | None = "physiclear"
    labels: tuple[str, ...] = tuple(LABELS)
    group: str | None = "object"
    touch_group: str | None = "video"
    split: str | None = "by-group"
    """by-group: test on unseen objects; owners_split: the owners' split, with 7 objects in test."""
    licence: str = "none stated"
    source_url: str = "https://github.com/clear-nus/octopi"

    def manifest(self) -> Manifest:
        videos = in_clone(self.path, "dataset", "*.mov", self.source_url)
        root = videos.parent
        known = _constants(root)
        labels = {label: known[name] for label, name in LABELS.items()}
        split = {name: side for side, constant in SPLIT.items() for name in known[constant]}
        rows: list[dict[str, str]] = []
        for path in sorted(videos.glob("*.[mM][oO][vV]")):
            thing = path.stem.rpartition("_")[0]
            key = f"physiclear_{thing}"
            length = num_frames(path)
            place = path.relative_to(root).as_posix()
            same = {"touch": place, "background": place, "background_frame": "0", "video": path.stem, "object": thing}
            same |= {label: str(found.get(key, "")) for label, found in labels.items()}
            same |= {"owners_split": split.get(key, "unlabelled"), "n_frames": str(length)}
            for seq, at in enumerate(spread(self.frames, length, *SPAN)):
                rows.append({**same, "frame": str(at), "seq": str(seq)})
        return Manifest.of(root, rows)


def _constants(root: Path) -> dict[str, Any]:
    """Read the literal values of the constants that are used from the owners' constants.py."""
    file = next((f for f in (root / "utils/constants.py", root / "src/utils/constants.py") if f.is_file()), None)
    if file is None:
        raise ValueError(f"{root} has no utils/constants.py, where the labels are: clone it whole")
    found: dict[str, Any] = {}
    wanted = {*LABELS.values(), *SPLIT.values()}
    try:
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id in wanted:
                found[node.targets[0].id] = ast.literal_eval(node.value)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:  # two of deep expressions
        raise ValueError(f"{file} cannot be read as labels ({brief(error)})") from None
    for name in sorted(wanted - found.keys()):
        raise ValueError(f"{file} does not define {name}: check out the version the paper was published with")
    for name, value in found.items():
        kind = dict if name in LABELS.values() else list
        if not isinstance(value, kind) or not all(isinstance(each, str) for each in value):
            raise ValueError(f"{file}: {name} is no {kind.__name__} of names of objects")
    return found
