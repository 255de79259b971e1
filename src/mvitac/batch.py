"""One training batch as a method sees it.

Shapes: N rows of a dataset, B images in a batch, V views of each image, C channels, H x W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Views:
    """A batch as a method sees it: V augmented, normalised views [B, C, H, W] of every image, per modality."""

    images: dict[str, list[Tensor]]
    """modality -> V tensors; a modality the dataset lacks is absent."""
    labels: dict[str, Tensor]
    """task -> [B] int64, -1 = unlabelled; only supervised references look at it."""
    rows: Tensor
    """[B] int64, the row of each pair in its pack (memory banks are indexed by it)."""
