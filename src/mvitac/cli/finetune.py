"""``mvitac finetune`` and ``mvitac adapt``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional

from mvitac.cli.options import asks_help, parse, selectors
from mvitac.datasets.base import DatasetConfig, dataset
from mvitac.experiments.adapt import Adaptation
from mvitac.experiments.adapt import adapt as run_adapt
from mvitac.experiments.finetune import Finetuning
from mvitac.experiments.finetune import finetune as run_finetune
from mvitac.report.tables import print_adaptation, print_finetuning


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
    model: Positional[Path]
    """Folder of a finished run, or of an artifact; imagenet, or imagenet:TRUNK; or TRUNK=FILE, other weights of a trunk of
    timm."""
    config: Annotated[Finetuning, tyro.conf.arg(name="")] = Finetuning()


@dataclass(frozen=True, kw_only=True)
class _AdaptOptions(_Options):
    config: Annotated[Adaptation, tyro.conf.arg(name="")] = Adaptation()


def _run(kind: type[Any], work: Any, show: Any, argv: list[str], name: str, about: str) -> tuple[Any, dict[str, Any]]:
    """Parse ``mvitac <name> MODEL --data D``, do the ``work`` and ``show`` its result; return options and result."""
    chosen, rest = selectors(argv, ("--data",))
    names = "|".join(DatasetConfig.choices)
    if "--data" not in chosen and not asks_help(rest):
        raise ValueError(f"name the data: --data {names}")
    data = dataset(chosen.get("--data", "pack"))
    usual = kind(model=Path("MODEL"), data=data, out=Path("runs") / f"{name.removesuffix('e')}ed")
    options = parse(kind, rest, name, default=usual, description=f"{about}\n\n  --data {names}  (required; or a path)")
    if options.model == usual.model:
        raise ValueError(f"name the model: the folder of a run or an artifact, or imagenet (see mvitac {name} --help)")
    more = {"resume": options.resume, "quiet": options.quiet, "say": print}
    result = work(options.model, options.data, options.config, options.out, **more)
    show(result)
    return options, result


def finetune(argv: list[str]) -> None:
    """mvitac finetune MODEL --data D [--labels TASK...] [--values TASK...] [--train PART] --out DIR"""
    about = (
        "Train a model's encoders with labels. Settings are chosen on held-out groups of train. Training from random weights"
        " and a linear probe on the frozen encoders get the same labels."
    )
    options, result = _run(_FinetuneOptions, run_finetune, print_finetuning, argv, "finetune", about)
    print(f"scores: {options.out / 'scores.json'}\nnext: mvitac publish {result['models'][-1]} ARTIFACT")


def adapt(argv: list[str]) -> None:
    """mvitac adapt MODEL --data D [--steps N] [--old PACK] --out DIR"""
    about = (
        "Adapt a model to data of a new sensor without labels, by a few steps of its own method. Prints what it gains on the"
        " new data and what it forgets of the old."
    )
    options, _ = _run(_AdaptOptions, run_adapt, print_adaptation, argv, "adapt", about)
    print(f"scores: {options.out / 'adapted.json'}\nnext: mvitac probe {options.out}")
