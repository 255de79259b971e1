"""Networks from files that need no code of ours: TorchScript and ONNX; safetensors with the name of a timm model.

TorchScript and ONNX files are programs: open only files that you trust.
"""

import warnings
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from mvitac.bench.external.base import FILES, Adapter, Loaded
from mvitac.bench.external.encoder import Plain
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.bench.external.timm_models import Timm
from mvitac.system.files import brief


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
            network = OnnxNetwork(file) if file.suffix == ".onnx" else Plain(_torchscript(file), self.prefix)
        except ImportError as error:
            raise ValueError(f"{file} needs {error.name}: pip install -e '.[export]' in mvitac's clone") from None
        except Exception as error:  # torch and onnxruntime have their own exceptions
            raise ValueError(f"{file} cannot be opened as {file.suffix} ({brief(error)})") from None
        made = Preprocessing()
        if isinstance(network, OnnxNetwork):
            made = replace(made, size=network.size or made.size)
            network = Plain(network, self.prefix)
        return Loaded(network=network, preprocessing=made, title=file.stem, files=(file,), source=file.name)


def _torchscript(file: Path) -> nn.Module:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.jit is deprecated; files of it are not
        return torch.jit.load(str(file), map_location="cpu").eval()


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
