"""Measure on one GPU, within a time limit: speed, then the main rows of Table I. Start it with benchmarks/gpu.sh.

    python -m benchmarks.gpu [--minutes 25] [--out FOLDER] [--resume FOLDER] [--commit HASH] [--smoke]

1. Simulated materials at 256 px, as many as fit in the time.
2. Table I from ImageNet (``mvitac compare``): rows of examples/imagenet.toml at 224 px, seed by seed.
3. Speed (``benchmarks.speed``): the step at batches 64 to 1,024, plain and compiled; input, end to end, probe, gradient
   caching.

``<out>/gpu.json`` has all figures. It is written after each part, and what is in it is not measured again.
``<out>/runs.tar.gz`` has the small files of finished runs. Both together continue on another machine (``--resume``). A
part that is cut off by the time limit starts again; a run of Table I continues from its checkpoint on the same machine.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mvitac.data.build import build
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.system.files import read_json, write_atomic, write_json
from mvitac.system.provenance import provenance

PLAN = Path(__file__).resolve().parents[1] / "examples" / "imagenet.toml"
TABLE_SECONDS = 45
"""Kept free at the end for controls and tables, because a comparison that is stopped has not made them."""
GRACE = 20
"""Seconds in which a stopped run writes its checkpoint."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """What is measured. ``view`` and ``stored`` are sides of images in pixels."""

    trunk: str = "tf_efficientnet_lite0"
    weights: str = "imagenet"
    view: int = 224
    stored: int = 256
    pairs: tuple[int, ...] = (6000, 4000, 2000)
    """Numbers of simulated pairs to choose from; a multiple of 2,000 has 4 of 20 instances of each class in test."""
    touches: int = 5
    workers: int = 0
    """Processes that simulate; 0 = one per core."""
    data_seconds: float = 90
    batch: int = 128
    steps: int = 300
    seeds: int = 3
    rows: tuple[str, ...] = (
        "MViTac, the paper's choices",
        "MViTac",
        "supervised, both",
        "SSVTP, twice the steps",
        "TAG (CMC)",
    )
    """Rows of examples/imagenet.toml, in the order in which they are trained."""
    speed: tuple[tuple[str, str], ...] = (
        ("256", "--batch 256 --rounds 5 --sections step input whole"),
        ("Lite0, 256", "--trunk tf_efficientnet_lite0 --batch 256 --rounds 5 --sections step"),
        ("1024", "--batch 1024 --rounds 3 --sections step"),
        ("256 compiled", "--batch 256 --rounds 5 --sections compiled"),
        ("64", "--batch 64 --rounds 5 --sections step"),
        ("caching", "--sections caching probe"),
    )
    """Name and options of each call of ``benchmarks.speed``."""
    speed_seconds: float = 75
    """Limit of each of them."""


SMOKE = Size(
    trunk="mvitac_tiny",
    weights="scratch",
    view=32,
    stored=36,
    pairs=(160, 120),
    touches=2,
    workers=1,
    data_seconds=20,
    batch=16,
    steps=2,
    seeds=1,
    rows=Size.rows[:2],
    speed=(("4", "--quick --batch 4 --rounds 1 --sections step"),),
)
"""A rehearsal in seconds. Its figures have no meaning."""


def plan(size: Size) -> dict[str, Any]:
    """Return the plan of the comparison: rows of examples/imagenet.toml at this size of image, batch and steps."""
    found = tomllib.loads(PLAN.read_text())
    network = {"encoder.trunk": size.trunk, "encoder.weights": size.weights, "augment.size": size.view}
    rows = {row["label"]: row for row in found["rows"]}
    for row in rows.values():
        if "steps" in row.get("set", {}):  # SSVTP's, which sees half the images a step
            row["set"]["steps"] = 2 * size.steps
    return {
        "name": "gpu",
        "title": f"Table I from ImageNet, {size.view} px",
        "recipe": found["recipe"],
        "reference": size.rows[0],
        "tasks": ["category", "soft", "rough"],
        "set": {**network, "batch_size": size.batch, "steps": size.steps, "eval_every": 0},
        "rows": [rows[label] for label in size.rows],
    }


class Session:
    """One call: its time limit, its folders, and the figures of this and earlier calls."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.size = SMOKE if options.smoke else Size()
        self.out, self.work, self.device = options.out.absolute(), options.work.absolute(), options.device
        self.end = time.monotonic() + 60 * options.minutes
        os.environ["MVITAC_CACHE"] = str(self.work / "cache")
        for folder in (self.out, self.work):
            folder.mkdir(parents=True, exist_ok=True)
        if options.resume and not (self.out / "gpu.json").exists() and (options.resume / "gpu.json").exists():
            for name in ("gpu.json", "runs.tar.gz"):
                if (options.resume / name).exists():
                    shutil.copyfile(options.resume / name, self.out / name)
        fresh = {"size": json.loads(json.dumps(asdict(self.size))), "data": {}, "speed": {}, "runs": [], "sessions": []}
        self.found: dict[str, Any] = fresh
        if (self.out / "gpu.json").exists():
            self.found = read_json(self.out / "gpu.json", "figures of an earlier call")
            if self.found["size"] != fresh["size"]:
                raise ValueError(f"{self.out}/gpu.json was measured with other settings: give another --out")
        made = provenance()
        call = {"date": datetime.now(UTC).isoformat(timespec="minutes"), "minutes": options.minutes, **made}
        self.found["sessions"].append({**call, "commit": options.commit or made["commit"]})

    def left(self) -> float:
        """Seconds until the time limit."""
        return self.end - time.monotonic()

    def save(self) -> None:
        write_json(self.out / "gpu.json", self.found)

    def say(self, text: str) -> None:
        print(f"[{self.left() / 60:.1f} min left] {text}", flush=True)

    def child(
        self, name: str, command: Sequence[str], seconds: float, tick: Callable[[], object] = lambda: None
    ) -> int | None:
        """Run ``python -m command`` and write its output to ``<out>/log``.

        Returns:
            The exit status, or None if it was stopped after ``seconds``.
        """
        until = time.monotonic() + seconds
        with (self.out / "log").open("a") as log:
            log.write(f"\n== {name}: {' '.join(command)}\n")
            log.flush()
            child = subprocess.Popen(
                [sys.executable, "-m", *command], stdout=log, stderr=log, stdin=subprocess.DEVNULL, process_group=0
            )
            try:
                while child.poll() is None and time.monotonic() < until:
                    time.sleep(0.1)
                    tick()
                if child.poll() is not None:
                    return child.returncode
                child.terminate()  # training saves a checkpoint
                try:
                    child.wait(GRACE)
                except subprocess.TimeoutExpired:
                    log.write(f"killed {GRACE} s after its time limit\n")
                return None
            finally:
                if child.poll() is None:
                    os.killpg(child.pid, signal.SIGKILL)  # with its workers
                    child.wait()
                tick()

    def blame(self, name: str, status: int | None) -> str:
        """Return what became of a child that did not succeed."""
        return f"{name}: stopped by its time limit" if status is None else f"{name}: failed, see {self.out}/log"


