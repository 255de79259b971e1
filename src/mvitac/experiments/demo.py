"""``mvitac demo``: simulate materials, pre-train, probe, write a report. Resumable."""

import time
from dataclasses import replace
from pathlib import Path

from mvitac.evaluation.evaluate import ProbeConfig, probe_runs, stored_result
from mvitac.recipes import RECIPES
from mvitac.report.report import write_report
from mvitac.report.tables import print_retrieval, print_summary
from mvitac.run import Run
from mvitac.system.files import write_json
from mvitac.system.progress import shown
from mvitac.training.loop import train
from mvitac.training.setup import check_start


def run_demo(run: Run, out: Path, num_seeds: int) -> Path:
    """Pre-train ``run`` with several seeds, probe the features, and write a report. Finished parts are not repeated.

    ``out`` gets the runs (seed0, seed1, ...), probe.json (all scores), summary.json (task -> modality -> method or
    control -> mean, low, high, seeds, groups) and report/. Returns the path of the report's page.
    """
    if not 1 <= num_seeds <= 1000:
        raise ValueError(f"seeds {num_seeds}: give 1 to 1000")
    start = time.perf_counter()
    check_start(run, out / f"seed{run.seed}")
    print(f"1/4 simulating {run.data.name}: {getattr(run.data, 'num', '')} pairs, kept in the cache")
    pack = run.data.open()
    runs = [(replace(run, seed=run.seed + i), out / f"seed{run.seed + i}") for i in range(num_seeds)]
    steps = run.num_steps(len(pack.rows("train")))
    print(f"recipe {run.recipe}: {(RECIPES[run.recipe].__doc__ or '').splitlines()[0]}")
    for seeded, path in runs:  # a finished run is only checked against the settings
        if not (path / "model.safetensors").exists():
            print(f"2/4 pre-training seed {seeded.seed} (of {num_seeds}): {steps} steps of {run.batch_size} pairs")
        train(seeded, path, resume=True, pack=pack)
    paths = [path for _, path in runs]
    print("3/4 probing the frozen features and the controls")
    with shown():
        result = stored_result(paths, pack) or probe_runs(paths, ProbeConfig(), pack)
    for folder in (*paths, out):
        write_json(folder / "probe.json", result, sealed=True)
    write_json(out / "summary.json", result["summary"])
    print("4/4 drawing the report")
    with shown():
        page = write_report(paths, out / "report", result=result, pack=pack)
    print_summary(result)
    print_retrieval(result)
    print(f"figures: {out / 'summary.json'}\nreport: {page}    (open it in a browser)")
    print(f"took {(time.perf_counter() - start) / 60:.1f} minutes")
    return page
