"""Run the jobs of a comparison: one by one, in parallel, as a SLURM array, or on several machines.

Jobs can be killed at any time and resume. A run whose loss became NaN or infinite counts as done and is kept as
failed.json. A run that fails otherwise is reported, and the next call tries it again.
"""

import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from rich.progress import TaskID

from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import ProbeConfig, chosen, probe_runs
from mvitac.evaluation.robustness import stress
from mvitac.experiments.plan import Plan
from mvitac.model_files import load
from mvitac.nn.encoders import SCRATCH
from mvitac.nn.initial import Init
from mvitac.registry import to_json
from mvitac.run import Run
from mvitac.system.console import Console
from mvitac.system.device import pick_device
from mvitac.system.files import brief, read_json, write_json
from mvitac.system.locks import Busy, hold_lock
from mvitac.system.processes import my_device, side_by_side
from mvitac.system.progress import Bars, shown
from mvitac.training.checkpoint import CHECKPOINT, PREVIOUS
from mvitac.training.log import Logger, in_a_bar, last_line, read_log, seconds_of
from mvitac.training.loop import Diverged, Interrupted, train


@dataclass(frozen=True)
class Job:
    """One run of one row: its settings, its folder, and how it is scored."""

    label: str
    run: Run
    out: Path
    session: ProbeConfig
    stress: bool = False
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
        kept = ["scores.json", *(["stress.json"] if self.stress else [])]
        return bool(self.failure) or all(_scored(self.out / name) == self.asked for name in kept)

    def seconds(self) -> float:
        """Seconds of training."""
        return seconds_of(read_log(self.out), self.run.batch_size)

    def drop_checkpoint(self) -> None:
        """Delete the checkpoints. A scored run needs none, and one is four times as large as the weights."""
        for name in (CHECKPOINT, PREVIOUS):
            (self.out / name).unlink(missing_ok=True)


def _scored(path: Path) -> dict[str, Any] | None:
    """``Job.asked`` of the scores in ``path``; None if there are none."""
    try:
        return _asked(path, path.stat().st_mtime_ns)
    except FileNotFoundError:
        return None


@cache
def _asked(path: Path, changed: int) -> dict[str, Any]:
    return read_json(path, "a run's scores").get("asked", to_json(ProbeConfig()))  # version 0.1.0 did not store it


@dataclass(frozen=True)
class Work:
    """A plan on one dataset (or fold): the jobs, and the rows left out with the reason."""

    plan: Plan
    pack: Pack
    jobs: list[Job]
    left_out: dict[str, str]


def do(job: Job, pack: Pack | None = None, *, quiet: bool = True, loggers: tuple[Logger, ...] = ()) -> str:
    """Train and score one run; returns a line about it.

    Safe to call again after a kill, and from several processes at once: a run that another process works on is skipped.
    ``loggers`` are called during training, as in ``training.loop.train``.
    """
    try:
        with hold_lock(
            job.out, "another process runs it; this command makes the whole table once it is done", wait=False
        ):
            return "finished before" if job.done else _do(job, pack, quiet, loggers)
    except Busy as busy:
        return str(busy)


def _do(job: Job, pack: Pack | None, quiet: bool, loggers: tuple[Logger, ...]) -> str:
    pack = pack or job.run.data.open(quiet=True)
    gpu = pick_device(job.run.device)
    measured = gpu.type == "cuda" and not (job.out / "model.safetensors").exists()
    if measured:
        torch.cuda.reset_peak_memory_stats(gpu)
    try:
        train(job.run, job.out, resume=True, quiet=quiet, loggers=loggers, pack=pack)
    except Diverged as error:
        write_json(job.out / "failed.json", {"error": str(error)}, sealed=True)
        return f"diverged: {error}"
    if measured:
        write_json(job.out / "memory.json", {"peak_bytes": torch.cuda.max_memory_allocated(gpu)})
    result = probe_runs([job.out], job.session, pack)
    if job.stress:
        records = stress(load(job.out), pack, *chosen(pack, job.session))
        own = {"source": job.run.method.name, "seed": job.run.seed, "run": str(job.out)}
        leaks = {r["task"]: r["leak"] for r in result["records"] if "run" in r}
        found = {"asked": job.asked, "records": [{**own, **r, "leak": leaks[r["task"]]} for r in records]}
        write_json(job.out / "stress.json", found, sealed=True)
    scores = {"asked": job.asked, "records": result["records"], "retrieval": result["retrieval"]}
    write_json(job.out / "scores.json", scores, sealed=True)
    job.drop_checkpoint()
    return f"{job.seconds():.0f} s of training"


