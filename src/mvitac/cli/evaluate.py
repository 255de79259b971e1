"""``mvitac probe`` and ``mvitac report``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from mvitac.cli.options import check_json, check_models, loading, parse, printed_to, save_json
from mvitac.data.pack import Pack
from mvitac.data.several import JoinedPack
from mvitac.evaluation.probe_config import ProbeConfig
from mvitac.shipped import BASE
from mvitac.system.progress import shown


@dataclass(frozen=True, kw_only=True)
class _ProbeOptions:
    """Score frozen features by linear probes, kNN and retrieval, each next to its controls."""

    runs: Positional[tuple[Path, ...]] = ()
    """Folder of each finished run: seeds of one method, or several methods, on the same data."""
    encoder: tuple[str, ...] = ()
    """Other people's encoders to probe on --on: external:timm/NAME, external:python:MODULE:FUNCTION (docs/bench.md)."""
    config: Annotated[ProbeConfig, tyro.conf.arg(name="")] = ProbeConfig()
    on: Path | None = None
    """Probe on this pack instead of the data the runs were trained on."""
    learn_on: Path | None = None
    """Fit the probes on train and val of this pack, score them on the test rows of --on: transfer without labels."""
    allow_leak: bool = False
    """Score a run also on rows or groups of --on that it was trained on. LEAK stands beside every such score."""
    per_class: bool = False
    """Also print precision, recall, rows and groups of each class."""
    weights: Literal["last", "best"] = "last"
    """Weights after the last step, or the best on split val, which training keeps with --eval-every."""
    json: Path | None = None
    """Also write everything that is printed, and more, to this file; - = stdout, and the tables to stderr."""


def probe(argv: list[str]) -> None:
    options = parse(_ProbeOptions, argv, "probe")
    check_json(options.json)
    check_models(*options.runs)
    if not options.runs and (options.weights != "last" or options.allow_leak):
        idle = "--allow-leak" if options.allow_leak else f"--weights {options.weights}"
        raise ValueError(f"{idle} is of runs: name one, or leave it out")
    loading()
    from mvitac.evaluation.encoders import about_lines
    from mvitac.evaluation.evaluate import probe_runs
    from mvitac.evaluation.scores import summarise_again
    from mvitac.evaluation.sensors import RecolouredPack
    from mvitac.report.tables import print_classes, print_retrieval, print_summary

    pack = Pack(options.on) if options.on else None
    if options.learn_on:
        if not pack:
            raise ValueError("--learn-on fits the probes: name the pack on which they are scored, --on PACK")
        if options.config.folds:
            raise ValueError("--folds fits and scores on one pack: leave --learn-on out")
        join = RecolouredPack if "colours" in options.config.standardise else JoinedPack
        pack = join(Pack(options.learn_on), pack, options.config.tasks)
    elif "colours" in options.config.standardise:
        raise ValueError("--standardise colours shows a new sensor as one of --learn-on: name that pack as well")
    with shown():
        more = {"allow_leak": options.allow_leak, "weights": options.weights, "encoders": options.encoder}
        result = probe_runs(options.runs, options.config, pack, **more)
    say = printed_to(options.json)
    print_summary(result, say, probe=options.config.probes[0])
    for kind in options.config.kinds[1:]:
        print_summary({**result, "summary": summarise_again(result["records"], kind)}, say, probe=kind)
    if options.per_class:
        print_classes(result, say)
    for line in about_lines(result["encoders"]):
        print(f"encoder: {line}", file=say)
    print_retrieval(result, say)
    for line in result.get("statistics", ()):
        print(line, file=say)
    save_json(options.json, result, sealed=True)


@dataclass(frozen=True, kw_only=True)
class _ReportOptions:
    """One self-contained HTML page about finished runs, and its figures as PNG. Scores are those that `mvitac probe RUN...`
    left in the first run's folder (probe.json); if they are missing or incomplete, the runs are probed now."""

    runs: Positional[tuple[Path, ...]]
    """Folder of each finished run: seeds of one method, or several methods, on the same data."""
    out: Path | None = None
    """Folder of the page (default: report inside the run's folder; runs/report for several runs)."""
    quiet: bool = False
    """No progress."""


def report(argv: list[str]) -> None:
    options = parse(_ReportOptions, argv, "report")
    check_models(*options.runs)
    loading()
    from mvitac.report.report import write_report

    alone = len(options.runs) == 1 and options.runs != (BASE,)  # nothing is written into the package
    out = options.out or (options.runs[0] / "report" if alone else Path("runs") / "report")
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file: give a folder")
    print(f"written: {write_report(options.runs, out, quiet=options.quiet)}")
