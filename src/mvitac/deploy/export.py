"""Write a model as ONNX, and refuse to if the result is another model than the trained one.

The reference is ``Model.features`` and its probes, the code that computed the published scores. The candidate is the
written file, opened again as on a robot.
"""

import contextlib
import functools
import io
import logging
import timeit
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import torch

from mvitac.data.pack import Pack
from mvitac.deploy.artifact import preprocessing
from mvitac.deploy.engine import CHECK, EXPORT, MODEL, Call, Runtime, cosines, open_model
from mvitac.deploy.export_config import ExportConfig
from mvitac.deploy.export_module import ExportModule, output_of, quantise, write_onnx
from mvitac.evaluation.features import fitting, sample
from mvitac.evaluation.sensors import learn_looks
from mvitac.model import Model
from mvitac.system.device import has_bf16
from mvitac.system.locks import new_folder
from mvitac.system.progress import work
from mvitac.system.provenance import provenance

NEW_SENSOR = "--new-sensor"  # the option that errors name
NUM_CALIBRATION, NUM_CHECK = 128, 16
"""Images that set the ranges of int8; images for the check on the robot (int8 products saturate for some images only)."""


def export(
    model: Model, pack: Pack, out: Path, config: ExportConfig = ExportConfig(), *, new: Pack | None = None
) -> dict[str, Any]:
    """Write ``model`` with its probes as ONNX into the new folder ``out``, checked on test rows of ``pack``.

    Its train rows set the ranges of int8. ``new``: unlabelled images of a touch sensor that ``pack`` lacks. The export is
    then for that sensor, whose images it shows in the colours of those of ``pack``; its ranges and the check are of
    ``new`` (all rows, if none is of split test). Returns the report: cosines, accuracies, errors of values in their
    units, size in MB, latency in ms. Raises Busy if another process writes ``out``; ValueError if the export is not
    possible, or differs by more than ``config`` allows.
    """
    if config.precision == "bf16" and not has_bf16(torch.device("cpu")):
        raise ValueError("--precision bf16: this CPU does not compute bf16 itself, so it could not be checked")
    asked = tuple(sorted({*config.modalities}, reverse=True)) or tuple(model.encoders)  # vision, touch
    known, pack = pack, new or pack
    if new and "touch" not in asked:
        raise ValueError(f"{NEW_SENSOR} is about touch, which this export lacks: leave it out")
    for given in (known, pack):
        if {*fitting(model, given, asked, in_use=True)} != {*asked}:
            raise ValueError(f"{given.path} cannot check this model: it needs images of {' and '.join(asked)}")
    graph = ExportModule(model, asked, learn_looks(known, new, NEW_SENSOR) if new else None)
    if not len(rows := pack.rows("test", having=asked)):  # of a recording
        rows = np.flatnonzero(np.logical_and.reduce([pack.has(modality) for modality in asked]))
    if not len(rows):
        raise ValueError(f"{pack.path} has no rows with {' and '.join(asked)} to check the export on")
    rows = sample(rows, config.num_rows)
    with new_folder(out) as partial:
        with work("writing ONNX"), silent():
            write_onnx(graph, partial / MODEL)
            if config.precision == "int8":
                quantise(partial / MODEL, list(graph.inputs), _examples(graph, pack))
        with work("checking the outputs of the export"):
            wanted = reference(model, graph, pack, rows)
            check = functools.partial(parity, graph, pack=pack, rows=rows, wanted=wanted, **config.tolerance)
            runtime, call, report = _checked(partial / MODEL, config.precision, check)
            report["size_mb"] = round((partial / MODEL).stat().st_size / 1e6, 2)
            report["latency_ms"] = latency(call, [pack.images[m][rows[:1]] for m in graph.modalities])
        # A few real inputs and the outputs of the trained model, which ``Engine`` repeats where it is opened.
        some = np.linspace(0, len(rows) - 1, min(len(rows), NUM_CHECK)).astype(int)
        kept = {f"input_{m}": pack.images[m][rows[some]] for m in graph.modalities}
        kept |= {name: values[some] for name, values in wanted.items()}
        data = safetensors.numpy.save({name: np.ascontiguousarray(values) for name, values in kept.items()})
        (partial / CHECK).write_bytes(data)
        about = {
            **{"precision": config.precision, "runtime": runtime},
            "inputs": {m: list(shape) for m, shape in graph.inputs.items()},
            **{"outputs": list(graph.outputs), "classes": graph.classes, "values": graph.values},
            "preprocessing": preprocessing(model) | ({"new_sensor": graph.looks.about()} if graph.looks else {}),
            **{"weights": model.weights_digest(), "tolerance": config.tolerance, "report": report},
        }
        EXPORT.write(partial, {**about, "provenance": provenance()})
    return report