class _Reporter:
    """Prints a line about each finished job, and keeps the errors of failed ones."""

    def __init__(self, work: Work, say: Callable[[str], None]) -> None:
        self.work, self.say = work, say
        self.errors: list[Exception] = []

    def __call__(self, job: Job, result: Callable[[], str]) -> None:
        try:
            line = result()
        except (Interrupted, BrokenProcessPool):
            raise
        except Exception as error:  # do not stop the other runs
            self.errors.append(error)
            line = f"failed: {brief(error)}"
        jobs = self.work.jobs
        self.say(f"[{sum(j.done for j in jobs)}/{len(jobs)}] {job.name}: {line}")


def do_all(work: Work, num_jobs: int, say: Callable[[str], None], console: Console | None = None) -> None:
    """Run the unfinished jobs, ``num_jobs`` at a time, each on its own GPU if there are several.

    ``say`` receives a line about each job. The first error of a failed job is raised after all other jobs ran;
    ValueError if a process was killed; Interrupted after Ctrl-C, once the active runs have saved their checkpoints.
    """
    todo = [job for job in work.jobs if not job.done]
    for job in work.jobs:
        if job.done and not job.failure:
            with suppress(Busy), hold_lock(job.out, "", wait=False):
                job.drop_checkpoint()  # a killed process may have left it, and its lock
    report = _Reporter(work, say)
    try:
        with shown(console, quiet=console is None) as bars:
            progress = _Progress(work, todo, bars, num_jobs)
            if num_jobs == 1 or len(todo) < 2:
                _one_by_one(work, todo, report, progress, quiet=console is None)
            else:
                _side_by_side(todo, num_jobs, report, progress)
    except (KeyboardInterrupt, Interrupted):
        raise Interrupted("stopped; the same command continues from here") from None
    except BrokenProcessPool:
        raise ValueError(
            f"one of {num_jobs} processes was killed, most likely for lack of memory: give fewer --jobs; the same command"
            " continues from here"
        ) from None
    if report.errors:
        raise report.errors[0]


def _one_by_one(work: Work, todo: Sequence[Job], report: _Reporter, progress: "_Progress", *, quiet: bool) -> None:
    for job in todo:
        report.say(f"{job.name} ...")
        pack = work.pack if job.run.data == work.plan.data else None
        loggers = (lambda *_, job=job: progress.update([job]),)
        report(job, lambda job=job, pack=pack, loggers=loggers: do(job, pack, quiet=quiet, loggers=loggers))
        progress.update([])


def _side_by_side(todo: Sequence[Job], num_jobs: int, report: _Reporter, progress: "_Progress") -> None:
    gpus = torch.cuda.device_count()
    devices = [f"cuda:{i}" for i in range(gpus)] if gpus > 1 else ()
    with side_by_side(num_jobs, devices) as pool:
        jobs = {pool.submit(_do_here, job): job for job in todo}
        waiting = set(jobs)
        while waiting:
            done, waiting = wait(waiting, timeout=1, return_when=FIRST_COMPLETED)
            for future in done:
                report(jobs[future], future.result)
            progress.update([jobs[future] for future in waiting if future.running()])


