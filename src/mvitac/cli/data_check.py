"""``mvitac data check``: what is wrong with a dataset."""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro
from tabulate import tabulate
from tyro.conf import Positional

from mvitac.cli.options import check_json, parse, printed_to, save_json, selectors
from mvitac.data.checks.examine import Draw, examine_pack, examine_source
from mvitac.data.checks.finding import Finding, exit_code
from mvitac.data.pack import Pack
from mvitac.data.several import MixedPack
from mvitac.datasets.base import DatasetConfig, dataset
from mvitac.datasets.mix import open_packs
from mvitac.datasets.pack import PackConfig
from mvitac.datasets.table.table import RowsConfig
from mvitac.report.contact_sheet import draw, samples, suspicious
from mvitac.system.files import write_atomic

_MANUAL = """Examine a dataset: unreadable, constant, BGR, copied, leaking, out of step, outside train.

    Exit code: 0 all is well, 1 a person should look, 2 something is broken (or the command could not be run).
    Heuristics only report "look", with their figures; "broken" is a fact. Nothing is changed.
    """


@dataclass(frozen=True, kw_only=True)
class _Options:
    json: Path | None = None
    """Also write every finding to this file; - = stdout, and the table to stderr."""
    sheet: Path | None = None
    """Also draw the suspicious rows into this PNG, and a few pairs of every class or group, to check by eye."""


@dataclass(frozen=True, kw_only=True)
class _PackOptions(_Options):
    pack: Positional[tuple[str, ...]]
    """Folder of the pack, or of several (FOLDER or NAME=FOLDER) as one. A source that is not packed yet: --data NAME ..."""


@dataclass(frozen=True, kw_only=True)
class _SourceOptions(_Options):
    data: Annotated[DatasetConfig, tyro.conf.arg(name="")]
    quiet: bool = False
    """No progress bar."""


def check(argv: list[str]) -> int:
    chosen, rest = selectors(argv, ("--data",))
    paths = [w for b, w in zip(["", *rest], rest, strict=False) if b[:2] != "--" and Path(w).exists()]
    if "--data" not in chosen and paths and not (Path(paths[0]) / "pack.json").exists():
        chosen["--data"] = paths[0]  # a table, a video or a folder
        rest.remove(paths[0])
    if "--data" not in chosen:
        options = parse(_PackOptions, rest, "data check", description=_MANUAL)
        name = " + ".join(options.pack)
        draw_sheet = _sheet(name, options)
        pack: Any = name
        if len(options.pack) != 1:  # at the least size: a copy that is enlarged has blurred edges, and is not found
            parts = open_packs(options.pack).parts
            pack = MixedPack(parts, size=min(part.size for part in parts.values()), allow_leak=True)
        return _report(name, examine_pack(pack, draw=draw_sheet), options)
    name = f"--data {chosen['--data']}"
    usual = _SourceOptions(data=dataset(chosen["--data"]))
    options = parse(_SourceOptions, rest, f"data check {name}", default=usual, description=_MANUAL)
    draw_sheet = _sheet(name, options)
    data: Any = options.data
    if isinstance(data, PackConfig):
        return _report(str(data.path), examine_pack(data.path, draw_sheet), options)
    # A leak is a finding here, beside all the others; packing refuses it.
    source = (replace(data, allow_leak=True) if isinstance(data, RowsConfig) else data).source()
    return _report(name, examine_source(source, workers=data.workers, quiet=options.quiet, draw=draw_sheet), options)


def _sheet(what: str, options: _Options) -> Draw | None:
    """What draws the contact sheet that ``options`` ask for; ValueError if their files cannot be written."""
    check_json(options.json)
    check_json(out := options.sheet, "--sheet")
    if not out:
        return None

    def sheet(pack: Pack, findings: Sequence[Finding]) -> None:
        write_atomic(out, lambda file: draw(what, [*suspicious(pack, findings), *samples(pack)]).save(file, "PNG"))
        print(f"written: {out}", file=printed_to(options.json))

    return sheet


def _report(what: str, findings: Sequence[Finding], options: _Options) -> int:
    code = exit_code(findings)
    width = max(40, shutil.get_terminal_size().columns - 40)
    rows = [[f.verdict, f.item, f.evidence + (f"\n-> {f.advice}" if f.advice else "")] for f in findings]
    table = tabulate(rows, ["", "item", "what was found"], disable_numparse=True, maxcolwidths=[None, 20, width])
    print(f"{what}: {('ok', 'look', 'broken')[code]}", table, "", sep="\n", file=printed_to(options.json))
    save_json(options.json, {"what": what, "exit_code": code, "findings": [asdict(f) for f in findings]})
    return code
