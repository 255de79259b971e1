"""``--data vt60``: ten categories of objects, photographed and touched by a TacTip, by Corradi et al.

Layout of ``git clone https://github.com/Exhor/deep_visuotactile_classification`` (images of 640 x 480):

    code/data/vt60/vision/<01_category>/<01>/IMG_inst_5_img_10_validframeID_62.jpg
    code/data/vt60/touch/<01_category>/<01>/touch_1_img_99_name_stapler_greyred_at_42094_5976_25275.jpg   (robot's x y z)

Photos and touches were not taken together. A pair is **weak**: the k-th touch of an object with its (k mod n)-th photo.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from mvitac.datasets.table.manifest import Manifest, in_clone
from mvitac.datasets.table.splits import add_folds
from mvitac.datasets.table.table import RowsConfig


@dataclass(frozen=True, kw_only=True)
class VT60Config(RowsConfig):
    """Category of 60 objects from weak pairs of photo and TacTip (github.com/Exhor/deep_visuotactile_classification)."""

    name: ClassVar[str] = "vt60"

    path: Path = Path("deep_visuotactile_classification")
    """Folder of the clone."""
    title: str | None = "vt60"
    labels: tuple[str, ...] = ("category",)
    group: str | None = "object"
    touch_group: str | None = "object"
    split: str | None = "fold1"
    """fold1, fold2 or fold3: unseen objects of known categories, each tested in one of them; or by-group."""
    licence: str = "none stated"
    source_url: str = "https://github.com/Exhor/deep_visuotactile_classification"

    def manifest(self) -> Manifest:
        root = in_clone(self.path, "code/data/vt60", "touch/*/*/*.jpg", self.source_url)
        rows: list[dict[str, str]] = []
        for folder in sorted(path for path in root.glob("touch/*/*") if path.is_dir()):
            thing = folder.relative_to(root / "touch").as_posix()
            photos = _by_number(root / "vision" / thing)
            touches = _by_number(folder)
            if touches and not photos:
                raise ValueError(f"{root / 'vision' / thing} holds no photos to pair with the touches: clone it whole")
            for k, touch in enumerate(touches):
                pair = {"vision": photos[k % len(photos)], "touch": touch}
                images = {name: path.relative_to(root).as_posix() for name, path in pair.items()}
                at = re.search(r"_at_(-?\d+)_(-?\d+)_(-?\d+)$", touch.stem)
                pose = dict(zip("xyz", at.groups() if at else ("", "", ""), strict=True))
                rows.append({**images, "category": thing.split("/")[0], "object": thing, "seq": str(k), **pose})
        add_folds(rows, [row["category"] for row in rows], 3)
        bare = {"/".join(path.parts[-2:]) for path in root.glob("vision/*/*/")} - {row["object"] for row in rows}
        note = f"objects without touches are left out: {', '.join(sorted(bare))}"
        return Manifest.of(root, rows, notes=(note,) * bool(bare))


def _by_number(folder: Path) -> list[Path]:
    numbers = {path: re.search(r"img_(\d+)", path.name) for path in folder.glob("*.[jJ][pP][gG]")}
    return sorted(numbers, key=lambda path: (int(found[1]) if (found := numbers[path]) else -1, path.name))
