"""How near packing comes to bare decoding, and what it saves over the owners' way with videos.

Sources are made by code in Touch and Go's layout (640 x 480, mpeg4 with a key frame every 12, touches of 30 frames every
300, as in the published lists), two processes' worth of nothing else. For each:

- ``bare``: a loop that decodes and resizes every listed pair, in as many processes as packing gets, and keeps nothing
- ``pack``: ``mvitac.packing.build``, the whole way to a finished, sealed pack on disk; ratio = bare time / pack time
- ``owners`` (videos only): seek both videos to each listed frame, write both as JPEG, read them back, resize

The ways take turns; medians over rounds. Another source is one more function in ``SOURCES``.

    python -m benchmarks.packing [--rounds N] [--workers N] [--recordings N] [--touches N] [--json FILE]
"""

from __future__ import annotations

import argparse
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
import numpy as np
from av.video.reformatter import Interpolation, VideoReformatter
from PIL import Image

from mvitac.datasets.touch_and_go import TouchAndGoConfig
from mvitac.packing import build
from mvitac.record import provenance, write_json
from mvitac.source import Source

SIZE, PERIOD, TOUCH = 256, 300, 30
STEMS = ("video", "gelsight")


def paint(recording: int, stem: str, number: int) -> np.ndarray:
    """A textured picture that moves a little from frame to frame, as a hand-held camera's does."""
    rng = np.random.default_rng([recording, STEMS.index(stem)])
    coarse = Image.fromarray(rng.integers(0, 255, (30, 40, 3), np.uint8))
    fine = np.asarray(coarse.resize((704, 528), Image.Resampling.BICUBIC))
    x, y = (number * 3) % 64, number % 48
    return np.ascontiguousarray(fine[y : y + 480, x : x + 640])


def make_videos(root: Path, recordings: int, touches: int) -> Path:
    """A tree of mp4 files with lists; nearly all frames are between the touches, as in the real one."""
    lines: dict[str, list[str]] = {"train": [], "test": []}
    for recording in range(recordings):
        name = f"20220501_{recording:06d}"
        for stem in STEMS:
            path = root / "dataset" / name / f"{stem}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            with av.open(str(path), "w") as container:
                stream: Any = container.add_stream("mpeg4", rate=27)
                stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 640, 480, "yuv420p", 2_000_000
                stream.codec_context.gop_size = 12
                pictures = [av.VideoFrame.from_ndarray(paint(recording, stem, i), format="rgb24") for i in range(48)]
                for number in range(touches * PERIOD):
                    picture = pictures[number % 48]
                    picture.pts = number
                    container.mux(stream.encode(picture))
                container.mux(stream.encode())
        for touch in range(touches):
            start = touch * PERIOD + 101
            side = lines["test" if touch % 4 == 3 else "train"]
            side += [f"{name}/{i:010d}.jpg,{recording % 20}" for i in range(start, start + TOUCH)]
    for side, rows in lines.items():
        (root / f"{side}.txt").write_text("\n".join(rows))
    return root


def make_jpegs(root: Path, recordings: int, touches: int) -> Path:
    """The same lists over extracted frames."""
    made = make_videos(root, recordings, touches)
    for line in [row for side in ("train", "test") for row in (root / f"{side}.txt").read_text().split()]:
        name, number = line[:15], int(line[16:26])
        for stem in STEMS:
            path = root / "dataset" / name / f"{stem}_frame" / f"{number:010d}.jpg"
            path.parent.mkdir(exist_ok=True)
            Image.fromarray(paint(int(name[9:]), stem, number)).save(path, quality=95)
    for path in (root / "dataset").glob("*/*.mp4"):
        path.unlink()
    return made


def listed(root: Path) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for side in ("train", "test"):
        for line in (root / f"{side}.txt").read_text().split():
            found.setdefault(line[:15], []).append(int(line[16:26]))
    return {name: sorted(numbers) for name, numbers in sorted(found.items())}


# -- bare loops and the owners' way: one recording per call --------------------------------------------------------------


