"""Runs all checks on a pack, or on a source that is packed as some first."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.build import build
from mvitac.data.checks import duplicates, image_checks, table_checks, value_checks
from mvitac.data.checks.finding import Finding, judged
from mvitac.data.checks.image_stats import look_at
from mvitac.data.pack import Pack
from mvitac.data.source import Lost, Sample, Source
from mvitac.data.spec import DataSpec

Draw = Callable[[Pack, Sequence[Finding]], None]  # draws a contact sheet


class _Some(Source):
    """Evenly spaced items of another source."""

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

    def read(self, item: int) -> Sequence[Sample | Lost]:
        return self.source.read(self._chosen[item])


def examine(pack: Pack, *, part: bool = False) -> list[Finding]:
    """Run every check on ``pack``. Classes that a ``part`` of a source lacks may be in the rest: not "broken"."""
    looks, labels = look_at(pack), [*table_checks.labels(pack), *value_checks.values(pack)]
    if part:
        milder = [replace(f, verdict="look", evidence="in the items examined: " + f.evidence) for f in labels]
        labels = [mild if f.verdict == "broken" else f for f, mild in zip(labels, milder, strict=True)]
    return [
        table_checks.unreadable(pack),
        table_checks.missing_images(pack),
        image_checks.constant_frames(pack, looks),
        image_checks.red_and_blue(pack, looks),
        image_checks.time_offset(pack, looks),
        *([value_checks.time_shift(pack, looks)] if pack.spec.values else []),
        *labels,
        *table_checks.ungrouped(pack),
        *table_checks.leaks(pack),
        *table_checks.shared_by_parts(pack),
        table_checks.similar_names(pack),
        duplicates.exact_copies(pack, looks),
        duplicates.near_copies(pack, looks),
        table_checks.give_aways(pack),
    ]


def examine_pack(pack: str | Path | Pack, draw: Draw | None = None) -> list[Finding]:
    """Check a pack, or the one at this path."""
    if not isinstance(pack, Pack):
        path = Path(pack)
        try:
            pack = Pack(path)
        except ValueError as error:
            if not (path / "pack.json").is_file():
                raise
            return [judged("pack", str(error), "make it again; training refuses it, too", broken=True)]
    findings = [Finding("pack", "ok", f"{pack.num} rows, every digest matches"), *examine(pack)]
    if draw:
        draw(pack, findings)
    return findings


def examine_source(
    source: Source, *, num: int = 0, size: int = 64, workers: int = 1, quiet: bool = False, draw: Draw | None = None
) -> list[Finding]:
    """Findings about ``source``, which is read into a temporary pack of ``size`` px, to ``draw`` while it is there.

    ``num`` items are read, evenly spaced; 0 = all. Damaged items are a finding; an error only if nothing can be read.
    """
    some = _Some(source, num)
    with tempfile.TemporaryDirectory(prefix="mvitac-check-") as folder:
        pack = build(some, Path(folder) / "pack", size=size, workers=workers, max_damaged=1.0, quiet=quiet)
        findings = examine(pack, part=len(some.items()) < len(source.items()))
        read = f"{len(some.items())} of {len(source.items())} items examined, kept at {size} px"
        findings.insert(0, Finding("source", "ok", f"{pack.spec.name}: {read}"))
        if draw:
            draw(pack, findings)
        return findings
