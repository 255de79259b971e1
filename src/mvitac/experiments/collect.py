"""``mvitac compare``: lay out the jobs of a plan, and collect the finished runs into one result.

    <out>/plan.json                      the plan
          runs/<row>/seed<k>/            a run as ``mvitac pretrain`` leaves it, with scores.json but no checkpoint
          controls.json                  majority, untrained trunk, pixels, border, the data's own, ImageNet if asked
          result.json  table.*           the tables (``table_formats``)

Finished runs are skipped, interrupted ones resumed. A run that diverged (failed.json) is named below the table.
"""

import re
import statistics
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.data.pack import Pack
from mvitac.data.row_hashes import split_leaks
from mvitac.evaluation.controls import Records, controls_of, frozen_trunks
from mvitac.evaluation.evaluate import ProbeConfig, chosen
from mvitac.evaluation.probe import split_rows
from mvitac.experiments.jobs import Job, Work
from mvitac.experiments.plan import ONE_ROW, Plan, Row, slug
from mvitac.nn.encoders import SCRATCH
from mvitac.registry import to_json
from mvitac.run import Run, load_run, precision_of
from mvitac.system.device import Hardware, describe, pick_device
from mvitac.system.files import digest, fields_of, read_json, write_json
from mvitac.system.provenance import provenance
from mvitac.training.setup import check_same


def lay_out(plan: Plan, pack: Pack, out: Path, session: ProbeConfig, device: str = "auto") -> Work:
    """The jobs of ``plan``, whose data is ``pack``, ordered by seed and then by row.

    Rows that need what the data lacks (labels, a camera) and rows equal to an earlier one are left out. A row may read
    the same samples differently (difference images of touch; ``Work.other_images``), but not other samples. ValueError
    if no row is possible, or ``out`` holds other runs.
    """
    assert plan.data is not None
    for task in chosen(pack, session)[0]:
        split_rows(pack, task)  # before anything is trained
    session = replace(session, controls=False)
    possible, left_out, seen = list[tuple[Row, Pack]](), dict[str, str](), dict[str, str]()
    for row in plan.rows:
        if row.label in pack.spec.controls:
            raise ValueError(f"row {row.label!r} has the name of a control of this data: give it another label")
        own_set = {name: value for name, value in row.set.items() if not name.startswith("data.")}
        plan.run(replace(row, set=own_set), plan.data, 0, pack.phased)  # a mistake in the plan, not a row to leave out
        try:
            own, key = _check_row(plan, row, pack)
        except ValueError as error:
            # It names options of pretrain; those of data are compare's, too.
            found = re.split(r"--(?!data)(\S+) (?=\d)", str(error))
            fields = [option.replace("-", "_") for option in found[1::2]]
            found[1::2] = [f"{name}=" if name in row.set else f"--set {name}=" for name in fields]  # a row's own count
            left_out[row.label] = "".join(found)
            continue
        if key in seen:
            left_out[row.label] = f"the same run as {seen[key]!r} under recipe {plan.recipe!r}"
            continue
        seen[key] = row.label
        possible.append((row, own))
    if not possible:
        raise ValueError(f"plan {plan.name!r} has no row that this data allows: {next(iter(left_out.values()))}")
    jobs = []
    for seed in range(plan.seeds):
        for row, own in possible:
            run = replace(plan.run(row, plan.data, seed, pack.phased), device=device)
            job = Job(row.label, run, out / "runs" / slug(row.label) / f"seed{seed}", session)
            if (job.out / "run.json").exists():
                check_same(job.run, own, job.out)
            jobs.append(job)
    return Work(plan, pack, jobs, left_out, [row.label for row, own in possible if _images(own) != _images(pack)])


def _images(pack: Pack) -> dict[str, str]:
    return {name: value for name, value in pack.digests.items() if not name.endswith("samples.parquet")}


def _check_row(plan: Plan, row: Row, pack: Pack) -> tuple[Pack, str]:
    """The pack that a row reads, and the digest of its settings; ValueError if the data does not allow the row."""
    assert plan.data is not None
    if missing := sorted(key for key in row.set if key.startswith("data.") and not hasattr(plan.data, key[5:])):
        raise ValueError(f"dataset {plan.data.name!r} has no {', '.join(missing)}")
    run = plan.run(row, plan.data, 0, pack.phased)
    own = pack if run.data == plan.data else run.data.open()
    values = [target.name for task in pack.spec.values for target in task.targets]
    for name in ("id", "group", *pack.spec.split_columns, *(f"label_{task.name}" for task in pack.spec.tasks), *values):
        theirs = own.column(name) if name in own.table.column_names else np.zeros(0)
        if not np.array_equal(theirs, pack.column(name), equal_nan=theirs.dtype.kind == "f" and name in values):
            raise ValueError(f"its data {own.path} has another column {name} than {pack.path}: give the same samples")
    run.check(own.spec, len(run.method.training_rows(own)), own.size)
    run.method.on_tiny_trunk(own.spec, run.encoder)
    return own, run.without_idle(own.spec).digest()


