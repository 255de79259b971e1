"""The command line: thin and lazy. `mvitac --help` imports nothing heavy; each command imports what it needs.

A user's mistake ends in one line on stderr and exit code 2; Ctrl-C in 130; anything else is our bug and shows a traceback.
"""

import argparse
import contextlib
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

HELP = """\
usage: mvitac COMMAND [OPTIONS]     (mvitac COMMAND --help explains one)

Learn from paired camera and optical-tactile images without labels, and prove
what the features are worth.

  demo                 the whole road in minutes, on simulated data
  data simulate KIND   simulate materials or grasps into a pack
  data pack            read any dataset (--data NAME) into a pack
  data info PACK       what is in a pack
  data sheet KIND      a picture of what the simulator makes
  pretrain             pre-train encoders (--method, --data, --recipe)
  probe RUN...         linear probes beside their controls
  report RUN...        one HTML page with curves, tables and pictures

First steps:
  mvitac demo                                        # no data needed
  mvitac pretrain --data materials --recipe demo --out runs/first
  mvitac probe runs/first
  mvitac report runs/first                           # open the page it names
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(HELP, end="")
        return 0
    if arguments[0] == "--version":
        from mvitac import __version__

        print(__version__)
        return 0
    try:
        name, rest = arguments[0], arguments[1:]
        _check_once(rest)
        if name == "data" and rest:
            if rest[0] in ("-h", "--help"):
                print(HELP, end="")
                return 0
            name, rest = f"data {rest[0]}", rest[1:]
        if name not in COMMANDS:
            from mvitac.registry import unknown

            raise unknown("command", name, COMMANDS)
        COMMANDS[name](rest)
        return 0
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, MemoryError) as error:
        print(f"mvitac: error: {one_line(error)}", file=sys.stderr)
        return 2
    except Exception as error:
        if type(error).__name__ == "Interrupted":
            print(f"mvitac: {error}", file=sys.stderr)
            return 130
        if isinstance(error, RuntimeError) and re.search("out of memory|can't allocate memory", str(error)):  # torch's
            print(f"mvitac: error: {one_line(MemoryError())}", file=sys.stderr)
            return 2
        raise


def _check_once(argv: Sequence[str]) -> None:
    """An option given twice is a slip in a long command: say so instead of letting the last one win."""
    names = [word.split("=")[0].replace("_", "-") for word in argv if word.startswith("--")]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name} is given twice: give it once")


def one_line(error: BaseException) -> str:
    """An error as one line; what the system says of a file gets the file's name and what to do."""
    if isinstance(error, OSError) and error.strerror:
        advice = {
            28: "free some space or choose another --out",
            13: "check its permissions or choose another place",
            30: "choose another --out",
            36: "choose a shorter name",
        }
        hint = advice.get(error.errno or 0, "check the path")
        text = f"{error.filename or 'file'}: {error.strerror} ({hint})"
    elif isinstance(error, MemoryError):
        text = "not enough memory: use a smaller --batch-size, --augment.size or pack"
    else:
        text = str(error) or type(error).__name__
    text = " ".join(text.split()).replace("\0", "\\x00")
    return text if len(text) <= 1200 else f"{text[:600]} ... {text[-600:]}"


def parse(kind: Callable[..., T] | type[T], argv: Sequence[str], prog: str, *, default: Any = None) -> T:
    """tyro, with its boxed errors folded into the one line every command owes."""
    import tyro

    if "-h" in argv or "--help" in argv:
        wide: Any = contextlib.nullcontext()
    else:
        wide = _columns("10000")  # no help will be shown, and an error's lines must not be wrapped
    boxed = io.StringIO()
    try:
        with contextlib.redirect_stderr(boxed), wide:
            options: dict[str, Any] = {} if default is None else {"default": default}
            return tyro.cli(kind, args=list(argv), prog=f"mvitac {prog}", **options)  # type: ignore[arg-type]
    except SystemExit as exit_:
        if not exit_.code:
            raise
        raise ValueError(_unboxed(boxed.getvalue(), prog)) from None


@contextlib.contextmanager
def _columns(width: str) -> Iterator[None]:
    old = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = width
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if old is not None:
            os.environ["COLUMNS"] = old


