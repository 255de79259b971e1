"""Run an export on the robot: numpy in, numpy out; no torch unless the engine is torch.

    <export>/export.json          inputs, outputs, classes, preprocessing, digests, the report of how it was checked
             model.onnx           or model.xml and model.bin (OpenVINO), or model.pt2 (torch.export)
             check.safetensors    a few real inputs and the outputs of the trained model for them

``Engine(folder)`` verifies the digests and repeats those few inputs on this machine before the first prediction.
Pickles in a torch export are refused. torch still calls its format unsafe, so open only exports that you trust.
"""

import bisect
import os
import re
import sys
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from mvitac.data.spec import listed
from mvitac.registry import from_json
from mvitac.system.files import brief, digest, digest_file, fields_of, read_json

FORMAT, FORMAT_VERSION = "mvitac-export", 1
MANIFEST, CHECK = "export.json", "check.safetensors"
FILES = {"torch": ("model.pt2",), "onnx": ("model.onnx",), "openvino": ("model.xml", "model.bin")}
TORCH_MEMBERS = re.compile(
    r"data/weights/(weight_\d+|model_weights_config\.json)|data/constants/(tensor_\d+|model_constants_config\.json)"
    r"|data/sample_inputs/model\.pt|models/model\.json|archive_format|archive_version|byteorder|\.data/\w+"
)
"""Files that torch.export writes of a model; not among them: compiled libraries and pickled objects, which it would run."""
Images = Mapping[str, np.ndarray]
Call = Callable[[list[np.ndarray]], list[np.ndarray]]


@dataclass(frozen=True)
class _Target:
    """What export.json says of a value."""

    name: str
    unit: str
    edges: tuple[float, ...]
    spread: tuple[float, ...]


class Engine:
    """An opened export: call it with uint8 [B, S, S, C] by modality to get float32 [B, ...] by output name.

    Examples:
        engine = Engine("exports/first")
        probabilities = engine(vision=photos, touch=presses)["probability_category"]   # [B, K]
        newtons = engine(vision=photos, touch=presses)["value_force_n"]                # [B, 1]
    """

    def __init__(self, folder: str | Path, *, threads: int = 0) -> None:
        """``threads``: CPU threads, 0 = all cores. ValueError if a file or an output differs from the export's."""
        folder = Path(folder)
        with fields_of(folder / MANIFEST):
            self._open(folder, threads)

    def _open(self, folder: Path, threads: int) -> None:
        self.meta = read_manifest(folder)
        self.inputs: dict[str, tuple[int, ...]] = {m: tuple(s) for m, s in self.meta["inputs"].items()}
        self.classes: dict[str, list[str]] = self.meta["classes"]
        self.values: dict[str, list[dict[str, Any]]] = self.meta.get("values", {})
        """task -> name, unit, edges and spread of each target (``spread_at``)."""
        self.difference: bool = self.meta["preprocessing"].get("difference", False)
        """Whether the touch input is (touch - background) / 2 + 128."""
        self.window: dict[str, Any] | None = self.meta["preprocessing"].get("window")
        """For windows: number of frames, stride, its unit (order) and modalities (of), as in export.json."""
        self.sensors: list[str] = self.meta["preprocessing"].get("sensors", [])
        """Names of the touch sensors that the model met, as far as its file says."""
        self.new_sensor: dict[str, Any] | None = self.meta["preprocessing"].get("new_sensor")
        """For an export for a sensor that the model never met: sensor, in_colours_of (known ones), num_images."""
        from_json(dict[str, tuple[str, ...]], self.classes, "classes")
        from_json(dict[str, tuple[_Target, ...]], self.values, "values")
        from_json(tuple[str, ...], self.sensors, "sensors")
        self._call = open_engine(folder, self.meta["kind"], self.meta["precision"], threads)
        check = safetensors.numpy.load_file(folder / CHECK)
        try:
            found = self(**{m: check[f"input_{m}"] for m in self.inputs})
        except (RuntimeError, ValueError) as error:  # the model has other inputs than export.json says
            raise ValueError(f"{folder} cannot be run ({brief(error)}): export it again") from None
        for name in (n for n in self.meta["outputs"] if n.startswith("embedding_")):
            least = float(cosines(found[name], check[name]).min())
            if not least >= self.meta["tolerance"]["min_cosine"]:
                again = " with this engine"
                if self.meta["int8"] and self.meta["report"].get("target") != "avx2":
                    again = ", with --target avx2 if this CPU has no VNNI"
                raise ValueError(
                    f"{folder}: on this machine {name} has cosine {least:.4f} to the output of the trained model,"
                    f" at least {self.meta['tolerance']['min_cosine']} is allowed: export it again{again}"
                )
        for task in self.values:
            self._check_values(folder, task, found[f"value_{task}"] - check[f"value_{task}"])

    def _check_values(self, folder: Path, task: str, change: np.ndarray) -> None:
        """ValueError if values change by over twice what the export may: its few inputs vary more than all test rows."""
        for t, target in enumerate(self.meta["report"]["values"][task]):
            rms = float((change[:, t] ** 2).mean() ** 0.5)
            if not rms <= 2 * target["allowed"] + 1e-6:
                raise ValueError(
                    f"{folder}: on this machine {target['name']} differs by {rms:.3g} {target['unit']} from the trained"
                    f" model, at most {2 * target['allowed']:.3g} is allowed: export it again with this engine"
                )

    def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
        """Outputs of one batch; ValueError names an input that is missing, unknown or of another shape."""
        if images.keys() != self.inputs.keys():
            raise ValueError(f"this export takes {', '.join(self.inputs)}; got {', '.join(images) or 'nothing'}")
        for name, shape in self.inputs.items():
            value = images[name]
            if value.dtype != np.uint8 or value.ndim != 4 or value.shape[1:] != shape:
                raise ValueError(f"{name}: expected uint8 [B, {shape}], got {value.dtype} {value.shape}")
        found = self._call([np.ascontiguousarray(images[m]) for m in self.inputs])
        return dict(zip(self.meta["outputs"], found, strict=True))


