"""Run an export on the robot, by OpenVINO or ONNX Runtime: numpy in, numpy out, no torch.

    <export>/export.json          inputs, outputs, classes, preprocessing, digests, the report of how it was checked
             model.onnx
             check.safetensors    a few real inputs and the outputs of the trained model for them

``Engine(folder)`` verifies the digests and repeats those few inputs on this machine before the first prediction.
"""

import bisect
import functools
import importlib.util
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import safetensors.numpy

from mvitac.data.spec import listed
from mvitac.registry import from_json
from mvitac.system.files import brief, fields_of
from mvitac.system.sealed_folder import SealedFolder

MODEL, CHECK = "model.onnx", "check.safetensors"
EXPORT = SealedFolder("export.json", "mvitac-export", 3, "mvitac export", frozenset((MODEL, CHECK)))
Runtime = Literal["auto", "onnxruntime", "openvino"]
Call = Callable[[list[np.ndarray]], list[np.ndarray]]


@dataclass(frozen=True)
class _Target:
    name: str
    unit: str
    edges: tuple[float, ...]
    spread: tuple[float, ...]

    def __post_init__(self) -> None:
        good = len(self.spread) == len(self.edges) + 1 and list(self.edges) == sorted(self.edges)
        assert good, f"edges and spread of {self.name}"  # which ``fields_of`` a file says


class Engine:
    """An opened export: call it with uint8 [B, S, S, C] by modality to get float32 [B, ...] by output name.

    Examples:
        engine = Engine("exports/first")
        probabilities = engine(vision=photos, touch=presses)["probability_category"]   # [B, K]
        newtons = engine(vision=photos, touch=presses)["value_force"]                  # [B, 1]
    """

    def __init__(self, folder: str | Path, *, engine: Runtime = "auto", threads: int = 0) -> None:
        """Open an export.

        Args:
            folder: What ``mvitac export`` wrote.
            engine: onnxruntime, openvino, or auto: what its export found right, usually OpenVINO where it is installed (for
                int8 only on a CPU with VNNI).
            threads: CPU threads, 0 = all cores.

        Raises:
            ValueError: A file or an output on this machine differs from the export's.
        """
        self.folder = Path(folder)
        with fields_of(self.folder / EXPORT.name):
            self._open(engine, threads)
            self._check()

    def _open(self, engine: Runtime, threads: int) -> None:
        self.meta = EXPORT.read(self.folder)
        self.inputs: dict[str, tuple[int, ...]] = {m: tuple(s) for m, s in self.meta["inputs"].items()}
        self.classes: dict[str, list[str]] = self.meta["classes"]
        self.values: dict[str, list[dict[str, Any]]] = self.meta["values"]
        """task -> name, unit, edges and spread of each target (``spread_at``)."""
        self.difference: bool = self.meta["preprocessing"]["difference"]
        """Whether the touch input is (touch - background) / 2 + 128."""
        self.window: dict[str, Any] | None = self.meta["preprocessing"].get("window")
        """For windows: number of frames, stride, its unit (order) and modalities (of), as in export.json."""
        self.crop: dict[str, str] = self.meta["preprocessing"]["crop"]
        """Modality -> part of the images that the model's data showed, as x:y:width:height."""
        self.sensors: list[str] = self.meta["preprocessing"]["sensors"]
        """Names of the touch sensors that the model met, as far as its file says."""
        self.new_sensor: dict[str, Any] | None = self.meta["preprocessing"].get("new_sensor")
        """For an export for a sensor that the model never met: sensor, in_colours_of (known ones), num_images."""
        where = f"{self.folder / EXPORT.name}: "
        from_json(dict[str, tuple[str, ...]], self.classes, f"{where}classes")
        from_json(dict[str, tuple[_Target, ...]], self.values, f"{where}values")
        from_json(tuple[str, ...], self.sensors, f"{where}sensors")
        from_json(dict[str, str], self.crop, f"{where}crop")
        from_json(Runtime, self.meta["runtime"], f"{where}runtime")
        engine = self.meta["runtime"] if engine == "auto" else engine
        self._call = open_model(self.folder / MODEL, engine, self.meta["precision"], threads)

    def _check(self) -> None:
        """Repeat the few inputs of the export; ValueError if an output differs by more than the export may."""
        check = safetensors.numpy.load_file(self.folder / CHECK)
        try:
            found = self(**{m: check[f"input_{m}"] for m in self.inputs})
        except (RuntimeError, ValueError) as error:  # the model has other inputs than export.json says
            raise ValueError(f"{self.folder} cannot be run ({brief(error)}): export it again") from None
        for task, names in self.classes.items():
            assert found[f"probability_{task}"].shape[1] == len(names), f"classes of {task}"
        for task, targets in self.values.items():
            assert found[f"value_{task}"].shape[1] == len(targets), f"values of {task}"
        here, allowed = f"{self.folder}: on this machine", self.meta["tolerance"]["min_cosine"]
        for name in (name for name in self.meta["outputs"] if name.startswith("embedding_")):
            least = float(cosines(found[name], check[name]).min())
            if not least >= allowed:
                raise ValueError(f"{here} {name} has cosine {least:.4f}, at least {allowed} is allowed")
        for task, targets in self.meta["report"]["values"].items():
            change = ((found[f"value_{task}"] - check[f"value_{task}"]) ** 2).mean(0) ** 0.5
            for target, rms in zip(targets, change, strict=True):
                name, unit, most = target["name"], target["unit"], 2 * target["allowed"] + 1e-6
                if not rms <= most:  # twice, because these few inputs vary more than all test rows
                    raise ValueError(f"{here} {name} differs by {rms:.3g} {unit}, at most {most:.3g} is allowed")

    def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
        """Outputs of one batch; ValueError names an input that is missing, unknown or of another shape."""
        if images.keys() != self.inputs.keys():
            raise ValueError(f"this export takes {', '.join(self.inputs)}; got {', '.join(images) or 'nothing'}")
        for name, shape in self.inputs.items():
            value = images[name] = np.asarray(images[name])
            if value.dtype != np.uint8 or value.ndim != 4 or value.shape[1:] != shape:
                raise ValueError(f"{name}: expected uint8 [B, {shape}], got {value.dtype} {value.shape}")
        if len(sizes := {len(value) for value in images.values()}) > 1 or 0 in sizes:
            given = " and ".join(f"{len(value)} of {name}" for name, value in images.items())
            raise ValueError(f"got {given}: give as many of each, and at least one")
        found = self._call([np.ascontiguousarray(images[m]) for m in self.inputs])
        return dict(zip(self.meta["outputs"], found, strict=True))


