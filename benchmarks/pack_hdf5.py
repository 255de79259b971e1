"""How close packing HDF5 shards comes to the bare loop that reads and resizes the same images and keeps nothing.

    python -m benchmarks.pack_hdf5 [--shards DIR] [--num 40] [--size 256] [--repeats 3] [--json FILE]

Without --shards a shard is made in the owners' layout and full resolution (GelSight 960 x 1280, Kinect 540 x 960,
gzip), of smooth pictures with noise. One process each, interleaved; what counts is the ratio of the medians.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

from mvitac.datasets.calandra import PHASES, CalandraConfig
from mvitac.pack import fit
from mvitac.packing import build
from mvitac.record import provenance, write_json

SHAPES = {"gelsightA": (960, 1280, 3), "gelsightB": (960, 1280, 3), "kinectA_rgb": (540, 960, 3)}


def write_shard(folder: Path, num: int, *, noise: int = 8) -> Path:
    """A shard of ``num`` grasps in the owners' layout and resolution; returns its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    with h5py.File(folder / "calandra_corl2017_000.h5", "w") as file:
        for index in range(num):
            group = file.create_group(f"data/i{index}")
            group.attrs["object_name"] = np.bytes_(("lemon", "potato", "soft_zebra")[index % 3])
            group.attrs["is_gripping"] = np.bool_(index % 2)
            for sensor, shape in SHAPES.items():
                for phase in PHASES:
                    y, x, c = np.ogrid[: shape[0], : shape[1], :3]
                    smooth = 128 + 60 * np.sin(x / (40 + index)) * np.cos(y / 60 + c)
                    image = (smooth + rng.integers(0, noise, shape)).astype(np.uint8)
                    group.create_dataset(f"{sensor}_{phase}", data=image, compression="gzip", compression_opts=1)
    return folder


def bare_loop(folder: Path, size: int) -> int:
    """Read and resize every image of every shard, one file handle per shard, nothing kept; returns how many images."""
    num = 0
    for path in sorted(folder.glob("calandra_corl2017_*.h5")):
        with h5py.File(path) as file:
            for group in file["data"].values():
                for sensor in SHAPES:
                    for phase in PHASES:
                        fit(group[f"{sensor}_{phase}"][()], size)
                        num += 1
    return num


def measure(folder: Path, size: int = 256, repeats: int = 3) -> dict[str, float]:
    """Images per second of the bare loop and of packing (one process, every digest), medians of interleaved repeats."""
    config = CalandraConfig(path=folder, size=size, workers=1, split="object")
    seconds: dict[str, list[float]] = {"bare": [], "pack": []}
    num = bare_loop(folder, size)  # also warms the page cache for both
    for _ in range(repeats):
        start = time.perf_counter()
        bare_loop(folder, size)
        seconds["bare"].append(time.perf_counter() - start)
        with tempfile.TemporaryDirectory() as out:
            start = time.perf_counter()
            build(config.source(), Path(out) / "pack", size=size, quiet=True)
            seconds["pack"].append(time.perf_counter() - start)
    bare, pack = (statistics.median(seconds[name]) for name in ("bare", "pack"))
    return {"images": num, "bare_per_second": num / bare, "pack_per_second": num / pack, "ratio": bare / pack}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shards", type=Path, help="a folder of real shards")
    parser.add_argument("--num", type=int, default=40, help="grasps of the shard that is made")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        shards = options.shards or write_shard(Path(folder) / "shards", options.num)
        result = measure(shards, options.size, options.repeats)
    print(", ".join(f"{name} {value:.2f}" for name, value in result.items()))
    if options.json:
        write_json(options.json, {**result, "size": options.size, "provenance": provenance()})


if __name__ == "__main__":
    main()
