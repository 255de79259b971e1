"""``mvitac pretrain``."""

from dataclasses import dataclass
from pathlib import Path

from mvitac.cli.options import parse, selectors


def pretrain(argv: list[str]) -> None:
    """mvitac pretrain --data D|--from run.json [--method M] [--recipe R] [fields] --out DIR [--resume]"""
    chosen, rest = selectors(argv, ("--method", "--data", "--recipe", "--from", "--sink"))
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.datasets.base import DatasetConfig
    from mvitac.methods.base import MethodConfig
    from mvitac.recipes import RECIPES, recipe, with_method
    from mvitac.registry import default
    from mvitac.run import Run, read_record
    from mvitac.training.log import open_loggers
    from mvitac.training.loop import train

    if "--from" in chosen:
        for name in ("--method", "--data", "--recipe"):
            if name in chosen:
                raise ValueError(f"--from already decides {name}: leave it out, or change single fields")
        base, _ = read_record(Path(chosen["--from"]))
    else:
        data = default(DatasetConfig, chosen.get("--data", "materials"))
        base = recipe(chosen.get("--recipe", "demo"), data)
        base = with_method(base, chosen.get("--method", base.method.name))
        if "--data" not in chosen and not {"-h", "--help"} & set(rest):
            raise ValueError(
                f"say what to learn from: --data {'|'.join(DatasetConfig.choices)} (or --from RUN.JSON); without data of"
                " your own: mvitac demo, or mvitac pretrain --data materials --recipe demo, which simulates"
            )

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
      --data {"|".join(DatasetConfig.choices)}  (needed)
      --method {"|".join(MethodConfig.choices)}  (default mvitac)
      --from RUN.JSON   repeat a recorded run instead
      --sink tensorboard|wandb|trackio   also log there (extras; none by default)
    """
    options = parse(Options, rest, "pretrain")
    console = Console(markup=False)
    with open_loggers(chosen.get("--sink"), options.out, options.run) as loggers:
        out = train(options.run, options.out, resume=options.resume, quiet=options.quiet, loggers=loggers)
    console.print(f"trained: {out}\nnext: mvitac probe {out}", soft_wrap=True, highlight=False)
