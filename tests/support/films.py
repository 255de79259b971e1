"""Videos whose every frame is known: frame i is one gray, far from that of its neighbours."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np


def shade(index: int, which: int = 0) -> int:
    """The gray of frame ``index``: neighbours differ by much more than the codec changes them."""
    return 20 + (index * 37 + which * 90) % 200


def film(path: Path, num: int, which: int = 0, size: tuple[int, int] = (64, 48), rate: int = 25) -> Path:
    """A video whose frame i is all of ``shade(i)``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height = size
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        for i in range(num):
            picture = np.full((size[1], size[0], 3), shade(i, which), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path
