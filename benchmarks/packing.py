"""Time of packing, compared with a bare loop that reads and resizes the same images and keeps nothing.

The sources are generated in the layouts of the original datasets: Touch and Go as extracted frames (``jpeg``) and as
videos (``mp4``; 640 x 480, a key frame every 12 frames, touches of 30 frames), Calandra as shards in full resolution
(``hdf5``; GelSight 960 x 1280, Kinect 540 x 960, gzip). Measured for each source:

- ``bare``: a loop that decodes and resizes every image, in as many processes as packing
- ``pack``: ``mvitac.data.build.build``, up to the finished pack on disk; ratio = bare time / pack time
- ``bare, every frame`` (mp4): decode from the first to the last listed frame, while ``bare`` seeks each touch
- ``owners`` (mp4; needs OpenCV): seek both videos to each listed frame, write both as JPEG, read them back, resize

Methods are interleaved, and medians over rounds are reported. To add a source, add a ``Case`` to ``CASES``.

    python -m benchmarks.packing [jpeg] [mp4] [hdf5] [--quick] [--rounds N] [--workers N] [--json FILE]
"""

from __future__ import annotations

import argparse
import importlib.util
import multiprocessing
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
from av.video.reformatter import Interpolation, VideoReformatter
from PIL import Image

from mvitac.data.build import build
from mvitac.data.images import fit
from mvitac.data.source import Source
from mvitac.datasets.calandra import PHASES, CalandraConfig
from mvitac.datasets.touch_and_go.reader import TouchAndGoConfig
from mvitac.system.files import write_json
from mvitac.system.provenance import provenance

TOUCH, NUM_PICTURES = 30, 48
STEMS = ("video", "gelsight")
SHAPES = {"gelsightA": (960, 1280, 3), "gelsightB": (960, 1280, 3), "kinectA_rgb": (540, 960, 3)}

Jobs = list[tuple[Path, list[int]]]
"""Pairs of a file or folder and the numbers of the frames or grasps to read from it."""
Way = Callable[[Path, list[int], int], int]
"""Read the images of one job, resize them to a side in pixels, and return their number."""


# -- Touch and Go ------------------------------------------------------------------------------------------------------


def paint(recording: int, stem: str, number: int) -> np.ndarray:
    """Generate a textured image that moves slightly from frame to frame, like that of a hand-held camera."""
    rng = np.random.default_rng([recording, STEMS.index(stem)])
    coarse = Image.fromarray(rng.integers(0, 255, (30, 40, 3), np.uint8))
    fine = np.asarray(coarse.resize((704, 528), Image.Resampling.BICUBIC))
    x, y = (number * 3) % 64, number % 48
    return np.ascontiguousarray(fine[y : y + 480, x : x + 640])


def write_lists(root: Path, options: argparse.Namespace) -> None:
    """Write train.txt and test.txt: one touch in every ``options.period`` frames. Most frames have no touch."""
    lines: dict[str, list[str]] = {"train": [], "test": []}
    for recording in range(options.recordings):
        for touch in range(options.touches):
            start = touch * options.period + options.period // 3
            side = lines["test" if touch % 4 == 3 else "train"]
            side += [f"20220501_{recording:06d}/{i:010d}.jpg,{recording % 20}" for i in range(start, start + TOUCH)]
    root.mkdir(parents=True)
    for side, rows in lines.items():
        (root / f"{side}.txt").write_text("\n".join(rows))


def listed(root: Path) -> Jobs:
    """Return the recordings in the lists, each with its listed frames in order."""
    found: dict[str, list[int]] = {}
    for side in ("train", "test"):
        for line in (root / f"{side}.txt").read_text().split():
            found.setdefault(line[:15], []).append(int(line[16:26]))
    return [(root / "dataset" / name, sorted(numbers)) for name, numbers in sorted(found.items())]


def make_videos(root: Path, options: argparse.Namespace) -> None:
    write_lists(root, options)
    for folder, _ in listed(root):
        folder.mkdir(parents=True)
        for stem in STEMS:
            pictures = [paint(int(folder.name[9:]), stem, i) for i in range(NUM_PICTURES)]
            with av.open(str(folder / f"{stem}.mp4"), "w") as container:
                stream: Any = container.add_stream("mpeg4", rate=27)
                stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 640, 480, "yuv420p", 2_000_000
                stream.codec_context.gop_size = 12
                frames = [av.VideoFrame.from_ndarray(picture, format="rgb24") for picture in pictures]
                for number in range(options.touches * options.period):
                    frame = frames[number % NUM_PICTURES]
                    frame.pts = number
                    container.mux(stream.encode(frame))
                container.mux(stream.encode())


