"""Contact detection: the background of one touch sensor, and whether something touches it."""

from dataclasses import dataclass

import numpy as np
from PIL import Image
from tyro.conf import Fixed

from mvitac.data.images import fit

SIDE = 32  # side in pixels of the small gray pictures in which contact is detected


@dataclass(frozen=True, kw_only=True)
class LiveConfig:
    """Contact detection of live input."""

    calibration: int = 30
    """Number of first frames, without contact, from which a sensor's background and noise are learned."""
    contact: float = 6.0
    """Contact begins at a change of this many times the noise without contact, and ends at half of that."""
    least_change: Fixed[float] = 1.0
    """Mean change in grey levels below which nothing counts as contact, however low the noise."""
    follow: Fixed[float] = 0.01
    """Share of the change by which the background is updated per frame while nothing is touched."""

    def __post_init__(self) -> None:
        if self.calibration < 2:
            raise ValueError(f"calibration {self.calibration}: give at least 2 frames")
        if not (self.contact > 0 and self.least_change >= 0 and 0 <= self.follow < 1):
            raise ValueError("contact must be > 0, least_change >= 0 and follow in [0, 1)")


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
        self.noise = self.level = 0.0
        self.touched = self.uneasy = False
        if self.free is not None:
            self.background = _small(self.free)
            self.picture = fit(self.free, self.side).astype(np.float32) if self.side else None

    def __call__(self, image: np.ndarray) -> bool | None:
        """True in contact, False without, None while calibrating; sets ``level``, the change over the threshold."""
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
            changes = np.abs(frames - middle).mean((1, 2))
            self.noise = float(np.median(changes))
            self.uneasy = bool(changes.max() > max(self.config.least_change, self.config.contact * self.noise))
            if self.uneasy:
                return None  # something moved: calibrate again
            self.background = middle
            self.picture = np.stack(pictures).mean(0, dtype=np.float32) if pictures else None
        change = float(np.abs(small - self.background).mean())
        threshold = max(self.config.least_change, self.config.contact * self.noise)
        self.level = change / threshold
        self.touched = self.level > (0.5 if self.touched else 1.0)
        if not self.touched:
            self.background += self.config.follow * (small - self.background)
            if whole is not None and self.picture is not None:
                self.picture += self.config.follow * (whole - self.picture)
        return self.touched


def _small(image: np.ndarray) -> np.ndarray:
    """float32 [SIDE, SIDE], gray."""
    return np.array(Image.fromarray(image).convert("L").resize((SIDE, SIDE), Image.Resampling.BOX), np.float32)
