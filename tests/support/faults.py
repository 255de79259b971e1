"""Live input on a fake clock: a robot that touches every three seconds, and something that breaks every minute."""

from typing import Any

import numpy as np

from mvitac.live.cameras import Source
from mvitac.live.contact import LiveConfig
from mvitac.live.predictor import Live
from mvitac.live.streams import Event, Stream

NAMES = {
    "unplugged": ("unplugged", "back"),
    "frozen": ("frozen", "moving again"),
    "resolution": ("resolution changed", "resolution changed"),  # there and back
    "damaged": ("damaged frame",),
    "stalled": ("stalled", "running again"),
}
"""What live must say of each fault of a sensor, in order."""


class Clock:
    def __init__(self) -> None:
        self.now = 99.0  # free at first: calibration needs it

    def __call__(self) -> float:
        return self.now


class Rig(Source):
    """A noisy sensor whose picture brightens in contact; ``fault`` breaks it."""

    def __init__(self, clock: Clock, seed: int, size: int = 32) -> None:
        self.clock, self.size, self.fault = clock, size, ""
        self.rng = np.random.default_rng(seed)
        self.base = self.rng.integers(60, 120, (size, size, 3)).astype(np.uint8)

    def open(self) -> None:
        if self.fault == "unplugged":
            raise OSError("no such device")

    def read(self) -> np.ndarray:
        if self.fault == "unplugged":
            raise OSError("select() timeout")
        if self.fault == "damaged":
            raise ValueError("corrupt JPEG data")
        if self.fault == "frozen":
            return self.picture
        image = self.base + self.rng.integers(0, 3, self.base.shape, dtype=np.uint8)
        if self.clock.now % 3 >= 1:  # in contact
            image[8:24, 8:24] += 80
        self.picture = image[::2, ::2] if self.fault == "resolution" else image
        return self.picture


class World:
    """Two streams of different rates around one ``Live``, in simulated time."""

    def __init__(self, engine: Any, config: LiveConfig = LiveConfig(calibration=8), **options: Any) -> None:
        self.clock = Clock()
        self.rigs = {"vision": Rig(self.clock, 1), "touch": Rig(self.clock, 2)}
        self.streams = {m: [Stream(m, rig, clock=self.clock)] for m, rig in self.rigs.items()}
        self.heard: list[Event] = []
        self.live = Live(engine, self.streams, config, clock=self.clock, tell=self.heard.append, **options)

    def run(self, seconds: float, fps: dict[str, float] | None = None) -> None:
        """Frames at ``fps``; a stalled device blocks its reader, so its stream is not pumped."""
        fps = fps or {"vision": 5.0, "touch": 10.0}
        end = self.clock.now + seconds
        due = dict.fromkeys(fps, self.clock.now)
        while self.clock.now < end - 1e-9:
            self.clock.now = min(*due.values(), end)
            for m in fps:
                if due[m] <= self.clock.now:
                    due[m] += 1 / fps[m]
                    if self.rigs[m].fault != "stalled":
                        self.streams[m][0].pump()
            self.live.tick()
