"""A trained linear probe that is published with a model: features in, class probabilities or values out.

Shapes: B images, D features (a probe on both modalities reads vision, then touch, concatenated), K classes, T targets.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from mvitac.data.spec import Target


@dataclass(frozen=True, kw_only=True)
class _Asked:
    task: str
    modality: str  # touch, vision or both

    @property
    def name(self) -> str:
        return f"{self.task}.{self.modality}"

    @property
    def modalities(self) -> tuple[str, ...]:
        return ("vision", "touch") if self.modality == "both" else (self.modality,)


@dataclass(frozen=True, kw_only=True)
class ProbeInfo(_Asked):
    """Task, modality and test score of a probe of classes."""

    parts: ClassVar[tuple[str, ...]] = ("weight", "bias")  # tensors of its ``LinearProbe``
    classes: tuple[str, ...]
    accuracy: float  # accuracy on the test split of the dataset it was trained on
    majority: float  # accuracy on the same rows of always predicting the most frequent class
    num_test: int
    leak: str = ""
    """Which test rows the encoders were trained on, or "unknown" (``evaluation.leaks``)."""

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.classes


@dataclass(frozen=True, kw_only=True)
class Error:
    """Errors of one target on the test split, in its unit."""

    r2: float
    mae: float
    rmse: float
    edges: tuple[float, ...]  # bounds [R - 1], ascending, between the R ranges of the predicted value
    spread: tuple[float, ...]  # root mean squared error [R] of the test rows whose prediction is in each range

    def __post_init__(self) -> None:
        if len(self.spread) != len(self.edges) + 1 or list(self.edges) != sorted(self.edges):
            raise ValueError(f"{len(self.edges)} edges and {len(self.spread)} spreads: give n ascending and n + 1")
        if not np.isfinite([self.r2, self.mae, self.rmse, *self.edges, *self.spread]).all():
            raise ValueError("errors of a probe must be finite numbers")


@dataclass(frozen=True, kw_only=True)
class ValueInfo(_Asked):
    """Task, modality and test errors of a probe of values."""

    parts: ClassVar[tuple[str, ...]] = ("weight", "bias", "bounds")
    targets: tuple[Target, ...]
    errors: tuple[Error, ...]  # one for each target
    num_test: int
    leak: str = ""  # as for ``ProbeInfo``

    def __post_init__(self) -> None:
        if not self.targets or len(self.errors) != len(self.targets):
            raise ValueError(f"probe {self.name}: {len(self.errors)} errors for {len(self.targets)} targets")

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(target.name for target in self.targets)


class LinearProbe(nn.Module):
    """softmax(features W^T + b) for classes; features W^T + b, in the units of the targets, for values.

    ``weight`` is [K, D] or [T, D], ``bias`` [K] or [T]. Features of values are first clipped at ``bounds`` [2, D]: lower
    and upper ones. All are fp32.
    """

    weight: Tensor
    bias: Tensor
    bounds: Tensor | None

    def __init__(self, info: ProbeInfo | ValueInfo, weight: Tensor, bias: Tensor, bounds: Tensor | None = None) -> None:
        super().__init__()
        num, tensors = len(info.outputs), [weight, bias] + ([] if bounds is None else [bounds])
        wanted = [(num, weight.shape[-1]), (num,), (2, weight.shape[-1])]
        if any(tensor.shape != shape for tensor, shape in zip(tensors, wanted, strict=False)):
            raise ValueError(f"probe {info.name}: the shapes of its tensors do not fit {num} outputs")
        if not all(tensor.dtype == torch.float32 and tensor.isfinite().all() for tensor in tensors):
            raise ValueError(f"probe {info.name}: its weights are not all finite float32")
        self.info = info
        for name, tensor in (("weight", weight), ("bias", bias), ("bounds", bounds)):
            self.register_buffer(name, tensor)

    def forward(self, features: Tensor) -> Tensor:
        """Probabilities [B, K] or values [B, T] of ``features`` [B, D]."""
        if self.bounds is not None:
            features = features.clamp(self.bounds[0], self.bounds[1])
        found = nn.functional.linear(features, self.weight, self.bias)
        return torch.softmax(found, dim=1) if isinstance(self.info, ProbeInfo) else found
