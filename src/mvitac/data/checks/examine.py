"""Runs all checks on a pack, or on a source, which is packed first."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from mvitac.data.build import build
from mvitac.data.checks import duplicates, image_checks, table_checks, value_checks
from mvitac.data.checks.finding import Finding, judged
from mvitac.data.checks.image_stats import look_at
from mvitac.data.pack import Pack
from mvitac.data.source import Source

Draw = Callable[[Pack, Sequence[Finding]], None]  # draws a contact sheet


def examine(pack: Pack, *before: Finding, draw: Draw | None = None) -> list[Finding]:
    """All findings about ``pack``, after those ``before``; and ``draw`` them."""
    looks = look_at(pack)
    findings = [
        *before,
        table_checks.unreadable(pack),
        table_checks.missing_images(pack),
        image_checks.constant_frames(pack, looks),
        image_checks.red_and_blue(pack, looks),
        image_checks.time_offset(pack, looks),
        *([value_checks.time_shift(pack, looks)] if pack.spec.values else []),
        *table_checks.labels(pack),
        *value_checks.values(pack),
        *table_checks.noted(pack),
        *table_checks.leaks(pack),
        table_checks.similar_names(pack),
        duplicates.exact_copies(pack, looks),
        duplicates.near_copies(pack, looks),
        table_checks.give_aways(pack),
    ]
    if draw:
        draw(pack, findings)
    return findings


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
    return examine(pack, Finding("pack", "ok", f"{pack.num} rows, every digest matches"), draw=draw)


def examine_source(
    source: Source, *, size: int = 64, workers: int = 1, quiet: bool = False, draw: Draw | None = None
) -> list[Finding]:
    """Findings about ``source``, which is read into a temporary pack of ``size`` px, to ``draw`` while it is there.

    Damaged items are a finding; an error only if nothing can be read.
    """
    with tempfile.TemporaryDirectory(prefix="mvitac-check-") as folder:
        pack = build(source, Path(folder) / "pack", size=size, workers=workers, max_damaged=1.0, quiet=quiet)
        read = f"{pack.spec.name}: {len(source.items())} items examined, kept at {size} px"
        return examine(pack, Finding("source", "ok", read), draw=draw)
