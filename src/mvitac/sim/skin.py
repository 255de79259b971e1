"""Surfaces of objects to grasp: the finish that the camera sees, and the skin that only the gels can feel.

Each grip meets another patch of skin. Peaks dig into the gel and grip; pits leave a plateau that slides. Both have the same
spectrum and range of depth and differ only in the sign of the skewness, so that neither contrast nor the size of the
imprint distinguishes them.

Shapes: N points, in millimetres in the object's frame (`objects.py`).
"""

from dataclasses import dataclass

import numpy as np

PATTERNS = ("ribs", "knurl", "grain", "bumps")
PEAKS = 0.76  # fraction of patches with peaks
GRIPS, SLIDES = 0.85, 0.3  # friction coefficients against the gel for peaks and for pits


class Pattern:
    """A procedural texture in the object's frame, with few high and many low points."""

    def __init__(self, rng: np.random.Generator, low_mm: float, high_mm: float) -> None:
        """Draw one with a wavelength of ``low_mm`` to ``high_mm``."""
        self.kind = str(rng.choice(PATTERNS))
        waves = rng.normal(size=(7, 3))  # directions
        # The sides that touch the pads face x, so a wave along x would be invisible to the gel.
        waves[:, 0] *= 0.3
        waves /= np.linalg.norm(waves, axis=1, keepdims=True)
        if self.kind in ("knurl", "bumps"):
            waves[1] = np.cross(waves[0], [1.0, 0.0, 0.0])
            waves[1] /= np.linalg.norm(waves[1])
        self.waves, self.wavelength_mm = waves, rng.uniform(low_mm, high_mm)
        self.phases = rng.uniform(0, 2 * np.pi, 7)

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the pattern in [-1, 1] at points [N, 3] of the object's frame."""
        angle = points_mm @ self.waves.T * (2 * np.pi / self.wavelength_mm) + self.phases
        if self.kind == "ribs":
            wave = np.sin(angle[:, 0])
        elif self.kind == "knurl":
            wave = np.sin(angle[:, 0]) * np.sin(angle[:, 1])
        elif self.kind == "bumps":
            wave = np.cos(angle[:, :2]).mean(1)
        else:
            wave = np.tanh(np.sin(angle).sum(1) * 1.5 / np.sqrt(angle.shape[1]))
        return 2 * ((wave + 1) / 2) ** 3 - 1


class Finish:
    """Appearance of an object in the camera; it is independent of friction. Colours are linear RGB."""

    def __init__(self, rng: np.random.Generator) -> None:
        # Saturated, so that the object differs from the pale tables and the picture shows where it is gripped.
        self.color = rng.permutation([rng.uniform(0.02, 0.15), rng.uniform(0.02, 0.9), rng.uniform(0.6, 0.95)])
        self.printed = Pattern(rng, 8, 20)
        self.accent = np.clip(self.color * rng.uniform(0.25, 1.6) + rng.normal(0, 0.12, 3), 0.02, 1)  # of the print
        self.gloss = float(np.clip(rng.uniform(-0.3, 1.05), 0, 1))  # strength of the highlight


@dataclass(frozen=True, kw_only=True)
class Patch:
    """The skin under one grip. Its relief is visible to the gels, but too fine for the camera."""

    pattern: Pattern
    peaks: bool  # whether the pattern is raised, which grips, or sunk, which slides
    amplitude_mm: float  # half the height between lowest and highest points
    friction: float  # sliding friction coefficient against the gel

    def relief_mm(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the relief in mm at points [N, 3] of the object's frame."""
        return (self.amplitude_mm if self.peaks else -self.amplitude_mm) * self.pattern(points_mm)


def draw_patch(rng: np.random.Generator) -> Patch:
    peaks = bool(rng.random() < PEAKS)
    pattern, amplitude = Pattern(rng, 2.2, 4.5), float(0.09 * 2.5 ** rng.uniform())
    friction = float((GRIPS if peaks else SLIDES) * np.exp(rng.normal(0, 0.06)))
    return Patch(pattern=pattern, peaks=peaks, amplitude_mm=amplitude, friction=friction)
