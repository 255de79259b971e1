"""``mvitac demo``: the whole road on simulated materials, simulate -> pre-train -> probe -> report, resumable."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_EXCEPTION, wait
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.recipes import RECIPES
from mvitac.report.report import write_report
from mvitac.report.tables import print_retrieval, print_summary
from mvitac.run import Run
from mvitac.system.device import pick_device
from mvitac.system.files import write_json
from mvitac.system.processes import side_by_side
from mvitac.training.log import bars, last_line
from mvitac.training.loop import Interrupted, train


def run_demo(run: Run, out: Path, num_seeds: int, console: Console) -> Path:
    """Pre-train ``run`` with seeds 0 .. num_seeds - 1 below ``out``, probe, report; returns the report's path.

    Leaves <out>/seed<i>/ (runs), probe.json (everything), summary.json (task -> modality -> method or control -> mean,
    low, high, seeds) and report/. What is finished is not done again.
    """
    if num_seeds < 1:
        raise ValueError(f"seeds {num_seeds}: give at least 1")
    start = time.perf_counter()
    say = lambda text: console.print(text, soft_wrap=True, highlight=False)  # noqa: E731
    say(
        f"1/4 simulating {run.data.name}: {getattr(run.data, 'num', '')} pairs, once; later runs find them in the cache"
    )
    pack = run.data.open()
    runs = [(replace(run, seed=run.seed + i), out / f"seed{run.seed + i}") for i in range(num_seeds)]
    steps = run.num_steps(len(pack.rows("train")))
    say(f"recipe {run.recipe}: {(RECIPES[run.recipe].__doc__ or '').splitlines()[0]}")
    unfinished = [(seeded, path) for seeded, path in runs if not (path / "model.safetensors").exists()]
    if len(unfinished) > 1 and pick_device(run.device).type == "cpu" and (os.cpu_count() or 1) > 1:
        # Several runs of few threads get more out of the cores than one run of many (docs/speed.md).
        say(f"2/4 pre-training {len(unfinished)} seeds side by side: {steps} steps of {run.batch_size} pairs each")
        train_together(unfinished, steps, console)
    for seeded, path in runs:  # what is finished is only held against what is asked for
        if not (path / "model.safetensors").exists():
            say(f"2/4 pre-training seed {seeded.seed} (of {num_seeds}): {steps} steps of {run.batch_size} pairs")
        train(seeded, path, resume=True, pack=pack)
    paths = [path for _, path in runs]
    say("3/4 probing the frozen features, beside controls")
    result = probe_runs(paths, ProbeConfig(), pack)
    write_json(out / "probe.json", result)
    write_json(out / "summary.json", result["summary"])
    say("4/4 drawing the report")
    page = write_report(paths, out / "report", result=result, pack=pack)
    print_summary(result, console)
    print_retrieval(result, console)
    say(f"figures: {out / 'summary.json'}\nreport: {page}    (open it in a browser)")
    say(f"took {(time.perf_counter() - start) / 60:.1f} minutes")
    return page


def train_together(runs: Sequence[tuple[Run, Path]], num_steps: int, console: Console) -> None:
    """Pre-train ``runs`` at the same time, each in a process of its own, with a line of progress for each.

    Where no one sees bars move (a file, a pipe) a line is printed for every tenth of the way.
    Interrupted after Ctrl-C, when every run has saved its checkpoint; the first run's error if one fails.
    """
    with bars(console) as progress:
        tenth = 0
        tasks = {path: progress.add_task(f"seed {run.seed}", total=num_steps, text="") for run, path in runs}
        with side_by_side(len(runs)) as pool:
            waiting = {pool.submit(train, run, path, resume=True, quiet=True) for run, path in runs}
            try:
                while waiting:
                    done, waiting = wait(waiting, timeout=0.5, return_when=FIRST_EXCEPTION)
                    for path, task in tasks.items():
                        step, text = last_line(path)
                        finished = (path / "model.safetensors").exists()
                        progress.update(task, completed=num_steps if finished else step, text=text)
                    slowest = min(progress.tasks, key=lambda task: task.completed)
                    if not console.is_terminal and 10 * slowest.completed // num_steps > tenth:
                        tenth = int(10 * slowest.completed // num_steps)
                        console.print(f"  {slowest.completed:.0f}/{num_steps} steps  {slowest.fields['text']}")
                    for future in done:
                        future.result()
            except KeyboardInterrupt:  # the terminal sent it to the runs as well, which stop after their step
                raise Interrupted("stopped; the same command goes on from here") from None
