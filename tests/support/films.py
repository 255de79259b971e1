"""Videos whose every frame is known: frame i is one gray, far from that of its neighbours."""

from pathlib import Path

import numpy as np

from support.videos import write_video


def shade(index: int, which: int = 0) -> int:
    """The gray of frame ``index``: neighbours differ by much more than the codec changes them."""
    return 20 + (index * 37 + which * 90) % 200


def film(path: Path, num: int, which: int = 0, size: tuple[int, int] = (64, 48), rate: int = 25) -> Path:
    """A video whose frame i is all of ``shade(i)``."""
    return write_video(path, num, lambda i: np.full((size[1], size[0], 3), shade(i, which), np.uint8), rate=rate)
