"""``mvitac demo``."""

from dataclasses import dataclass
from pathlib import Path

from mvitac.cli.options import parse


def demo(argv: list[str]) -> None:
    """mvitac demo [--out DIR] [--seeds N] [--resume]"""
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.experiments.demo import run_demo
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
