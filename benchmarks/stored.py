"""Cost of storing images as JPEG instead of raw: bytes on disk, pixel error, and images/s of random batches.

The images come from a raw pack or from simulated materials. Both packs are in the page cache, reads are interleaved,
and medians over rounds are reported. OMP_NUM_THREADS sets the number of decoding threads; default: one per core, at
most 8.

    python -m benchmarks.stored [PACK] [--num N] [--quality 95] [--batch 128] [--rounds 5] [--json FILE]
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.system.files import write_json
from mvitac.system.provenance import provenance


class Rows(Source):
    """The first ``num`` rows of a pack."""

    def __init__(self, path: Path, num: int) -> None:
        self.pack = Pack(path, verify=False)
        self.num = min(num, self.pack.num)

    def spec(self) -> DataSpec:
        return self.pack.spec

    def items(self) -> list[str]:
        return [str(row) for row in range(self.num)]

    def fingerprint(self) -> dict[str, Any]:
        return {"pack": self.pack.digest, "num": self.num}

    def read(self, item: int) -> list[Sample]:
        columns = {name: self.pack.table.column(name)[item].as_py() for name in self.pack.table.column_names}
        images = {m: self.pack.images[m][item] if self.pack.has(m)[item] else None for m in self.pack.spec.modalities}
        return [Sample(columns=columns, vision=images.get("vision"), touch=images.get("touch"))]


def speed(pack: Pack, batch: int, seed: int) -> float:
    """Read one epoch in random batches, all modalities. Return images/s."""
    order = np.random.default_rng(seed).permutation(pack.num)
    began = time.perf_counter()
    for start in range(0, pack.num, batch):
        for modality in pack.spec.modalities:
            pack.images[modality][order[start : start + batch]]
    return pack.num * len(pack.spec.modalities) / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pack", nargs="?", type=Path, help="a raw pack (default: simulated materials at 256 px)")
    parser.add_argument("--num", type=int, default=400, help="number of rows")
    parser.add_argument("--quality", type=int, default=95, help="JPEG quality")
    parser.add_argument("--batch", type=int, default=128, help="rows per read")
    parser.add_argument("--rounds", type=int, default=5, help="epochs per pack")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        config = MaterialsConfig(num=options.num, size=256)
        source = Rows(options.pack, options.num) if options.pack else config.source()
        size = source.pack.size if isinstance(source, Rows) else config.size
        raw = build(source, Path(place) / "raw", size=size, quiet=True)
        kept = build(source, Path(place) / "jpeg", size=size, quiet=True, store="jpeg", quality=options.quality)
        rounds = [[speed(pack, options.batch, seed) for pack in (raw, kept)] for seed in range(options.rounds)]
        speeds = dict(zip(("raw", "jpeg"), map(statistics.median, zip(*rounds, strict=True)), strict=True))
        result: dict[str, Any] = {"num": raw.num, "size": raw.size, "images_per_s": speeds, "modalities": {}}
        for m in raw.spec.modalities:
            before, after = raw.images[m][:].astype(np.int16), kept.images[m][:]
            result["modalities"][m] = {
                "raw_over_jpeg_bytes": before.size / (kept.path / f"{m}.jpegs").stat().st_size,
                "mean_error_levels": float(np.abs(before - after).mean()),
            }
            print(m, *(f"{name.replace('_', ' ')} {value:.2f}" for name, value in result["modalities"][m].items()))
    print("images/s:", ", ".join(f"{name} {value:,.0f}" for name, value in speeds.items()))
    if options.json:
        write_json(options.json, {**result, "quality": options.quality, "rounds": rounds, **provenance()})


if __name__ == "__main__":
    main()
