"""Write a model for another engine, and refuse to if the result is another model than the trained one.

The reference is ``Model.features`` and its probes, the code that computed the published scores. The candidate is the
written file, opened again by the engine that will run it.
"""

from __future__ import annotations

import contextlib
import io
import logging
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import safetensors.numpy
import torch

from mvitac.data.pack import Pack, has_difference
from mvitac.deploy.artifact import preprocessing
from mvitac.deploy.engine import CHECK, FILES, FORMAT, FORMAT_VERSION, MANIFEST, Call, cosines, open_engine
from mvitac.deploy.export_module import ExportModule
from mvitac.deploy.quantise import Target, quantise, this_machine, to_openvino, write_onnx
from mvitac.evaluation.features import sample
from mvitac.model import Model
from mvitac.system.device import has_bf16
from mvitac.system.files import digest, digest_file, write_atomic, write_json
from mvitac.system.locks import new_folder
from mvitac.system.progress import work
from mvitac.system.provenance import provenance
from mvitac.transforms.random_views import IMAGENET_MEAN, IMAGENET_STD

Kind = Literal["torch", "onnx", "openvino"]
MIN_COSINE = {"fp32": 0.9999, "bf16": 0.99, "int8": 0.95}
"""Lowest cosine of any single embedding with the original, by the arithmetic of an export."""
NUM_CALIBRATION, NUM_CHECK = 128, 16
"""Images that set the ranges of int8; images that an export carries for the check on the robot (int8 products saturate
for some images only)."""


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """What to export, and how far it may differ from the trained model."""

    kind: Kind = "onnx"
    """Engine: torch (torch.export), onnx (ONNX Runtime) or openvino."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Arithmetic; bf16 for openvino only."""
    int8: bool = False
    """8-bit weights and activations (onnx, openvino)."""
    target: Target = "auto"
    """CPU that int8 is for. avx2: any CPU (7-bit weights). vnni: 8-bit weights. auto: this machine."""
    modalities: tuple[str, ...] | None = None
    """Inputs of the export; None = all the model has."""
    min_cosine: float | None = None
    """Lowest cosine of any single embedding with the original; None = that of ``MIN_COSINE``."""
    accuracy_loss: float = 0.5
    """Points of accuracy (percent) that any one task may lose on the test rows."""
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
        if not (self.min_cosine is None or -1 <= self.min_cosine <= 1):
            raise ValueError(f"--min-cosine {self.min_cosine}: give a cosine, -1 to 1")
        if self.num_rows < 1:
            raise ValueError(f"--rows {self.num_rows}: give at least 1")
        if self.precision == "bf16" and (self.kind != "openvino" or self.int8):
            raise ValueError("--precision bf16 is a mode of openvino without --int8: give --format openvino")


def export(
    model: Model, pack: Pack, out: Path, config: ExportConfig = ExportConfig(), *, calibrate: Pack | None = None
) -> dict[str, Any]:
    """Write ``model`` with its probes for another engine into the new folder ``out``.

    Args:
        model: a trained model; its probes are exported with it.
        pack: data whose test rows check the export.
        out: the new folder.
        config: engine, arithmetic, inputs and allowed differences.
        calibrate: data whose train rows set the ranges of int8 (default: ``pack``).

    Returns:
        The report: cosines, accuracies, size in MB, latency in ms.

    Raises:
        Busy: another process writes ``out``.
        ValueError: the export is not possible, or differs by more than ``config`` allows; ``out`` is not made.
    """
    if config.precision == "bf16" and not has_bf16(torch.device("cpu")):
        raise ValueError(
            "--precision bf16: this CPU does not compute bf16 itself, so OpenVINO would use fp32 or emulate it, and the"
            " export could not be checked: export it on a CPU with AVX512-BF16 or AMX, or leave --precision out"
        )
    graph = ExportModule(model, config.modalities)
    for given, modality in product((pack, calibrate or pack), graph.inputs):
        _check_fits(model, given, modality)
    rows = pack.rows("test", having=graph.modalities)
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
    """ValueError if ``pack`` does not hold images of ``modality`` as ``model`` wants them."""
    channels, difference = model.spec.channels(modality), modality == "touch" and model.spec.difference
    fits = (modality in pack.spec.modalities, pack.spec.channels(modality) == channels, pack.size == model.stored)
    if not all(fits) or (difference and not has_difference(pack)):
        raise ValueError(
            f"{pack.path} cannot check this model: it needs {modality} images of {channels} channels"
            f" at {model.stored} px{' minus their background' * difference}, as the training data has"
        )


# -- writing ----------------------------------------------------------------------------------------------------------


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
    meta = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": config.kind,
        "precision": config.precision,
        "int8": config.int8,
        "inputs": {m: list(shape) for m, shape in graph.inputs.items()},
        "outputs": list(graph.outputs),
        "classes": graph.classes,
        "preprocessing": preprocessing(model),
        "weights": model.weights_digest(),
        "tolerance": {"min_cosine": config.min_cosine, "accuracy_loss": config.accuracy_loss},
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


# -- checking ---------------------------------------------------------------------------------------------------------


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


