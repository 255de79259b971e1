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


@dataclass(frozen=True, kw_only=True)
class Pattern:
    """A procedural texture in the object's frame, with few high and many low points."""

    kind: str  # one of ``PATTERNS``
    wavelength_mm: float
    waves: np.ndarray  # unit directions [7, 3] of the pattern's waves
    phases: np.ndarray  # their phases [7] in radians

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


@dataclass(frozen=True, kw_only=True)
class Finish:
    """Appearance of an object in the camera; it is independent of friction."""

    printed: Pattern
    color: np.ndarray  # linear RGB [3] of the body
    accent: np.ndarray  # linear RGB [3] of the print
    gloss: float  # strength of the highlight, 0..1


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


def _pattern(rng: np.random.Generator, low_mm: float, high_mm: float) -> Pattern:
    kind = str(rng.choice(PATTERNS))
    waves = rng.normal(size=(7, 3))
    # The sides that touch the pads face x, so a wave along x would be invisible to the gel.
    waves[:, 0] *= 0.3
    waves /= np.linalg.norm(waves, axis=1, keepdims=True)
    if kind in ("knurl", "bumps"):
        waves[1] = np.cross(waves[0], [1.0, 0.0, 0.0])
        waves[1] /= np.linalg.norm(waves[1])
    return Pattern(
        kind=kind, wavelength_mm=rng.uniform(low_mm, high_mm), waves=waves, phases=rng.uniform(0, 2 * np.pi, 7)
    )


def draw_finish(rng: np.random.Generator) -> Finish:
    """Draw the appearance of an object."""
    # Saturated, so that the object differs from the pale tables and the picture shows where it is gripped.
    color = rng.permutation([rng.uniform(0.02, 0.15), rng.uniform(0.02, 0.9), rng.uniform(0.6, 0.95)])
    return Finish(
        printed=_pattern(rng, 8, 20),
        color=color,
        accent=np.clip(color * rng.uniform(0.25, 1.6) + rng.normal(0, 0.12, 3), 0.02, 1),
        gloss=float(np.clip(rng.uniform(-0.3, 1.05), 0, 1)),
    )


def draw_patch(rng: np.random.Generator) -> Patch:
    """Draw the skin under the fingers of one grip."""
    peaks = bool(rng.random() < PEAKS)
    return Patch(
        pattern=_pattern(rng, 2.2, 4.5),
        peaks=peaks,
        amplitude_mm=float(0.09 * 2.5 ** rng.uniform()),
        friction=float((GRIPS if peaks else SLIDES) * np.exp(rng.normal(0, 0.06))),
    )
