"""``mvitac compare``: a plan -> runs -> one result. What is finished is skipped, what was cut is resumed.

    <out>/plan.json                      what was asked for
          runs/<row>/seed<k>/            a run like any other, with scores.json in place of its checkpoint
          controls.json                  majority, untrained trunk, pixels, border, the data's own, ImageNet where asked
          result.json  table.*           the tables (``paper_tables``)

A run whose loss stops being a number is a result too: it is kept as failed.json and told in the table.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import TaskID

from mvitac.batches import gel_mirror, training_rows
from mvitac.controls import controls_of
from mvitac.device import describe, pick_device
from mvitac.encoders import SCRATCH
from mvitac.log import bars, last_line
from mvitac.model import load
from mvitac.pack import Pack
from mvitac.plans import Plan, Row, slug
from mvitac.record import brief, digest, provenance, read_json, write_json
from mvitac.registry import to_json
from mvitac.run import Run
from mvitac.session import Session, chosen, probe_runs
from mvitac.stress import stress
from mvitac.train import Diverged, Interrupted, train
from mvitac.workers import my_device, side_by_side


@dataclass(frozen=True)
class Job:
    """One run of one row: where it goes, and how it is scored."""

    label: str
    run: Run
    out: Path
    session: Session
    stress: bool = False
    fold: str = ""

    @property
    def name(self) -> str:
        """Its row and seed, and its fold where there are several."""
        return f"{self.label}, {f'{self.fold}, ' if self.fold else ''}seed {self.run.seed}"

    @property
    def done(self) -> bool:
        scored = (self.out / "scores.json").exists() and (not self.stress or (self.out / "stress.json").exists())
        return scored or (self.out / "failed.json").exists()

    def drop_checkpoint(self) -> None:
        """Once scored, a run needs none; they are four times its weights, and hundreds of runs would fill a disk."""
        (self.out / "checkpoint.pt").unlink(missing_ok=True)


@dataclass(frozen=True)
class Work:
    """A plan on one dataset (one fold of it): the jobs to do, and the rows that cannot be part of it, with the reason."""

    plan: Plan
    pack: Pack
    jobs: list[Job]
    left_out: dict[str, str]


def lay_out(plan: Plan, pack: Pack, out: Path, session: Session, device: str = "auto") -> Work:
    """The jobs of ``plan`` on the data of its rows, seeds outermost; ValueError if not one row is possible.

    Rows that need what the data lacks (labels, a camera) and rows that are the same run as an earlier one are left out. A
    row may read the same samples in another way (difference images of touch), not other samples.
    """
    assert plan.data is not None
    chosen(pack, session)
    session = replace(session, controls=False)
    possible: list[Row] = []
    left_out: dict[str, str] = {}
    seen: dict[str, str] = {}
    for row in plan.rows:
        if missing := sorted(key for key in row.set if key.startswith("data.") and not hasattr(plan.data, key[5:])):
            left_out[row.label] = f"dataset {plan.data.name!r} has no {', '.join(missing)}"
            continue
        run = plan.run(row, plan.data, 0)
        try:
            own = pack if run.data == plan.data else _same_samples(run.data.open(), pack)
            run.check(own.spec, len(training_rows(run, own)), own.size)
            gel_mirror(run, own, torch.device("cpu"))
            run.method.build(own.spec, replace(run.encoder, trunk="mvitac_tiny", weights=SCRATCH))
        except ValueError as error:
            left_out[row.label] = str(error)
            continue
        alike = replace(run, recipe="")
        if set(getattr(run.method, "modalities", ())) == set(own.spec.modalities):  # all there are, named or not
            alike = replace(alike, method=replace(run.method, modalities=()))  # type: ignore[call-arg]
        if (key := alike.digest()) in seen:
            left_out[row.label] = f"the same run as {seen[key]!r} under recipe {plan.recipe!r}"
            continue
        seen[key] = row.label
        possible.append(row)
    if not possible:
        raise ValueError(f"plan {plan.name!r} has no row that this data allows: {next(iter(left_out.values()))}")
    jobs = [
        Job(row.label, replace(plan.run(row, plan.data, seed), device=device), place, session, plan.stress)
        for seed in range(plan.seeds)
        for row in possible
        for place in (out / "runs" / slug(row.label) / f"seed{seed}",)
    ]
    return Work(plan, pack, jobs, left_out)


def _same_samples(own: Pack, pack: Pack) -> Pack:
    """``own``, if it holds the samples of ``pack`` on the same sides, with the same labels."""
    for name in ("id", "group", "split", *(f"label_{task.name}" for task in pack.spec.tasks)):
        if name not in own.table.column_names or not np.array_equal(own.column(name), pack.column(name)):
            raise ValueError(
                f"its data {own.path} has another column {name} than {pack.path}: compare the same samples"
            )
    return own


# -- doing it ---------------------------------------------------------------------------------------------------------


def do(job: Job, pack: Pack | None = None, *, quiet: bool = True) -> str:
    """Train and score one run; returns a line about it. Safe to repeat, also after a kill at any instant."""
    if job.done:
        return "finished before"
    pack = pack or job.run.data.open(quiet=True)
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    try:
        train(job.run, job.out, resume=True, quiet=quiet, pack=pack)
    except Diverged as error:
        write_json(job.out / "failed.json", {"error": str(error)})
        return f"diverged: {error}"
    if torch.cuda.is_available():
        write_json(job.out / "memory.json", {"peak_bytes": torch.cuda.max_memory_allocated()})
    result = probe_runs([job.out], job.session, pack)
    if job.stress:
        records = stress(load(job.out), pack, *chosen(pack, job.session))
        own = {"source": job.run.method.name, "seed": job.run.seed, "run": str(job.out)}
        write_json(job.out / "stress.json", {"records": [{**own, **record} for record in records]})
    write_json(job.out / "scores.json", {"records": result["records"], "retrieval": result["retrieval"]})
    job.drop_checkpoint()
    return f"{seconds_of(job.out):.0f} s of training"


def do_all(work: Work, num_jobs: int, say: Callable[[str], None], console: Console | None = None) -> None:
    """Do the unfinished jobs, ``num_jobs`` at a time, each on a GPU of its own where there are several.

    ``console``, if it is a terminal, shows how far they are. A job that fails is told; the first one's error is raised after
    all others are done. ValueError if a process dies. Interrupted after Ctrl-C, when the runs under way have saved
    their checkpoints.
    """
    todo = [job for job in work.jobs if not job.done]
    for job in work.jobs:
        if job.done and not (job.out / "failed.json").exists():
            job.drop_checkpoint()  # of a run that was killed when it had been scored
    shown = console if console and console.is_terminal else None
    errors: list[Exception] = []

    def told(job: Job, result: Callable[[], str]) -> None:
        try:
            line = result()
        except (Interrupted, BrokenProcessPool):
            raise
        except Exception as error:  # the other runs need not wait for someone to mend it
            errors.append(error)
            line = f"failed: {brief(error)}"
        say(f"[{sum(j.done for j in work.jobs)}/{len(work.jobs)}] {job.name}: {line}")

    try:
        if num_jobs == 1 or len(todo) < 2:
            for job in todo:
                say(f"{job.name} ...")
                pack = work.pack if job.run.data == work.plan.data else None
                told(job, lambda job=job, pack=pack: do(job, pack, quiet=not shown))
        else:
            _side_by_side(work, todo, num_jobs, told, shown)
    except (KeyboardInterrupt, Interrupted):
        raise Interrupted("stopped; the same command goes on from here") from None
    except BrokenProcessPool:
        raise ValueError(
            f"one of {num_jobs} processes was killed, most likely for lack of memory: give fewer --jobs; the same command"
            " goes on from here"
        ) from None
    if errors:
        raise errors[0]


def _side_by_side(
    work: Work,
    todo: Sequence[Job],
    num_jobs: int,
    told: Callable[[Job, Callable[[], str]], None],
    console: Console | None,
) -> None:
    gpus = torch.cuda.device_count()
    devices = [f"cuda:{i}" for i in range(gpus)] if gpus > 1 else ()
    shown = bars(console or Console(), disable=console is None, transient=True, speed_estimate_period=600)
    with shown as progress, side_by_side(num_jobs, devices) as pool:
        overall = progress.add_task("all runs", total=len(todo), text="")
        tasks: dict[Path, tuple[TaskID, int]] = {}  # of the runs under way, with their steps
        jobs = {pool.submit(_do_here, job): job for job in todo}
        waiting = set(jobs)
        while waiting:
            done, waiting = wait(waiting, timeout=1, return_when=FIRST_COMPLETED)
            for future in done:
                told(job := jobs[future], future.result)
                if job.out in tasks:
                    progress.remove_task(tasks.pop(job.out)[0])
            part = 0.0
            for job in (jobs[future] for future in waiting if future.running()) if console else ():
                step, text = last_line(job.out)
                if step and job.out not in tasks:
                    steps = job.run.num_steps(len(training_rows(job.run, work.pack)))
                    tasks[job.out] = progress.add_task(job.name, total=steps, text=""), steps
                if job.out in tasks:
                    task, steps = tasks[job.out]
                    progress.update(task, completed=step, text=text)
                    part += min(1, step / steps)  # a fold's own steps may be more
            progress.update(overall, completed=len(todo) - len(waiting) + part)


def _do_here(job: Job) -> str:
    device = my_device()
    return do(job if device == "auto" else replace(job, run=replace(job.run, device=device)))


def submit(work: Work, options: str) -> str:
    """Hand the unfinished jobs to SLURM as one array by submitit and return its id; nothing waits for them here.

    ``options``: comma-separated name=value of submitit's ``update_parameters``, e.g. "slurm_partition=gpu,timeout_min=600".
    """
    try:
        import submitit  # type: ignore[import-not-found]
    except ImportError:
        raise ValueError(
            "--slurm needs submitit, which is not installed: pip install 'mvitac[slurm]', or leave --slurm out"
        ) from None
    parameters: dict[str, Any] = {}
    for pair in options.split(","):
        name, equals, value = pair.partition("=")
        if not equals:
            raise ValueError(f"--slurm {pair}: give name=value pairs, e.g. slurm_partition=gpu,timeout_min=600")
        parameters[name] = int(value) if value.isdigit() else value
    todo = [job for job in work.jobs if not job.done]
    if not todo:
        return "nothing to submit: all runs are finished"
    executor = submitit.AutoExecutor(folder=work.jobs[0].out.parents[3 if work.jobs[0].fold else 2] / "slurm")
    executor.update_parameters(name=f"mvitac-{work.plan.name}", **parameters)
    handles = executor.map_array(do, todo)
    return f"{len(handles)} runs submitted as {handles[0].job_id.split('_')[0]}"


# -- what came of it --------------------------------------------------------------------------------------------------


def gather(work: Work, out: Path, session: Session) -> dict[str, Any]:
    """Everything the tables are made of, from the finished runs; ValueError if there is none."""
    finished = [job for job in work.jobs if job.done and not (job.out / "failed.json").exists()]
    failed = {
        job.name: read_json(job.out / "failed.json", "a failure")["error"]
        for job in work.jobs
        if (job.out / "failed.json").exists()
    }
    if not finished:
        lost = "; ".join(f"{name}: {error}" for name, error in failed.items())
        raise ValueError(f"no run of {out} is finished: nothing to tell yet{f' ({lost})' if lost else ''}")
    records: list[dict[str, Any]] = []
    retrieval: list[dict[str, Any]] = []
    for job in finished:
        scores = read_json(job.out / "scores.json", "a run's scores")
        method = job.run.method.name
        worse = read_json(job.out / "stress.json", "a run's stress")["records"] if job.stress else []
        for record in scores["records"] + worse:
            records.append({**record, "source": job.label + record["source"].removeprefix(method)})
        retrieval += [{**found, "source": job.label} for found in scores["retrieval"]]
    controls, found = _controls(work, out, session)
    rows = {row.label: row for row in work.plan.rows}
    return {
        "plan": to_json(work.plan),
        "data": work.pack.spec.name,
        "pack": work.pack.digest,
        "group_by": work.pack.spec.group_by,
        "leaks": leaks(work.pack),
        "records": records + controls,
        "retrieval": retrieval + found,
        "rows": [label for label in rows if label not in work.left_out],
        "left_out": work.left_out,
        "failed": failed,
        "unfinished": [job.name for job in work.jobs if not job.done],
        "cost": [cost(label, [j for j in finished if j.label == label], work.pack) for label in _labels(finished)],
        "device": describe(pick_device(work.jobs[0].run.device)),
        **provenance(),
    }


def _labels(jobs: Sequence[Job]) -> Iterator[str]:
    yield from dict.fromkeys(job.label for job in jobs)


def _controls(work: Work, out: Path, session: Session) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The controls beside the reference row, made once."""
    if not session.controls:
        return [], []
    beside = [job.run for job in work.jobs if job.label == work.plan.reference] or [work.jobs[0].run]
    key = digest([to_json(session), work.pack.digest, [run.digest() for run in beside]])
    path = out / "controls.json"
    if path.exists() and (kept := read_json(path, "the controls"))["key"] == key:
        return kept["records"], kept["retrieval"]
    tasks, modalities = chosen(work.pack, session)
    records, retrieval = controls_of(beside, work.pack, tasks, modalities, session.probes, session.imagenet)
    write_json(path, {"key": key, "records": records, "retrieval": retrieval})
    return records, retrieval


