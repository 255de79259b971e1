"""The encoder of a bench: load it, say what it is, score it, write its result."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mvitac.bench.check import GUESS, wrong_name
from mvitac.bench.external import ExternalModel
from mvitac.bench.external.adapters import NOTHING
from mvitac.bench.result import FORM, read_signed, sign, write_result
from mvitac.bench.score import Entry, score_suite
from mvitac.bench.suite import Suite
from mvitac.deploy.artifact import load
from mvitac.evaluation.controls import CONTROLS
from mvitac.evaluation.leaks import FILE, UNKNOWN, read_sources
from mvitac.evaluation.run_names import names_of
from mvitac.experiments.plan import slug
from mvitac.model import Model
from mvitac.nn.encoders import SCRATCH, num_features
from mvitac.run import load_run
from mvitac.system.files import check_place, digest, fields_of
from mvitac.system.locks import hold_lock
from mvitac.system.provenance import provenance

Score = Callable[[Sequence[Model], dict[str, Any]], dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class About:
    """What only the encoder's owner knows."""

    name: str = ""
    """Name on the page. Default: method, recipe and trunk, or the name of an external encoder."""
    licence: str = ""
    """Licence of the weights. Default: that of the adapter of an external encoder."""
    trained_on: str = ""
    """Names of all data that it was trained on. Default: what its run or its adapter says."""

    def __post_init__(self) -> None:
        if self.name and (why := wrong_name(self.name, (*CONTROLS, GUESS))):
            raise ValueError(f"--name: the encoder {why}: give another")
        for key, text in (("licence", self.licence), ("trained-on", self.trained_on)):
            if not text.isprintable():  # a terminal would obey it
                raise ValueError(f"--{key}: {text!r} has a control character: leave it out")


def run_bench(places: Sequence[str], suite: Suite, out: Path, root: Path | None, about: About) -> Path:
    """Score an encoder on a suite and write <out>/<suite>-<name>.json; the same call continues an interrupted one.

    ``places`` are its seeds: folders of runs or artifacts, or "external:...". ``root`` is the folder of real data.
    """

    def score(models: Sequence[Model], encoder: dict[str, Any]) -> dict[str, Any]:
        entry = Entry(models, places, encoder["name"], encoder["trained_on"])
        blocks = list(score_suite(entry, suite, root, out / "parts", digest(encoder)))
        if all("not_run" in block for block in blocks):
            raise ValueError(f"{entry.name} was scored on no task of {suite.name}: {blocks[0]['not_run']}")
        return {"blocks": blocks}

    return measure(places, suite, out, about, score)


def measure(
    places: Sequence[str], suite: Any, out: Path, about: About, score: Score, form: tuple[str, int] = FORM
) -> Path:
    """Load an encoder (its seeds), let ``score`` measure it, and write <out>/<suite>-<name>.json.

    ``score`` gets the models and the encoder as ``describe`` says it, and returns the fields of its own in the result.
    """
    models = [load(place) for place in places]
    encoder = describe(models, places, about)
    path = out / f"{slug(suite.name + '-' + encoder['name'])}.json"
    check_place(path)
    old: dict[str, Any] = read_signed(path, form) if path.exists() else {"encoder": encoder}
    name, weights = (old["encoder"][key] for key in ("name", "weights"))
    if (name, weights) != (encoder["name"], encoder["weights"]):
        raise ValueError(f"{path} is the result of {name!r}, weights {weights[0][:12]}: give --name, or another --out")
    if old.get("suite_digest", suite.digest()) != suite.digest():
        raise ValueError(f"{path} is the result of another suite {suite.name!r}: rename it, or give another --out")
    start = time.perf_counter()
    with hold_lock(path, f"another process writes {path}: wait for it, or give another --out", wait=False):
        found = score(models, encoder)
        scored = ([b for b in one.get("blocks", ()) if "data" in b] for one in (old, found))
        was, now = ({(b["set"], b["task"]): b["data"] for b in blocks} for blocks in scored)
        for key in (key for key in was if now.get(key) != was[key]):
            what = f"other data of {key[0]}" if key in now else f"{': '.join(key)}, which is not run now"
            raise ValueError(f"{path} is the result on {what}: move it, or give another --out")
        took = {"time": datetime.now(UTC).isoformat(timespec="seconds"), "seconds": round(time.perf_counter() - start)}
        write_result(path, sign(form, suite, encoder, found, {**provenance(), **took}))
        for part in (out / "parts").glob(f"{digest(encoder)[:16]}-*.json"):
            part.unlink()
    return path


def describe(models: Sequence[Model], places: Sequence[str], about: About) -> dict[str, Any]:
    """What a result says of its encoder; ValueError if the models are not seeds of one encoder."""
    model, seeds = models[0], [each.seed for each in models]
    external = isinstance(model, ExternalModel)
    names = [m.title for m in models] if external else names_of([Path(place) for place in places], models)
    weights = [each.weights_digest() for each in models]
    if len(set(names)) > 1 or not len(seeds) == len(set(seeds)) == len(set(weights)):
        raise ValueError(f"{', '.join(places)} are not seeds of one encoder: bench them one by one")
    found = _of_external(model) if isinstance(model, ExternalModel) else _of_run(model, Path(places[0]))
    given = {key: value for key, value in vars(about).items() if value}
    # Of floats: the wrapper of an external network keeps a digest among its parameters.
    sizes = {m: sum(p.numel() for p in t.parameters() if p.is_floating_point()) for m, t in model.encoders.items()}
    side = max(model.image_sizes(m)[0] for m in model.encoders)
    return {**found, **given, "size": side, "seeds": seeds, "weights": weights, "parameters": sizes}


def _of_external(model: ExternalModel) -> dict[str, Any]:
    described = model.describe()
    licences = dict.fromkeys(part["licence"] for part in described["encoders"].values())
    known = None if model.trained_on == UNKNOWN else model.trained_on
    about = {"name": model.title, "licence": "; ".join(licences), "trained_on": known}
    return {**about, "images_seen": 0 if known == NOTHING else None, "external": described}


def _of_run(model: Model, path: Path) -> dict[str, Any]:
    run = model.run
    weights = dict.fromkeys(run.encoder[m].weights for m in model.encoders)
    start = [f"starts from {Path(name).name}" for name in weights if name != SCRATCH]
    if run.init.digest:
        record = load_run(path)[1] if (path / "run.json").exists() else {}
        with fields_of(path / "run.json"):
            known = record.get("start", {"name": "other weights", "trained_on": [UNKNOWN]})
            start += [f"starts from {known['name']}, which was trained on: {', '.join(known['trained_on'])}"]
    widths = {m: num_features(trunk) for m, trunk in model.encoders.items()}
    name = f"{run.method.name} ({run.recipe}, {run.encoder.named(model.encoders)})"
    about = {"name": name, "licence": None, "trained_on": "; ".join([model.spec.name, *start])}
    return {**about, "images_seen": _images_seen(model, path), "method": run.method.name, "features": widths}


def _images_seen(model: Model, path: Path) -> int | None:
    """Steps x batch size, which is images of each modality. None if it started from weights, or rows are not known."""
    run = model.run
    started = run.init.digest or {run.encoder[m].weights for m in model.encoders} != {SCRATCH}
    if started or not (run.steps or (path / FILE).exists()):
        return None
    return (run.steps or run.num_steps(sum(len(source.ids) for source in read_sources(path) or ()))) * run.batch_size
