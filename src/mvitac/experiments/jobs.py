"""Run the jobs of a comparison. Several processes, also on other machines, share them by locks.

Jobs can be killed at any time and resume. A run whose loss became NaN or infinite counts as done and is kept as
failed.json. A run that fails otherwise is reported, and the next call tries it again.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.experiments.plan import Plan
from mvitac.registry import to_json
from mvitac.run import Run
from mvitac.system.files import brief, fields_of, read_json, write_json
from mvitac.system.locks import Busy, hold_lock
from mvitac.training.checkpoint import CHECKPOINT, PREVIOUS
from mvitac.training.log import read_log, seconds_of
from mvitac.training.loop import Diverged, Interrupted, train


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
        with fields_of(path := self.out / "failed.json"):
            return str(read_json(path, "a failure")["error"]) if path.exists() else ""

    @property
    def done(self) -> bool:
        path = self.out / "scores.json"
        if self.failure or not path.exists():
            return bool(self.failure)
        with fields_of(path):
            found = read_json(path, "a run's scores")  # which may have been copied from another run
            return (found["asked"], found["of"]) == (self.asked, self.run.digest())

    def seconds(self) -> float:
        return seconds_of(read_log(self.out), self.run.batch_size)


@dataclass(frozen=True)
class Work:
    """A plan on one dataset (or fold): the jobs, and the rows left out with the reason."""

    plan: Plan
    pack: Pack
    jobs: list[Job]
    left_out: dict[str, str]
    other_images: list[str] = field(default_factory=list)  # labels of rows that read other images than ``pack``'s


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
        scores = {key: result[key] for key in ("records", "retrieval")}
        write_json(job.out / "scores.json", {"asked": job.asked, "of": job.run.digest(), **scores}, sealed=True)
        for name in (CHECKPOINT, PREVIOUS):  # a scored run needs none, and one is four times as large as the weights
            (job.out / name).unlink(missing_ok=True)
        return f"{job.seconds():.0f} s of training"


def do_all(work: Work, *, quiet: bool = False) -> None:
    """Run the unfinished jobs that no other process has, and print a line about each.

    A job that fails is told and the others go on; ValueError at the end. Interrupted after Ctrl-C and a checkpoint.
    """
    failed = ""
    for job in [job for job in work.jobs if not job.done]:
        try:
            line = do(job, work.pack if job.run.data == work.plan.data else None, quiet=quiet)
        except (KeyboardInterrupt, Interrupted):
            raise Interrupted("stopped; the same command continues from here") from None
        except Busy as busy:
            line = str(busy)
        except Exception as error:  # do not stop the other runs
            line = f"failed: {brief(error)}"
            failed = f"{job.name} {line}"
        print(f"[{sum(j.done for j in work.jobs)}/{len(work.jobs)}] {job.name}: {line}", flush=True)
    if failed:
        raise ValueError(f"{failed}; the same command continues from here")
