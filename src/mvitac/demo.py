"""``mvitac demo``: the whole road on simulated materials, simulate -> pre-train -> probe -> report, resumable."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from mvitac.record import write_json
from mvitac.report import write_report
from mvitac.run import Run
from mvitac.session import Session, probe_runs
from mvitac.tables import print_retrieval, print_summary
from mvitac.train import train


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
    paths = []
    for seed in range(num_seeds):
        say(f"2/4 pre-training seed {seed} (of {num_seeds}): {run.num_steps(len(pack.rows('train')))} steps")
        seeded = replace(run, seed=run.seed + seed)
        paths.append(train(seeded, out / f"seed{seeded.seed}", resume=True, pack=pack))
    say("3/4 probing the frozen features, beside controls")
    result = probe_runs(paths, Session(), pack)
    write_json(out / "probe.json", result)
    write_json(out / "summary.json", result["summary"])
    say("4/4 drawing the report")
    page = write_report(paths, out / "report", result=result, pack=pack)
    print_summary(result, console)
    print_retrieval(result, console)
    say(f"figures: {out / 'summary.json'}\nreport: {page}    (open it in a browser)")
    say(f"took {(time.perf_counter() - start) / 60:.1f} minutes")
    return page