def about_sensor(engine: Any, name: str) -> str:
    """A sentence on touch sensor ``name`` ("" = not known), if it is new to the model of ``engine``; else ""."""
    known, new = engine.sensors, engine.new_sensor
    if new and name not in ("", new["sensor"]):
        return f"this export is for touch sensor {new['sensor']}: export the model again for {name}, --new-sensor"
    if new:
        colours = f"{listed(new['in_colours_of'])} ({new['num_images']} unlabelled images)"
        return f"touch sensor {new['sensor']} is new to the model: it is shown in the colours of {colours}"
    if not name or name in known or "touch" not in engine.inputs:
        return ""
    how = "nothing is done about it (`mvitac export MODEL --new-sensor RECORDING` shows it in their colours)"
    return f"touch sensor {name} is new to the model, which knows {listed(known) or 'none by name'}: {how}"


def frames_of(window: Mapping[str, Any] | None, modality: str) -> int:
    """Frames of one input of ``modality``, by ``Engine.window``."""
    return int(window["frames"]) if window and modality in window["of"] else 1


def frame_shapes(engine: Any) -> dict[str, tuple[int, int, int]]:
    """Shapes [S, S, C] of single frames by modality, of all cameras or sensors of it."""
    return {m: (h, w, c // frames_of(engine.window, m)) for m, (h, w, c) in engine.inputs.items()}


def spread_at(target: Mapping[str, Any], value: float) -> float:
    """The root mean squared error of test rows whose prediction was in the range of ``value``, in the target's unit."""
    return float(target["spread"][bisect.bisect_right(target["edges"], value)])


def open_model(path: Path, engine: Runtime = "auto", precision: str = "fp32", threads: int = 0) -> Call:
    """An ONNX file as a function from input arrays to output arrays. Only OpenVINO computes in bf16."""
    if engine not in get_args(Runtime) or type(threads) is not int or not 0 <= threads <= 1024:
        known = ", ".join(get_args(Runtime))
        raise ValueError(f"engine {engine!r}, threads {threads}: give one of {known}, and 0 to 1024")
    if engine == "auto":
        wanted = importlib.util.find_spec("openvino") and (precision != "int8" or _has_vnni())
        engine = "openvino" if wanted else "onnxruntime"
    threads = threads or os.cpu_count() or 1
    try:
        return _openvino(path, precision, threads) if engine == "openvino" else _onnxruntime(path, threads)
    except ImportError as error:
        raise ValueError(f"{path} needs {error.name}: pip install -e '.[export]' in mvitac's clone") from None
    except Exception as error:  # each engine has its own exceptions
        raise ValueError(f"{path} cannot be opened ({brief(error)}): export it again") from None


def _has_vnni() -> bool:
    """Whether the CPU has instructions for 8-bit products. Without them OpenVINO 2026.4 now and then computes a wrong
    int8 result (two threads, busy machine)."""
    flags = Path("/proc/cpuinfo")
    return "AVX2" not in os.environ.get("ONEDNN_MAX_CPU_ISA", "") and flags.exists() and "vnni" in flags.read_text()


def _onnxruntime(path: Path, threads: int) -> Call:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [i.name for i in session.get_inputs()]
    return lambda arrays: session.run(None, dict(zip(names, arrays, strict=True)))  # type: ignore[return-value]


@functools.cache
def _core() -> Any:
    """OpenVINO's only core in this process. Each that compiles sets the stack that signals are handled on, and when it
    goes, the stack before: of two, that may be one that has gone, and Ctrl-C crashes."""
    # OpenVINO would report its import to an analytics host and keep an id in the home folder: without telemetry it cannot.
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino

    return openvino.Core()


def _openvino(path: Path, precision: str, threads: int) -> Call:
    core = _core()
    bf16 = precision == "bf16" and "BF16" in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    config: dict[str, Any] = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_NUM_THREADS": threads}
    config["INFERENCE_PRECISION_HINT"] = "bf16" if bf16 else "f32"
    model = core.compile_model(path, "CPU", config)
    names, request = [port.any_name for port in model.inputs], model.create_infer_request()

    def call(arrays: list[np.ndarray]) -> list[np.ndarray]:
        found = request.infer(dict(zip(names, arrays, strict=True)), share_inputs=True)
        return [np.array(found[i]) for i in range(len(found))]  # the engine reuses its buffers

    return call


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cosine [B] of each row of ``a`` with the same row of ``b``, both [B, D]; 1 for two rows of zeros."""
    product, norms = (a * b).sum(1), np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    zeros = (np.linalg.norm(a, axis=1) == 0) & (np.linalg.norm(b, axis=1) == 0)
    return np.where(zeros, 1.0, product / np.maximum(norms, 1e-12))