def _checked(path: Path, precision: str, check: Callable[[Call], Any]) -> tuple[Runtime, Call, dict[str, Any]]:
    """The first runtime whose outputs are those of the model, and the report of its ``check``. OpenVINO 2026.4 computes
    some int8 networks wrongly, such as a ResNet whose features are means of all its stages."""
    runtimes: dict[str, tuple[Runtime, ...]] = {"bf16": ("openvino",), "int8": ("auto", "onnxruntime")}
    trouble = ""
    for runtime in runtimes.get(precision, ("auto",)):
        call = open_model(path, runtime, precision)
        try:
            with np.errstate(all="ignore"):
                return runtime, call, check(call)
        except ValueError as error:
            trouble = f"{error}" + "; fp32 or bf16 may hold it, or other --modalities" * (precision == "int8")
    raise ValueError(trouble)


def _examples(graph: ExportModule, pack: Pack) -> list[list[np.ndarray]]:
    if not len(rows := pack.rows("train", "unlabelled", having=graph.modalities)):
        raise ValueError(f"{pack.path} has no rows in split train: int8 takes its ranges from them")
    return [[pack.images[m][r : r + 1] for m in graph.modalities] for r in sample(rows, NUM_CALIBRATION)]


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Hide what exporters print, log and warn about their own future; real faults are found by the check."""
    level = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logging.disable(level)


def reference(model: Model, graph: ExportModule, pack: Pack, rows: np.ndarray) -> dict[str, np.ndarray]:
    """The outputs of ``graph`` for pack rows, computed by the code of ``Model`` itself."""
    chunks = []
    for chunk in np.array_split(rows, max(1, len(rows) // 64)):
        images = {m: pack.images[m][chunk] for m in graph.modalities}
        shown = {m: graph.looks(x) if graph.looks and m == "touch" else [x] for m, x in images.items()}
        looks = {m: [torch.from_numpy(x).permute(0, 3, 1, 2) for x in each] for m, each in shown.items()}
        features = {m: torch.stack([model.features(m, x) for x in each]).mean(0) for m, each in looks.items()}
        found = {f"embedding_{m}": x for m, x in features.items()}
        for m in graph.projectors:
            wide = torch.stack([model.features(m, x, for_heads=True) for x in looks[m]]).mean(0)
            found[f"shared_{m}"] = model.project(m, wide)
        joined = torch.cat([features[m] for m in ("vision", "touch") if m in features], dim=1)
        found |= {output_of(r): r(joined) for r in graph.probes}  # type: ignore[arg-type]
        chunks.append(found)
    return {name: torch.cat([c[name] for c in chunks]).numpy() for name in graph.outputs}


def parity(
    graph: ExportModule,
    call: Call,
    pack: Pack,
    rows: np.ndarray,
    wanted: dict[str, np.ndarray],
    *,
    min_cosine: float,
    accuracy_loss: float = 0.5,
    value_loss: float = 0.1,
) -> dict[str, Any]:
    """Compare the outputs of ``call`` for pack rows with those ``wanted``. The limits are those of ``ExportConfig``.

    Returns num_rows; cosine by embedding (min, mean); accuracy by task (original, export, num labelled rows); errors of
    values by task. ValueError if they differ by more than a limit allows.
    """
    parts = np.array_split(rows, max(1, len(rows) // 16))  # batches of another size than the traced one
    chunks = [call([np.ascontiguousarray(pack.images[m][part]) for m in graph.modalities]) for part in parts]
    found = {name: np.concatenate([c[i] for c in chunks]) for i, name in enumerate(graph.outputs)}
    report: dict[str, Any] = {"num_rows": len(rows), "cosine": {}, "accuracy": {}, "values": {}}
    for name in (n for n in graph.outputs if n.startswith(("embedding_", "shared_"))):
        values = cosines(found[name], wanted[name])
        report["cosine"][name] = {"min": float(values.min()), "mean": float(values.mean())}
        if not values.min() >= min_cosine:
            how = f"{name} has cosine {values.min():.4f} on real inputs, at least {min_cosine} is allowed (min_cosine)"
            raise ValueError(f"the export is not the trained model: {how}")
    for task, known in graph.classes.items():
        labels, name = labels_of(pack, task, known, rows), f"probability_{task}"
        if not (labels >= 0).any():
            continue
        right = [(x[name].argmax(1) == labels)[labels >= 0] for x in (wanted, found)]
        before, after = (100 * float(x.mean()) for x in right)
        if not before - after <= accuracy_loss:
            how = f"accuracy on {task} from {before:.1f} to {after:.1f} % of {len(right[0])} rows"
            raise ValueError(f"the export lowers {how}, at most {accuracy_loss} points are allowed (--accuracy-loss)")
        report["accuracy"][task] = {"original": before, "export": after, "num": len(right[0])}
    for task, targets in graph.values.items():
        columns = zip(targets, wanted[f"value_{task}"].T, found[f"value_{task}"].T, strict=True)
        report["values"][task] = [_error(pack, rows, *column, value_loss) for column in columns]
    return report


def _error(
    pack: Pack, rows: np.ndarray, target: dict[str, Any], wanted: np.ndarray, found: np.ndarray, limit: float
) -> dict[str, Any]:
    """What an export does to one target, in its unit; ValueError if values change by more than ``limit`` deviations.
    The deviation is that of the measured values, or of the model's own where under two were measured in this unit."""
    name, unit, true = target["name"], target["unit"], np.full(len(rows), np.nan)
    for task in pack.spec.values:
        for t, known in enumerate(task.targets):
            if (known.name, known.unit) == (name, unit):
                true = pack.values(task)[rows, t]
    have = ~np.isnan(true)
    std = float((true[have] if have.sum() > 1 else wanted).std())
    change, allowed = float(((found - wanted) ** 2).mean() ** 0.5), limit * std
    if not change <= allowed:
        how = f"by {change:.3g} {unit} (root mean square), at most {allowed:.3g} is allowed (--value-loss)"
        raise ValueError(f"the export changes {name} {how}")
    before, after = (float(abs(x - true)[have].mean()) if have.any() else None for x in (wanted, found))
    errors = {"original": before, "export": after, "num": int(have.sum()), "change": change, "allowed": allowed}
    return {"name": name, "unit": unit, **errors}


def labels_of(pack: Pack, task: str, classes: list[str], rows: np.ndarray) -> np.ndarray:
    """Labels [len(rows)] of pack rows as indices into ``classes``, matched by name; -1 = unlabelled or unknown class."""
    if (own := next((t.classes for t in pack.spec.tasks if t.name == task), None)) is None:
        return np.full(len(rows), -1)
    numbers = np.array([*(classes.index(name) if name in classes else -1 for name in own), -1])
    return numbers[pack.column(f"label_{task}")[rows].astype(int)]


def latency(call: Call, one: list[np.ndarray]) -> dict[str, float]:
    """p50 and p99 in ms of 100 calls with a batch of one pair, after ten that are not measured."""
    p50, p99 = 1000 * np.percentile(timeit.repeat(lambda: call(one), number=1, repeat=110)[10:], [50, 99])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}
