"""Write a model for another engine, and refuse to if the result is another model than the trained one.

The reference is ``Model.features`` and its probes, the code that computed the published scores. The candidate is the
written file, opened again by the engine that will run it.
"""

import contextlib
import io
import logging
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import safetensors.numpy
import torch

from mvitac.data.pack import Pack
from mvitac.deploy.artifact import preprocessing
from mvitac.deploy.engine import CHECK, FILES, FORMAT, FORMAT_VERSION, MANIFEST, open_engine
from mvitac.deploy.export_module import ExportModule
from mvitac.deploy.parity import latency, parity, reference
from mvitac.deploy.quantise import Target, quantise, this_machine, to_openvino, write_onnx
from mvitac.evaluation.features import sample
from mvitac.evaluation.sensors import learn_looks
from mvitac.model import Model
from mvitac.system.device import has_bf16
from mvitac.system.files import digest, digest_file, write_atomic, write_json
from mvitac.system.locks import new_folder
from mvitac.system.progress import work
from mvitac.system.provenance import provenance

Kind = Literal["torch", "onnx", "openvino"]
MIN_COSINE = {"fp32": 0.9999, "bf16": 0.99, "int8": 0.95}
"""Lowest cosine of any single embedding with the original, by the arithmetic of an export."""
NEW_SENSOR = "--new-sensor"  # the option that errors name
NUM_CALIBRATION, NUM_CHECK = 128, 16
"""Images that set the ranges of int8; images that an export carries for the check on the robot (int8 products saturate
for some images only)."""


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """What to export, and how far it may differ from the trained model."""

    kind: Kind = "onnx"
    """Engine: torch (torch.export), onnx (ONNX Runtime) or openvino."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Arithmetic of openvino; bf16 only on a CPU that computes it, where it can be checked."""
    int8: bool = False
    """8-bit weights and activations; their ranges come from train rows of the pack (onnx, openvino)."""
    target: Target = "auto"
    """CPU that int8 is for. avx2: any CPU (7-bit weights). vnni: x86 with VNNI or AMX, or ARM (8-bit weights). auto: this
    machine's, as measured."""
    modalities: tuple[str, ...] | None = None
    """Inputs of the export; None = all the model has."""
    min_cosine: float | None = None
    """Lowest cosine of any single embedding with the original (default: .9999 for fp32, .99 for bf16, .95 for int8)."""
    accuracy_loss: float = 0.5
    """Points of accuracy (percent) that any one task may lose on the test rows."""
    value_loss: float = 0.1
    """Change of any predicted value on the test rows (root mean square), in standard deviations of that value."""
    num_rows: int = 512
    """Maximum number of test rows to check on."""
    threads: int = 0
    """CPU threads while measuring latency; 0 = all cores."""

    def __post_init__(self) -> None:
        if self.min_cosine is None:
            object.__setattr__(self, "min_cosine", MIN_COSINE["int8" if self.int8 else self.precision])
        if self.int8 and self.kind == "torch":
            raise ValueError("--int8 is for onnx and openvino: give --format onnx or --format openvino")
        if self.target != "auto" and not self.int8:
            raise ValueError(f"--target {self.target} chooses the weights of --int8: add --int8, or leave --target out")
        if not (0 <= self.accuracy_loss <= 100):
            raise ValueError(f"--accuracy-loss {self.accuracy_loss}: give points of accuracy, 0 to 100")
        if not 0 <= self.value_loss < math.inf:
            raise ValueError(f"--value-loss {self.value_loss}: give standard deviations of the value, 0 or more")
        if not (self.min_cosine is None or -1 <= self.min_cosine <= 1):
            raise ValueError(f"--min-cosine {self.min_cosine}: give a cosine, -1 to 1")
        if self.num_rows < 1:
            raise ValueError(f"--rows {self.num_rows}: give at least 1")
        if self.precision == "bf16" and (self.kind != "openvino" or self.int8):
            raise ValueError("--precision bf16 is a mode of openvino without --int8: give --format openvino")


def export(
    model: Model,
    pack: Pack,
    out: Path,
    config: ExportConfig = ExportConfig(),
    *,
    calibrate: Pack | None = None,
    new: Pack | None = None,
) -> dict[str, Any]:
    """Write ``model`` with its probes for another engine into the new folder ``out``, checked on test rows of ``pack``.

    ``calibrate``: data whose train rows set the ranges of int8 (default: ``pack``). ``new``: unlabelled images of a touch
    sensor that ``pack`` lacks. The export is then for that sensor, whose images it shows in the colours of those of
    ``pack``, and is checked on ``new`` (all rows, if none is of split test). Returns the report: cosines, accuracies,
    errors of values in their units, size in MB, latency in ms. Raises Busy if another process writes ``out``; ValueError
    if the export is not possible, or differs by more than ``config`` allows.
    """
    if config.precision == "bf16" and not has_bf16(torch.device("cpu")):
        raise ValueError(
            "--precision bf16: this CPU does not compute bf16 itself, so OpenVINO would use fp32 or emulate it, and the"
            " export could not be checked: export it on a CPU with AVX512-BF16 or AMX, or leave --precision out"
        )
    asked, known, pack = config.modalities or tuple(model.encoders), pack, new or pack
    if new and "touch" not in asked:
        raise ValueError(f"{NEW_SENSOR} is about touch, which this export lacks: leave it out")
    for given, modality in product((known, pack, calibrate or pack), asked):
        _check_fits(model, given, modality)
    graph = ExportModule(model, asked, learn_looks(known, new, NEW_SENSOR) if new else None)
    rows = pack.rows("test", having=asked)
    if new and not len(rows):
        rows = np.flatnonzero(np.logical_and.reduce([new.has(modality) for modality in asked]))
    if not len(rows):
        raise ValueError(
            f"{pack.path} has no rows in split test: an export is checked on rows that no probe was fitted on"
        )
    rows = sample(rows, config.num_rows)
    with new_folder(out) as partial:
        with work(f"writing {config.kind}"), silent():
            if config.int8 and config.target == "auto":
                config = replace(config, target=this_machine(config.kind))
            _write_model(graph, partial, config, _examples(graph, calibrate or pack) if config.int8 else None)
        report, wanted = _measure(model, graph, partial, pack, rows, config)
        _write_check(graph, partial, pack, rows, wanted)
        _write_manifest(model, graph, partial, config, report)
    return report


