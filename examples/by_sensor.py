"""Write the rows of a pack into one pack for each group of sensors (for docs/results/transfer.md).

python examples/by_sensor.py packs/materials packs mini+mini_dots classic+digit
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec


@dataclass
class Rows(Source):
    """Some rows of a pack."""

    pack: Pack
    rows: np.ndarray

    def spec(self) -> DataSpec:
        return self.pack.spec

    def items(self) -> list[str]:
        return self.pack.column("id")[self.rows].tolist()

    def fingerprint(self) -> dict[str, Any]:
        return {"pack": self.pack.digest, "rows": self.rows.tolist()}

    def read(self, item: int) -> list[Sample]:
        row = int(self.rows[item])
        cells = self.pack.table.slice(row, 1).to_pylist()[0]
        columns = {name: cell for name, cell in cells.items() if not name.startswith(("crc_", "bytes_"))}
        images = {m: np.array(images[row]) for m, images in self.pack.images.items()}
        return [Sample(vision=images.get("vision"), touch=images.get("touch"), columns=columns)]


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(f"usage: python {sys.argv[0]} PACK OUT_FOLDER SENSOR+SENSOR ...")
    whole = Pack(sys.argv[1])
    for group in sys.argv[3:]:
        rows = np.flatnonzero(np.isin(whole.column("sensor").astype(str), group.split("+")))
        made = build(Rows(whole, rows), Path(sys.argv[2]) / group, size=whole.size, workers=1)
        print(f"{made.path}: {made.num} rows")
