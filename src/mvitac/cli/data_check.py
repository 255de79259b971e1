"""``mvitac data check``: the doctor."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mvitac.cli.options import parse, selectors, short

_COLOURS = {"ok": "green", "look": "yellow", "broken": "bold red", "not checkable": "dim"}


def check(argv: list[str]) -> int:
    """mvitac data check PACK | --data NAME ... [--json FILE] [--sheet FILE.png]"""
    from typing import Annotated

    import tyro

    from mvitac import datasets
    from mvitac.data.checks.examine import examine_pack, examine_source
    from mvitac.datasets.table.table import RowsConfig
    from mvitac.registry import default

    chosen, rest = selectors(argv, ("--data",))

    @dataclass(frozen=True, kw_only=True)
    class Shared:
        json: Path | None = None
        """Also write every finding to this file."""
        sheet: Path | None = None
        """Also draw the suspicious rows into this PNG."""

    manual = """Examine a dataset: unreadable, constant, swapped, mislabelled, copied, leaking, out of step.

    Exit code: 0 all is well, 1 somebody should look, 2 something is broken (or the command could not be run).
    Heuristics say "look" and show their figures; only facts say "broken". Nothing is changed.
    """
    if "--data" not in chosen:

        @dataclass(frozen=True, kw_only=True)
        class OfPack(Shared):
            pack: tyro.conf.Positional[Path]
            """Folder of the pack; for a source that is not packed yet: mvitac data check --data NAME ..."""

        OfPack.__doc__ = manual
        options = parse(OfPack, rest, "data check")
        _check_places(options)
        findings, strips = examine_pack(options.pack)
        return _tell(str(options.pack), findings, strips, options)

    config: Any = default(datasets.DatasetConfig, chosen["--data"])

    @dataclass(frozen=True, kw_only=True)
    class OfSource(Shared):
        data: Annotated[type(config), tyro.conf.arg(name="", help=config.__doc__)] = config  # type: ignore[valid-type]
        num: int = 0
        """Items to read, evenly spread over the source; 0 = all."""
        thumbnail: int = 64
        """Side in pixels at which the images are kept for the examination."""
        quiet: bool = False
        """No progress bar."""

    OfSource.__doc__ = manual
    options = parse(OfSource, short(rest), f"data check --data {chosen['--data']}")
    _check_places(options)
    if options.num < 0:
        raise ValueError(f"--num {options.num}: give how many items to read, 0 for all")
    # What leaks is a finding here, beside all the others; packing refuses it.
    leaky = {"allow_leak": True} if isinstance(options.data, RowsConfig) else {}
    source = replace(options.data, **leaky).source()
    findings, strips = examine_source(
        source, num=options.num, size=options.thumbnail, workers=options.data.workers, quiet=options.quiet
    )
    return _tell(f"--data {chosen['--data']}", findings, strips, options)


def _check_places(options: Any) -> None:
    from mvitac.system.files import check_place

    if options.sheet and options.sheet.suffix.lower() != ".png":
        raise ValueError(f"--sheet {options.sheet}: the sheet is a PNG, give a name that ends in .png")
    for path in (options.json, options.sheet):
        if path:
            check_place(path)


def _tell(what: str, findings: Any, strips: Any, options: Any) -> int:
    from dataclasses import asdict

    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from mvitac.data.checks.contact_sheet import draw
    from mvitac.data.checks.finding import exit_code
    from mvitac.system.files import write_atomic, write_json

    code = exit_code(findings)
    console = Console(markup=False)
    table = Table(title=f"{what}: {('ok', 'look', 'broken')[code]}", title_justify="left")
    for column in ("", "item", "what was found"):
        table.add_column(column, overflow="fold")
    for finding in findings:
        told = finding.evidence + (f"\n-> {finding.advice}" if finding.advice else "")
        table.add_row(Text(finding.verdict, style=_COLOURS[finding.verdict]), finding.item, told)
    console.print(table)
    if options.json:
        write_json(options.json, {"what": what, "exit_code": code, "findings": [asdict(f) for f in findings]})
        console.print(f"written: {options.json}", soft_wrap=True, highlight=False)
    if options.sheet:
        write_atomic(options.sheet, lambda file: draw(file, strips))
        console.print(f"written: {options.sheet}", soft_wrap=True, highlight=False)
    return code
