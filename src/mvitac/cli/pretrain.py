"""``mvitac pretrain``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mvitac.cli.options import asks_help, parse, selectors
from mvitac.datasets.base import DatasetConfig
from mvitac.methods.base import MethodConfig
from mvitac.recipes import RECIPES, recipe, with_method
from mvitac.registry import default
from mvitac.run import Run, read_record
from mvitac.training.log import LOGGERS, open_loggers
from mvitac.training.loop import train


@dataclass(frozen=True, kw_only=True)
class _Options:
    run: Annotated[Run, tyro.conf.arg(name="")]
    out: Path
    """Folder of the run."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint."""
    quiet: bool = False
    """No progress bar."""


def pretrain(argv: list[str]) -> None:
    """mvitac pretrain --data D|--from run.json [--method M] [--recipe R] [fields] --out DIR [--resume]"""
    chosen, rest = selectors(argv, ("--method", "--data", "--recipe", "--from", "--logger", "--sink"))
    if "--sink" in chosen:  # the name of --logger in 0.1.0
        chosen.setdefault("--logger", chosen["--sink"])
    base = _chosen_run(chosen, asks_help(rest))
    description = f"""Pre-train encoders without labels.

    First choose, then change single fields below (defaults are those of the chosen recipe):
      --recipe {"|".join(RECIPES)}  (default demo)
      --data {"|".join(DatasetConfig.choices)}  (required)
      --method {"|".join(MethodConfig.choices)}  (default mvitac)
      --from RUN.JSON   repeat a recorded run instead
      --logger {"|".join(LOGGERS)}   also log there (extras; none by default)
    """
    usual = _Options(run=base, out=Path("runs") / f"{base.data.name}-{base.method.name}-{base.recipe}")
    options = parse(_Options, rest, "pretrain", default=usual, description=description)
    with open_loggers(chosen.get("--logger"), options.out, options.run) as loggers:
        out = train(options.run, options.out, resume=options.resume, quiet=options.quiet, loggers=loggers)
    print(f"trained: {out}\nnext: mvitac probe {out}")


def _chosen_run(chosen: dict[str, str], help_only: bool) -> Run:
    """The run before single fields are changed: a recorded one, or a recipe with its data and method."""
    if "--from" in chosen:
        for name in ("--method", "--data", "--recipe"):
            if name in chosen:
                raise ValueError(f"--from already decides {name}: leave it out, or change single fields")
        return read_record(Path(chosen["--from"]))[0]
    base = recipe(chosen.get("--recipe", "demo"), default(DatasetConfig, chosen.get("--data", "materials")))
    base = with_method(base, chosen.get("--method", base.method.name))
    if "--data" not in chosen and not help_only:
        raise ValueError(
            f"name the data to learn from: --data {'|'.join(DatasetConfig.choices)} (or --from RUN.JSON); without data of"
            " your own: mvitac demo, or mvitac pretrain --data materials --recipe demo, which simulates"
        )
    return base
