"""Reads the images of a table's rows, those of one video (or row group, ...) together."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mvitac.data.images import difference, fit, shrink
from mvitac.data.source import Lost, Sample
from mvitac.datasets.table.image_refs import Damage, ImageRef, mean_image, read_all

Loaded = dict[ImageRef, np.ndarray]  # images at the stored size


@dataclass(frozen=True, slots=True)
class Row:
    """One sample before its images are read: where they are, and the row's columns in the pack."""

    number: int
    vision: ImageRef | None
    touch: tuple[ImageRef, ...]
    background: tuple[tuple[ImageRef, ...], ...]
    """Per touch image, the no-contact images whose mean is subtracted; empty for raw images."""
    columns: dict[str, Any]

    def refs(self) -> Iterator[ImageRef]:
        """Yield the reference of every image that is needed."""
        yield from (ref for ref in (self.vision, *self.touch) if ref)
        yield from (ref for many in self.background for ref in many)


def bundles(rows: Sequence[Row], most: int) -> list[list[int]]:
    """Group row indices into items: at most ``most`` rows whose images are in the same containers; other rows alone."""
    items: list[list[int]] = []
    open_items: dict[Any, list[int]] = {}
    for i, row in enumerate(rows):
        key = tuple(ref.container() if ref else None for ref in (row.vision, *row.touch))
        if not any(key):
            items.append([i])
            continue
        item = open_items.get(key)
        if item is None or len(item) == most:
            item = open_items[key] = []
            items.append(item)
        item.append(i)
    return items


def read_rows(rows: Sequence[Row], size: int) -> list[Sample | Lost]:
    """Return the samples of rows that ``bundles`` put together, with images of side ``size``.

    A row with a damaged image is ``Lost``, or raises ValueError or OSError if it is the only one.
    """
    lost: Damage = {}
    vision = _load([row.vision for row in rows if row.vision], size, lost)
    num_touch = max(len(row.touch) for row in rows)
    touch = [_load([row.touch[k] for row in rows if row.touch], size, lost) for k in range(num_touch)]
    samples: list[Sample | Lost] = []
    for row in rows:
        try:
            samples.append(_sample(row, vision, touch, size, lost))
        except (ValueError, OSError) as error:
            if len(rows) == 1:
                raise
            samples.append(Lost(f"row {row.number}", str(error)))  # the other rows of the video are still good
    return samples


def _load(refs: Sequence[ImageRef], size: int, lost: Damage) -> Loaded:
    """Read images at the stored size (a whole video would not fit otherwise); damaged ones are put in ``lost``."""
    return {ref: shrink(image, size) for ref, image in read_all(refs, lost)}


def _sample(row: Row, vision: Loaded, touch: Sequence[Loaded], size: int, lost: Damage) -> Sample:
    """Make the sample of ``row`` from the loaded images; ValueError if one of them is damaged."""
    for ref in (row.vision, *row.touch):
        if ref in lost:
            raise ValueError(lost[ref])
    pressed = [images[ref] for images, ref in zip(touch, row.touch, strict=False)]
    for k, background in enumerate(row.background):
        pressed[k] = difference(pressed[k], fit(mean_image(background), size))
    image = vision[row.vision] if row.vision else None
    return Sample(vision=image, touch=np.concatenate(pressed, axis=2) if pressed else None, columns=row.columns)
