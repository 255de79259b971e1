"""Write a model as ONNX, and refuse to if the result is another model than the trained one.

The reference is ``Model.features`` and its probes, the code that computed the published scores. The candidate is the
written file, opened again as on a robot.
"""

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import torch

from mvitac.data.pack import Pack
from mvitac.deploy.artifact import preprocessing
from mvitac.deploy.engine import CHECK, EXPORT, MODEL, open_model
from mvitac.deploy.export_config import ExportConfig
from mvitac.deploy.export_module import ExportModule, write_onnx
from mvitac.deploy.parity import latency, parity, reference
from mvitac.deploy.quantise import quantise
from mvitac.evaluation.features import fitting, sample
from mvitac.evaluation.sensors import learn_looks
from mvitac.model import Model
from mvitac.system.device import has_bf16
from mvitac.system.locks import new_folder
from mvitac.system.progress import work
from mvitac.system.provenance import provenance

NEW_SENSOR = "--new-sensor"  # the option that errors name
NUM_CALIBRATION, NUM_CHECK = 128, 16
"""Images that set the ranges of int8; images that an export carries for the check on the robot (int8 products saturate
for some images only)."""


def export(
    model: Model,
    pack: Pack,
    out: Path,
    config: ExportConfig = ExportConfig(),
    *,
    new: Pack | None = None,
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
    asked = tuple(sorted(config.modalities, reverse=True)) or tuple(model.encoders)  # vision, touch
    known, pack = pack, new or pack
    if new and "touch" not in asked:
        raise ValueError(f"{NEW_SENSOR} is about touch, which this export lacks: leave it out")
    for given in (known, pack):
        if {*fitting(model, given, asked)} != {*asked} or given.size != model.stored:
            what = f"{' and '.join(asked)} at {model.stored} px"
            raise ValueError(f"{given.path} cannot check this model: it needs images of {what}")
    graph = ExportModule(model, asked, learn_looks(known, new, NEW_SENSOR) if new else None)
    rows = pack.rows("test", having=asked)
    if new and not len(rows):
        rows = np.flatnonzero(np.logical_and.reduce([new.has(modality) for modality in asked]))
    if not len(rows):
        raise ValueError(f"{pack.path} has no rows in split test to check the export on")
    rows = sample(rows, config.num_rows)
    with new_folder(out) as partial:
        with work("writing ONNX"), silent():
            write_onnx(graph, partial / MODEL)
            if config.precision == "int8":
                quantise(partial / MODEL, list(graph.inputs), _examples(graph, pack))
        report, wanted = _measure(model, graph, partial / MODEL, pack, rows, config)
        # A few real inputs and the outputs of the trained model, which ``Engine`` repeats where it is opened.
        some = np.linspace(0, len(rows) - 1, min(len(rows), NUM_CHECK)).astype(int)
        check = {f"input_{m}": pack.images[m][rows[some]] for m in graph.modalities}
        check |= {name: values[some] for name, values in wanted.items()}
        data = safetensors.numpy.save({name: np.ascontiguousarray(values) for name, values in check.items()})
        (partial / CHECK).write_bytes(data)
        about = {
            "precision": config.precision,
            "inputs": {m: list(shape) for m, shape in graph.inputs.items()},
            **{"outputs": list(graph.outputs), "classes": graph.classes, "values": graph.values},
            "preprocessing": preprocessing(model) | ({"new_sensor": graph.looks.about()} if graph.looks else {}),
            **{"weights": model.weights_digest(), "tolerance": config.tolerance, "report": report},
        }
        EXPORT.write(partial, {**about, "provenance": provenance()})
    return report


def _examples(graph: ExportModule, pack: Pack) -> list[list[np.ndarray]]:
    """Single real inputs: a sample of the train rows of ``pack``."""
    rows = pack.rows("train", "unlabelled", having=graph.modalities)
    if not len(rows):
        raise ValueError(f"{pack.path} has no rows in split train: int8 takes its ranges from them")
    return [[pack.images[m][r : r + 1] for m in graph.modalities] for r in sample(rows, NUM_CALIBRATION)]


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Hide what exporters print, log and warn about their own future; real faults are found by the check."""
    level = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(level)


def _measure(
    model: Model, graph: ExportModule, path: Path, pack: Pack, rows: np.ndarray, config: ExportConfig
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    engine = "openvino" if config.precision == "bf16" else "auto"
    call = open_model(path, engine, config.precision, config.threads)
    with work("computing the outputs of the model", len(rows), "rows") as advance:
        wanted = reference(model, graph, pack, rows, advance)
    with work("checking the outputs of the export", len(rows), "rows") as advance:
        report = parity(graph, call, pack, rows, wanted, **config.tolerance, advance=advance)
    report["size_mb"] = round(path.stat().st_size / 1e6, 2)
    with work("measuring latency"):
        report["latency_ms"] = latency(call, [pack.images[m][rows[:1]] for m in graph.modalities])
    return report, wanted
