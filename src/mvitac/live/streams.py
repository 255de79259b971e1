"""Streams of frames: only the newest frame counts, and every fault is reported.

Time comes from a clock passed as an argument, so tests use a fake one. Frames are uint8 RGB [H, W, 3].
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mvitac.data.images import fit
from mvitac.live.cameras import Ended, Source
from mvitac.system.files import brief

FROZEN_AFTER, RETRY_EVERY = 1.0, 1.0
"""Seconds: how long pictures may be identical to the last byte, and between two tries to open a lost device."""

_RECOVERED = {"unplugged": "back", "stalled": "running again", "frozen": "moving again"}  # a fault, and its end


@dataclass(frozen=True)
class Frame:
    """One picture and its time of capture (seconds of the stream's clock)."""

    image: np.ndarray
    time: float
    number: int


@dataclass(frozen=True)
class Event:
    """A fault or its end: ``what`` is the kind, ``text`` the sentence for the user."""

    stream: str
    what: str
    text: str


class Stream:
    """The newest frame of one source, and its faults. Call ``pump`` from one thread only, the rest from any."""

    def __init__(
        self, name: str, origin: Source, *, clock: Callable[[], float] = time.monotonic, stale_after: float = 0.5
    ) -> None:
        """Frames are used for ``stale_after`` seconds. ``tell`` gets every event, in the thread that noticed it."""
        self.name, self.origin, self.clock = name, origin, clock
        self.tell: Callable[[Event], None] = lambda event: None
        self.stale_after, self.ended, self.fault = stale_after, False, ""
        self.num_frames = self.num_dropped = self.num_damaged = 0
        self._side, self._keep = 0, 0.0
        self._past: deque[tuple[float, np.ndarray]] = deque()
        self._lock = threading.Lock()
        self._newest: Frame | None = None
        self._taken, self._open, self._retry_at = True, False, float("-inf")
        self._moved_at = self._opened_at = clock()
        self._arrivals: deque[float] = deque(maxlen=30)

    def pump(self) -> None:
        """Read one frame, or try once to open the source. Blocks as long as the device does."""
        if self.ended:
            return
        try:
            if not self._open:
                if self.clock() < self._retry_at:
                    return
                self.origin.open()
                self._open, self._opened_at = True, self.clock()
            image = self.origin.cropped(self.origin.read())
        except Ended:
            self.ended = True
            self._say("ended", "has no more frames")
            return
        except ValueError as error:
            self.num_damaged += 1
            self._say("damaged frame", f"skipped a damaged frame ({brief(error)})")
            return
        except Exception as error:  # OSError, or one of the exceptions of OpenCV and its drivers
            self.close()
            self._retry_at = self.clock() + RETRY_EVERY
            if self.fault != "unplugged":
                self._arrivals.clear()
                self._say("unplugged", f"is gone ({brief(error)}): trying again every {RETRY_EVERY:g} s")
            return
        self.take(image)

    def newest(self, *, take: bool = True) -> Frame | None:
        """The newest frame of any age; with ``take`` it counts as used, not as dropped."""
        with self._lock:
            self._taken = self._taken or take
            return self._newest

    def remember(self, seconds: float, side: int) -> None:
        """Keep frames of the last ``seconds`` (and one before them), resized to ``side`` pixels, for ``window``."""
        self._keep, self._side = seconds, side

    def window(self, newest: Frame, back: Sequence[float], since: float) -> list[np.ndarray]:
        """Kept frames as uint8 [side, side, 3], one for each of ``back``, seconds before ``newest``.

        As in the training data (``data/windows.py``), it is the newest frame that is old enough, found by time, so that
        dropped frames shift nothing; a quarter of the interval between frames is allowed for jitter. Where that would be
        before ``since``, the first frame from there on repeats.
        """
        slack = (self.interval() or 0.0) / 4
        with self._lock:
            past = [(time, image) for time, image in self._past if since <= time <= newest.time]
        past = past or [(newest.time, fit(newest.image, self._side))]
        found = []
        for seconds in back:
            old = [image for time, image in past if time <= newest.time - seconds + (slack if seconds else 0)]
            found.append(old[-1] if old else past[0][1])
        return found

    def interval(self) -> float | None:
        """Seconds between two frames: the median of the last thirty; None before the second frame."""
        gaps = np.diff(list(self._arrivals))
        return float(np.median(gaps)) if len(gaps) else None

    def check(self) -> None:
        """Report a device that has stopped giving frames; ``pump`` cannot, as it waits for the device."""
        now = self.clock()
        last = max((self._opened_at, *self._arrivals))
        if self._open and not self.ended and self.fault != "stalled" and now - last > self.stale_after:
            self._say("stalled", f"gives no frames since {now - last:.1f} s")

    def close(self) -> None:
        self.origin.close()
        self._open = False

    def take(self, image: np.ndarray) -> None:
        """Make ``image`` the newest frame, captured when its source says, or now."""
        now, before, image = self.clock(), self._newest, image.copy()  # a source may fill one buffer again and again
        captured = now if self.origin.captured is None else self.origin.captured
        changed = before and before.image.shape != image.shape
        if self.fault in ("unplugged", "stalled"):
            self._recovered()
        if before and changed:
            old, new = (f"{x.shape[1]}x{x.shape[0]}" for x in (before.image, image))
            self._say("resolution changed", f"changed from {old} to {new}")
        if before is None or changed or not np.array_equal(before.image, image):
            if self.fault == "frozen":
                self._recovered()
            self._moved_at = now
        elif self.fault != "frozen" and now - self._moved_at >= FROZEN_AFTER:
            self._say("frozen", f"shows the same picture since {now - self._moved_at:.1f} s")
        self.num_frames += 1
        self._arrivals.append(now)
        with self._lock:
            self.num_dropped += not self._taken
            self._newest, self._taken = Frame(image, captured, self.num_frames), False
            if self._side:
                if changed:
                    self._past.clear()  # another lens or crop
                self._past.append((captured, fit(image, self._side)))
                while len(self._past) > 1 and self._past[1][0] <= captured - self._keep:
                    self._past.popleft()

    def _recovered(self) -> None:
        what, self.fault = _RECOVERED[self.fault], ""
        self._say(what, f"is {what}")

    def _say(self, what: str, text: str) -> None:
        if what in (*_RECOVERED, "ended"):
            self.fault = what
        self.tell(Event(self.name, what, f"{self.name} {text}"))


class CaptureThread(threading.Thread):
    """Reads one stream until ``stopping`` is set; the frames of files at their times."""

    def __init__(self, stream: Stream, wake: Callable[[], None]) -> None:
        super().__init__(name=f"capture {stream.name}", daemon=True)
        self.stream, self.wake, self.stopping = stream, wake, threading.Event()

    def run(self) -> None:
        start, origin = time.monotonic(), self.stream.origin
        while not self.stream.ended:
            wait = origin.wait(time.monotonic() - start)
            if self.stopping.wait(max(wait, 0.1 if self.stream.fault == "unplugged" else 0.0)):
                break
            self.stream.pump()
            self.wake()
        self.stream.close()
