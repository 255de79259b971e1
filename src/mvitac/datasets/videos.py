"""How long a video is, and which of its frames to take: known before any is decoded."""

from __future__ import annotations

from pathlib import Path

import av
import av.error
import numpy as np


def num_frames(path: Path) -> int:
    """How many frames ``path`` holds, counted without decoding them; ValueError if it is no video or has none."""
    try:
        with av.open(str(path)) as container:
            num = sum(packet.size > 0 for packet in container.demux(video=0))
    except (av.error.FFmpegError, IndexError, OSError) as error:
        raise ValueError(f"{path} cannot be read as a video ({error}): fetch it again") from None
    if not num:
        raise ValueError(f"{path} holds no frames: fetch it again")
    return num


def spread(num: int, length: int, start: float = 0.0, end: float = 1.0) -> list[int]:
    """At most ``num`` different frame numbers, evenly spread from the share ``start`` to ``end`` of ``length`` frames."""
    places = np.linspace(start * (length - 1), end * (length - 1), num)
    return sorted({int(place) for place in np.rint(places)})
