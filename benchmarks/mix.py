"""Speed and memory of a mix of two packs compared with one pack of as many rows. Images are noise.

Training steps are taken alternately, a few from the pack, then from each mix. Times are CPU seconds of the process, so that
other work on the machine counts little. ``reading`` is the time to read the images of a batch alone, by the wall clock.
Memory is the peak of Python's and numpy's allocations (tracemalloc) while the data is opened and 20 batches are read, and
what Arrow holds afterwards.

    python -m benchmarks.mix [--num 2000] [--size 72] [--batch 64] [--steps 4] [--rounds 9] [--json FILE]
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.mix import MixConfig
from mvitac.datasets.pack import PackConfig
from mvitac.recipes import recipe
from mvitac.run import Run
from mvitac.system.distributed import World
from mvitac.system.files import write_json
from mvitac.system.provenance import provenance
from mvitac.training.sampler import batches
from mvitac.training.step import Step
from mvitac.training.views import load_chunks

MIXES: dict[str, dict[str, Any]] = {"mix": {}, "mix, one part per batch": {"batches": "one-part"}}


@dataclass
class Noise(Source):
    """Pairs of noise images, eight per touch."""

    num: int
    size: int

    def spec(self) -> DataSpec:
        words = {"name": "noise", "group_by": "touch", "licence": "none", "source": "benchmarks/mix.py"}
        return DataSpec(vision_channels=3, touch_channels=3, tasks=(), **words)  # type: ignore[arg-type]

    def items(self) -> list[str]:
        return [str(row) for row in range(self.num)]

    def fingerprint(self) -> dict[str, Any]:
        return {"noise": [self.num, self.size]}

    def read(self, item: int) -> list[Sample]:
        pixels = np.random.default_rng(item).integers(0, 256, (2, self.size, self.size, 3), np.uint8)
        columns = {"id": str(item), "group": str(item // 8), "split": "train"}
        return [Sample(vision=pixels[0], touch=pixels[1], columns=columns)]


def epoch(run: Run, pack: Pack, number: int) -> float:
    """Return the seconds of reading the batches of one epoch."""
    rows = run.method.training_rows(pack)
    per_epoch, began = run.steps_per_epoch(len(rows)), time.perf_counter()
    for batch in batches(run, pack, rows, number * per_epoch, (number + 1) * per_epoch):
        for modality in pack.spec.modalities:
            pack.images[modality][batch]
    return time.perf_counter() - began


def steps_of(run: Run) -> Callable[[int], float]:
    """A function that takes some training steps and returns their CPU seconds per step."""
    pack, cpu = run.data.open(), torch.device("cpu")
    rows = run.method.training_rows(pack)
    torch.manual_seed(0)
    method = run.method.build(pack.spec, run.encoder)
    method.prepare(torch.from_numpy(rows))
    step = Step(run, method, cpu)
    views: Iterator[Any] = enumerate(load_chunks(run, pack, rows, method.views, cpu, World(), 0, 1 << 20))

    def take(num: int) -> float:
        began = time.process_time()
        for _ in range(num):
            at, chunks = next(views)
            step(chunks, lr=1e-3, seed=at, progress=0.5)
        return (time.process_time() - began) / num

    return take


def memory(data: DatasetConfig, run: Run) -> dict[str, float]:
    """Peak MB while the data is opened and 20 batches are read, and MB that Arrow then holds."""
    before = pa.total_allocated_bytes()
    tracemalloc.start()
    pack = data.open()
    for rows in batches(run, pack, run.method.training_rows(pack), 0, 20):
        for modality in pack.spec.modalities:
            pack.images[modality][rows]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"peak_mb": peak / 1e6, "arrow_mb": (pa.total_allocated_bytes() - before) / 1e6}


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--num", type=int, default=2000, help="number of pairs in all")
    parser.add_argument("--size", type=int, default=72, help="image side in pixels")
    parser.add_argument("--batch", type=int, default=64, help="pairs per step")
    parser.add_argument("--trunk", default="resnet18", help="encoder of both modalities")
    parser.add_argument("--steps", type=int, default=4, help="training steps in a row")
    parser.add_argument("--rounds", type=int, default=9, help="alternations; medians are reported")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        sizes = {"whole": options.num, "a": options.num // 2 + 8, "b": options.num // 2 - 8}
        packs: dict[str, Pack] = {
            name: build(Noise(num, options.size), Path(place) / name, size=options.size, workers=1, quiet=True)
            for name, num in sizes.items()
        }
        parts = tuple(f"{name}={packs[name].path}" for name in ("a", "b"))
        data: dict[str, DatasetConfig] = {"pack": PackConfig(path=packs["whole"].path)}
        data |= {name: MixConfig(parts=parts, **given) for name, given in MIXES.items()}
        side = replace(recipe("demo").augment, size=options.size - options.size % 8, whole=None)
        base = replace(recipe("demo", data["pack"]), batch_size=options.batch, augment=side, precision="fp32")
        encoder = replace(base.encoder, trunk=options.trunk)
        runs = {name: replace(base, data=one, encoder=encoder) for name, one in data.items()}
        take = {name: steps_of(run) for name, run in runs.items()}
        times: dict[str, list[float]] = {name: [] for name in runs}
        for number in range(options.rounds + 1):
            for name, function in take.items():
                seconds = function(options.steps)
                times[name] += [seconds] if number else []  # the first round warms up
        opened = {name: run.data.open() for name, run in runs.items()}
        reading: dict[str, list[float]] = {name: [] for name in runs}
        for number in range(options.rounds):
            for name, pack in opened.items():
                reading[name].append(epoch(runs[name], pack, number))
        pairs = base.steps_per_epoch(options.num) * options.batch
        medians = {name: statistics.median(found) for name, found in times.items()}
        ratios = {n: statistics.median([p / t for p, t in zip(times["pack"], times[n], strict=True)]) for n in times}
        result: dict[str, Any] = {
            "cpu_seconds_per_step": medians,
            "speed_over_pack": {name: medians["pack"] / median for name, median in medians.items()},
            "paired_speed_over_pack": ratios,
            "pairs_per_s_of_reading": {name: pairs / statistics.median(found) for name, found in reading.items()},
            "memory": {name: memory(run.data, run) for name, run in runs.items()},
        }
    for name, value in result.items():
        print(name.replace("_", " "), value)
    if options.json:
        write_json(options.json, {"options": {**vars(options), "json": None}, **result, **provenance()})


if __name__ == "__main__":
    main()
