"""A trained linear probe that is published with a model: features in, class probabilities out.

Shapes: B images, D features (a probe on both modalities reads vision, then touch, concatenated), K classes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mvitac.registry import LATER

UNSEEN = -1e4
"""Logit of a class without training examples: probability 0 in fp32, and still finite in fp16."""


@dataclass(frozen=True, kw_only=True)
class ProbeInfo:
    """Task, modality and test score of a probe."""

    task: str
    modality: str
    """touch, vision or both."""
    classes: tuple[str, ...]
    accuracy: float
    """Accuracy on the test split of the dataset it was trained on."""
    majority: float
    """Accuracy on the same rows of always predicting the most frequent class."""
    num_test: int
    leak: str = field(default="", metadata=LATER)
    """Which test rows the encoders were trained on, or "unknown" (``evaluation.leaks``)."""

    @property
    def name(self) -> str:
        return f"{self.task}.{self.modality}"

    @property
    def modalities(self) -> tuple[str, ...]:
        return ("vision", "touch") if self.modality == "both" else (self.modality,)


class LinearProbe(nn.Module):
    """softmax(features W^T + b).

    Args:
        question: What the probe predicts.
        weight: [K, D], fp32.
        bias: [K], fp32.
    """

    weight: Tensor
    bias: Tensor

    def __init__(self, question: ProbeInfo, weight: Tensor, bias: Tensor) -> None:
        super().__init__()
        num = len(question.classes)
        if weight.ndim != 2 or weight.shape[0] != num or tuple(bias.shape) != (num,):
            raise ValueError(
                f"probe {question.name}: weights of shape {tuple(weight.shape)} and bias of shape {tuple(bias.shape)}"
                f" do not fit {num} classes: expected [{num}, D] and [{num}]"
            )
        if weight.dtype != torch.float32 or bias.dtype != torch.float32:
            raise ValueError(f"probe {question.name}: weights are {weight.dtype}, expected torch.float32")
        if not (weight.isfinite().all() and bias.isfinite().all()):
            raise ValueError(f"probe {question.name}: its weights are not all finite")
        self.question = question
        self.register_buffer("weight", weight)
        self.register_buffer("bias", bias)

    def forward(self, features: Tensor) -> Tensor:
        """Probabilities [B, K] of ``features`` [B, D]."""
        return torch.softmax(nn.functional.linear(features, self.weight, self.bias), dim=1)


def from_logistic(question: ProbeInfo, model: Any, mean: np.ndarray, std: np.ndarray) -> LinearProbe:
    """Convert a scikit-learn ``LogisticRegression`` fitted on (x - mean) / std; the scaling is folded into the weights."""
    coef, intercept = np.asarray(model.coef_, float), np.asarray(model.intercept_, float)
    if len(coef) == 1:  # with two classes scikit-learn has one logit, that of the second class
        coef, intercept = np.concatenate([0 * coef, coef]), np.concatenate([0 * intercept, intercept])
    num = len(question.classes)
    weight, bias = np.zeros((num, coef.shape[1])), np.full(num, UNSEEN)
    weight[model.classes_] = coef / std
    bias[model.classes_] = intercept - (coef / std) @ mean
    return LinearProbe(question, torch.from_numpy(weight).float(), torch.from_numpy(bias).float())


def constant(question: ProbeInfo, label: int, dim: int) -> LinearProbe:
    """A probe that always predicts class ``label``, for training data with a single class."""
    bias = torch.full((len(question.classes),), UNSEEN)
    bias[label] = 0
    return LinearProbe(question, torch.zeros(len(question.classes), dim), bias)
