"""Write a model for another engine, and refuse to if it is not the same model: parity on real inputs, or no export.

The reference is ``Model.features`` and its probes, the very code that made the published scores; the candidate is the
written file, opened again by the engine that will run it.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import shutil
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
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
from mvitac.system.files import check_place, digest, digest_file, write_atomic, write_json
from mvitac.system.progress import work
from mvitac.system.provenance import provenance
from mvitac.transforms.random_views import IMAGENET_MEAN, IMAGENET_STD

Kind = Literal["torch", "onnx", "openvino"]
NUM_CALIBRATION, NUM_CHECK = 128, 16
"""Images that set the ranges of int8; images that travel with an export for the check on the robot (int8
products saturate for some images only)."""


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far an export may be from the trained model."""

    min_cosine: float
    """Least cosine of any single embedding with the original's."""
    accuracy_loss: float = 0.5
    """Points of accuracy (percent) that any one task may lose on the test rows."""


TOLERANCES = {
    "fp32": Tolerance(min_cosine=0.9999, accuracy_loss=0.5),
    "bf16": Tolerance(min_cosine=0.99, accuracy_loss=0.5),
    "int8": Tolerance(min_cosine=0.95, accuracy_loss=0.5),
}
"""What an export must keep, by its arithmetic."""


def export(
    model: Model,
    pack: Pack,
    out: Path,
    *,
    kind: Kind = "onnx",
    precision: Literal["fp32", "bf16"] = "fp32",
    int8: bool = False,
    target: Target = "auto",
    calibrate: Pack | None = None,
    modalities: tuple[str, ...] | None = None,
    tolerance: Tolerance | None = None,
    num_rows: int = 512,
    threads: int = 0,
) -> dict[str, Any]:
    """Write ``model`` (with its probes) for ``kind`` into the new folder ``out`` and return the report.

    Checked on up to ``num_rows`` test rows of ``pack``; int8 ranges come from train rows of ``calibrate`` (``pack``).
    ``target`` is the CPU that int8 is for: avx2 has 7-bit weights, vnni 8-bit ones, auto is this machine.
    ValueError, and no folder, if an embedding or the accuracy is off by more than ``tolerance``.
    """
    if out.exists():
        raise ValueError(f"{out} already exists: choose another --out, or delete it first")
    if int8 and kind == "torch":
        raise ValueError("--int8 is for onnx and openvino: give --format onnx or --format openvino")
    if target != "auto" and not int8:
        raise ValueError(f"--target {target} chooses the weights of --int8: add --int8, or leave --target out")
    if num_rows < 1:
        raise ValueError(f"--rows {num_rows}: give at least 1")
    if precision == "bf16" and (kind != "openvino" or int8):
        raise ValueError("--precision bf16 is a mode of openvino without --int8: give --format openvino")
    if precision == "bf16" and not has_bf16(torch.device("cpu")):
        raise ValueError(
            "--precision bf16: this CPU does not compute bf16 itself, so OpenVINO would use fp32 or emulate it, and the"
            " export could not be checked: export it on a CPU with AVX512-BF16 or AMX, or leave --precision out"
        )
    check_place(out)
    graph = ExportModule(model, modalities)
    for given, (modality, (_, _, channels)) in product((pack, calibrate or pack), graph.inputs.items()):
        minus = modality == "touch" and model.spec.difference
        if (
            modality not in given.spec.modalities
            or given.spec.channels(modality) != channels
            or given.size != model.stored
            or (minus and not has_difference(given))
        ):
            raise ValueError(
                f"{given.path} cannot check this model: it needs {modality} images of {channels} channels"
                f" at {model.stored} px{' minus their background' * minus}, as the training data has"
            )
    tolerance = tolerance or TOLERANCES["int8" if int8 else precision]
    rows = pack.rows("test", having=graph.modalities)
    if not len(rows):
        raise ValueError(f"{pack.path} has no rows in split test: an export is checked on rows nobody trained on")
    rows = sample(rows, num_rows)
    partial = out.with_name(out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        with work(f"writing {kind}"), silent():
            if int8 and target == "auto":
                target = this_machine(kind)
            _write(graph, partial, kind, _examples(graph, calibrate or pack) if int8 else None, target)
        call = open_engine(partial, kind, precision, threads)
        with work("computing what the model itself answers", len(rows), "rows") as advance:
            wanted = reference(model, graph, pack, rows, advance)
        with work("checking what the export answers", len(rows), "rows") as advance:
            report = parity(graph, call, model, pack, rows, wanted, tolerance, advance)
        if int8:
            report["target"] = target
        report["size_mb"] = round(sum((partial / name).stat().st_size for name in FILES[kind]) / 1e6, 2)
        with work("measuring latency"):
            report["latency_ms"] = latency(call, [pack.images[m][rows[:1]] for m in graph.modalities])
        some = np.linspace(0, len(rows) - 1, min(len(rows), NUM_CHECK)).astype(int)
        check = {f"input_{m}": pack.images[m][rows[some]] for m in graph.modalities}
        check |= {n: v[some] for n, v in wanted.items()}
        data = safetensors.numpy.save({n: np.ascontiguousarray(v) for n, v in check.items()})
        write_atomic(partial / CHECK, lambda file: file.write(data))
        meta = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "kind": kind,
            "precision": precision,
            "int8": int8,
            "inputs": {m: list(shape) for m, shape in graph.inputs.items()},
            "outputs": list(graph.outputs),
            "classes": graph.classes,
            "preprocessing": preprocessing(model),
            "weights": model.weights_digest(),
            "tolerance": asdict(tolerance),
            "report": report,
            "provenance": provenance(),
            "files": {name: digest_file(partial / name) for name in (CHECK, *FILES[kind])},
        }
        write_json(partial / MANIFEST, {**meta, "digest": digest(meta)})
        for stray in {p.name for p in partial.iterdir()} - {MANIFEST, *meta["files"]}:
            (partial / stray).unlink()
        os.rename(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return report


# -- writing ----------------------------------------------------------------------------------------------------------


def _examples(graph: ExportModule, pack: Pack) -> list[list[np.ndarray]]:
    """Single real inputs, a sample of the train rows of ``pack``."""
    rows = pack.rows("train", "unlabelled", having=graph.modalities)
    if not len(rows):
        raise ValueError(f"{pack.path} has no rows in split train: int8 takes its ranges from them")
    return [[pack.images[m][r : r + 1] for m in graph.modalities] for r in sample(rows, NUM_CALIBRATION)]


def _write(
    graph: ExportModule, folder: Path, kind: Kind, examples: list[list[np.ndarray]] | None, target: Target
) -> None:
    two = tuple(torch.zeros(2, *shape, dtype=torch.uint8) for shape in graph.inputs.values())
    batch = torch.export.Dim("batch", min=1, max=1024)
    shapes = (tuple({0: batch} for _ in two),)
    if kind == "torch":
        torch.export.save(torch.export.export(graph, two, dynamic_shapes=shapes), folder / FILES[kind][0])
        return
    path = write_onnx(graph, two, folder, list(graph.inputs), list(graph.outputs), shapes)
    if examples is not None:
        quantise(path, list(graph.inputs), examples, seven_bits=target == "avx2")
    if kind == "openvino":
        to_openvino(path)


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Exporters print, log and warn about their own future; what matters of it ends in our own check."""
    level = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(level)


# -- checking ---------------------------------------------------------------------------------------------------------


def reference(
    model: Model, graph: ExportModule, pack: Pack, rows: np.ndarray, advance: Callable[[int], object] = lambda num: None
) -> dict[str, np.ndarray]:
    """What the trained model itself makes of pack rows: the outputs of ``graph``, by ``Model``'s own code."""
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
    tolerance: Tolerance,
    advance: Callable[[int], object] = lambda num: None,
) -> dict[str, Any]:
    """Cosines and accuracies of ``call`` on pack rows beside ``wanted``; ValueError if beyond ``tolerance``, with the
    likeliest reason."""
    chunks = []
    for chunk in np.array_split(rows, max(1, len(rows) // 16)):  # batches of another size than the traced one
        chunks.append(call([np.ascontiguousarray(pack.images[m][chunk]) for m in graph.modalities]))
        advance(len(chunk))
    found = {name: np.concatenate([c[i] for c in chunks]) for i, name in enumerate(graph.outputs)}
    report: dict[str, Any] = {"num_rows": len(rows), "cosine": {}, "accuracy": {}}
    for name in (n for n in graph.outputs if n.startswith(("embedding_", "shared_"))):
        values = cosines(found[name], wanted[name])
        report["cosine"][name] = {"min": float(values.min()), "mean": float(values.mean())}
        if not values.min() >= tolerance.min_cosine:
            raise ValueError(
                f"the export is not the trained model: {name} has cosine {values.min():.4f} on real inputs, at least"
                f" {tolerance.min_cosine} is allowed{explain(model, name.partition('_')[2], found, pack, rows)}"
            )
    for task, known in graph.classes.items():
        labels = labels_of(pack, task, known, rows)
        if not (labels >= 0).any():
            continue
        name = f"probability_{task}"
        before, after = (100 * float((x[name].argmax(1) == labels)[labels >= 0].mean()) for x in (wanted, found))
        report["accuracy"][task] = {"original": before, "export": after, "num": int((labels >= 0).sum())}
        if before - after > tolerance.accuracy_loss:
            raise ValueError(
                f"the export loses {before - after:.2f} points of accuracy on {task} ({before:.1f} to {after:.1f} %),"
                f" at most {tolerance.accuracy_loss} is allowed: use another precision, check on more --rows if the"
                f" {len(rows)} here are few, or allow more, --accuracy-loss"
            )
    return report


def labels_of(pack: Pack, task: str, classes: list[str], rows: np.ndarray) -> np.ndarray:
    """Labels [len(rows)] of pack rows as numbers of ``classes``, by name; -1 = unlabelled, or a class not among them."""
    own = next((t.classes for t in pack.spec.tasks if t.name == task), None)
    if own is None:
        return np.full(len(rows), -1)
    numbers = np.array([*(classes.index(name) if name in classes else -1 for name in own), -1])
    return numbers[pack.column(f"label_{task}")[rows].astype(int)]


def explain(model: Model, modality: str, found: dict[str, np.ndarray], pack: Pack, rows: np.ndarray) -> str:
    """The preprocessing under which the trained model gives what the export gave, if it is a common slip."""
    raw = torch.from_numpy(pack.images[modality][rows[:8]]).permute(0, 3, 1, 2)
    swapped = raw.unflatten(1, (-1, 3)).flip(2).flatten(1, 2)
    size = (model.run.augment.eval_size,) * 2
    unit = torch.nn.functional.interpolate(raw, size, mode="bilinear", antialias=True).float() / 255
    mean, std = (torch.tensor(v * (raw.shape[1] // 3)).view(-1, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
    with torch.no_grad():
        slips = {
            "its input is BGR, the model wants RGB": model.features(modality, swapped),
            "it does not normalise by the ImageNet mean and std": model.encoders[modality](unit),
            "it normalises to [-1, 1] instead of by the ImageNet mean and std": model.encoders[modality](2 * unit - 1),
            "it does not divide by 255": model.encoders[modality]((255 * unit - mean) / std),
        }
    for reason, features in slips.items():
        if cosines(features.numpy(), found[f"embedding_{modality}"][:8]).min() > 0.999:
            return f": {reason}"
    return ""


def latency(call: Call, one: list[np.ndarray], *, num: int = 100, warm: int = 10) -> dict[str, float]:
    """p50 and p99 in ms of ``num`` calls with a batch of one pair, after ``warm`` unmeasured ones."""
    times = []
    for _ in range(warm + num):
        start = time.perf_counter()
        call(one)
        times.append(1000 * (time.perf_counter() - start))
    p50, p99 = np.percentile(times[warm:], [50, 99])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}