def make_data(session: Session) -> list[str]:
    """Simulate as many pairs as fit in the time. Returns the options of ``mvitac compare`` that name them.

    Pairs are numbered, so another machine makes the same ones.
    """
    size = session.size
    config = MaterialsConfig(size=size.stored, touches=size.touches, workers=size.workers)
    if not session.found["data"]:
        num = 16 * (size.workers or os.cpu_count() or 1)
        with tempfile.TemporaryDirectory() as folder:
            start, trial = time.monotonic(), replace(config, num=num).source()
            build(trial, Path(folder) / "trial", size=size.stored, workers=size.workers, quiet=True)
            seconds = (time.monotonic() - start) / num
        possible = [count for count in size.pairs if count * seconds <= size.data_seconds]
        session.found["data"] = {"num": (possible or size.pairs[-1:])[0], "trial_seconds_per_pair": seconds}
    data = session.found["data"]
    session.say(f"simulating {data['num']} pairs at {size.stored} px")
    start = time.monotonic()
    pack = replace(config, num=data["num"]).open(quiet=True)
    data.update(seconds=round(time.monotonic() - start, 1), digest=pack.digest, cores=os.cpu_count())
    session.save()
    fields = {"num": data["num"], "size": size.stored, "touches": size.touches}
    return ["--data", "materials", *(text for key, value in fields.items() for text in (f"--data.{key}", str(value)))]


def measure_speed(session: Session) -> None:
    """Run the calls of ``benchmarks.speed`` that are not finished."""
    for name, options in session.size.speed:
        known = session.found["speed"].get(name, {})
        if known.get("finished"):
            continue
        if session.left() < 20:
            return
        session.say(f"speed, {name}")
        file = session.work / f"speed-{name.replace(' ', '-')}.json"
        file.unlink(missing_ok=True)
        command = ["benchmarks.speed", "--device", session.device, *options.split(), "--json", str(file)]
        status = session.child(f"speed {name}", command, min(session.size.speed_seconds, session.left() - 10))
        result = read_json(file, "speed") if file.exists() else known  # sections that were finished before the limit
        session.found["speed"][name] = {**result, "finished": status == 0}
        if status != 0:
            session.say(session.blame(f"speed {name}", status))
        session.save()


