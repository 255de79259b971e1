"""``mvitac finetune`` and ``mvitac adapt``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from mvitac.cli.options import asks_help, parse, selectors
from mvitac.datasets.base import DatasetConfig
from mvitac.experiments.finetune import Finetuning
from mvitac.experiments.finetune import finetune as run_finetune
from mvitac.registry import default
from mvitac.report.tables import print_finetuning
from mvitac.system.console import Console
from mvitac.system.progress import shown


@dataclass(frozen=True, kw_only=True)
class _FinetuneOptions:
    model: Positional[Path]
    """Folder of a finished run, or of an artifact."""
    data: DatasetConfig
    config: Annotated[Finetuning, tyro.conf.arg(name="")] = Finetuning()
    out: Path
    """Folder for the models (seed0, seed1, ...) and scores.json."""
    resume: bool = False
    """Continue in --out after an interruption."""


def finetune(argv: list[str]) -> None:
    """mvitac finetune MODEL --data D [--labels TASK...] [--values TASK...] [--train PART] --out DIR"""
    chosen, rest = selectors(argv, ("--data",))
    description = f"""Train a model's encoders with labels. Learning rate, length and start of the heads are chosen on held-out
    groups of train. The same labels from random weights, and a linear probe on the frozen encoders, stand beside the result.

      --data {"|".join(DatasetConfig.choices)}  (required)
    """
    if "--data" not in chosen and not asks_help(rest):
        raise ValueError(f"name the labelled data: --data {'|'.join(DatasetConfig.choices)}")
    usual = _FinetuneOptions(
        model=Path("MODEL"), data=default(DatasetConfig, chosen.get("--data", "pack")), out=Path("runs/finetuned")
    )
    options = parse(_FinetuneOptions, rest, "finetune", default=usual, description=description)
    if options.model == usual.model:
        raise ValueError("name the model to fine-tune: the folder of a run or an artifact (see mvitac finetune --help)")
    console = Console(markup=False, highlight=False)
    with shown(Console(stderr=True)):
        result = run_finetune(
            options.model, options.data, options.config, options.out, resume=options.resume, say=console.print
        )
    print_finetuning(result, console)
    model = options.out / "seed0"
    console.print(f"scores: {options.out / 'scores.json'}\nnext: mvitac publish {model} ARTIFACT", soft_wrap=True)
