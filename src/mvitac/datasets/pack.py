"""``--data pack``: a folder that ``mvitac data`` wrote."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

from mvitac.data.pack import Pack
from mvitac.datasets.base import DatasetConfig

ON_VAL = "scores are on split val (--data.score-on val); split test is hidden"
"""The note beside all scores of such data."""


@dataclass(frozen=True, kw_only=True)
class PackConfig(DatasetConfig):
    """A folder written by ``mvitac data pack``."""

    name: ClassVar[str] = "pack"

    path: Path = Path("pack")
    """The pack's folder."""

    score_on: Literal["test", "val"] = "test"
    """val: use split val as the test split and hide test, to choose a recipe by `mvitac compare` without it."""

    @classmethod
    def reads(cls, path: Path) -> bool:
        return (path / "pack.json").is_file()

    def _frames(self, quiet: bool) -> Pack:
        pack = Pack(self.path)
        for name in (n for n, own in (("size", pack.size), ("store", "raw")) if getattr(self, n) != own):
            if getattr(self, name) != getattr(DatasetConfig, name):
                raise ValueError(f"--data.{name} is for what is packed now, a pack stays as it is: leave it out")
        if self.score_on == "val":
            if not len(pack.rows("val")):
                raise ValueError(f"{self.path} has no split val to score on: leave out --data.score-on")
            others = {"test": "hidden", "val": "test"}
            splits = {name: [others.get(str(s), str(s)) for s in pack.column(name)] for name in pack.spec.split_columns}
            pack = pack.with_splits(splits)
            pack.spec = replace(pack.spec, notes=(*pack.spec.notes, ON_VAL))
        return pack