class _Progress:
    """Progress of a comparison's jobs, and the time left by the speeds in the runs' logs."""

    def __init__(self, work: Work, todo: Sequence[Job], bars: Bars | None, num_jobs: int) -> None:
        self.todo, self.bars, self.num_jobs = todo, bars, num_jobs
        self.speeds: dict[str, float] = {}  # label of a row -> its last speed in pairs per second
        self.tasks: dict[Path, TaskID] = {}  # bars of the active runs
        if bars:
            # A fold may take a few steps more or less than counted here.
            self.steps = {job.out: job.run.num_steps(len(job.run.method.training_rows(work.pack))) for job in work.jobs}
            for job in work.jobs:
                self._read(job)
            self.overall = bars.add_task("all runs", total=len(todo), unit="runs", rate="")

    def _read(self, job: Job) -> dict[str, Any]:
        """Fields for the bar of ``job`` from its log; also keeps the speed of its row."""
        fields = in_a_bar(last_line(job.out), self.steps[job.out], job.run.batch_size)
        if fields["speed"]:
            self.speeds[job.label] = fields["speed"]
        return fields

    def update(self, active: Sequence[Job]) -> None:
        """Show how far the active jobs are, and the time left for all."""
        if not self.bars:
            return
        for path in self.tasks.keys() - {job.out for job in active}:
            self.bars.remove_task(self.tasks.pop(path))
        steps_done = {}
        for job in active:
            fields = self._read(job)
            steps_done[job.out] = fields["completed"]
            if len(self.todo) > 1 and self.num_jobs > 1:  # a run in this process has its own bar
                self._show(job, fields)
        todo = [job for job in self.todo if not job.done]
        part = sum(min(1, steps_done.get(job.out, 0) / self.steps[job.out]) for job in todo)
        left = self.seconds_left(todo, steps_done)
        self.bars.update(self.overall, completed=len(self.todo) - len(todo) + part, left=left)

    def _show(self, job: Job, fields: dict[str, Any]) -> None:
        assert self.bars
        if job.out not in self.tasks:
            options = {"total": self.steps[job.out], "unit": "steps", "rate": "pairs", "silent": True}
            self.tasks[job.out] = self.bars.add_task(job.name, **options)
        self.bars.update(self.tasks[job.out], **fields)

    def seconds_left(self, todo: Sequence[Job], steps_done: dict[Path, int]) -> float | None:
        """Seconds of training for ``todo``, ``num_jobs`` at a time; None if no speed is known.

        A row without a speed gets the mean of the others.
        """
        if not self.speeds:
            return None
        usual = fmean(1 / max(speed, 1e-9) for speed in self.speeds.values())
        seconds = 0.0
        for job in todo:
            pairs = max(0, self.steps[job.out] - steps_done.get(job.out, 0)) * job.run.batch_size
            seconds += pairs / self.speeds[job.label] if job.label in self.speeds else pairs * usual
        return seconds / min(self.num_jobs, max(1, len(todo)))


def _do_here(job: Job) -> str:
    device = my_device()
    return do(job if device == "auto" else replace(job, run=replace(job.run, device=device)))


def submit(work: Work, options: str) -> str:
    """Submit the unfinished jobs to SLURM as one array with submitit; returns at once with a line that has its id.

    ``options``: comma-separated name=value of submitit's ``update_parameters``, e.g. "slurm_partition=gpu,timeout_min=600".
    """
    try:
        import submitit  # type: ignore[import-not-found]
    except ImportError:
        raise ValueError(
            "--slurm needs submitit: pip install -e '.[slurm]' in mvitac's clone, or leave --slurm out"
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


class _Measured(Exception):
    """Pairs per second."""


def pairs_per_second(run: Run, pack: Pack) -> float:
    """Speed of the first steps of ``run`` after its start-up, trained from random weights in a temporary folder."""

    def stop(step: int, values: dict[str, float]) -> None:
        if "pairs_per_s" in values:
            raise _Measured(values["pairs_per_s"])

    run = replace(run, eval_every=0, encoder=replace(run.encoder, weights=SCRATCH), init=Init())
    with tempfile.TemporaryDirectory() as folder:
        try:
            train(run, Path(folder) / "run", quiet=True, loggers=(stop,), pack=pack)
        except _Measured as measured:
            return max(0.05, measured.args[0])  # logged with one decimal
    raise AssertionError("a run logs its first steps")