def make_jpegs(root: Path, options: argparse.Namespace) -> None:
    write_lists(root, options)
    for folder, numbers in listed(root):
        for stem in STEMS:
            place = folder / f"{stem}_frame"
            place.mkdir(parents=True)
            for number in numbers:
                picture = Image.fromarray(paint(int(folder.name[9:]), stem, number))
                picture.save(place / f"{number:010d}.jpg", quality=95)


def touch_and_go(root: Path, options: argparse.Namespace) -> Source:
    return TouchAndGoConfig(root=root, size=options.size).source()


def bare_jpeg(folder: Path, numbers: list[int], size: int) -> int:
    num = 0
    for stem in STEMS:
        for number in numbers:
            with Image.open(folder / f"{stem}_frame" / f"{number:010d}.jpg") as image:
                shrunk = image.convert("RGB").resize((size, size), Image.Resampling.BILINEAR)
                num += np.asarray(shrunk).shape[0] == size
    return num


def bare_video(folder: Path, numbers: list[int], size: int) -> int:
    """Decode all frames of both videos up to the last listed one, in a plain loop over PyAV."""
    wanted, num = set(numbers), 0
    for stem in STEMS:
        shrink = VideoReformatter()
        with av.open(str(folder / f"{stem}.mp4")) as container:
            container.streams.video[0].codec_context.thread_count = 1
            for i, frame in enumerate(container.decode(video=0)):
                if i in wanted:
                    made = shrink.reformat(frame, size, size, "rgb24", interpolation=Interpolation.BILINEAR)
                    num += made.to_ndarray().shape[0] == size
                if i >= numbers[-1]:
                    break
    return num


def bare_touches(folder: Path, numbers: list[int], size: int) -> int:
    """Decode as few frames as possible: seek once per touch, then decode from the key frame before it to its end."""
    num = 0
    starts = [n for n in numbers if n - 1 not in set(numbers)]
    for stem in STEMS:
        shrink = VideoReformatter()
        with av.open(str(folder / f"{stem}.mp4")) as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            step = 1 / (stream.average_rate * stream.time_base)  # type: ignore[operator]
            for start in starts:
                container.seek(int(start * step), stream=stream)
                for frame in container.decode(stream):
                    number = round(frame.pts / step)  # type: ignore[operator]
                    if number >= start:
                        made = shrink.reformat(frame, size, size, "rgb24", interpolation=Interpolation.BILINEAR)
                        num += made.to_ndarray().shape[0] == size
                    if number >= start + TOUCH - 1:
                        break
    return num