def about_sensor(engine: Any, name: str) -> str:
    """A sentence on touch sensor ``name`` ("" = not known), if it is new to the model of ``engine``; else ""."""
    if "touch" not in engine.inputs:
        return ""
    known = listed(engine.sensors)
    if new := engine.new_sensor:
        if name not in ("", new["sensor"]):
            return f"this export is for touch sensor {new['sensor']}: export the model again for {name}, --new-sensor"
        return (
            f"touch sensor {new['sensor']} is new to the model: it is shown in the colours of"
            f" {listed(new['in_colours_of'])} ({new['num_images']} unlabelled images)"
        )
    if not known:
        return f"nothing says which touch sensors the model met: {name} may be new to it" if name else ""
    if not name:
        return f"the model met the touch sensors {known}: --sensor NAME says if another is used"
    if name in engine.sensors:
        return ""
    return (
        f"touch sensor {name} is new to the model, which knows {known}: nothing is done about it (`mvitac export MODEL"
        " --new-sensor RECORDING` shows it in their colours, `mvitac probe RUN --on PACK --learn-on OLD --standardise"
        " colours` says what that is worth)"
    )


def frames_of(window: Mapping[str, Any] | None, modality: str) -> int:
    """Frames of one input of ``modality``, by ``Engine.window``."""
    return int(window["frames"]) if window and modality in window["of"] else 1