def leaks(pack: Pack) -> str:
    """A sentence if groups (instances, objects, recordings) lie in train and in test, else ""."""
    groups = pack.column("group").astype(str)
    train_groups, test_groups = (set(groups[pack.rows(split)]) for split in ("train", "test"))
    shared = len(train_groups & test_groups)
    if not shared:
        return ""
    return f"{shared} of {len(test_groups)} test {pack.spec.group_by}s are also in train: this split leaks"


def seconds_of(path: Path) -> float:
    """Seconds of training that a run's log tells, over all its resumptions; steps lost to a kill are not in it."""
    total, before = 0.0, 0
    batch_size = read_json(path / "run.json", "a run's record")["run"]["batch_size"]
    for line in (path / "log.jsonl").read_text().splitlines():
        entry = json.loads(line)
        if entry.get("pairs_per_s"):
            total += (entry["step"] - before) * batch_size / entry["pairs_per_s"]
        before = entry["step"]
    return total


def cost(label: str, jobs: Sequence[Job], pack: Pack) -> dict[str, Any]:
    """Steps, pairs, images and median seconds of one run of a row, and its peak GPU memory where it was measured."""
    run = jobs[0].run
    rows = len(training_rows(run, pack))
    method = run.method.build(pack.spec, replace(run.encoder, weights=SCRATCH))
    steps = run.num_steps(rows)
    peaks = [read_json(p, "peak memory")["peak_bytes"] for job in jobs if (p := job.out / "memory.json").exists()]
    return {
        "row": label,
        "seeds": len(jobs),
        "steps": steps,
        "pairs": steps * run.batch_size,
        "images": steps * run.batch_size * method.views * len(method.encoders()),
        "trained_parameters": sum(p.numel() for p in method.parameters() if p.requires_grad),
        "seconds": statistics.median(seconds_of(job.out) for job in jobs),
        "peak_gpu_bytes": int(np.max(peaks)) if peaks else None,
    }


