"""``mvitac finetune``."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional

from mvitac.cli.options import asks_help, parse, selectors
from mvitac.datasets.base import DatasetConfig, dataset
from mvitac.evaluation.intervals import MIN_GROUPS, num_groups_of, paired_difference
from mvitac.experiments.finetune import FROZEN, TUNED, Finetuning
from mvitac.experiments.finetune import finetune as run_finetune
from mvitac.report.tables import print_finetuning


@dataclass(frozen=True, kw_only=True)
class _Options:
    model: Positional[Path]
    """Folder of a finished run or an artifact; imagenet, imagenet:TRUNK, or TRUNK=FILE: weights of a trunk of timm."""
    data: DatasetConfig
    config: Annotated[Finetuning, tyro.conf.arg(name="")] = Finetuning()
    out: Path = Path("runs/finetuned")
    """Folder of the result."""
    resume: bool = False
    """Continue in --out after an interruption."""
    quiet: bool = False
    """No progress bar."""


def finetune(argv: list[str]) -> None:
    chosen, rest = selectors(argv, ("--data",))
    names = "|".join(DatasetConfig.choices)
    if "--data" not in chosen and not asks_help(rest):
        raise ValueError(f"name the data: --data {names}")
    usual = _Options(model=tyro.MISSING, data=dataset(chosen.get("--data", "pack")))
    about = f"""Train a model's encoders with labels. Settings are chosen on held-out groups of train. Training from random
    weights and a linear probe on the frozen encoders get the same labels.

      --data {names}  (required; or a path)
    """
    options = parse(_Options, rest, "finetune", default=usual, description=about)
    given = options.model, options.data, options.config, options.out
    result = run_finetune(*given, resume=options.resume, quiet=options.quiet)
    print_finetuning(result)
    print(f"scores: {options.out / 'scores.json'}", next_step(result, options.config.fractions[-1]), sep="\n")


def next_step(result: dict[str, Any], fraction: float) -> str:
    """What to do with the models of ``fraction`` percent of the labels: publish them only if a gain is sure."""
    last = [record for record in result["records"] if record["fraction"] == fraction]
    if (num := min(map(num_groups_of, last))) < MIN_GROUPS:
        by = result["group_by"]
        return f"whether fine-tuning gained cannot be told with under {MIN_GROUPS} {by}s in test ({num}): label more of them"
    gains = []
    for task in dict.fromkeys(record["task"] for record in last):
        ours, theirs = ([r for r in last if (r["task"], r["source"]) == (task, name)] for name in (TUNED, FROZEN))
        gains.append(paired_difference(ours, theirs))
    if any(low > 0 for _, low, *_ in gains) and not any(high < 0 for _, _, high, _ in gains):
        model = shlex.quote(str(result["models"][-1]))
        return f"next: mvitac publish {model} ARTIFACT\n  (it fits probes of its own, on all labels)"
    return "no gain over the frozen probe is sure: keep the model as it is, and publish or probe that"
