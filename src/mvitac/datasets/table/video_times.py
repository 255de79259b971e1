"""Times of a video's frames, read without decoding it."""

from pathlib import Path

import av
import av.error
import numpy as np


def spread(num: int, length: int, start: float = 0.0, end: float = 1.0) -> list[int]:
    """Return at most ``num`` distinct frame numbers, evenly spaced between fractions ``start`` and ``end`` of ``length``."""
    places = np.linspace(start * (length - 1), end * (length - 1), num)
    return sorted({int(place) for place in np.rint(places)})


def timestamps(path: Path) -> np.ndarray:
    """Return the presentation times in seconds [N], ascending, of the displayed frames."""
    try:
        with av.open(str(path)) as container:
            base = float(container.streams.video[0].time_base or 0)
            # Frames cut off by an edit list are left out: neither a player nor ``mvitac.data.video`` counts them.
            packets = [p for p in container.demux(video=0) if p.size and not p.is_discard and p.pts is not None]
    except (av.error.FFmpegError, IndexError, OSError) as error:
        raise ValueError(f"{path} cannot be read as a video ({error}): fetch it again") from None
    return np.sort(np.array([packet.pts for packet in packets], float)) * base


def nearest(times: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index in ascending ``times`` [N] nearest to each of ``wanted`` [M], and the distance in seconds."""
    if not len(times):
        return np.zeros(len(wanted), int), np.full(len(wanted), np.inf)
    after = np.clip(np.searchsorted(times, wanted), 1, max(1, len(times) - 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    at = np.where(np.abs(times[after] - wanted) < np.abs(times[before] - wanted), after, before)
    return at, np.abs(times[at] - wanted)
