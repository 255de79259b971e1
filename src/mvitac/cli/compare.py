"""``mvitac compare``: many runs into the paper's tables."""

from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import fill
from typing import Any

from mvitac.cli.options import parse, selectors
from mvitac.datasets.base import DatasetConfig, dataset
from mvitac.evaluation.evaluate import ProbeConfig
from mvitac.evaluation.probe_config import Probe
from mvitac.experiments.collect import outline
from mvitac.experiments.cross_validation import gather_folds, lay_out_folds, together
from mvitac.experiments.jobs import do_all
from mvitac.experiments.plan import PLANS, find_plan, setting
from mvitac.experiments.table_formats import write_tables
from mvitac.recipes import RECIPES
from mvitac.registry import check_known, to_json
from mvitac.system.device import pick_device
from mvitac.system.files import SEAL, check_place, is_temporary, write_json
from mvitac.system.locks import hold_lock


@dataclass(frozen=True, kw_only=True)
class _Options:
    data: DatasetConfig
    out: Path
    """Folder of the comparison: runs, controls, tables. The same command continues where it stopped."""
    rows: tuple[str, ...] = ()
    """Labels of the rows to run and to show beside the reference, e.g. --rows SSVTP "TAG (CMC)"; none = all. The tables
    in --out then hold these only; runs of other rows stay, and the same command without --rows shows them again."""
    seeds: int
    """Runs per row, seeds 0 .. seeds - 1."""
    folds: tuple[str, ...]
    """Cross-validation: the field of the data that makes each fold, e.g. --folds split=fold1 split=fold2. Test groups
    must differ between folds, and are pooled."""
    probes: tuple[Probe, ...]
    """Probes that score the features: linear, paper, knn. The tables show the first; the paper's numbers are of paper."""
    set: tuple[str, ...] = ()
    """field=value for every row of the plan, e.g. --set steps=100 encoder.weights=scratch; a row's own come after."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N. The same command given again meanwhile, on another GPU or on a machine that shares the
    folder, takes the runs that no process has."""
    dry_run: bool = False
    """Print the plan, what is finished and what is left, and stop. It opens the data, which may have to be packed."""
    tables_only: bool = False
    """Make the tables of what is finished and train nothing."""


_SAME = ("seeds", "folds", "probes")  # fields of a plan that are options, too
_MANUAL = """Many runs into one table: methods x settings x seeds, next to controls and the paper's numbers.

    First choose, then change single fields below:
      --plan {plans}|FILE.toml|FILE.json  (default table1)
      --data {data}  (default: the plan's, else materials; grasps for table2)
      --recipe {recipes}  (default: the plan's, {recipe})

    A plan of your own, in TOML (in JSON the same fields):
      recipe = "quick"
      seeds = 3
      reference = "MViTac"            # the row the others are tested against
      set = {{ steps = 300 }}           # fields of every run
      data = {{ name = "pack", path = "packs/materials" }}
      # folds = ["split=fold1", "split=fold2"]  # folds in columns of a manifest
      [[rows]]
      label = "MViTac"
      [[rows]]
      label = "colder"
      method = "mvitac"               # the default
      set = {{ "method.temperature" = 0.2, "optim.lr" = 1e-3 }}
    """


def compare(argv: list[str]) -> None:
    chosen, rest = selectors(argv, ("--plan", "--data", "--recipe"))
    plan = find_plan(chosen.get("--plan", "table1"))
    check_known("recipe", [recipe := chosen.get("--recipe", plan.recipe)], RECIPES)
    data = dataset(chosen["--data"]) if "--data" in chosen else plan.data
    data = data or dataset("grasps" if plan.name == "table2" else "materials")
    given: Any = {name: getattr(plan, name) for name in _SAME}
    usual = _Options(data=data, out=Path("runs") / f"compare-{plan.name}-{data.name}", **given)
    choices = {"plans": PLANS, "data": DatasetConfig.choices, "recipes": RECIPES}
    manual = _MANUAL.format(**{name: "|".join(values) for name, values in choices.items()}, recipe=plan.recipe)
    options = parse(_Options, rest, "compare", default=usual, description=manual)
    pick_device(options.device)
    same = {name: getattr(options, name) for name in ("data", *_SAME)}
    given = [setting(text) for text in options.set]
    if twice := [name for i, (name, _) in enumerate(given) if name in dict(given[:i])]:
        raise ValueError(f"--set {twice[0]} is given twice: give it once")
    plan = plan.only(options.rows)
    if "--recipe" in chosen and all(row.recipe for row in plan.rows):
        raise ValueError(f"--recipe {recipe} has no effect: every row of {plan.name} has its own")
    plan = replace(plan, recipe=recipe, set={**plan.set, **dict(given)}, **same)
    config = ProbeConfig(probes=plan.probes, tasks=plan.tasks, modalities=plan.modalities)
    if options.dry_run and options.tables_only:
        raise ValueError("--tables-only has no effect beside --dry-run: leave one out")
    kept = options.out / "plan.json"
    if not options.dry_run:
        check_place(kept)
        own = kept.is_file() and SEAL in kept.read_text(errors="replace")
        if not own and options.out.is_dir() and not all(map(is_temporary, options.out.iterdir())):
            raise ValueError(f"{options.out} is not empty, and holds no comparison: choose another --out")
    works = lay_out_folds(plan, options.out, config, options.device)
    work = together(works)
    print("\n".join(outline(work)), flush=True)
    if options.dry_run:
        return
    write_json(kept, to_json(plan), sealed=True)
    if not options.tables_only:
        do_all(work)
    with hold_lock(options.out / "tables", "waiting for the tables of another process", wait=True):
        written = write_tables(gather_folds(plan, works, options.out, config), options.out)
    text = [line if line.startswith("|") else fill(line, 80) for line in written[0].read_text().splitlines()]
    print(*text, "", *(f"written: {path}" for path in written), sep="\n")
