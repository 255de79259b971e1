"""The encoder of a bench: load it, say what it is, score it, and write its result."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mvitac.bench.result import read_result, sign, write_result
from mvitac.bench.score import Entry, score_suite
from mvitac.bench.suite import Suite
from mvitac.deploy.artifact import MANIFEST, load
from mvitac.evaluation.evaluate import names_of
from mvitac.evaluation.leaks import FILE, read_sources
from mvitac.experiments.plan import slug
from mvitac.model import Model
from mvitac.nn.encoders import SCRATCH, num_features
from mvitac.system.files import check_place, digest
from mvitac.system.locks import hold_lock
from mvitac.system.provenance import provenance


@dataclass(frozen=True, kw_only=True)
class About:
    """What only the encoder's owner knows."""

    name: str = ""
    """Name on the page. Default: the method, its recipe and its trunk."""
    licence: str = ""
    """Licence of the weights."""
    trained_on: str = ""
    """Names of all data that it was trained on. Default: what its run or its adapter says."""
    images_seen: int = 0
    """Images that it saw in training, repeats counted. Default: steps x batch size of its run."""


def run_bench(places: Sequence[str], suite: Suite, out: Path, root: Path | None, about: About) -> Path:
    """Score an encoder on a suite and write <out>/<suite>-<name>.json.

    Args:
        places: Folders of runs or artifacts: the seeds of one encoder.
        suite: The suite.
        out: Folder of results. Parts of an interrupted bench are in <out>/parts, and the same call continues.
        root: Folder of real data; None = without.
        about: What its owner says.

    Raises:
        ValueError: If the encoder cannot be loaded or scored, or the folder has another encoder of this name.
    """
    models = [load(place) for place in places]
    encoder = describe(models, [Path(place) for place in places], about)
    path = out / f"{suite.name}-{slug(encoder['name'])}.json"
    check_place(path)
    if path.exists() and (old := read_result(path)["encoder"])["weights"] != encoder["weights"]:
        raise ValueError(
            f"{path} is the result of other weights ({old['weights'][0][:12]}): give --name or another --out"
        )
    entry = Entry(models, [Path(place) for place in places], encoder["name"], encoder["trained_on"])
    start, parts, key = time.perf_counter(), out / "parts", digest(encoder)
    with hold_lock(path, f"another process writes {path}", wait=False):
        blocks = list(score_suite(entry, suite, root, parts, key))
        if all("not_run" in block for block in blocks):
            raise ValueError(f"{encoder['name']} was scored on no task of {suite.name}: {blocks[0]['not_run']}")
        here = {"time": datetime.now(UTC).isoformat(timespec="seconds"), "seconds": round(time.perf_counter() - start)}
        write_result(path, sign(suite, encoder, blocks, {**provenance(), **here}))
        for part in parts.glob(f"{key[:16]}-*.json"):
            part.unlink()
    return path


def describe(models: Sequence[Model], paths: Sequence[Path], about: About) -> dict[str, Any]:
    """What a result says of its encoder; ValueError if the models are not seeds of one encoder."""
    names = names_of(paths, models)
    if len(set(names)) > 1:
        raise ValueError(f"these are different encoders ({', '.join(dict.fromkeys(names))}): bench them one by one")
    model, run = models[0], models[0].run
    parameters = {m: sum(p.numel() for p in trunk.parameters()) for m, trunk in model.encoders.items()}
    start = [] if run.encoder.weights == SCRATCH else [f"starts from weights {Path(run.encoder.weights).name}"]
    return {
        "name": about.name or f"{run.method.name} ({run.recipe}, {run.encoder.trunk})",
        "kind": "artifact" if (paths[0] / MANIFEST).exists() else "run",
        "method": run.method.name,
        "trunk": run.encoder.trunk,
        "size": run.augment.eval_size,
        "seeds": [each.run.seed for each in models],
        "weights": [each.weights_digest() for each in models],
        "parameters": parameters,
        "features": {m: num_features(trunk) for m, trunk in model.encoders.items()},
        "images_seen": about.images_seen or _images_seen(model, paths[0]),
        "licence": about.licence or None,
        "trained_on": about.trained_on or "; ".join([model.spec.name, *start]),
    }


def _images_seen(model: Model, path: Path) -> int | None:
    """Steps x batch size: images of each modality, repeats counted. None if it started from weights, or is not known."""
    if model.run.encoder.weights != SCRATCH or not ((path / FILE).exists() or model.run.steps):
        return None
    rows = model.run.batch_size
    if not model.run.steps:
        rows = sum(len(source.ids) for source in read_sources(path, model.run, None, None) or [])
    return model.run.num_steps(rows) * model.run.batch_size
