"""``--data pack``: a pack that already lies on disk, whatever it was made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import pyarrow as pa

from mvitac.datasets.base import DatasetConfig
from mvitac.pack import Pack
from mvitac.source import Source


@dataclass(frozen=True, kw_only=True)
class PackConfig(DatasetConfig):
    """A folder written by ``mvitac data simulate`` or ``mvitac data pack``."""

    name: ClassVar[str] = "pack"

    path: Path = Path("pack")
    """The pack's folder."""

    score_on: Literal["test", "val"] = "test"
    """val: split val stands in for test, and test is out of sight: for choosing a recipe by `mvitac compare`, so that its
    test scores stay unseen until it is chosen."""

    def source(self) -> Source:
        raise ValueError(f"{self.path} is a pack already: use it with --data pack, there is nothing to pack")

    def open(self, *, quiet: bool = False) -> Pack:
        pack = Pack(self.path)
        if self.score_on == "val":
            if not len(pack.rows("val")):
                raise ValueError(f"{self.path} has no split val to score on: leave out --data.score-on")
            for column in {"split", *(task.split for task in pack.spec.tasks)}:
                pack.table = _shifted(pack.table, column)
        return pack


def _shifted(table: pa.Table, column: str) -> pa.Table:
    """``table`` with val called test in ``column``, and test called hidden."""
    new = [{"test": "hidden", "val": "test"}.get(split, split) for split in table.column(column).to_pylist()]
    return table.set_column(table.schema.get_field_index(column), column, pa.array(new))
