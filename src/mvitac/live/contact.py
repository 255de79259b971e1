"""Contact detection: the background of one touch sensor, and whether something touches it."""

from dataclasses import dataclass

import numpy as np
from PIL import Image

from mvitac.data.images import fit
from mvitac.registry import check_range

SIDE = 32  # side in pixels of the small gray pictures in which contact is detected
LEAST_CHANGE = 1.0  # mean change in grey levels below which nothing counts as contact, however low the noise
FOLLOW = 0.01  # share of the change by which the background is updated per frame while nothing is touched


@dataclass(frozen=True, kw_only=True)
class LiveConfig:
    """Contact detection of live input."""

    calibration: int = 30
    """Number of first frames, without contact, from which a sensor's background and noise are learned."""
    contact: float = 6.0
    """Contact begins at a change of this many times the noise without contact, and ends at half of that."""

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
        self.noise = 0.0
        self.touched = self.uneasy = False
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
            changes = np.abs(frames - middle).mean((1, 2))
            self.noise = float(np.median(changes))
            self.uneasy = bool(changes.max() > max(LEAST_CHANGE, self.config.contact * self.noise))
            if self.uneasy:
                return None  # something moved: calibrate again
            self.background = middle
            self.picture = np.stack(pictures).mean(0, dtype=np.float32) if pictures else None
        change = float(np.abs(small - self.background).mean())
        threshold = max(LEAST_CHANGE, self.config.contact * self.noise)
        self.touched = change > threshold * (0.5 if self.touched else 1.0)
        if not self.touched:
            self.background += FOLLOW * (small - self.background)
            if whole is not None and self.picture is not None:
                self.picture += FOLLOW * (whole - self.picture)
        return self.touched


def _small(image: np.ndarray) -> np.ndarray:
    """float32 [SIDE, SIDE], gray."""
    return np.array(Image.fromarray(image).convert("L").resize((SIDE, SIDE), Image.Resampling.BOX), np.float32)
