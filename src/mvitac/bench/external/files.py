"""Networks that need no code of ours: TorchScript, ONNX, weights with the name of a timm model, a Python function.

TorchScript and ONNX files are programs: open only files that you trust. The function of
external:python:package.module:function takes no arguments and returns a torch module and a dict:

    def function():
        return network, {"size": (224, 224), "mean": (0.5, 0.5, 0.5), "std": (0.5, 0.5, 0.5), "licence": "MIT"}

The module maps normalised images to features [B, D], tokens [B, P, D] or maps [B, D, H, W]; one with timm's interface
(``forward_features``, ``num_features``) is used as it is. The dict has fields of ``Preprocessing``, and "title",
"licence", "source", "trained_on" and "prefix" (tokens in front that are no places).
"""

import importlib
import sys
import warnings
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from mvitac.bench.external.base import FILES, Adapter, Loaded, seeded
from mvitac.bench.external.encoder import Plain
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.bench.external.timm_models import Timm
from mvitac.registry import from_json, to_json
from mvitac.system.files import brief

ABOUT = ("title", "licence", "source", "trained_on")


@dataclass(frozen=True, kw_only=True)
class File(Adapter):
    """A TorchScript or ONNX file, or weights of a timm model."""

    name: ClassVar[str] = "file"
    expects: ClassVar[str] = f"a file that exists ({', '.join(FILES)})"
    reads: Literal["touch", "vision", "both"] = "both"
    trunk: str = ""
    """Name of the timm model, for .safetensors and .pth."""
    prefix: int = 0
    """Tokens in front that are no places (class, registers), of TorchScript and ONNX."""

    def load(self) -> Loaded:
        file = self.path()
        if self.trunk:
            given = {field.name: getattr(self, field.name) for field in fields(Adapter)}
            return Timm(**{**given, "place": self.trunk}, weights=str(file)).load()
        if file.suffix in (".safetensors", ".pth"):
            raise ValueError(f"{file} holds weights only: name their timm model with trunk=NAME, or an adapter")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # torch.jit is deprecated; files of it are not
                onnx = file.suffix == ".onnx"
                opened = OnnxNetwork(file) if onnx else torch.jit.load(str(file), map_location="cpu").eval()
        except ImportError as error:
            raise ValueError(f"{file} needs {error.name}: pip install -e '.[export]' in mvitac's clone") from None
        except Exception as error:  # torch and onnxruntime have their own exceptions
            raise ValueError(f"{file} cannot be opened as {file.suffix} ({brief(error)})") from None
        made = Preprocessing()
        if isinstance(opened, OnnxNetwork):
            made = replace(made, size=opened.size or made.size)
        return Loaded(Plain(opened, self.prefix), made, file.stem, files=(file,), source=file.name)


class OnnxNetwork(nn.Module):
    """The first output of an ONNX file, on the CPU."""

    def __init__(self, file: Path) -> None:
        import onnxruntime

        super().__init__()
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        self.session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        self.input: Any = self.session.get_inputs()[0]
        self.one_by_one, sides = self.input.shape[0] == 1, self.input.shape[-2:]
        channels = self.input.shape[1] if len(self.input.shape) == 4 else 3
        if isinstance(channels, int) and channels % 3:
            raise ValueError(f"it takes {channels} channels, the images have 3 for each frame")
        self.size = tuple(sides) if all(isinstance(side, int) for side in sides) else None

    def forward(self, images: Tensor) -> Tensor:
        array = images.cpu().numpy()
        parts = array[:, None] if self.one_by_one else [array]  # some files have a fixed batch of one
        outputs: Any = [self.session.run(None, {self.input.name: part})[0] for part in parts]
        return torch.from_numpy(np.concatenate(outputs)).to(images.device)


@dataclass(frozen=True, kw_only=True)
class Python(Adapter):
    """A function that returns a module and its preprocessing."""

    name: ClassVar[str] = "python"
    expects: ClassVar[str] = "package.module:function"
    reads: Literal["touch", "vision", "both"] = "both"

    def load(self) -> Loaded:
        module, _, name = self.place.partition(":")
        sys.path.insert(0, str(Path.cwd()))  # as python -m does
        try:
            made: Any = seeded(getattr(importlib.import_module(module), name), self.seed)
            network, given = made[0], dict(made[1])
        except Exception as error:  # whatever the module raises, or returns
            why = f"{type(error).__name__}: {brief(error)}"
            raise ValueError(f"{self.place}() returns no torch module and dict ({why}): give {self.expects}") from None
        finally:
            sys.path.remove(str(Path.cwd()))
        about: dict[str, Any] = {"title": self.place, "source": self.place}
        about |= {name: str(given.pop(name)) for name in ABOUT if name in given}
        prefix = int(given.pop("prefix", 0))
        if isinstance(size := given.get("size"), int):
            given["size"] = (size, size)
        preprocessing = from_json(Preprocessing, to_json(given), f"{self.place}()")
        if not (hasattr(network, "forward_features") and hasattr(network, "num_features")):
            network = Plain(network, prefix)
        return Loaded(network, preprocessing, **about)
