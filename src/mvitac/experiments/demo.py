"""``mvitac demo``: simulate materials, pre-train, probe, write a report. Resumable."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mvitac.data.joined_pack import JoinedPack
from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs, stored_result
from mvitac.evaluation.probe import probe_model
from mvitac.evaluation.probe_config import Standardise
from mvitac.evaluation.scores import summarise
from mvitac.evaluation.sensors import RecolouredPack
from mvitac.model_files import load
from mvitac.recipes import RECIPES
from mvitac.report.report import write_report
from mvitac.report.tables import print_retrieval, print_summary
from mvitac.run import Run
from mvitac.system.files import write_json
from mvitac.system.progress import shown
from mvitac.training.loop import train


def run_demo(run: Run, out: Path, num_seeds: int) -> Path:
    """Pre-train ``run`` with several seeds, probe the features, and write a report. Finished parts are not repeated.

    ``out`` gets the runs (seed0, seed1, ...), probe.json (all scores), summary.json (task -> modality -> method or
    control -> mean, low, high, seeds, groups) and report/. Returns the path of the report's page.
    """
    if num_seeds < 1:
        raise ValueError(f"seeds {num_seeds}: give at least 1")
    start = time.perf_counter()
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
        if "new sensor" not in result and (other := run.data.on_new_sensor()) is not None:
            result["new sensor"] = scores_on_new_sensor(paths, pack, other.open(), result)
    for folder in (*paths, out):
        write_json(folder / "probe.json", result, sealed=True)
    write_json(out / "summary.json", result["summary"])
    print("4/4 drawing the report")
    with shown():
        page = write_report(paths, out / "report", result=result, pack=pack)
    print_summary(result)
    print_retrieval(result)
    new = result.get("new sensor", {"summary": {}})
    for first in list(new["summary"])[:1]:
        print_summary(new | {"summary": {first: new["summary"][first]}})
    print(f"figures: {out / 'summary.json'}\nreport: {page}    (open it in a browser)")
    print(f"took {(time.perf_counter() - start) / 60:.1f} minutes")
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
