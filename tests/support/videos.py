"""Pictures of one colour, and videos whose every frame says which it is: by blocks and a band of colour, or by its gray."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image

BITS = 12
WIDTH, HEIGHT = 160, 120
COLOURS = {"vision": (220, 60, 40), "touch": (40, 90, 220)}


def picture(path: Path, colour: int | tuple[int, int, int] = 0, size: tuple[int, int] = (16, 16)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (colour,) * 3 if isinstance(colour, int) else colour).save(path, quality=95)
    return path


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
    rate: int = 25,
    codec: str = "mpeg4",
    gop: int = 12,
    b_frames: int = 0,
    options: dict[str, str] | None = None,
    flags: dict[str, str] | None = None,
) -> Path:
    """``num`` frames painted by ``paint``; the defaults are the codec and key frame distance of Touch and Go's own files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=flags or {}) as container:
        stream: Any = container.add_stream(codec, rate=rate, options=options or {})
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


def edited(path: Path, out: Path, *edits: tuple[int, int]) -> Path:
    """``path`` (mp4, 25 frames a second) as a trim without encoding anew leaves it: all packets are there, and an edit list
    says what is shown, one or more stretches of (first frame, how many)."""
    data = bytearray(path.read_bytes())
    header = data.rindex(b"moov")  # behind the packets, so none of them moves

    def at(name: bytes) -> int:
        return data.index(name, header)

    def number(place: int) -> int:
        return int.from_bytes(data[place : place + 4], "big")

    movie, ticks, old = number(at(b"mvhd") + 16), number(at(b"mdhd") + 16), at(b"elst")
    assert number(old + 8) == 1  # from the first frame shown to the end
    entries = [(num * movie // 25, number(old + 16) + first * ticks // 25, 1 << 16) for first, num in edits]
    for name in (b"moov", b"trak", b"edts", b"elst"):
        struct.pack_into(">I", data, at(name) - 4, number(at(name) - 4) + 12 * (len(edits) - 1))
    data[old + 8 : old + 24] = struct.pack(">I", len(edits)) + b"".join(struct.pack(">III", *e) for e in entries)
    out.write_bytes(data)
    return out


def shade(index: int, which: int = 0) -> int:
    """The gray of frame ``index``: neighbours differ by much more than the codec changes them."""
    return 20 + (index * 37 + which * 90) % 200


def level(image: np.ndarray) -> float:
    return float(image.mean())


def film(path: Path, num: int, which: int = 0, size: tuple[int, int] = (64, 48), rate: int = 25) -> Path:
    return write_video(path, num, lambda i: np.full((size[1], size[0], 3), shade(i, which), np.uint8), rate=rate)