def bare_video(folder: Path, numbers: list[int]) -> int:
    """Every frame of both videos from the first to the last listed one, as a plain loop over PyAV decodes them."""
    wanted, num = set(numbers), 0
    for stem in STEMS:
        shrink = VideoReformatter()
        with av.open(str(folder / f"{stem}.mp4")) as container:
            container.streams.video[0].codec_context.thread_count = 1
            for i, frame in enumerate(container.decode(video=0)):
                if i in wanted:
                    made = shrink.reformat(frame, SIZE, SIZE, "rgb24", interpolation=Interpolation.BILINEAR)
                    num += made.to_ndarray().shape[0] == SIZE
                if i >= numbers[-1]:
                    break
    return num


def bare_touches(folder: Path, numbers: list[int]) -> int:
    """The least a video costs: one seek per touch, decoding from the key frame before it to its end."""
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
                        made = shrink.reformat(frame, SIZE, SIZE, "rgb24", interpolation=Interpolation.BILINEAR)
                        num += made.to_ndarray().shape[0] == SIZE
                    if number >= start + TOUCH - 1:
                        break
    return num


def bare_jpeg(folder: Path, numbers: list[int]) -> int:
    num = 0
    for stem in STEMS:
        for number in numbers:
            with Image.open(folder / f"{stem}_frame" / f"{number:010d}.jpg") as image:
                shrunk = image.convert("RGB").resize((SIZE, SIZE), Image.Resampling.BILINEAR)
                num += np.asarray(shrunk).shape[0] == SIZE
    return num


def owners_way(folder: Path, numbers: list[int]) -> int:
    """Seek per frame and write JPEGs (OpenCV, as in their extract_frame.py), then load and resize them with Pillow."""
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
        return bare_jpeg(Path(place), numbers)


def in_processes(way: Callable[[Path, list[int]], int], root: Path, workers: int) -> int:
    """``way`` over all recordings; processes are started anew, as packing starts them."""
    jobs = [(root / "dataset" / name, numbers) for name, numbers in listed(root).items()]
    if workers == 1:
        return sum(way(*job) for job in jobs)
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        return sum(pool.map(way, *zip(*jobs, strict=True)))


# -- sources -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A source on disk, and other ways through the same images, by name."""

    source: Callable[[Path], Source]
    make: Callable[[Path, int, int], Path]
    ways: dict[str, Callable[[Path, list[int]], int]]


def touch_and_go(root: Path) -> Source:
    return TouchAndGoConfig(root=root, size=SIZE).source()


SOURCES = {
    "jpeg": Case(touch_and_go, make_jpegs, {"bare": bare_jpeg}),
    "mp4": Case(
        touch_and_go, make_videos, {"bare": bare_touches, "bare, every frame": bare_video, "owners": owners_way}
    ),
}


def measure(name: str, options: argparse.Namespace, place: Path) -> dict[str, Any]:
    case = SOURCES[name]
    root = case.make(place / name, options.recordings, options.touches)
    num = sum(map(len, listed(root).values()))
    seconds: dict[str, list[float]] = {}
    for _ in range(options.rounds):
        for way, function in [("pack", None), *case.ways.items()]:
            began = time.perf_counter()
            if function is None:
                build(case.source(root), place / "pack", size=SIZE, workers=options.workers, quiet=True)
            else:
                assert in_processes(function, root, options.workers) == 2 * num
            seconds.setdefault(way, []).append(time.perf_counter() - began)
            shutil.rmtree(place / "pack", ignore_errors=True)
    median = {way: statistics.median(values) for way, values in seconds.items()}
    ratios = {way: median[way] / median["pack"] for way in case.ways}
    print(f"{name}: {num} pairs, pack {num / median['pack']:.0f} pairs/s;", end=" ")
    print(", ".join(f"{way} takes {ratio:.2f} x the time of pack" for way, ratio in ratios.items()))
    return {"pairs": num, "seconds": seconds, "median": median, "ratio to pack": ratios}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sources", nargs="*", choices=[*SOURCES, []], help="default: all")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--recordings", type=int, default=4)
    parser.add_argument("--touches", type=int, default=8, help="per recording, of 30 frames, one in every 300 frames")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        results = {name: measure(name, options, Path(place)) for name in options.sources or SOURCES}
    if options.json:
        given = {k: v for k, v in vars(options).items() if k not in ("json", "sources")}
        write_json(options.json, {"results": results, "options": given, "size": SIZE, **provenance()})


if __name__ == "__main__":
    main()
