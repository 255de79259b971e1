"""``mvitac demo``, ``pretrain``, ``probe`` and ``report``: the main road."""

from dataclasses import dataclass
from pathlib import Path

from mvitac.options import parse, selectors


def pretrain(argv: list[str]) -> None:
    """mvitac pretrain --method M --data D --recipe R [--from run.json] [fields] --out DIR [--resume]"""
    chosen, rest = selectors(argv, ("--method", "--data", "--recipe", "--from", "--sink"))
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.datasets import DatasetConfig
    from mvitac.methods import MethodConfig
    from mvitac.model import read_record
    from mvitac.recipes import RECIPES, recipe, with_method
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
        base = with_method(base, chosen.get("--method", base.method.name))

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
    console = Console(markup=False)
    with open_sinks(chosen.get("--sink"), options.out, options.run) as sinks:
        out = train(options.run, options.out, resume=options.resume, quiet=options.quiet, sinks=sinks)
    console.print(f"trained: {out}\nnext: mvitac probe {out}", soft_wrap=True, highlight=False)


def probe(argv: list[str]) -> None:
    """mvitac probe RUN... [--on PACK] [--learn-on PACK] [--json FILE]"""
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.model import load
    from mvitac.pack import Pack
    from mvitac.record import check_place, write_json
    from mvitac.scores import summarise
    from mvitac.session import END_TO_END, Session, chosen, probe_runs
    from mvitac.stress import STRESSES, stress
    from mvitac.tables import print_retrieval, print_summary
    from mvitac.transfer import Transfer

    @dataclass(frozen=True, kw_only=True)
    class Options:
        """Score frozen features by linear probes, kNN and retrieval, each beside its controls."""

        runs: tyro.conf.Positional[tuple[Path, ...]]
        """Folders of finished runs: seeds of one method, or several methods, on the same data."""
        session: Annotated[Session, tyro.conf.arg(name="")] = Session()
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
        pack = Transfer(Pack(options.learn_on), pack)
    result = probe_runs(options.runs, options.session, pack)
    console, worse = Console(markup=False), []
    names = {r["run"]: r["source"].removesuffix(END_TO_END) for r in result["records"] if "run" in r}
    for i, path in enumerate(options.runs if options.stress else (), start=1):
        console.print(
            f"few labels, noise, missing modalities, leaks: run {i} of {len(options.runs)} ...", highlight=False
        )
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
        seeds: int = 2
        """How many times to pre-train, each from its own seed."""
        run: Annotated[Run, tyro.conf.arg(name="")] = recipe("demo")

    options = parse(Options, argv, "demo")
    run_demo(options.run, options.out, options.seeds, Console(markup=False))


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
    Console(markup=False).print(f"written: {written}", soft_wrap=True, highlight=False)
