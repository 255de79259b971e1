"""``mvitac pretrain``."""

import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from mvitac.cli.options import asks_help, parse, selectors
from mvitac.datasets.base import DatasetConfig, dataset
from mvitac.methods.base import MethodConfig
from mvitac.recipes import RECIPES, recipe, with_method
from mvitac.run import Run, load_run
from mvitac.system.distributed import join
from mvitac.training.log import LOGGERS, open_loggers
from mvitac.training.loop import train
from mvitac.training.setup import check_out, check_start, open_pack


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
    chosen, rest = selectors(argv, ("--method", "--data", "--recipe", "--from", "--logger"))
    base = _chosen_run(chosen, rest, phased=False)
    if not asks_help(rest) and not {"--data", "--from"} & chosen.keys():
        names = "|".join(DatasetConfig.choices)
        raise ValueError(f"name the data: --data {names}, a path, or --from RUN.JSON; without any: mvitac demo")
    description = f"""Pre-train encoders, by a method without labels or a supervised one.

    First choose, then change single fields below (defaults are those of the chosen recipe):
      --recipe {"|".join(RECIPES)}  (default quick)
      --data {"|".join(DatasetConfig.choices)}  (required; or the path of a pack, a table or a folder)
      --method {"|".join(MethodConfig.choices)}  (default mvitac)
      --from RUN.JSON   repeat a recorded run instead
      --init RUN        start from its weights (also an artifact)
      --logger {"|".join(LOGGERS)}   also log there (extras; none by default)
    """
    usual = _Options(run=base, out=Path("runs") / f"{base.data.name}-{base.method.name}-{base.recipe}")
    options, pack = parse(_Options, rest, "pretrain", default=usual, description=description), None
    if "--from" in chosen or base.data.phased is None:
        check_out(options.out, options.resume)
        check_start(options.run, options.out)
        pack = open_pack(options.run.data, join(), options.quiet)
    if pack and "--from" in chosen:
        known = load_run(Path(chosen["--from"]))[1].get("pack", pack.digest)
        if pack.digest != known and options.run.data == base.data and not options.resume:  # which refuses it
            print(f"mvitac: warning: its data is not that of {chosen['--from']} any more", file=sys.stderr)
    elif pack:  # the recipe depends on what the opened data says
        options = parse(_Options, rest, "pretrain", default=replace(usual, run=_chosen_run(chosen, rest, pack.phased)))
    with open_loggers(chosen.get("--logger"), options.out, options.run) as loggers:
        out = train(options.run, options.out, resume=options.resume, quiet=options.quiet, loggers=loggers, pack=pack)
    data = load_run(out)[1].get("data", {})
    known = "probe" if data.get("tasks") or data.get("values") else "report"
    print(f"trained: {out}\nnext: mvitac {known} {shlex.quote(str(out))}")


def _chosen_run(chosen: dict[str, str], rest: list[str], phased: bool) -> Run:
    """The run before single fields are changed: a recorded one, or a recipe with its data and method. ``phased`` is for
    data that does not know it before it is opened. ``--epochs`` in ``rest`` replaces the recipe's steps."""
    if "--from" in chosen:
        for name in ("--method", "--data", "--recipe"):
            if name in chosen:
                raise ValueError(f"--from already decides {name}: leave it out, or change single fields")
        run = load_run(Path(chosen["--from"]))[0]
    else:
        data = dataset(chosen.get("--data", "materials"))
        base = recipe(chosen.get("--recipe", "quick"), data, phased if data.phased is None else data.phased)
        run = with_method(base, chosen.get("--method", base.method.name))
    return replace(run, steps=None) if any(word.split("=")[0] == "--epochs" for word in rest) else run
