"""Chosen frames of a video in one forward pass."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import av
import av.error
import numpy as np


def frames(path: str | Path, indices: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
    """(index, RGB uint8 [H, W, 3]) for every one of the ascending ``indices``, frames counted from 0 as decoded.

    Decodes once, from the start to the last index, and converts only what is asked for. ValueError if the video cannot
    be read or ends before an index.
    """
    wanted = iter(indices)
    at = next(wanted, None)
    count = 0
    try:
        with av.open(str(path)) as container:
            for count, frame in enumerate(container.decode(video=0), 1):
                if at is None:
                    return
                if count - 1 == at:
                    yield at, frame.to_ndarray(format="rgb24")
                    at = next(wanted, None)
    except (av.error.FFmpegError, IndexError) as error:
        raise ValueError(f"{path} cannot be decoded as a video ({error})") from None
    if at is not None:
        raise ValueError(f"{path} has {count} frames: there is no frame {at}")
