"""Run the jobs of a comparison: one by one, in several processes, or on several machines.

Jobs can be killed at any time and resume. A run whose loss became NaN or infinite counts as done and is kept as
failed.json. A run that fails otherwise is reported, and the next call tries it again.
"""

import os
import signal
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

import torch

from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.experiments.plan import Plan
from mvitac.registry import to_json
from mvitac.run import Run
from mvitac.system.files import brief, read_json, write_json
from mvitac.system.locks import Busy, hold_lock
from mvitac.training.checkpoint import CHECKPOINT, PREVIOUS
from mvitac.training.log import read_log, seconds_of
from mvitac.training.loop import Diverged, Interrupted, train

SPAWN = get_context("spawn")


@dataclass(frozen=True)
class Job:
    """One run of one row: its settings, its folder, and how it is scored."""

    label: str
    run: Run
    out: Path
    session: ProbeConfig
    fold: str = ""

    @property
    def name(self) -> str:
        """Row, fold (if there are several) and seed."""
        return f"{self.label}, {f'{self.fold}, ' if self.fold else ''}seed {self.run.seed}"

    @property
    def asked(self) -> dict[str, Any]:
        """The probes, tasks and modalities to score, as stored with the scores."""
        asked = self.session
        return to_json(ProbeConfig(probes=asked.probes, tasks=asked.tasks, modalities=asked.modalities))

    @property
    def failure(self) -> str:
        """Why the run diverged; "" if it did not."""
        path = self.out / "failed.json"
        return read_json(path, "a failure")["error"] if path.exists() else ""

    @property
    def done(self) -> bool:
        path = self.out / "scores.json"
        return bool(self.failure) or (path.exists() and read_json(path, "a run's scores")["asked"] == self.asked)

    def seconds(self) -> float:
        """Seconds of training."""
        return seconds_of(read_log(self.out), self.run.batch_size)


@dataclass(frozen=True)
class Work:
    """A plan on one dataset (or fold): the jobs, and the rows left out with the reason."""

    plan: Plan
    pack: Pack
    jobs: list[Job]
    left_out: dict[str, str]


def do(job: Job, pack: Pack | None = None, *, quiet: bool = True) -> str:
    """Train and score one run; returns a line about it. Safe to call again after a kill. Busy if another process has it."""
    with hold_lock(job.out, "another process runs it", wait=False):
        if job.done:
            return "finished before"
        pack = pack or job.run.data.open(quiet=True)
        try:
            train(job.run, job.out, resume=True, quiet=quiet, pack=pack)
        except Diverged as error:
            write_json(job.out / "failed.json", {"error": str(error)}, sealed=True)
            return f"diverged: {error}"
        result = probe_runs([job.out], job.session, pack)
        scores = {"asked": job.asked, "records": result["records"], "retrieval": result["retrieval"]}
        write_json(job.out / "scores.json", scores, sealed=True)
        for name in (CHECKPOINT, PREVIOUS):  # a scored run needs none, and one is four times as large as the weights
            (job.out / name).unlink(missing_ok=True)
        return f"{job.seconds():.0f} s of training"


def do_all(work: Work, num_jobs: int = 1, *, quiet: bool = False) -> None:
    """Run the unfinished jobs and print a line about each, in ``num_jobs`` processes at a time.

    Each process takes the jobs that no other process has, of this or another command; several GPUs are shared out among
    them. A job that fails is told and the others go on; ValueError at the end. Interrupted after Ctrl-C, when the runs
    under way have saved their checkpoints.
    """
    num_jobs = min(num_jobs, sum(not job.done for job in work.jobs))
    try:
        if num_jobs > 1:
            failed = _side_by_side(work.jobs, num_jobs)
        else:
            failed = _take(work.jobs, work, quiet=quiet)
    except (KeyboardInterrupt, Interrupted):
        raise Interrupted("stopped; the same command continues from here") from None
    if failed:
        raise ValueError(f"{failed}; the same command continues from here")


def _take(jobs: Sequence[Job], work: Work | None = None, *, quiet: bool = True) -> str:
    """Run the unfinished jobs that no other process has; returns the last error, or ""."""
    failed = ""
    for job in [job for job in jobs if not job.done]:
        pack = work.pack if work and job.run.data == work.plan.data else None
        try:
            line = do(job, pack, quiet=quiet)
        except Interrupted:
            raise
        except Busy as busy:
            if work is None:  # one beside this one
                continue
            line = str(busy)
        except Exception as error:  # do not stop the other runs
            line = f"failed: {brief(error)}"
            failed = f"{job.name} {line}"
        print(f"[{sum(j.done for j in jobs)}/{len(jobs)}] {job.name}: {line}", flush=True)
    return failed


def _side_by_side(jobs: Sequence[Job], num: int) -> str:
    """``_take`` in ``num`` processes; returns what went wrong, or ""."""
    processes = [SPAWN.Process(target=_take_part, args=(jobs, i, num)) for i in range(num)]
    for process in processes:
        process.start()
    try:
        for process in processes:
            process.join()
    except KeyboardInterrupt:
        for process in processes:
            process.terminate()
            process.join()
        raise
    if any((process.exitcode or 0) < 0 for process in processes):
        return f"one of {num} processes was killed, most likely for lack of memory: give fewer --jobs"
    return "some runs failed, as told above" if any(process.exitcode for process in processes) else ""


def _take_part(jobs: Sequence[Job], index: int, num: int) -> None:
    """``_take`` as process ``index`` of ``num``, with its share of the cores and one GPU."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // num))
    if (gpus := torch.cuda.device_count()) > 1:
        jobs = [replace(job, run=replace(job.run, device=f"cuda:{index % gpus}")) for job in jobs]
    try:
        sys.exit(bool(_take(jobs)))
    except (Interrupted, KeyboardInterrupt):
        sys.exit(0)  # its parent tells it


def _end_with_parent() -> None:
    """SIGTERM to this process when its parent has ended, so that a killed command can be started again."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
