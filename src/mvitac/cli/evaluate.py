"""``mvitac probe`` and ``mvitac report``."""

from dataclasses import dataclass
from pathlib import Path

from mvitac.cli.options import parse


def probe(argv: list[str]) -> None:
    """mvitac probe RUN... [--on PACK] [--learn-on PACK] [--json FILE]"""
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.data.joined_pack import JoinedPack
    from mvitac.data.pack import Pack
    from mvitac.evaluation.evaluate import END_TO_END, ProbeConfig, chosen, probe_runs
    from mvitac.evaluation.robustness import STRESSES, stress
    from mvitac.evaluation.scores import summarise
    from mvitac.model import load
    from mvitac.report.tables import print_retrieval, print_summary
    from mvitac.system.files import check_place, write_json
    from mvitac.system.progress import shown, work

    @dataclass(frozen=True, kw_only=True)
    class Options:
        """Score frozen features by linear probes, kNN and retrieval, each beside its controls."""

        runs: tyro.conf.Positional[tuple[Path, ...]]
        """Folders of finished runs: seeds of one method, or several methods, on the same data."""
        session: Annotated[ProbeConfig, tyro.conf.arg(name="")] = ProbeConfig()
        on: Path | None = None
        """Probe on this pack instead of the data the runs were trained on."""
        learn_on: Path | None = None
        """The probes learn from this pack's train rows, and only meet the test rows of --on: what they are worth on a
        sensor that nobody labelled anything of."""
        stress: bool = False
        """Also learn from 1 % and 10 % of the labels, score noisy test images and a modality missing at test time, and say
        what a split that leaks groups would add."""
        json: Path | None = None
        """Also write everything that is printed, and more, to this file."""

    options = parse(Options, argv, "probe")
    if options.json:
        check_place(options.json)
        if options.json.is_dir():
            raise ValueError(f"--json {options.json} is a folder: give another name, of a file")
    pack = Pack(options.on) if options.on else None
    if options.learn_on:
        if not pack:
            raise ValueError("--learn-on says what probes learn from: say with --on which pack they are scored on")
        pack = JoinedPack(Pack(options.learn_on), pack)
    with shown(Console(stderr=True)):
        result = probe_runs(options.runs, options.session, pack)
    console, worse = Console(markup=False), []
    names = {r["run"]: r["source"].removesuffix(END_TO_END) for r in result["records"] if "run" in r}
    for i, path in enumerate(options.runs if options.stress else (), start=1):
        what = f"few labels, noise, missing modalities, leaks: run {i} of {len(options.runs)}"
        with shown(Console(stderr=True)), work(what):
            model = load(path)
            where = pack or model.run.data.open()
            own = {"source": names.get(str(path), ""), "seed": model.run.seed, "run": str(path)}
            worse += [{**own, **r} for r in stress(model, where, *chosen(where, options.session))]
    for kind in options.session.probes:
        print_summary({**result, "summary": summarise(result["records"], kind)}, console, probe=kind)
    for kind in STRESSES:
        mine = [r for r in worse if r["probe"] == kind]
        if mine:
            majority = [r for r in result["records"] if r["source"] == "majority"]
            print_summary({**result, "summary": summarise(mine + majority, kind)}, console, probe=kind)
    print_retrieval(result, console)
    result["records"] += worse
    if options.json:
        write_json(options.json, result)
        console.print(f"written: {options.json}", soft_wrap=True, highlight=False)


def report(argv: list[str]) -> None:
    """mvitac report RUN... [--out DIR] [--probe FILE.json]"""
    import tyro
    from rich.console import Console

    from mvitac.report.report import write_report
    from mvitac.system.files import read_json

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
    Console(markup=False).print(f"written: {written}", soft_wrap=True, highlight=False)
