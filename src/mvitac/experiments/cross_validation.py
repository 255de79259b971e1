"""Cross-validation: run a plan on each fold of its data, and pool the folds' test groups into one result.

Each fold has its own folder of runs and controls. A plan without folds is one fold with an empty name.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.evaluation.evaluate import ProbeConfig, chosen
from mvitac.evaluation.retrieval import MIN_GALLERY
from mvitac.evaluation.scores import pool, pool_retrieval
from mvitac.experiments.collect import gather, lay_out
from mvitac.experiments.jobs import Work
from mvitac.experiments.plan import Plan
from mvitac.registry import to_json
from mvitac.system.files import digest


def lay_out_folds(plan: Plan, out: Path, session: ProbeConfig, device: str = "auto") -> list[Work]:
    """The work of every fold of ``plan``. A row that one fold does not allow is left out of all.

    ValueError if two folds test the same group, or no row is left.
    """
    works: list[Work] = []
    tested: dict[tuple[str, str], str] = {}  # (split column, group) -> fold
    for fold, part in plan.in_folds():
        assert part.data is not None
        pack = part.data.open()
        if fold:
            groups = pack.column("group").astype(str)
            columns = dict.fromkeys(("split", *(task.split for task in chosen(pack, session)[0])))
            held = {name: np.unique(groups[pack.rows("test", by=name)]).tolist() for name in columns}
            for column, group in ((name, group) for name, names in held.items() for group in names):
                if (column, group) in tested:
                    own = "" if column == "split" else f" (column {column})"
                    both = f"folds {tested[column, group]!r} and {fold!r} both test {pack.spec.group_by} {group!r}{own}"
                    raise ValueError(f"{both}: each group must be tested once")
                tested[column, group] = fold
        work = lay_out(part, pack, out / fold, session, device)
        works.append(replace(work, jobs=[replace(job, fold=fold) for job in work.jobs]))
    left_out = {label: reason for work in works for label, reason in work.left_out.items()}
    keep = [[job for job in work.jobs if job.label not in left_out] for work in works]
    works = [replace(work, jobs=jobs, left_out=left_out) for work, jobs in zip(works, keep, strict=True)]
    if not works[0].jobs:
        raise ValueError(f"plan {plan.name!r} has no row that all folds allow: {next(iter(left_out.values()))}")
    return works


def together(works: Sequence[Work]) -> Work:
    """The jobs of all folds as one work, ordered by seed."""
    return replace(works[0], jobs=sorted((job for work in works for job in work.jobs), key=lambda job: job.run.seed))


def gather_folds(plan: Plan, works: Sequence[Work], out: Path, session: ProbeConfig) -> dict[str, Any]:
    """``gather`` all folds into one result: pooled test groups (``scores.pool``), cost of the first fold."""
    results = [gather(work, out / fold, session) for work, (fold, _) in zip(works, plan.in_folds(), strict=True)]
    if len(results) == 1:
        return {**results[0], "plan": to_json(plan)}
    lists = ("notes", "run_commits", "run_devices", "unfinished")
    named = ("failed", "run_precisions")  # by the name of a run, of which the fold is part
    return {
        **results[0],
        "plan": to_json(plan),
        "pack": digest([result["pack"] for result in results]),
        "records": pool([result["records"] for result in results]),
        "retrieval": pool_retrieval([r for one in results for r in one["retrieval"] if r["num_groups"] >= MIN_GALLERY]),
        **{key: list(dict.fromkeys(value for result in results for value in result[key])) for key in lists},
        **{key: dict(pair for result in results for pair in result[key].items()) for key in named},
        "leaks": "; ".join(dict.fromkeys(result["leaks"] for result in results if result["leaks"])),
    }
