"""A trained linear probe that goes with a model: features in, class probabilities out.

Shapes: B images, D features (of both modalities joined, vision first, where it reads both), K classes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

UNSEEN = -1e4
"""Logit of a class that training never showed: probability 0 in fp32, and still a number in fp16."""


@dataclass(frozen=True, kw_only=True)
class ProbeInfo:
    """What a readout answers, from which modality, and how well it did on rows it never saw."""

    task: str
    modality: str
    """touch, vision or both."""
    classes: tuple[str, ...]
    accuracy: float
    """On the test rows of the data it was trained on."""
    majority: float
    """Accuracy there of always saying the commonest class: the score to beat."""
    num_test: int

    @property
    def name(self) -> str:
        return f"{self.task}.{self.modality}"

    @property
    def modalities(self) -> tuple[str, ...]:
        return ("vision", "touch") if self.modality == "both" else (self.modality,)


class LinearProbe(nn.Module):
    """softmax(features W^T + b)."""

    weight: Tensor
    bias: Tensor

    def __init__(self, question: ProbeInfo, weight: Tensor, bias: Tensor) -> None:
        """``weight`` [K, D], ``bias`` [K], both fp32."""
        super().__init__()
        num = len(question.classes)
        if weight.ndim != 2 or weight.shape[0] != num or tuple(bias.shape) != (num,):
            raise ValueError(
                f"probe {question.name}: weights {tuple(weight.shape)} and {tuple(bias.shape)}"
                f" do not belong to {num} classes"
            )
        if weight.dtype != torch.float32 or bias.dtype != torch.float32:
            raise ValueError(f"probe {question.name}: weights are {weight.dtype}, expected torch.float32")
        if not (weight.isfinite().all() and bias.isfinite().all()):
            raise ValueError(f"probe {question.name}: its weights are not all numbers")
        self.question = question
        self.register_buffer("weight", weight)
        self.register_buffer("bias", bias)

    def forward(self, features: Tensor) -> Tensor:
        """Probabilities [B, K] of ``features`` [B, D]."""
        return torch.softmax(nn.functional.linear(features, self.weight, self.bias), dim=1)


def from_logistic(question: ProbeInfo, model: Any, mean: np.ndarray, std: np.ndarray) -> LinearProbe:
    """A fitted scikit-learn ``LogisticRegression`` on (x - mean) / std, with the scaling folded into its weights."""
    coef, intercept = np.asarray(model.coef_, float), np.asarray(model.intercept_, float)
    if len(coef) == 1:  # two classes: one logit, of the second
        coef, intercept = np.concatenate([0 * coef, coef]), np.concatenate([0 * intercept, intercept])
    num = len(question.classes)
    weight, bias = np.zeros((num, coef.shape[1])), np.full(num, UNSEEN)
    weight[model.classes_] = coef / std
    bias[model.classes_] = intercept - (coef / std) @ mean
    return LinearProbe(question, torch.from_numpy(weight).float(), torch.from_numpy(bias).float())


def constant(question: ProbeInfo, label: int, dim: int) -> LinearProbe:
    """Always class ``label``: all that can be learned where training shows one class only."""
    bias = torch.full((len(question.classes),), UNSEEN)
    bias[label] = 0
    return LinearProbe(question, torch.zeros(len(question.classes), dim), bias)
