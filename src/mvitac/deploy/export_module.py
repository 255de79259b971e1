"""From pixels to probabilities and values in one module: uint8 in, resizing and normalisation inside.

Shapes: B images, S stored side, C channels (3, or 6 for two sensors), D features, E shared space, K classes.
Inputs: one uint8 [B, S, S, C] RGB per modality, as a pack stores them. Outputs, by ``ExportModule.outputs``:
embedding_<modality> [B, D], shared_<modality> [B, E] (L2-normalised; absent without a shared space),
probability_<task> [B, K], value_<task> [B, T] in the units of its T targets. With ``looks``, touch is of a new sensor:
features are the mean over its images in the colours of each known one.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mvitac.model import Model
from mvitac.nn.linear_probe import LinearProbe, ProbeInfo, ValueInfo
from mvitac.transforms.gel_colours import Looks


class _View(nn.Module):
    """uint8 [B, S, S, C] to the normalised [B, C, size, size] that an encoder takes, for probes or for heads."""

    filter: Tensor
    scale: Tensor
    shift: Tensor

    def __init__(self, model: Model, modality: str, for_heads: bool) -> None:
        super().__init__()
        mean, std = (torch.tensor(v).view(3, 1, 1) for v in model.run.encoder[modality].mean_std)
        self.register_buffer("filter", _filter(model.image_sizes(modality)[for_heads], model.stored))
        self.register_buffer("scale", 1 / (255 * std))
        self.register_buffer("shift", -mean / std)

    def forward(self, images: Tensor) -> Tensor:
        x, filter = images.permute(0, 3, 1, 2).float(), self.filter
        if filter.shape[0] != filter.shape[1]:
            x = _along_width(_along_width(x, filter).transpose(2, 3), filter).transpose(2, 3)
        sensors = [x[:, i : i + 3] * self.scale + self.shift for i in range(0, x.shape[1], 3)]
        return torch.cat(sensors, dim=1) if len(sensors) > 1 else sensors[0]


class ExportModule(nn.Module):
    """The exported module. It shares no preprocessing code with ``Model.features``, so comparing them is a check."""

    lamps: Tensor
    mixing: Tensor
    minus_ground: Tensor

    def __init__(self, model: Model, modalities: tuple[str, ...] | None = None, looks: Looks | None = None) -> None:
        """``modalities``: its inputs; None = all the model has. ValueError if the model lacks one."""
        super().__init__()
        self.looks = looks
        self.modalities = modalities or tuple(model.encoders)
        for modality in self.modalities:
            model.check_modality(modality)
        asked = "both" if len(self.modalities) == 2 else self.modalities[0]
        self.encoders = nn.ModuleDict({m: model.encoders[m] for m in self.modalities})
        self.projectors = nn.ModuleDict({m: p for m, p in model.projectors.items() if m in self.modalities})
        self.probes = nn.ModuleList([r for r in model.probes.values() if r.info.modality == asked])
        infos: list[Any] = [r.info for r in self.probes]
        self.classes = {q.task: list(q.classes) for q in infos if isinstance(q, ProbeInfo)}
        self.values = {
            q.task: [
                {"name": t.name, "unit": t.unit, "edges": list(e.edges), "spread": list(e.spread)}
                for t, e in zip(q.targets, q.errors, strict=True)
            ]
            for q in infos
            if isinstance(q, ValueInfo)
        }
        self.inputs = {m: (model.stored, model.stored, model.spec.channels(m)) for m in self.modalities}
        names = [*(f"embedding_{m}" for m in self.modalities), *(f"shared_{m}" for m in self.projectors)]
        self.outputs = (*names, *(output_of(r) for r in self.probes))  # type: ignore[arg-type]
        self.views = nn.ModuleDict({m: _View(model, m, for_heads=False) for m in self.modalities})
        # Heads need views of the size they were trained on.
        twice = [m for m in self.projectors if len(set(model.image_sizes(m))) > 1]
        self.head_views = nn.ModuleDict({m: _View(model, m, for_heads=True) for m in twice})
        if looks:
            mixing = [looks.source.mixtures @ target.colours.T for target in looks.targets]
            ground = [target.level + target.rest for target in looks.targets]
            self.register_buffer("lamps", torch.from_numpy(looks.source.rest).float())
            self.register_buffer("mixing", torch.from_numpy(np.stack(mixing)).float())
            self.register_buffer("minus_ground", torch.from_numpy(-np.stack(ground)).float())
        self.eval()

    def encode(self, modality: str, images: Tensor, view: nn.Module) -> Tensor:
        """Features [B, D] of uint8 [B, S, S, C]; of a new sensor in the colours of each of L known ones, averaged."""
        if not (self.looks and modality == "touch"):
            return self.encoders[modality](view(images))
        levels = images.float()
        slopes = levels - levels.mean((1, 2), keepdim=True) - self.lamps
        # A difference, because int8 exports round what is added.
        shown = [slopes @ mixing - ground for mixing, ground in zip(self.mixing, self.minus_ground, strict=True)]
        found = self.encoders[modality](view(torch.cat(shown).round().clamp(0, 255)))  # whole levels [L B, S, S, 3]
        return found.reshape(len(self.mixing), -1, found.shape[1]).mean(0)

    def forward(self, *images: Tensor) -> tuple[Tensor, ...]:
        """The outputs, in the order of ``outputs``, of the images, in the order of ``modalities``."""
        given = dict(zip(self.modalities, images, strict=True))
        features = {m: self.encode(m, x, self.views[m]) for m, x in given.items()}
        wanted = features | {m: self.encode(m, given[m], view) for m, view in self.head_views.items()}
        shared = [F.normalize(head(wanted[m]), dim=1) for m, head in self.projectors.items()]
        joined = torch.cat([features[m] for m in ("vision", "touch") if m in features], dim=1)
        return (*features.values(), *shared, *(probe(joined) for probe in self.probes))


def write_onnx(graph: ExportModule, path: Path) -> None:
    """Write ``graph`` as the ONNX file ``path``, for batches of 1 to 1024."""
    two = tuple(torch.zeros(2, *shape, dtype=torch.uint8) for shape in graph.inputs.values())
    batch = torch.export.Dim("batch", min=1, max=1024)
    names: Any = {"input_names": list(graph.inputs), "output_names": list(graph.outputs)}
    shapes: Any = {"dynamo": True, "dynamic_shapes": (tuple({0: batch} for _ in two),)}
    torch.onnx.export(graph, two, path, **names, **shapes, opset_version=18, external_data=False, verbose=False)


def quantise(path: Path, inputs: list[str], examples: list[list[np.ndarray]]) -> None:
    """Replace the ONNX file by its int8 version: weights per channel, activations by ranges seen on ``examples``.

    Weights have 7 bits: a CPU without VNNI adds pairs of 8-bit products in 16 bits, where larger sums are cut off.
    """
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    left = (dict(zip(inputs, example, strict=True)) for example in examples)

    class Reader(CalibrationDataReader):
        def get_next(self) -> dict[str, np.ndarray] | None:  # type: ignore[override]
            return next(left, None)

    prepared = path.with_name("prepared.onnx")
    quant_pre_process(str(path), str(prepared), skip_symbolic_shape=True)
    kinds: Any = {"quant_format": QuantFormat.QDQ, "activation_type": QuantType.QUInt8, "weight_type": QuantType.QInt8}
    # Heads and probes stay in fp32: they are small.
    kinds["op_types_to_quantize"] = ["Conv", "Add", "MaxPool", "GlobalAveragePool"]
    quantize_static(str(prepared), str(path), Reader(), **kinds, per_channel=True, reduce_range=True)
    prepared.unlink()


def output_of(probe: LinearProbe) -> str:
    return f"{'probability' if isinstance(probe.info, ProbeInfo) else 'value'}_{probe.info.task}"


def _filter(size: int, stored: int) -> Tensor:
    """[size, stored]: antialiased bilinear resizing is linear along each axis, so it is one matrix, the resized
    identity. Rounded to the 16-bit fixed-point weights of torch's uint8 kernel, so that every pixel is the same."""
    rows = F.interpolate(torch.eye(stored)[None, None], (size, stored), mode="bilinear", antialias=True)[0, 0]
    step = 2.0 ** max(p for p in range(24) if (rows.max() * 2**p).round() < 2**15)
    return (rows * step).round() / step


def _along_width(x: Tensor, filter: Tensor) -> Tensor:
    """[B, C, H, S] -> [B, C, H, size] in whole grey levels, rounded after each pass as torch's uint8 kernel does. As a
    plain matrix product: OpenVINO 2026.4 cannot compile a batched one followed by a scale per channel."""
    return (x.flatten(0, 2) @ filter.T + 0.5).floor().unflatten(0, x.shape[:3])
