"""``mvitac compare``: many runs into the paper's tables."""

from dataclasses import dataclass, replace
from pathlib import Path

from mvitac.cli.options import parse, selectors


def compare(argv: list[str]) -> None:
    """mvitac compare --plan table1|table2|ablation|FILE [--data D] [--recipe R] [--seeds N] [--jobs N] [--dry-run]"""
    given, rest = selectors(argv, ("--plan", "--data", "--recipe"))
    from typing import Annotated

    import tyro
    from rich.console import Console

    from mvitac.datasets.base import DatasetConfig
    from mvitac.evaluation.evaluate import ProbeConfig
    from mvitac.experiments.collect import forecast
    from mvitac.experiments.cross_validation import gather_folds, lay_out_folds, together
    from mvitac.experiments.jobs import do_all, submit
    from mvitac.experiments.paper_plans import PLANS, find_plan
    from mvitac.experiments.plan import setting
    from mvitac.experiments.table_formats import write_tables
    from mvitac.recipes import RECIPES
    from mvitac.registry import default, to_json, unknown
    from mvitac.system.files import check_place, write_json

    plan = find_plan(given.get("--plan", "table1"))
    if "--recipe" in given and given["--recipe"] not in RECIPES:
        raise unknown("recipe", given["--recipe"], RECIPES)
    usual = "grasps" if plan.name == "table2" else "materials"
    chosen = (
        default(DatasetConfig, given["--data"]) if "--data" in given else plan.data or default(DatasetConfig, usual)
    )

    @dataclass(frozen=True, kw_only=True)
    class Options:
        data: Annotated[type(chosen), tyro.conf.arg(name="data", help=chosen.__doc__)] = chosen  # type: ignore[valid-type]
        out: Path = Path("runs") / f"compare-{plan.name}-{chosen.name}"
        """Folder of the comparison: runs, controls, tables. The same command goes on where it stopped."""
        rows: tuple[str, ...] = ()
        """Labels of the rows to run and to show beside the reference, e.g. --rows SSVTP "TAG (CMC)"; none = all. The tables
        in --out are then of these; runs of others stay, and the same command without --rows shows them again."""
        seeds: int = plan.seeds
        """Runs per row, seeds 0 .. seeds - 1."""
        folds: tuple[str, ...] = plan.folds
        """Cross-validation: the data's fields that make each fold, e.g. --folds split=fold1 split=fold2; test groups, which
        must differ, are pooled."""
        set: tuple[str, ...] = ()
        """field=value for every row of the plan, e.g. --set steps=100 encoder.weights=scratch; a row's own come after."""
        jobs: int | None = None
        """Runs at a time; none = one per GPU, one on a machine without. The same command given again meanwhile, also on
        another machine that shares the folder, does the runs that nobody is at."""
        device: str = "auto"
        """auto, cpu, cuda or cuda:N; with several jobs and GPUs each job has its own."""
        imagenet: Path | None = None
        """ImageNet weights of the trunk (a file), for the frozen-ImageNet control."""
        stress: bool = plan.stress
        """Also score 1 % and 10 % of the labels, noisy test images, a modality missing at test time, and a leaking split."""
        dry_run: bool = False
        """Print the plan, what is finished and what is left, and stop."""
        tables_only: bool = False
        """Make the tables of what is finished and train nothing."""
        slurm: str | None = None
        """Submit the unfinished runs as a SLURM array (extra: slurm) with these submitit parameters, e.g.
        slurm_partition=gpu,timeout_min=600,gpus_per_node=1, and stop; the same command without it makes the tables."""

    Options.__doc__ = f"""Many runs into one table: methods x settings x seeds, beside controls and the paper's numbers.

    First choose, then change single fields below:
      --plan {"|".join(PLANS)}|FILE.toml|FILE.json  (default table1)
      --data {"|".join(DatasetConfig.choices)}  (default: the plan's, else materials; grasps for table2)
      --recipe {"|".join(RECIPES)}  (default: the plan's, {plan.recipe})

    A plan of your own, in TOML (in JSON the same fields):
      recipe = "demo"
      seeds = 3
      reference = "MViTac"            # the row the others are tested against
      set = {{ steps = 300 }}           # fields of every run
      data = {{ name = "pack", path = "packs/materials" }}
      # folds = ["split=fold1", "split=fold2"]  # cross-validation over columns of a folder's manifest
      [[rows]]
      label = "MViTac"
      [[rows]]
      label = "colder"
      method = "mvitac"               # the default
      set = {{ "method.temperature" = 0.2, "optim.lr" = 1e-3 }}
    """
    options = parse(Options, rest, "compare")
    if options.jobs is not None and not 1 <= options.jobs <= 1024:
        raise ValueError(f"jobs {options.jobs}: give 1 to 1024 runs at a time")
    extra = dict(setting(text) for text in options.set)
    plan = replace(
        plan.only(options.rows),
        data=options.data,
        recipe=given.get("--recipe", plan.recipe),
        seeds=options.seeds,
        folds=options.folds,
        stress=options.stress,
        set={**plan.set, **extra},
    )
    session = ProbeConfig(probes=plan.probes, tasks=plan.tasks, modalities=plan.modalities, imagenet=options.imagenet)
    if not options.dry_run:
        check_place(options.out / "plan.json")
    console = Console(markup=False)
    say = lambda text: console.print(text, soft_wrap=True, highlight=False)  # noqa: E731
    works = lay_out_folds(plan, options.out, session, options.device)
    work = together(works)
    for line in forecast(work):
        say(line)
    if options.dry_run:
        return
    write_json(options.out / "plan.json", to_json(plan))
    if options.slurm is not None:
        say(submit(work, options.slurm))
        return
    if not options.tables_only:
        do_all(work, options.jobs or _num_gpus(), say, console)
    written = write_tables(gather_folds(plan, works, options.out, session), options.out)
    say(written[0].read_text())
    for path in written:
        say(f"written: {path}")


def _num_gpus() -> int:
    import torch

    return max(1, torch.cuda.device_count())
