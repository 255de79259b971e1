"""``mvitac demo``: simulate materials, pre-train, probe, write a report. Resumable."""

import os
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_EXCEPTION, wait
from dataclasses import replace
from pathlib import Path
from typing import Any

from mvitac.data.joined_pack import JoinedPack
from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs, stored_result
from mvitac.evaluation.probe import probe_model
from mvitac.evaluation.scores import summarise
from mvitac.evaluation.sensors import RecolouredPack, Standardise
from mvitac.model_files import load
from mvitac.recipes import RECIPES
from mvitac.report.report import write_report
from mvitac.report.tables import print_retrieval, print_summary
from mvitac.run import Run
from mvitac.system.console import Console
from mvitac.system.device import describe_precision, pick_device, pick_precision
from mvitac.system.files import write_json
from mvitac.system.processes import side_by_side
from mvitac.system.progress import shown
from mvitac.training.log import in_a_bar, last_line
from mvitac.training.loop import Interrupted, train


def run_demo(run: Run, out: Path, num_seeds: int, console: Console) -> Path:
    """Pre-train ``run`` with several seeds, probe the features, and write a report. Finished parts are not repeated.

    ``out`` gets the runs (seed0, seed1, ...), probe.json (all scores), summary.json (task -> modality -> method or
    control -> mean, low, high, seeds, groups) and report/. Returns the path of the report's page.
    """
    if num_seeds < 1:
        raise ValueError(f"seeds {num_seeds}: give at least 1")
    start = time.perf_counter()
    say = lambda text: console.print(text, soft_wrap=True, highlight=False)  # noqa: E731
    say(f"1/4 simulating {run.data.name}: {getattr(run.data, 'num', '')} pairs, kept in the cache")
    pack = run.data.open()
    runs = [(replace(run, seed=run.seed + i), out / f"seed{run.seed + i}") for i in range(num_seeds)]
    steps = run.num_steps(len(pack.rows("train")))
    say(f"recipe {run.recipe}: {(RECIPES[run.recipe].__doc__ or '').splitlines()[0]}")
    unfinished = [(seeded, path) for seeded, path in runs if not (path / "model.safetensors").exists()]
    if len(unfinished) > 1 and pick_device(run.device).type == "cpu" and (os.cpu_count() or 1) > 1:
        # Several runs of few threads get more out of the cores than one run of many (docs/speed.md).
        say(f"2/4 pre-training {len(unfinished)} seeds side by side: {steps} steps of {run.batch_size} pairs each")
        device = pick_device(run.device)
        say(describe_precision(run.precision, pick_precision(run.precision, device), device))
        train_together(unfinished, steps, console)
    for seeded, path in runs:  # a finished run is only checked against the settings
        if not (path / "model.safetensors").exists():
            say(f"2/4 pre-training seed {seeded.seed} (of {num_seeds}): {steps} steps of {run.batch_size} pairs")
        train(seeded, path, resume=True, pack=pack)
    paths = [path for _, path in runs]
    say("3/4 probing the frozen features and the controls")
    with shown(console):
        result = stored_result(paths, pack) or probe_runs(paths, ProbeConfig(), pack)
        if "new sensor" not in result and (other := run.data.on_new_sensor()) is not None:
            result["new sensor"] = scores_on_new_sensor(paths, pack, other.open(), result)
    for folder in (*paths, out):
        write_json(folder / "probe.json", result, sealed=True)
    write_json(out / "summary.json", result["summary"])
    say("4/4 drawing the report")
    with shown(console):
        page = write_report(paths, out / "report", result=result, pack=pack)
    print_summary(result, console)
    print_retrieval(result, console)
    new = result.get("new sensor", {"summary": {}})
    for first in list(new["summary"])[:1]:
        print_summary(new | {"summary": {first: new["summary"][first]}}, console)
    say(f"figures: {out / 'summary.json'}\nreport: {page}    (open it in a browser)")
    say(f"took {(time.perf_counter() - start) / 60:.1f} minutes")
    return page


def scores_on_new_sensor(paths: Sequence[Path], learn: Pack, score: Pack, known: dict[str, Any]) -> dict[str, Any]:
    """What the runs at ``paths``, and labels of ``learn``, are worth on the touch sensor of ``score``, which they never saw.

    ``known`` is the result of ``probe_runs`` on ``learn``. Returns "data", "group_by", "notes" and "summary", as in that
    result; the sources are the known sensors, the new sensor as it is, and in the known sensors' colours unless it has too
    few images for that, which is then a note.
    """
    looks: dict[str, tuple[type[JoinedPack], tuple[Standardise, ...]]] = {
        "new sensor, as it is": (JoinedPack, ()),
        "new sensor, in known colours": (RecolouredPack, ("colours", "features")),
    }
    models, records, notes = [load(path) for path in paths], [], []
    for source, (join, standardise) in looks.items():
        try:
            pack = join(learn, score)
        except ValueError as error:
            notes.append(f"{source}: {error}")
            continue
        for model in models:
            found = probe_model(model, pack, pack.spec.tasks, ("touch", "both"), ("linear",), standardise)
            records += [{"source": source, "seed": model.seed, **r} for r in found if r["probe"] == "linear"]
    own = known["records"][0]["source"]
    old = [
        r | {"source": "known sensors"} for r in known["records"] if r["source"] == own and r["modality"] != "vision"
    ]
    asked = {r["task"] for r in records}
    data = f"{known['data']} on a sensor it never saw ({', '.join(score.sensor_names)})"
    summary = summarise([r for r in [*old, *records] if r["task"] in asked])
    return {"data": data, "group_by": score.spec.group_by, "notes": notes, "summary": summary}


def train_together(runs: Sequence[tuple[Run, Path]], num_steps: int, console: Console) -> None:
    """Pre-train ``runs`` at the same time, each in a process of its own, with a bar for each.

    Interrupted after Ctrl-C, when every run has saved its checkpoint; the first run's error if one fails.
    """
    with shown(console) as bars, side_by_side(len(runs)) as pool:
        assert bars is not None
        overall = bars.add_task("pre-training", total=num_steps * len(runs), unit="steps", rate="pairs")
        tasks = {path: bars.add_task(f"seed {run.seed}", total=num_steps, silent=True) for run, path in runs}
        waiting = {pool.submit(train, run, path, resume=True, quiet=True) for run, path in runs}
        try:
            while waiting:
                done, waiting = wait(waiting, timeout=0.5, return_when=FIRST_EXCEPTION)
                said = [in_a_bar(last_line(path), num_steps, run.batch_size) for run, path in runs]
                for path, one in zip(tasks, said, strict=True):
                    bars.update(tasks[path], **one)
                if all(one["speed"] for one in said):  # side by side they take as long as the slowest
                    whole = {"left": max(one["left"] for one in said), "speed": sum(one["speed"] for one in said)}
                    bars.update(overall, completed=sum(one["completed"] for one in said), **whole)
                for future in done:
                    future.result()
            bars.end(overall)
        except KeyboardInterrupt:  # the terminal sent it to the runs as well, which stop after their step
            raise Interrupted("stopped; the same command continues from here") from None