def _check_fits(model: Model, pack: Pack, modality: str) -> None:
    """ValueError if ``model`` takes no ``modality``, or ``pack`` does not hold images of it as ``model`` wants them."""
    model.check_modality(modality)
    channels, difference = model.spec.channels(modality), modality == "touch" and model.spec.difference
    fits = (modality in pack.spec.modalities, pack.spec.channels(modality) == channels, pack.size == model.stored)
    if not all(fits) or (difference and not pack.spec.difference):
        raise ValueError(
            f"{pack.path} cannot check this model: it needs {modality} images of {channels} channels"
            f" at {model.stored} px{' minus their background' * difference}, as the training data has"
        )


def _examples(graph: ExportModule, pack: Pack) -> list[list[np.ndarray]]:
    """Single real inputs: a sample of the train rows of ``pack``."""
    rows = pack.rows("train", "unlabelled", having=graph.modalities)
    if not len(rows):
        raise ValueError(f"{pack.path} has no rows in split train: int8 takes its ranges from them")
    return [[pack.images[m][r : r + 1] for m in graph.modalities] for r in sample(rows, NUM_CALIBRATION)]


def _write_model(
    graph: ExportModule, folder: Path, config: ExportConfig, examples: list[list[np.ndarray]] | None
) -> None:
    """The model files of the engine; in int8 where there are ``examples``."""
    two = tuple(torch.zeros(2, *shape, dtype=torch.uint8) for shape in graph.inputs.values())
    batch = torch.export.Dim("batch", min=1, max=1024)
    shapes = (tuple({0: batch} for _ in two),)
    if config.kind == "torch":
        buffer = io.BytesIO()  # to a file, torch ends the process on a full disk
        torch.export.save(torch.export.export(graph, two, dynamic_shapes=shapes), buffer)
        write_atomic(folder / FILES["torch"][0], lambda file: file.write(buffer.getbuffer()))
        return
    path = write_onnx(graph, two, folder, list(graph.inputs), list(graph.outputs), shapes)
    if examples is not None:
        quantise(path, list(graph.inputs), examples, seven_bits=config.target == "avx2")
    if config.kind == "openvino":
        to_openvino(path)


def _write_check(
    graph: ExportModule, folder: Path, pack: Pack, rows: np.ndarray, wanted: dict[str, np.ndarray]
) -> None:
    """A few real inputs and the outputs of the trained model, which ``Engine`` repeats where it is opened."""
    some = np.linspace(0, len(rows) - 1, min(len(rows), NUM_CHECK)).astype(int)
    check = {f"input_{m}": pack.images[m][rows[some]] for m in graph.modalities}
    check |= {name: values[some] for name, values in wanted.items()}
    data = safetensors.numpy.save({name: np.ascontiguousarray(values) for name, values in check.items()})
    write_atomic(folder / CHECK, lambda file: file.write(data))


def _write_manifest(
    model: Model, graph: ExportModule, folder: Path, config: ExportConfig, report: dict[str, Any]
) -> None:
    """export.json; every other file that it does not name is deleted."""
    values = {"value_loss": config.value_loss} if graph.values else {}
    meta = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": config.kind,
        "precision": config.precision,
        "int8": config.int8,
        "inputs": {m: list(shape) for m, shape in graph.inputs.items()},
        "outputs": list(graph.outputs),
        "classes": graph.classes,
        **({"values": graph.values} if graph.values else {}),
        "preprocessing": preprocessing(model) | ({"new_sensor": graph.looks.about()} if graph.looks else {}),
        "weights": model.weights_digest(),
        "tolerance": {"min_cosine": config.min_cosine, "accuracy_loss": config.accuracy_loss} | values,
        "report": report,
        "provenance": provenance(),
        "files": {name: digest_file(folder / name) for name in (CHECK, *FILES[config.kind])},
    }
    write_json(folder / MANIFEST, {**meta, "digest": digest(meta)})
    for stray in {p.name for p in folder.iterdir()} - {MANIFEST, *meta["files"]}:
        (folder / stray).unlink()


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
    model: Model, graph: ExportModule, folder: Path, pack: Pack, rows: np.ndarray, config: ExportConfig
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The report on the written files, and the outputs of the trained model for ``rows``."""
    call = open_engine(folder, config.kind, config.precision, config.threads)
    with work("computing the outputs of the model", len(rows), "rows") as advance:
        wanted = reference(model, graph, pack, rows, advance)
    with work("checking the outputs of the export", len(rows), "rows") as advance:
        report = parity(graph, call, model, pack, rows, wanted, config, advance)
    if config.int8:
        report["target"] = config.target
    report["size_mb"] = round(sum((folder / name).stat().st_size for name in FILES[config.kind]) / 1e6, 2)
    with work("measuring latency"):
        report["latency_ms"] = latency(call, [pack.images[m][rows[:1]] for m in graph.modalities])
    return report, wanted