def compare_methods(session: Session) -> None:
    """Train and score the rows of Table I, seed by seed, and make the table of what is finished."""
    if session.left() < TABLE_SECONDS + session.size.data_seconds:
        return
    data = make_data(session)
    folder, archive = session.work / "table", session.out / "runs.tar.gz"
    if archive.exists() and not folder.exists():
        with tarfile.open(archive) as tar:
            tar.extraction_filter = getattr(tarfile, "data_filter", None)  # type: ignore  # not in Python 3.11.0 to 3.11.3
            tar.extractall(folder)
    write_json(session.work / "plan.json", plan(session.size))
    given = ["mvitac", "compare", "--plan", str(session.work / "plan.json"), *data, "--out", str(folder)]
    given += ["--device", session.device]
    done = len(session.found["runs"]) // len(session.size.rows)
    for seed in range(min(done, session.size.seeds - 1), session.size.seeds):
        if session.left() < TABLE_SECONDS:
            return
        session.say(f"Table I, seed {seed}")
        command = [*given, "--seeds", str(seed + 1)]
        status = session.child(
            f"table, seed {seed}", command, session.left() - TABLE_SECONDS, lambda: keep_runs(session)
        )
        if status is None and any(folder.glob("runs/*/*/scores.json")):
            status = session.child("table", [*command, "--tables-only"], session.left() - 5)
        if status != 0:
            session.say(session.blame("Table I", status))
        if status == 0:
            session.found["table"] = table(folder)
        keep_runs(session, again=True)
        if status != 0 or session.found["table"]["unfinished"]:
            return


def keep_runs(session: Session, *, again: bool = False) -> None:
    """Keep the small files of finished runs, and each run's accuracies, if a run has finished meanwhile."""
    folder = session.work / "table"
    scored = sorted(folder.glob("runs/*/*/scores.json"))
    if len(scored) == len(session.found["runs"]) and not again:
        return
    session.found["runs"] = [accuracies(path) for path in scored]
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        ended = {path.parent for path in [*scored, *folder.glob("runs/*/*/failed.json")]}
        files = [f for run in sorted(ended) for f in run.iterdir() if f.suffix in (".json", ".jsonl")]
        for path in [*files, *folder.glob("*.json"), *folder.glob("*.md")]:
            tar.add(path, path.relative_to(folder))
    write_atomic(session.out / "runs.tar.gz", lambda file: file.write(buffer.getvalue()))
    session.save()


def accuracies(scores: Path) -> dict[str, Any]:
    """Return the accuracies of one run, by task and modality."""
    records = read_json(scores, "a run's scores")["records"]
    found = {f"{r['task']}, {r['modality']}, {r['probe']}": round(r["accuracy"], 4) for r in records}
    return {"row": scores.parent.parent.name, "seed": scores.parent.name, "accuracy": found}


def table(folder: Path) -> dict[str, Any]:
    """Return the figures of the comparison's table: accuracies with intervals, retrieval, cost."""
    from mvitac.experiments.table import lines_of  # imports torch, which processes that simulate do not need

    result = read_json(folder / "result.json", "a comparison")
    cells = [
        {"row": line.source, "modality": line.modality, "task": task, "seeds": max(1, len(cell["seeds"]))}
        | {key: cell[key] for key in ("mean", "low", "high")}
        for line in lines_of(result)
        for task, cell in line.cells.items()
    ]
    found = [{key: r[key] for key in ("source", "seed", "direction", "R@5")} for r in result["retrieval"]]
    kept = ("rows", "cost", "unfinished", "failed", "run_devices", "run_commits", "run_precisions", "pack")
    return {"cells": cells, "retrieval": found, **{key: result[key] for key in kept}}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Measure on one GPU, within a time limit.")
    parser.add_argument("--minutes", type=float, default=25, help="time limit of this call; default 25")
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"), help="folder of the figures; default runs/gpu")
    parser.add_argument("--work", type=Path, default=Path("runs/gpu-work"), help="folder of data and weights")
    parser.add_argument("--resume", type=Path, help="--out of an earlier call, if --out has no figures yet")
    parser.add_argument("--commit", help="commit of this code, if it is not in a git checkout")
    parser.add_argument("--device", default="cuda", help="cuda (default) or cpu")
    parser.add_argument("--smoke", action="store_true", help="a rehearsal in seconds")
    session = Session(parser.parse_args(argv))
    session.save()
    compare_methods(session)
    measure_speed(session)
    session.save()
    session.say(f"written: {session.out}/gpu.json; the same command continues")


if __name__ == "__main__":
    main()
