"""``mvitac finetune`` and ``mvitac adapt``."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional

from mvitac.cli.options import asks_help, parse, selectors
from mvitac.datasets.base import DatasetConfig
from mvitac.experiments.adapt import Adaptation
from mvitac.experiments.adapt import adapt as run_adapt
from mvitac.experiments.finetune import Finetuning
from mvitac.experiments.finetune import finetune as run_finetune
from mvitac.registry import default
from mvitac.report.tables import print_adaptation, print_finetuning
from mvitac.system.console import Console


@dataclass(frozen=True, kw_only=True)
class _Options:
    model: Positional[Path]
    """Folder of a finished run, or of an artifact."""
    data: DatasetConfig
    out: Path
    """Folder of the result."""
    resume: bool = False
    """Continue in --out after an interruption."""
    quiet: bool = False
    """No progress bar."""


@dataclass(frozen=True, kw_only=True)
class _FinetuneOptions(_Options):
    config: Annotated[Finetuning, tyro.conf.arg(name="")] = Finetuning()


@dataclass(frozen=True, kw_only=True)
class _AdaptOptions(_Options):
    config: Annotated[Adaptation, tyro.conf.arg(name="")] = Adaptation()


def _parsed(kind: type[Any], argv: list[str], name: str, description: str) -> Any:
    """The options of ``mvitac <name> MODEL --data D``."""
    chosen, rest = selectors(argv, ("--data",))
    names = "|".join(DatasetConfig.choices)
    if "--data" not in chosen and not asks_help(rest):
        raise ValueError(f"name the data: --data {names}")
    data = default(DatasetConfig, chosen.get("--data", "pack"))
    usual = kind(model=Path("MODEL"), data=data, out=Path("runs") / f"{name.removesuffix('e')}ed")
    options = parse(kind, rest, name, default=usual, description=f"{description}\n\n  --data {names}  (required)")
    if options.model == usual.model:
        raise ValueError(f"name the model: the folder of a run or an artifact (see mvitac {name} --help)")
    return options


def finetune(argv: list[str]) -> None:
    """mvitac finetune MODEL --data D [--labels TASK...] [--values TASK...] [--train PART] --out DIR"""
    about = (
        "Train a model's encoders with labels. Settings are chosen on held-out groups of train. Training from random weights"
        " and a linear probe on the frozen encoders get the same labels."
    )
    options = _parsed(_FinetuneOptions, argv, "finetune", about)
    console = Console(markup=False, highlight=False)
    say = partial(console.print, soft_wrap=True)
    arguments = (options.model, options.data, options.config, options.out)
    result = run_finetune(*arguments, resume=options.resume, quiet=options.quiet, say=say)
    print_finetuning(result, console)
    say(f"scores: {options.out / 'scores.json'}\nnext: mvitac publish {result['models'][-1]} ARTIFACT")


def adapt(argv: list[str]) -> None:
    """mvitac adapt MODEL --data D [--steps N] [--old PACK] --out DIR"""
    about = (
        "Adapt a model to data of a new sensor without labels: new statistics of BatchNorm, then a few steps of its own"
        " method. Prints what it gains on the new data and what it forgets of the old."
    )
    options = _parsed(_AdaptOptions, argv, "adapt", about)
    console = Console(markup=False, highlight=False)
    say = partial(console.print, soft_wrap=True)
    arguments = (options.model, options.data, options.config, options.out)
    print_adaptation(run_adapt(*arguments, resume=options.resume, quiet=options.quiet, say=say), console)
    say(f"scores: {options.out / 'adapted.json'}\nnext: mvitac probe {options.out}")
