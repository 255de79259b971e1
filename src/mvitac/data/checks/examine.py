"""The whole examination, of a pack or of a source that is packed as thumbnails for it."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.build import build
from mvitac.data.checks import duplicates, image_checks, table_checks
from mvitac.data.checks.contact_sheet import Strips, strips_of
from mvitac.data.checks.finding import Finding
from mvitac.data.checks.image_stats import look_at
from mvitac.data.pack import Pack
from mvitac.data.source import Count, Lost, Sample, Source
from mvitac.data.spec import DataSpec


class ThumbnailSource(Source):
    """Every k-th item of another source, with the size of the images as they came in columns of their own."""

    def __init__(self, source: Source, num: int) -> None:
        self.source = source
        items = source.items()
        chosen = np.arange(len(items)) if not num else np.linspace(0, len(items) - 1, min(num, len(items))).astype(int)
        self._chosen: list[int] = chosen.tolist()
        self._items = [items[i] for i in self._chosen]

    def spec(self) -> DataSpec:
        return self.source.spec()

    def items(self) -> list[str]:
        return self._items

    def fingerprint(self) -> dict[str, Any]:
        return {"glance": self._chosen, **self.source.fingerprint()}

    def samples_per_item(self) -> list[int]:
        counts = self.source.samples_per_item()
        return [counts[number] for number in self._chosen]

    def expected(self) -> list[Count]:
        return self.source.expected()

    def read(self, item: int) -> list[Sample | Lost]:
        samples: list[Sample | Lost] = []
        for sample in self.source.read(self._chosen[item]):
            if isinstance(sample, Lost):
                samples.append(sample)
                continue
            given = {"vision": sample.vision, "touch": sample.touch}
            shapes = {m: sample.sizes.get(m, i.shape[:2]) for m, i in given.items() if i is not None}
            sizes = {f"{m}_size": f"{width} x {height}" for m, (height, width) in shapes.items()}
            samples.append(replace(sample, columns={**sample.columns, **sizes}))
        return samples


def examine(pack: Pack, counts: list[Count] | None = None, *, part: bool = False) -> list[Finding]:
    """Every check of ``pack``; ``counts`` are what its source says of the owners' lists. Classes and labels that are not in
    ``part`` of a source may be in the rest of it."""
    looks = look_at(pack)
    labels = [table_checks.missing_labels(pack), *table_checks.class_balance(pack)]
    if part:
        note = "in the items examined: "
        milder = [replace(f, verdict="look", evidence=note + f.evidence) for f in labels]
        labels = [mild if f.verdict == "broken" else f for f, mild in zip(labels, milder, strict=True)]
    return [
        *table_checks.published(counts or []),
        table_checks.unreadable(pack),
        table_checks.missing_images(pack),
        image_checks.constant_frames(pack, looks),
        image_checks.grayscale_mix(pack, looks),
        image_checks.red_and_blue(pack, looks),
        image_checks.swapped_modalities(pack, looks),
        image_checks.time_offset(pack, looks),
        table_checks.mixture(pack),
        *labels,
        *table_checks.leaks(pack),
        duplicates.exact_copies(pack, looks),
        duplicates.near_copies(pack, looks),
        table_checks.numbers(pack),
        table_checks.give_aways(pack),
    ]


def examine_pack(path: Path) -> tuple[list[Finding], Strips]:
    """The findings on the pack at ``path``, and their suspicious rows as pictures."""
    try:
        pack = Pack(path)
    except ValueError as error:
        if not (path / "pack.json").is_file():
            raise
        found = Finding(
            item="pack", verdict="broken", evidence=str(error), advice="make it again; training refuses it as well"
        )
        return [found], {}
    whole = Finding(item="pack", verdict="ok", evidence=f"{pack.num} rows, every digest matches")
    findings = [whole, *examine(pack)]
    return findings, strips_of(pack, findings)


def examine_source(
    source: Source, *, num: int = 0, size: int = 64, workers: int = 1, quiet: bool = False
) -> tuple[list[Finding], Strips]:
    """The findings on ``source``, read once into a temporary pack of ``size`` px; ``num`` items of it, 0 = all.

    Damaged items are a finding, not an error, unless nothing at all can be read.
    """
    glance = ThumbnailSource(source, num)
    with tempfile.TemporaryDirectory(prefix="mvitac-check-") as folder:
        options: dict[str, Any] = {"size": size, "workers": workers, "quiet": quiet}
        pack = build(glance, Path(folder) / "pack", max_damaged=1.0, **options)
        findings = examine(pack, glance.expected(), part=len(glance.items()) < len(source.items()))
        read = f"{len(glance.items())} of {len(source.items())} items examined, kept at {size} px"
        findings.insert(0, Finding(item="source", verdict="ok", evidence=f"{pack.spec.name}: {read}"))
        return findings, strips_of(pack, findings)
