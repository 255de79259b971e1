"""``mvitac bench``, ``mvitac bench board`` and ``mvitac bench check``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tabulate import tabulate
from tyro.conf import Positional

from mvitac.bench.board import write_board
from mvitac.bench.check import problems
from mvitac.bench.encoder import About, run_bench
from mvitac.bench.result import read_result, records_of
from mvitac.bench.suite import find_suite, shipped
from mvitac.cli.options import check_json, parse
from mvitac.control import result as loop
from mvitac.evaluation.leaks import leaks_of
from mvitac.evaluation.scores import summarise
from mvitac.registry import check_known
from mvitac.report.tables import print_summary
from mvitac.system.files import fields_of
from mvitac.system.progress import shown


@dataclass(frozen=True, kw_only=True)
class _Options:
    models: Positional[tuple[str, ...]]
    """The encoder: the folder of a run or an artifact, or an id on the Hub; several are seeds of one encoder."""
    suite: str
    """Name of a suite, or a TOML file of a suite of tasks."""
    out: Path = Path("results")
    """Folder of results. An interrupted bench continues from <out>/parts."""
    data_root: Path | None = None
    """Folder with the clones or manifests of real data (docs/bench.md). What is not there is marked "not run"."""
    about: Annotated[About, tyro.conf.arg(name="")] = About()


@dataclass(frozen=True, kw_only=True)
class _CheckOptions:
    """Check results: digests, the suite inside, no score missing, sums per test group that predictions can give."""

    files: Positional[tuple[Path, ...]]
    """Results that `mvitac bench MODEL` wrote."""

    def __post_init__(self) -> None:
        if not self.files:
            raise ValueError("name the results: files that `mvitac bench MODEL` wrote")


@dataclass(frozen=True, kw_only=True)
class _BoardOptions(_CheckOptions):
    """Write one page that compares results of one suite: tasks down, encoders across, controls last."""

    out: Path = Path("board.html")
    """The page, one file without scripts."""


_MANUAL = """Score an encoder on every task of a suite, beside the same controls, and write one JSON file about it.

    Suites: {suites}. `mvitac bench board FILE...` makes a page of results, `mvitac bench check FILE...` checks them.
    """


def bench(argv: list[str]) -> None:
    suites = [*shipped(), *loop.shipped()]
    options = parse(_Options, argv, "bench", description=_MANUAL.format(suites=", ".join(suites)))
    if not options.models:
        raise ValueError("name the encoder: the folder of a run or an artifact (see mvitac bench --help)")
    if not options.suite.endswith(".toml"):
        check_known("suite", [options.suite], [*suites, "FILE.toml"])
    suite = None if options.suite in loop.shipped() else find_suite(options.suite)
    if options.data_root and not (suite and any(form.at for one in suite.sets for form in one.forms)):
        raise ValueError(f"--data-root has no effect on {options.suite}, which is simulated: leave it out")
    if not suite:
        with shown():
            path = loop.run_suite(options.models, loop.find_suite(options.suite), options.out, options.about)
        own, value = loop.read_control(path)
        for condition, (columns, rows) in loop.tables(own, [value]).items():
            print(f"{own.name}, {condition}\n{tabulate(rows, columns)}\n")
        print(f"{loop.note(own, [value])}\nwritten: {path}")
        return
    with shown():
        path = run_bench(options.models, suite, options.out, options.data_root, options.about)
    result = read_result(path)
    for block in result["blocks"]:
        if "not_run" in block:
            print(f"{block['set']}, {block['task']}: not run, {block['not_run']}")
            continue
        records = records_of(block, result["encoder"])
        shown_ = {"data": block["set"], "group_by": block["group_by"], "summary": summarise(records, suite.probes[0])}
        print_summary({**shown_, "leaks": leaks_of(records)})
    print(f"written: {path} (digest {result['digest'][:16]})")


def board(argv: list[str]) -> None:
    options = parse(_BoardOptions, argv, "bench board")
    check_json(options.out, "--out")
    write = loop.write_page if loop.is_result(options.files[0]) else write_board
    print(f"written: {write(options.files, options.out)}")


def check(argv: list[str]) -> None:
    for path in parse(_CheckOptions, argv, "bench check").files:
        if loop.is_result(path):
            _, value = loop.read_control(path)
            print(f"{path}: {value['encoder']['name']} on {value['suite']['name']}: {len(value['rows'])} rows hold")
            continue
        with fields_of(path):
            found = problems(result := read_result(path))
        if found:
            raise ValueError(f"{path}: {found[0]}" + f" (and {len(found) - 1} more)" * (len(found) > 1))
        num = sum(len(block.get("records", ())) for block in result["blocks"])
        print(f"{path}: {result['encoder']['name']} on {result['suite']['name']}, {num} scores are those of its sums")
