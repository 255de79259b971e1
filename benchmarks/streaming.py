"""Speed of reading shards compared with a pack, and bytes fetched per epoch as a share of the dataset.

Images are noise. Shards are read from file:// into a cache with room for two windows and one file, less than the
dataset. Epochs are read as in training, from shards and from the pack alternately. Files are in the page cache, so the
speed of the disk is not measured. With --step-ms, each batch is followed by a sleep that stands for the network's step,
and the time spent waiting for input is reported.

    python -m benchmarks.streaming [--num 2000] [--size 256] [--shard-mb 16] [--window 8] [--batch 128] [--step-ms 0]
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.sharding import write_shards
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec
from mvitac.data.streaming import StreamedPack
from mvitac.datasets.pack import StreamConfig
from mvitac.recipes import recipe
from mvitac.run import Run
from mvitac.system.files import write_json
from mvitac.system.provenance import provenance
from mvitac.training.sampler import batches


@dataclass
class Noise(Source):
    """Pairs of noise images, eight per touch."""

    num: int
    size: int

    def spec(self) -> DataSpec:
        words = {"name": "noise", "group_by": "touch", "licence": "none", "source": "benchmarks/streaming.py"}
        return DataSpec(vision_channels=3, touch_channels=3, tasks=(), **words)  # type: ignore[arg-type]

    def items(self) -> list[str]:
        return [str(row) for row in range(self.num)]

    def fingerprint(self) -> dict[str, Any]:
        return {"noise": [self.num, self.size]}

    def read(self, item: int) -> list[Sample]:
        pixels = np.random.default_rng(item).integers(0, 256, (2, self.size, self.size, 3), np.uint8)
        columns = {"id": str(item), "group": str(item // 8), "split": "train"}
        return [Sample(vision=pixels[0], touch=pixels[1], columns=columns)]


def epoch(run: Run, pack: Pack, number: int, step_s: float) -> float:
    """Read one epoch. Return the seconds spent waiting for its batches."""
    rows = run.method.training_rows(pack)
    per_epoch, waited = run.steps_per_epoch(len(rows)), 0.0
    order = batches(run, pack, rows, number * per_epoch, (number + 1) * per_epoch, expect=pack.expect)
    while True:
        began = time.perf_counter()
        if (batch := next(order, None)) is None:
            return waited
        for modality in pack.spec.modalities:
            pack.images[modality][batch]
        waited += time.perf_counter() - began
        time.sleep(step_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=2000, help="number of pairs")
    parser.add_argument("--size", type=int, default=256, help="image side in pixels")
    parser.add_argument("--shard-mb", type=float, default=16, help="size of a shard in MB")
    parser.add_argument("--window", type=int, default=8, help="shards that are mixed at a time")
    parser.add_argument("--batch", type=int, default=128, help="pairs per batch")
    parser.add_argument("--step-ms", type=float, default=0, help="sleep after each batch, in ms")
    parser.add_argument("--epochs", type=int, default=5, help="epochs; medians are reported")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        pack = build(Noise(options.num, options.size), Path(place) / "pack", size=options.size, workers=0, quiet=True)
        url = f"file://{place}/shards"
        num = write_shards(pack, url, shard_mb=options.shard_mb, quiet=True)
        limit = int((2 * options.window + 1) * 1e6 * options.shard_mb)
        shards = StreamedPack(url, Path(place) / "cache", limit=limit, window=options.window)
        run = replace(recipe("smoke", StreamConfig(window=options.window)), batch_size=options.batch)
        times: dict[str, list[float]] = {"pack": [], "shards": []}
        fetched = []
        for number in range(options.epochs):
            before = shards.fetched
            for name, one in (("pack", pack), ("shards", shards)):
                times[name].append(epoch(run, one, number, options.step_ms / 1e3))
            fetched.append(shards.fetched - before)
        whole = sum(images.nbytes for images in pack.images.values())
        pairs = run.steps_per_epoch(pack.num) * options.batch
        result: dict[str, Any] = {
            "set_mb": whole / 1e6,
            "cache_mb": limit / 1e6,
            "shards": num,
            "fetched_over_set": [round(f / whole, 3) for f in fetched],
            "waited_s": {name: statistics.median(seconds) for name, seconds in times.items()},
            "pairs_per_s_of_waiting": {n: pairs / statistics.median(seconds) for n, seconds in times.items()},
        }
        for name, value in result.items():
            print(name.replace("_", " "), value)
    if options.json:
        write_json(options.json, {"options": {**vars(options), "json": None}, **result, **provenance()})


if __name__ == "__main__":
    main()