def forecast(work: Work) -> list[str]:
    """The plan in words: runs, what is finished, steps and pairs, and the time left where finished runs tell it."""
    rows = {label: next(job for job in work.jobs if job.label == label) for label in _labels(work.jobs)}
    num = len({job.fold for job in work.jobs})
    folds = f" x {num} folds" if num > 1 else ""
    lines = [f"plan {work.plan.name}: {len(rows)} rows x {work.plan.seeds} seeds{folds} = {len(work.jobs)} runs"]
    known = [seconds_of(job.out) for job in work.jobs if (job.out / "scores.json").exists()]
    for label, job in rows.items():
        num = len(training_rows(job.run, work.pack))
        steps = job.run.num_steps(num)
        mine = [j for j in work.jobs if j.label == label]
        lines.append(
            f"  {label}: {job.run.method.name}, {steps} steps x {job.run.batch_size} pairs of {num} rows,"
            f" {sum(j.done for j in mine)} of {len(mine)} finished"
        )
    lines += [f"  left out: {label} ({reason})" for label, reason in work.left_out.items()]
    left = sum(not job.done for job in work.jobs)
    if known and left:
        hours = left * statistics.median(known) / 3600
        lines.append(f"{left} runs left, about {hours:.1f} h of training one after another (median of finished runs)")
    elif left:
        lines.append(f"{left} runs left; run one for a forecast of the time")
    else:
        lines.append("all runs are finished")
    return lines