def frame_shapes(engine: Any) -> dict[str, tuple[int, int, int]]:
    """Shapes [S, S, C] of single frames by modality, of all cameras or sensors of it."""
    return {m: (h, w, c // frames_of(engine.window, m)) for m, (h, w, c) in engine.inputs.items()}


def spread_at(target: Mapping[str, Any], value: float) -> float:
    """The root mean squared error of test rows whose prediction was in the range of ``value``, in the target's unit."""
    return float(target["spread"][bisect.bisect_right(target["edges"], value)])


def read_manifest(folder: Path) -> dict[str, Any]:
    """export.json of ``folder``, after checking every file against its digest."""
    meta = read_json(folder / MANIFEST, "an export's description")
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        raise ValueError(f"{folder / MANIFEST} does not describe an export: give a folder `mvitac export` wrote")
    if meta.get("format_version") != FORMAT_VERSION or meta.get("kind") not in FILES:
        raise ValueError(f"{folder / MANIFEST} is of another version: export it again")
    if meta.get("digest") != digest({key: value for key, value in meta.items() if key != "digest"}):
        raise ValueError(f"{folder / MANIFEST} does not match its digest: it was changed or damaged, copy it again")
    if set(meta["files"]) != {CHECK, *FILES[meta["kind"]]}:
        raise ValueError(f"{folder / MANIFEST} names other files than {', '.join(FILES[meta['kind']])}: refused")
    for name, expected in meta["files"].items():
        if not (folder / name).is_file() or digest_file(folder / name) != expected:
            raise ValueError(f"{folder / name} does not match its digest: it was changed or damaged, copy it again")
    return meta


def open_engine(folder: Path, kind: str, precision: str = "fp32", threads: int = 0) -> Call:
    """The model file of ``folder`` as a function from input arrays to output arrays."""
    threads = threads or os.cpu_count() or 1
    path = folder / FILES[kind][0]
    try:
        return {"torch": _torch, "onnx": _onnx, "openvino": _openvino}[kind](path, precision, threads)
    except ImportError as error:
        raise ValueError(f"{path} needs {error.name}: pip install -e '.[export]' in mvitac's clone") from None
    except Exception as error:  # each engine has its own exceptions
        raise ValueError(f"{path} cannot be opened ({brief(error)}): export it again") from None


def _onnx(path: Path, precision: str, threads: int) -> Call:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [i.name for i in session.get_inputs()]
    return lambda arrays: session.run(None, dict(zip(names, arrays, strict=True)))  # type: ignore[return-value]


def import_openvino() -> Any:
    """Module ``openvino`` without its telemetry, which looks up an analytics host and keeps an id in the home folder.

    Importing it is reported, too. A None in ``sys.modules`` makes its import fail; OpenVINO then does without.
    """
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino

    return openvino


def lists_bf16(core: Any) -> bool:
    """Whether OpenVINO (an ``openvino.Core``) lists bf16 for this CPU; where it does not, fp32 is used."""
    return "BF16" in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")


def _openvino(path: Path, precision: str, threads: int) -> Call:
    core = import_openvino().Core()
    config = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": threads,
        "INFERENCE_PRECISION_HINT": "bf16" if precision == "bf16" and lists_bf16(core) else "f32",
    }
    request = core.compile_model(path, "CPU", config).create_infer_request()

    def call(arrays: list[np.ndarray]) -> list[np.ndarray]:
        found = request.infer(arrays, share_inputs=True)
        return [np.array(found[i]) for i in range(len(found))]  # the engine reuses its buffers

    return call


def _torch(path: Path, precision: str, threads: int) -> Call:
    import torch

    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            if not TORCH_MEMBERS.fullmatch(name.partition("/")[2]):
                raise ValueError(f"it holds {name!r}, which mvitac does not write and which may be a program: refused")
    # Without this torch falls back to unpickling.
    forced = os.environ.get("TORCH_FORCE_WEIGHTS_ONLY_LOAD")
    os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = "1"
    try:
        module = torch.export.load(path).module()
    finally:
        del os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"]
        if forced is not None:
            os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = forced

    def call(arrays: list[np.ndarray]) -> list[np.ndarray]:
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            with torch.inference_mode():
                return [x.numpy() for x in module(*(torch.tensor(a) for a in arrays))]  # a copy: images are read-only
        finally:
            torch.set_num_threads(before)

    return call


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cosine [B] of each row of ``a`` with the same row of ``b``, both [B, D]; 1 for two rows of zeros."""
    product, norms = (a * b).sum(1), np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    zeros = (np.linalg.norm(a, axis=1) == 0) & (np.linalg.norm(b, axis=1) == 0)
    return np.where(zeros, 1.0, product / np.maximum(norms, 1e-12))