def gather(work: Work, out: Path, session: ProbeConfig) -> dict[str, Any]:
    """Collect the finished runs and the controls into the result that tables are made from; ValueError without runs."""
    failed = {job.name: job.failure for job in work.jobs if job.failure}
    if not (finished := [job for job in work.jobs if job.done and not job.failure]):
        lost = "; ".join(["nothing to show yet", *(f"{name}: {error}" for name, error in failed.items())])
        raise ValueError(f"no run of {out} is finished with probes {' '.join(session.probes)}: {lost}")
    scored = [_scores(job) for job in finished]
    controls, found = _controls(work, out, session)
    runs, labels = [load_run(job.out) for job in finished], dict.fromkeys(job.label for job in finished)
    return {
        "plan": to_json(work.plan),
        "data": work.pack.spec.name,
        "pack": work.pack.digest,
        "group_by": work.pack.spec.group_by,
        "notes": [
            *(" ".join(note.split()) for note in work.pack.spec.notes),
            *(f"{label} reads other images than the controls" for label in work.other_images),
        ],
        "leaks": "; ".join(split_leaks(work.pack, chosen(work.pack, session)[0]).values()),
        "records": [record for records, _ in scored for record in records] + controls,
        "retrieval": [record for _, retrieval in scored for record in retrieval] + found,
        "rows": [row.label for row in work.plan.rows if row.label not in work.left_out],
        "left_out": work.left_out,
        "failed": failed,
        "unfinished": [job.name for job in work.jobs if not job.done],
        "cost": [cost(label, [j for j in finished if j.label == label], work.pack) for label in labels],
        "device": describe(pick_device(work.jobs[0].run.device)),
        "run_commits": list(dict.fromkeys(record.get("commit") for _, record in runs)),
        "run_devices": list(dict.fromkeys(record.get("device", "unknown device") for _, record in runs)),
        "run_precisions": {job.name: precision_of(*run) for job, run in zip(finished, runs, strict=True)},
        **provenance(),
    }


def _scores(job: Job) -> tuple[Records, Records]:
    with fields_of(path := job.out / "scores.json"):
        scores = read_json(path, "a run's scores")
        named = [{**r, "source": job.label + r["source"].removeprefix(job.run.method.name)} for r in scores["records"]]
        return named, [{**found, "source": job.label} for found in scores["retrieval"]]


def _controls(work: Work, out: Path, session: ProbeConfig) -> tuple[Records, Records]:
    if not session.controls:
        return [], []
    runs = [job.run for job in work.jobs if job.label == work.plan.reference] or [work.jobs[0].run]
    frozen = [name for name, _ in frozen_trunks(runs)]  # weights may be installed later
    key = digest([to_json(session), work.pack.digest, to_json(work.pack.spec), [run.digest() for run in runs], frozen])
    with fields_of(path := out / "controls.json"):
        if path.exists() and (kept := read_json(path, "the controls"))["key"] == key:
            return kept["records"], kept["retrieval"]
    tasks, modalities = chosen(work.pack, session)
    records, retrieval = controls_of(runs, work.pack, tasks, modalities, session.probes)
    write_json(path, {"key": key, "records": records, "retrieval": retrieval}, sealed=True)
    return records, retrieval


def cost(label: str, jobs: Sequence[Job], pack: Pack) -> dict[str, Any]:
    """Steps, pairs, images and median seconds of one run of a row."""
    run = jobs[0].run
    rows = len(run.method.training_rows(pack))
    method = run.method.build(pack.spec, run.encoder.changed(weights=SCRATCH))
    pairs = (steps := run.num_steps(rows)) * run.batch_size
    trained = sum(p.numel() for p in method.parameters() if p.requires_grad)
    seen = {"pairs": pairs, "pairs_of": pairs_of(run, method.views, pack)}
    seen |= {"images": pairs * method.views * len(method.encoders()), "trained_parameters": trained}
    seconds = statistics.median(job.seconds() for job in jobs)
    return {"row": label, "seeds": len(jobs), "steps": steps, **seen, "seconds": seconds}


def pairs_of(run: Run, views: int, pack: Pack) -> str:
    """Which rows form a positive pair (``Run.positives``). This matters more than the choice of most methods."""
    other = run.positives != "same-image" if views > 1 else run.positives == "same-touch-pairs"
    return "two rows of a touch" if other and len(np.unique(pack.touch_groups)) < pack.num else ONE_ROW


def outline(work: Work) -> list[str]:
    """Lines that describe the plan: rows, runs, steps, pairs, what is finished and what is left out."""
    rows: dict[str, list[Job]] = {}
    for job in work.jobs:
        rows.setdefault(job.label, []).append(job)
    num = len({job.fold for job in work.jobs})
    folds = f" x {num} folds" if num > 1 else ""
    lines = [f"plan {work.plan.name}: {len(rows)} rows x {work.plan.seeds} seeds{folds} = {len(work.jobs)} runs"]
    for label, mine in rows.items():
        run = mine[0].run
        num = len(run.method.training_rows(work.pack))
        lines.append(
            f"  {label}: {run.method.name}, {run.num_steps(num)} steps x {run.batch_size} pairs of {num} rows,"
            f" {sum(job.done for job in mine)} of {len(mine)} finished"
        )
    lines += [f"  left out: {label} ({reason})" for label, reason in work.left_out.items()]
    todo = [job for job in work.jobs if not job.done]
    for asked, run in {job.run.precision: job.run for job in todo}.items():
        if asked != "auto":  # which each run measures when it begins
            lines.append(f"on this machine: {Hardware.choose(pick_device(run.device), asked).sentence}")
    return [*lines, f"{len(todo)} runs left" if todo else "all runs are finished"]