def reference(
    model: Model, graph: ExportModule, pack: Pack, rows: np.ndarray, advance: Callable[[int], object] = lambda num: None
) -> dict[str, np.ndarray]:
    """The outputs of ``graph`` for pack rows, computed by the code of ``Model`` itself."""
    chunks = []
    for chunk in np.array_split(rows, max(1, len(rows) // 64)):
        images = {m: torch.from_numpy(pack.images[m][chunk]).permute(0, 3, 1, 2) for m in graph.modalities}
        features = {m: model.features(m, x) for m, x in images.items()}
        joined = torch.cat([features[m] for m in ("vision", "touch") if m in features], dim=1)
        found = {f"embedding_{m}": x for m, x in features.items()}
        found |= {
            f"shared_{m}": model.project(m, model.features(m, images[m], for_heads=True)) for m in graph.projectors
        }
        found |= {f"probability_{r.question.task}": r(joined) for r in graph.readouts}  # type: ignore[union-attr]
        chunks.append(found)
        advance(len(chunk))
    return {name: torch.cat([c[name] for c in chunks]).numpy() for name in graph.outputs}


def parity(
    graph: ExportModule,
    call: Call,
    model: Model,
    pack: Pack,
    rows: np.ndarray,
    wanted: dict[str, np.ndarray],
    config: ExportConfig,
    advance: Callable[[int], object] = lambda num: None,
) -> dict[str, Any]:
    """Compare the outputs of ``call`` for pack rows with ``wanted``.

    Returns:
        num_rows; cosine by embedding (min, mean); accuracy by task (original, export, num labelled rows).

    Raises:
        ValueError: they differ by more than ``config`` allows; the message names the likeliest reason.
    """
    chunks = []
    for chunk in np.array_split(rows, max(1, len(rows) // 16)):  # batches of another size than the traced one
        chunks.append(call([np.ascontiguousarray(pack.images[m][chunk]) for m in graph.modalities]))
        advance(len(chunk))
    found = {name: np.concatenate([c[i] for c in chunks]) for i, name in enumerate(graph.outputs)}
    report: dict[str, Any] = {"num_rows": len(rows), "cosine": {}, "accuracy": {}}
    for name in (n for n in graph.outputs if n.startswith(("embedding_", "shared_"))):
        values = cosines(found[name], wanted[name])
        report["cosine"][name] = {"min": float(values.min()), "mean": float(values.mean())}
        if not values.min() >= (config.min_cosine or 0):
            raise ValueError(
                f"the export is not the trained model: {name} has cosine {values.min():.4f} on real inputs, at least"
                f" {config.min_cosine} is allowed{explain(model, name.partition('_')[2], found, pack, rows)}"
            )
    for task, known in graph.classes.items():
        labels = labels_of(pack, task, known, rows)
        if (labels >= 0).any():
            name = f"probability_{task}"
            report["accuracy"][task] = _accuracy(task, labels, wanted[name], found[name], config.accuracy_loss)
    return report


def _accuracy(task: str, labels: np.ndarray, wanted: np.ndarray, found: np.ndarray, limit: float) -> dict[str, Any]:
    """Accuracy in percent before and after, over labelled rows; ValueError if more than ``limit`` points are lost."""
    before, after = (100 * float((x.argmax(1) == labels)[labels >= 0].mean()) for x in (wanted, found))
    if before - after > limit:
        raise ValueError(
            f"the export loses {before - after:.2f} points of accuracy on {task} ({before:.1f} to {after:.1f} %),"
            f" at most {limit} is allowed: use another precision, check on more --rows if the {len(labels)} here are"
            " few, or allow more, --accuracy-loss"
        )
    return {"original": before, "export": after, "num": int((labels >= 0).sum())}


def labels_of(pack: Pack, task: str, classes: list[str], rows: np.ndarray) -> np.ndarray:
    """Labels [len(rows)] of pack rows as indices into ``classes``, matched by name; -1 = unlabelled or unknown class."""
    own = next((t.classes for t in pack.spec.tasks if t.name == task), None)
    if own is None:
        return np.full(len(rows), -1)
    numbers = np.array([*(classes.index(name) if name in classes else -1 for name in own), -1])
    return numbers[pack.column(f"label_{task}")[rows].astype(int)]


def explain(model: Model, modality: str, found: dict[str, np.ndarray], pack: Pack, rows: np.ndarray) -> str:
    """The preprocessing mistake with which the model reproduces the export's output, if it is a common one."""
    raw = torch.from_numpy(pack.images[modality][rows[:8]]).permute(0, 3, 1, 2)
    swapped = raw.unflatten(1, (-1, 3)).flip(2).flatten(1, 2)
    size = (model.run.augment.eval_size,) * 2
    unit = torch.nn.functional.interpolate(raw, size, mode="bilinear", antialias=True).float() / 255
    mean, std = (torch.tensor(v * (raw.shape[1] // 3)).view(-1, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
    with torch.no_grad():
        mistakes = {
            "its input is BGR, the model wants RGB": model.features(modality, swapped),
            "it does not normalise by the ImageNet mean and std": model.encoders[modality](unit),
            "it normalises to [-1, 1] instead of by the ImageNet mean and std": model.encoders[modality](2 * unit - 1),
            "it does not divide by 255": model.encoders[modality]((255 * unit - mean) / std),
        }
    for reason, features in mistakes.items():
        if cosines(features.numpy(), found[f"embedding_{modality}"][:8]).min() > 0.999:
            return f": {reason}"
    return ""


def latency(call: Call, one: list[np.ndarray], *, num: int = 100, warm: int = 10) -> dict[str, float]:
    """p50 and p99 in ms of ``num`` calls with a batch of one pair, after ``warm`` calls that are not measured."""
    times = []
    for _ in range(warm + num):
        start = time.perf_counter()
        call(one)
        times.append(1000 * (time.perf_counter() - start))
    p50, p99 = np.percentile(times[warm:], [50, 99])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}