def owners_way(folder: Path, numbers: list[int], size: int) -> int:
    """Seek each frame and write it as JPEG with OpenCV, as extract_frame.py of the dataset; read it with Pillow."""
    import cv2

    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as place:
        for stem in STEMS:
            player = cv2.VideoCapture(str(folder / f"{stem}.mp4"), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
            (Path(place) / f"{stem}_frame").mkdir()
            for number in numbers:
                player.set(cv2.CAP_PROP_POS_FRAMES, number)
                cv2.imwrite(f"{place}/{stem}_frame/{number:010d}.jpg", player.read()[1])
            player.release()
        return bare_jpeg(Path(place), numbers, size)


# -- Calandra ----------------------------------------------------------------------------------------------------------


def make_shards(root: Path, options: argparse.Namespace) -> None:
    """Write ``options.recordings`` shards of ``options.touches`` grasps, with smooth images plus noise."""
    root.mkdir(parents=True)
    rng = np.random.default_rng(0)
    for shard in range(options.recordings):
        with h5py.File(root / f"calandra_corl2017_{shard:03d}.h5", "w") as file:
            for index in range(options.touches):
                group = file.create_group(f"data/i{index}")
                group.attrs["object_name"] = np.bytes_(("lemon", "potato", "soft_zebra")[index % 3])
                group.attrs["is_gripping"] = np.bool_(index % 2)
                for sensor, shape in SHAPES.items():
                    for phase in PHASES:
                        y, x, c = np.ogrid[: shape[0], : shape[1], :3]
                        smooth = 128 + 60 * np.sin(x / (40 + index)) * np.cos(y / 60 + c)
                        image = (smooth + rng.integers(0, 8, shape)).astype(np.uint8)
                        group.create_dataset(f"{sensor}_{phase}", data=image, compression="gzip", compression_opts=1)


def grasps(root: Path) -> Jobs:
    """Return the shards, each with the numbers of its grasps."""
    found: Jobs = []
    for path in sorted(root.glob("calandra_corl2017_*.h5")):
        with h5py.File(path) as file:
            data: Any = file["data"]
            found.append((path, sorted(int(name[1:]) for name in data)))
    return found


def calandra(root: Path, options: argparse.Namespace) -> Source:
    return CalandraConfig(path=root, size=options.size, split="object").source()


def bare_hdf5(path: Path, numbers: list[int], size: int) -> int:
    num = 0
    with h5py.File(path) as file:
        data: Any = file["data"]
        for number in numbers:
            for sensor in SHAPES:
                for phase in PHASES:
                    num += fit(data[f"i{number}/{sensor}_{phase}"][()], size).shape[0] == size
    return num


# -- All sources -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A source on disk, and other ways to read the same images, by name. Packing is compared with the first."""

    make: Callable[[Path, argparse.Namespace], None]
    source: Callable[[Path, argparse.Namespace], Source]
    jobs: Callable[[Path], Jobs]
    num_images: int
    """Images per frame or grasp."""
    ways: dict[str, Way]


CASES = {
    "jpeg": Case(make_jpegs, touch_and_go, listed, 2, {"bare": bare_jpeg}),
    "mp4": Case(
        make_videos,
        touch_and_go,
        listed,
        2,
        {"bare": bare_touches, "bare, every frame": bare_video, "owners": owners_way},
    ),
    "hdf5": Case(make_shards, calandra, grasps, 9, {"bare": bare_hdf5}),
}


def in_processes(way: Way, jobs: Jobs, size: int, workers: int) -> int:
    """Apply ``way`` to all ``jobs``. Processes are started for each call, as in packing."""
    if workers == 1:
        return sum(way(*job, size) for job in jobs)
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        return sum(pool.map(way, *zip(*jobs, strict=True), [size] * len(jobs)))


def measure(name: str, options: argparse.Namespace, place: Path) -> dict[str, Any]:
    """Return the seconds of each way per round, their medians, and the medians divided by that of packing."""
    case = CASES[name]
    root = options.shards if name == "hdf5" and options.shards else place / name
    if root == place / name:
        case.make(root, options)
    jobs = case.jobs(root)
    num = case.num_images * sum(len(numbers) for _, numbers in jobs)
    ways = {way: f for way, f in case.ways.items() if f is not owners_way or importlib.util.find_spec("cv2")}
    seconds: dict[str, list[float]] = {}
    for number in range(-1, options.rounds):
        for way, function in [("pack", None), *ways.items()]:
            began = time.perf_counter()
            if function is None:
                source = case.source(root, options)
                build(source, place / "pack", size=options.size, workers=options.workers, quiet=True)
            else:
                assert in_processes(function, jobs, options.size, options.workers) == num, way
            if number >= 0:  # the first round only fills the page cache and completes lazy imports
                seconds.setdefault(way, []).append(time.perf_counter() - began)
            shutil.rmtree(place / "pack", ignore_errors=True)
    median = {way: statistics.median(values) for way, values in seconds.items()}
    ratios = {way: median[way] / median["pack"] for way in ways}
    print(f"{name}: {num} images, pack {num / median['pack']:.0f} images/s;", end=" ")
    print(", ".join(f"{way} takes {ratio:.2f} x the time of pack" for way, ratio in ratios.items()), flush=True)
    return {"images": num, "seconds": seconds, "median": median, "ratio to pack": ratios}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", choices=[*CASES, []], help="sources to measure; default: all")
    parser.add_argument(
        "--quick", action="store_true", help="check in seconds that it runs: two small files, one round"
    )
    parser.add_argument("--rounds", type=int, default=3, help="measurements per method")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--size", type=int, default=256, help="image side in the pack, in pixels")
    parser.add_argument("--recordings", type=int, default=4, help="number of recordings, or of shards")
    parser.add_argument(
        "--touches", type=int, default=8, help="touches of 30 frames per recording, or grasps per shard"
    )
    parser.add_argument("--period", type=int, default=300, help="frames between the starts of two touches; 45 or more")
    parser.add_argument("--shards", type=Path, help="hdf5: folder of real shards, used instead of generated ones")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    if options.period < TOUCH * 3 // 2:
        parser.error(f"--period {options.period}: must be at least {TOUCH * 3 // 2}, or touches would overlap")
    if options.quick:
        options.rounds, options.recordings, options.touches, options.period = 1, 2, 4, 60
    with tempfile.TemporaryDirectory() as place:
        results = {name: measure(name, options, Path(place)) for name in options.cases or CASES}
    if options.json:
        given = {k: v for k, v in vars(options).items() if k not in ("json", "cases", "shards")}
        write_json(options.json, {"results": results, "options": given, **provenance()})


if __name__ == "__main__":
    main()