def _unboxed(text: str, prog: str) -> str:
    """What a boxed error of tyro says, in our words: `--batch-size: 'x' is not an int (see ... --help)`."""
    from mvitac.registry import unknown

    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    # A frame of ╭─ title ─╮ and rules of ─ in a terminal; a title, an empty line and rules of - where it is ASCII only.
    lines = [line.strip(" │|") for line in text.splitlines() if not re.match(r"\s*([╭╰├]|[│|]?\s*[-─]{3,})", line)]
    lines = [line for line in lines if line and not line.startswith("For full helptext")]
    if lines and lines[0] in (
        "Value error",
        "Missing argument",
        "Invalid choice",
        "Unrecognized options",
        "Required options",
    ):
        lines = lines[1:]
    see = f"(see mvitac {prog} --help)"
    whole = " ".join(lines)
    if found := re.match(r"Error parsing (?:run|data|session)?(?:\.[\w.]+)?: (.*)", whole):
        return found[1]  # a config's own check, which names its field and what is allowed
    if found := re.match(r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of (\(.*\))", whole):
        return f"{found[2]}: {unknown('choice', found[1], re.findall(chr(39) + '(.*?)' + chr(39), found[3]))}"
    if found := re.match(r"Missing value for argument '(\S+)'\. Expected (\d+) values", whole):
        return f"{found[1]}: expected {found[2]} value{'s' * (found[2] != '1')} after it {see}"
    if found := re.match(r"Unrecognized (?:or misplaced )?options: (.*?)(?: Perhaps you meant:? (--\S+).*)?$", whole):
        near = f"; did you mean {found[2]}?" if found[2] else ""
        return f"unknown option {found[1].replace(', ', ' ')}{near} {see}"
    if found := re.match(r"Error parsing (\S+): (.*?)(?: Argument helptext: (.*))?$", whole):
        given = re.search(r"invalid literal for int\(\) with base 10: (.*)$", found[2])
        if given:
            what = f"{given[1]} is not an int"
        elif given := re.match(r"could not convert string to float: (.*)$", found[2]):
            what = f"{given[1]} is not a number"
        elif "Exceeds the limit" in found[2]:
            what = "a number of so many digits is too long"
        elif given := re.search(r"(?:instantiated from|parse arguments) \[(.*?)\]", found[2]):
            kind = re.search(r"(?:[A-Z]{3,}|\{\S+)(?: [A-Z]{3,})*", found[3] or "")  # FLOAT FLOAT, {None}|INT
            what = f"{given[1]} is not {kind[0] if kind else 'possible'}"
        else:
            what = found[2]
        return f"{found[1]}: {what} {see}"
    if found := re.match(r"Missing from .*?: (.*)", whole):
        return f"missing {found[1].split(' (required)')[0]} {see}"
    return f"{whole} {see}"


# -- data -------------------------------------------------------------------------------------------------------------


def data_simulate(argv: list[str]) -> None:
    """mvitac data simulate materials|grasps --num ... --size ... --seed ... --out DIR"""
    from mvitac.datasets.simulated import SimulatedConfig
    from mvitac.registry import default, unknown

    names = sorted(cls.name for cls in SimulatedConfig.__subclasses__())
    if not argv or argv[0].startswith("-"):
        raise ValueError(f"say what to simulate: mvitac data simulate {'|'.join(names)} --out DIR")
    if argv[0] not in names:
        raise unknown("kind to simulate", argv[0], names)
    _pack(default(SimulatedConfig, argv[0]), argv[1:], f"data simulate {argv[0]}")


def data_pack(argv: list[str]) -> None:
    """mvitac data pack --data NAME ... --out DIR"""
    from mvitac import datasets
    from mvitac.registry import default

    chosen, rest = _selectors(argv, ("--data",))
    if "--data" not in chosen:
        raise ValueError(
            f"say which dataset: mvitac data pack --data {'|'.join(datasets.DatasetConfig.choices)} --out DIR"
        )
    _pack(default(datasets.DatasetConfig, chosen["--data"]), rest, f"data pack --data {chosen['--data']}")


def _pack(config: Any, argv: list[str], prog: str) -> None:
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.pack import build
    from mvitac.record import check_place

    @dataclass(frozen=True, kw_only=True)
    class Options:
        out: Path
        """Folder of the new pack."""
        data: Annotated[type(config), tyro.conf.arg(name="")] = config  # type: ignore[valid-type]
        max_damaged: float = 0.0
        """Share of the items that may be unreadable before packing stops; they are listed in pack.json."""
        quiet: bool = False
        """No progress bar."""

    options = parse(Options, argv, prog)
    check_place(options.out)
    source = options.data.source()
    pack = build(
        source,
        options.out,
        size=options.data.size,
        workers=options.data.workers,
        max_damaged=options.max_damaged,
        quiet=options.quiet,
    )
    Console().print(f"{pack.path}: {pack.num} samples at {pack.size} px", soft_wrap=True, highlight=False)


def data_sheet(argv: list[str]) -> None:
    """mvitac data sheet materials|grasps [--out FILE.png]"""
    from typing import Literal

    import tyro
    from rich.console import Console

    @dataclass(frozen=True)
    class Options:
        """A picture of everything a simulator makes, for a person to judge."""

        kind: tyro.conf.Positional[Literal["materials", "grasps"]]
        """Which simulator."""
        out: Path | None = None
        """The picture (default: KIND.png here)."""
        seed: int = 0
        """World seed."""

    options = parse(Options, argv, "data sheet")
    from mvitac.record import write_atomic
    from mvitac.sim import grasps, sheet

    draw = {"materials": sheet.contact_sheet, "grasps": grasps.contact_sheet}[options.kind]
    out = options.out or Path(f"{options.kind}.png")
    if out.suffix.lower() != ".png":
        raise ValueError(f"--out {out}: the sheet is a PNG, give a name that ends in .png")
    if options.seed < 0:
        raise ValueError(f"--seed {options.seed}: give a number >= 0")
    write_atomic(out, lambda file: draw(file, seed=options.seed))
    Console().print(f"{out}", soft_wrap=True, highlight=False)


def data_info(argv: list[str]) -> None:
    """mvitac data info PACK"""
    import numpy as np
    from rich.console import Console
    from rich.table import Table
    from tyro.conf import Positional

    from mvitac.pack import SPLITS, Pack

    @dataclass(frozen=True)
    class Options:
        pack: Positional[Path]
        """Folder of the pack."""

    pack = Pack(parse(Options, argv, "data info").pack)
    table = Table(title=f"{pack.path}: {pack.spec.name}, {pack.num} samples at {pack.size} px", title_justify="left")
    for column in ("split", "rows", f"{pack.spec.group_by}s", *(f"{t.name}: majority" for t in pack.spec.tasks)):
        table.add_column(column)
    for split in SPLITS:
        rows = pack.rows(split)
        if not len(rows):
            continue
        cells = []
        for task in pack.spec.tasks:
            labels = pack.column(f"label_{task.name}")[pack.rows(split, only=task.only)]
            labels = labels[labels >= 0]
            common = np.bincount(labels).argmax() if len(labels) else None
            cells.append("" if common is None else f"{task.classes[common]} {100 * (labels == common).mean():.1f} %")
        table.add_row(split, str(len(rows)), str(len(set(pack.column("group")[rows]))), *cells)
    console = Console()
    console.print(table)
    console.print(f"source {pack.spec.source}; licence {pack.spec.licence}", soft_wrap=True, highlight=False)


# -- pretrain, probe, report ------------------------------------------------------------------------------------------


def _selectors(argv: list[str], names: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take the plain selectors out of ``argv``; what is left is for the chosen things' own fields."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in names:
        parser.add_argument(name, dest=name)
    try:
        found, rest = parser.parse_known_args(argv)
    except argparse.ArgumentError as error:
        raise ValueError(f"{error.argument_name}: expected a value after it") from None
    return {name: value for name, value in vars(found).items() if value is not None}, rest


def pretrain(argv: list[str]) -> None:
    """mvitac pretrain --method M --data D --recipe R [--from run.json] [fields] --out DIR [--resume]"""
    chosen, rest = _selectors(argv, ("--method", "--data", "--recipe", "--from", "--sink"))
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.datasets import DatasetConfig
    from mvitac.methods import MethodConfig
    from mvitac.model import read_record
    from mvitac.recipes import RECIPES, recipe
    from mvitac.registry import default
    from mvitac.run import Run
    from mvitac.sinks import open_sinks
    from mvitac.train import train

    if "--from" in chosen:
        for name in ("--method", "--data", "--recipe"):
            if name in chosen:
                raise ValueError(f"--from already decides {name}: leave it out, or change single fields")
        base, _ = read_record(Path(chosen["--from"]))
    else:
        data = default(DatasetConfig, chosen.get("--data", "materials"))
        base = recipe(chosen.get("--recipe", "demo"), data)
        method = chosen.get("--method", base.method.name)
        if method != base.method.name:
            base = replace(base, method=default(MethodConfig, method))

    @dataclass(frozen=True, kw_only=True)
    class Options:
        run: Annotated[Run, tyro.conf.arg(name="")] = base
        out: Path = Path("runs") / f"{base.data.name}-{base.method.name}-{base.recipe}"
        """Folder of the run."""
        resume: bool = False
        """Continue the run in --out from its last checkpoint."""
        quiet: bool = False
        """No progress bar."""

    Options.__doc__ = f"""Pre-train encoders without labels.

    First choose, then change single fields below (defaults are the chosen recipe's):
      --recipe {"|".join(RECIPES)}  (default demo)
      --data {"|".join(DatasetConfig.choices)}  (default materials)
      --method {"|".join(MethodConfig.choices)}  (default mvitac)
      --from RUN.JSON   repeat a recorded run instead
      --sink tensorboard|wandb|trackio   also log there (extras; none by default)
    """
    options = parse(Options, rest, "pretrain")
    console = Console()
    with open_sinks(chosen.get("--sink"), options.out, options.run) as sinks:
        out = train(options.run, options.out, resume=options.resume, quiet=options.quiet, sinks=sinks)
    console.print(f"trained: {out}\nnext: mvitac probe {out}", soft_wrap=True, highlight=False)


def probe(argv: list[str]) -> None:
    """mvitac probe RUN... [--data-pack DIR] [--json FILE]"""
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.pack import Pack
    from mvitac.probe import Session, probe_runs, summarise
    from mvitac.record import check_place, write_json
    from mvitac.tables import print_retrieval, print_summary

    @dataclass(frozen=True, kw_only=True)
    class Options:
        """Score frozen features by linear probes, kNN and retrieval, each beside its controls."""

        runs: tyro.conf.Positional[tuple[Path, ...]]
        """Folders of finished runs: seeds of one method, or several methods, on the same data."""
        session: Annotated[Session, tyro.conf.arg(name="")] = Session()
        on: Path | None = None
        """Probe on this pack instead of the data the runs were trained on."""
        json: Path | None = None
        """Also write everything that is printed, and more, to this file."""

    options = parse(Options, argv, "probe")
    if options.json:
        check_place(options.json)
        if options.json.is_dir():
            raise ValueError(f"--json {options.json} is a folder: give another name, of a file")
    result = probe_runs(options.runs, options.session, Pack(options.on) if options.on else None)
    console = Console()
    for kind in options.session.probes:
        print_summary({**result, "summary": summarise(result["records"], kind)}, console, probe=kind)
    print_retrieval(result, console)
    if options.json:
        write_json(options.json, result)
        console.print(f"written: {options.json}", soft_wrap=True, highlight=False)


def demo(argv: list[str]) -> None:
    """mvitac demo [--out DIR] [--seeds N] [--resume]"""
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.demo import run_demo
    from mvitac.recipes import recipe
    from mvitac.run import Run

    @dataclass(frozen=True, kw_only=True)
    class Options:
        """The whole road on simulated materials: simulate, pre-train, probe, report. A second call goes on where the
        first stopped."""

        out: Path = Path("runs/demo")
        """Folder of the demo: one run per seed, summary.json, report."""
        seeds: int = 3
        """How many times to pre-train, each from its own seed."""
        run: Annotated[Run, tyro.conf.arg(name="")] = recipe("demo")

    options = parse(Options, argv, "demo")
    run_demo(options.run, options.out, options.seeds, Console())


def report(argv: list[str]) -> None:
    """mvitac report RUN... [--out DIR] [--probe FILE.json]"""
    import tyro
    from rich.console import Console

    from mvitac.record import read_json
    from mvitac.report import write_report

    @dataclass(frozen=True, kw_only=True)
    class Options:
        """One self-contained HTML page about finished runs, and its figures as PNG."""

        runs: tyro.conf.Positional[tuple[Path, ...]]
        """Folders of finished runs: seeds of one method, or several methods, on the same data."""
        out: Path | None = None
        """Folder of the page (default: report inside the run's folder; runs/report for several runs)."""
        probe: Path | None = None
        """What `mvitac probe RUN... --json FILE` wrote; without it the runs are probed now."""
        quiet: bool = False
        """No progress."""

    options = parse(Options, argv, "report")
    result = read_json(options.probe, "a probe result") if options.probe else None
    out = options.out or (options.runs[0] / "report" if len(options.runs) == 1 else Path("runs") / "report")
    written = write_report(options.runs, out, result=result, quiet=options.quiet)
    Console().print(f"written: {written}", soft_wrap=True, highlight=False)


COMMANDS: dict[str, Callable[[list[str]], None]] = {
    "demo": demo,
    "data simulate": data_simulate,
    "data pack": data_pack,
    "data info": data_info,
    "data sheet": data_sheet,
    "pretrain": pretrain,
    "probe": probe,
    "report": report,
}
