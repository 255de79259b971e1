"""Contact detection: the background of one touch sensor, and whether something touches it."""

from dataclasses import dataclass

import numpy as np
from PIL import Image

from mvitac.data.images import fit
from mvitac.registry import check_range

SIDE = 32  # side in pixels of the small pictures in which contact is detected
LEAST_CHANGE = 1.0  # mean change in levels of R, G and B below which nothing counts as contact, however low the noise
IMPRINT = 0.15  # share of a touch's largest change below which it has ended: a gel may keep an imprint of the press
FOLLOW = 0.01  # share of the change by which a learned background is updated per frame while nothing is touched


@dataclass(frozen=True, kw_only=True)
class LiveConfig:
    """Contact detection of live input."""

    calibration: int = 30
    """Number of first frames, without contact, from which a sensor's background and noise are learned."""
    contact: float = 6.0
    """Contact begins at a change of this many times the noise without contact, and ends at half of that, or at 15 % of
    the largest change of the touch."""

    def __post_init__(self) -> None:
        check_range(self, 2, 1_000_000, "calibration")
        check_range(self, 1e-6, 1e6, "contact")


class Contact:
    """Contact of one touch sensor: learns its background, then compares frames with it."""

    def __init__(self, config: LiveConfig, side: int = 0, free: np.ndarray | None = None) -> None:
        """``side``: side in pixels of the background to keep for a model of difference images; 0 = none.

        ``free``: an image without contact, which is the background then, instead of the first frames.
        """
        self.config, self.side, self.free = config, side, free
        self.forget()

    def forget(self) -> None:
        """Calibrate again, e.g. after a change of resolution or a reconnected sensor."""
        self.first: list[tuple[np.ndarray, np.ndarray | None]] = []
        self.background: np.ndarray | None = None
        self.picture: np.ndarray | None = None
        """The background float32 [side, side, 3] at the size of the model's input."""
        self.noise = 0.0 if self.free is None else np.inf  # until two frames show it
        self.before: np.ndarray | None = None  # the last frame, small
        self.touched = self.uneasy = False
        self.most = self.imprint = 0.0  # the touch's largest change; what is left of the last one
        if self.free is not None:
            self.background = _small(self.free)
            self.picture = fit(self.free, self.side).astype(np.float32) if self.side else None

    def __call__(self, image: np.ndarray) -> bool | None:
        """True in contact, False without, None while calibrating."""
        small = _small(image)
        whole = fit(image, self.side) if self.side else None
        if self.background is None:
            self.first.append((small, whole))
            if len(self.first) < self.config.calibration:
                return None
            frames = np.stack([small for small, _ in self.first])
            frames = frames[1 - len(frames) % 2 :]  # an odd number: contact in exactly half would pass for noise
            pictures = [whole for _, whole in self.first if whole is not None]
            self.first = []
            middle = np.median(frames, axis=0)
            changes = np.abs(frames - middle).mean((1, 2, 3))
            self.noise = float(np.median(changes))
            self.uneasy = bool(changes.max() > max(LEAST_CHANGE, self.config.contact * self.noise))
            if self.uneasy:
                return None  # something moved: calibrate again
            self.background = middle
            self.picture = np.stack(pictures).mean(0, dtype=np.float32) if pictures else None
        noise = self.noise
        if self.free is not None:  # its own noise counts, too: learn it from the least change from frame to frame
            step = 0.0 if self.before is None else float(np.abs(small - self.before).mean()) / 2**0.5
            self.noise = min(step or np.inf, self.noise)
            unknown = LEAST_CHANGE if self.before is None else 0.0  # all frames so far are the same
            noise, self.before = (min(self.noise, LEAST_CHANGE) if self.noise < np.inf else unknown), small
        change = float(np.abs(small - self.background).mean())
        threshold = max(LEAST_CHANGE, self.config.contact * noise)
        if self.touched:
            self.most = max(self.most, change)
            self.touched = change > max(threshold / 2, IMPRINT * self.most)
            self.imprint = change * (change > threshold / 2)
        else:
            self.imprint = min(self.imprint, change)
            self.touched, self.most = change > threshold + self.imprint, change
        if not self.touched and self.free is None:
            self.background += FOLLOW * (small - self.background)
            if whole is not None and self.picture is not None:
                self.picture += FOLLOW * (whole - self.picture)
        return self.touched


def _small(image: np.ndarray) -> np.ndarray:
    """float32 [SIDE, SIDE, 3]: in colours, because slopes of a gel may change them and not its brightness."""
    return np.array(Image.fromarray(image).convert("RGB").resize((SIDE, SIDE), Image.Resampling.BOX), np.float32)
