"""Several packs as one training set."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from mvitac.data.pack import Pack
from mvitac.data.several import MixedPack
from mvitac.data.spec import check_request
from mvitac.data.stamps import number_of
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.pack import PackConfig


@dataclass(frozen=True, kw_only=True)
class MixConfig(DatasetConfig):
    """Several packs as one training set: other datasets, sensors, image sizes, and parts without a camera or touch."""

    name: ClassVar[str] = "mix"

    parts: tuple[str, ...] = ()
    """The packs, each as NAME=FOLDER:WEIGHT, such as tag=packs/tag:2 mine=packs/mine:1. NAME is by default the folder's.
    WEIGHT is the part's share of the drawn rows relative to the others; by default a part's number of rows."""
    size: int = 0
    """Side of the images in pixels; those of another side are resized when they are read. 0: the largest of the parts."""
    score_on: Literal["test", "val"] = "test"
    """val: use split val as the test split and hide test, as for a pack."""
    allow_leak: bool = False
    """Accept groups, rows or images that one part has in train and another in test. Scores then say LEAK."""

    def __post_init__(self) -> None:
        self.frame_window()
        check_request(self.store, size=self.size or 256, workers=self.workers, quality=self.quality)
        names = [name for name, _, _ in self.named_parts()]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"part {name!r} is given twice: give each part its own name, NAME=FOLDER")
        weights = [weight for _, _, weight in self.named_parts()]
        if any(weights) and not all(weights):
            raise ValueError(f"parts {' '.join(self.parts)}: give every part a weight (NAME=FOLDER:WEIGHT), or none")

    def named_parts(self) -> list[tuple[str, Path, float | None]]:
        """Name, folder and weight of each part."""
        found = []
        for text in self.parts:
            name, folder, weight = re.fullmatch(r"(?:([\w.-]+)=)?(.*?)(?::([^:/]*))?", text).groups()  # type: ignore
            if not folder:
                raise ValueError(f"part {text!r} names no folder: give NAME=FOLDER or NAME=FOLDER:WEIGHT")
            number = None if weight is None else number_of(weight) or 0
            if number is not None and number <= 0:
                raise ValueError(f"part {text!r} has weight {weight!r}: give a positive number, or leave it out")
            found.append((name or Path(folder).resolve().name, Path(folder), number))
        return found

    def _frames(self, quiet: bool) -> Pack:
        if len(given := self.named_parts()) < 2:
            raise ValueError(f"a mix needs at least two parts, got {len(given)}: --data.parts a=packs/a b=packs/b")
        parts = {}
        for name, folder, _ in given:
            try:
                parts[name] = PackConfig(path=folder, score_on=self.score_on).open(quiet=quiet)
            except ValueError as error:
                raise ValueError(f"part {name}: {error}") from None
        pack = MixedPack(parts, size=self.size, allow_leak=self.allow_leak)
        pack.weights = tuple(weight for _, _, weight in given if weight is not None)
        return pack


def open_packs(folders: Sequence[str]) -> Pack:
    """The pack in one folder, or those in several (FOLDER or NAME=FOLDER) as one; what they share is a note."""
    if not folders:
        raise ValueError("missing PACK: Folder of the pack, or of several")
    return Pack(folders[0]) if len(folders) == 1 else MixConfig(parts=tuple(folders), allow_leak=True).open()
