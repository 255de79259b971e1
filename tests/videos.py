"""Videos whose every frame says which it is: its number in black and white blocks, its stream in a band of colour."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np

BITS = 12
WIDTH, HEIGHT = 160, 120
COLOURS = {"vision": (220, 60, 40), "touch": (40, 90, 220)}


def numbered(number: int, stream: str) -> np.ndarray:
    """uint8 [120, 160, 3]: 12 bits in 4 x 3 blocks above a band of the stream's colour."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for bit in range(BITS):
        row, column = divmod(bit, 4)
        image[30 * row : 30 * row + 30, 40 * column : 40 * column + 40] = 235 if number >> bit & 1 else 20
    image[90:] = COLOURS[stream]
    return image


def read_number(image: np.ndarray) -> tuple[int, str]:
    """What ``numbered`` wrote, whatever codec and resizing lie between."""
    height, width = image.shape[:2]
    number = 0
    for bit in range(BITS):
        row, column = divmod(bit, 4)
        block = image[int((row + 0.5) * height / 4), int((column + 0.5) * width / 4)]
        assert block.min() > 180 or block.max() < 80, f"bit {bit} is neither black nor white: {block}"
        number |= int(block.min() > 180) << bit
    red, _, blue = image[int(3.5 * height / 4), width // 2]
    return number, "vision" if int(red) > int(blue) else "touch"


def write_video(
    path: Path,
    num: int,
    paint: Callable[[int], np.ndarray],
    *,
    codec: str = "mpeg4",
    gop: int = 12,
    b_frames: int = 0,
    options: dict[str, str] | None = None,
    flags: dict[str, str] | None = None,
) -> Path:
    """``num`` frames painted by ``paint``; the defaults are the codec and key frame distance of Touch and Go's own files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=flags or {}) as container:
        stream: Any = container.add_stream(codec, rate=25, options=options or {})
        height, width = paint(0).shape[:2]
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.bit_rate = 2_000_000
        stream.codec_context.gop_size = gop
        stream.codec_context.max_b_frames = b_frames
        stream.codec_context.thread_count = 1
        for number in range(num):
            for packet in stream.encode(av.VideoFrame.from_ndarray(paint(number), format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def trimmed(path: Path, out: Path, frames: int) -> Path:
    """``path`` (mp4, 25 frames a second) without its first ``frames``, as ``ffmpeg -ss ... -c copy`` cuts: every packet
    stays, and an edit list says what is shown."""
    with av.open(str(path)) as old, av.open(str(out), "w", options={"avoid_negative_ts": "disabled"}) as new:
        stream = old.streams.video[0]
        copy = new.add_stream_from_template(stream)
        for packet in old.demux(stream):
            if packet.size and packet.pts is not None and packet.dts is not None and packet.time_base:
                away = round(frames / 25 / packet.time_base)
                packet.pts, packet.dts, packet.stream = packet.pts - away, packet.dts - away, copy
                new.mux(packet)
    return out
