"""The heads that a probe fits on frozen features: logistic regression, the paper's linear layer, the nearest neighbours.

None of them knows of packs, splits or models. Shapes: features [N, D]; fitted, a head is a function from features to class
probabilities [N, K].
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from threadpoolctl import threadpool_limits
from torch import Tensor

STRENGTHS = (0.001, 0.01, 0.1, 1.0)
"""Inverse regularisation C that logistic regression may choose from."""
EPOCHS, BATCH, DROPOUT = 60, 256, 0.2
"""Of the paper's probe."""


@dataclass(frozen=True)
class Logistic:
    """A fitted logistic regression on (z - mean) / std; called, it gives probabilities in ascending label order."""

    model: LogisticRegression
    mean: np.ndarray
    std: np.ndarray

    def __call__(self, z: np.ndarray) -> np.ndarray:
        return self.model.predict_proba((z - self.mean) / self.std)


def fit_linear(x: np.ndarray, y: np.ndarray, x_val: np.ndarray, y_val: np.ndarray) -> tuple[Logistic, float]:
    """Logistic regression on standardised features; C is the best on val, then train and val are fitted together.

    Returns it and C.
    """
    mean, std = x.mean(0), x.std(0) + 1e-6
    x, x_val = (x - mean) / std, (x_val - mean) / std
    # Ascending C, each start warm from the last: about a third of the steps of cold starts.
    model = LogisticRegression(max_iter=300, tol=1e-3, warm_start=True)
    # One BLAS thread: these products are small, and threads that wait for each other made it ten times slower.
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore", ConvergenceWarning)  # 300 L-BFGS steps are plenty for choosing
        scores = [model.set_params(C=c).fit(x, y).score(x_val, y_val) for c in STRENGTHS]
        c = STRENGTHS[int(np.argmax(scores))]
        if set(y_val) - set(y):  # a class only seen in val changes the shape of the weights
            model = LogisticRegression(max_iter=300, tol=1e-3)
        model.set_params(C=c).fit(np.concatenate([x, x_val]), np.concatenate([y, y_val]))
    return Logistic(model, mean, std), c


def train_heads(
    features: Tensor, labels: Tensor, num_classes: Sequence[int], seeds: Sequence[int]
) -> list[list[Tensor]]:
    """The paper's probe (appendix A): linear heads, dropout .2, Adam 1e-4 (eps 1e-7), 60 epochs, batch 256.

    Weights [num_classes, D + 1] of every head, the bias last: a list of T for each of the S models. ``features`` [S, N, D]
    of S models, ``labels`` [T, N] of T tasks. The heads of all tasks and seeds that share rows are trained at once: Adam
    treats every weight by itself, so a head ends as it would alone. Order and dropout are drawn from a model's seed, and
    are the same for all its tasks. Runs where ``features`` are.
    """
    models, num, width = features.shape
    device = features.device
    streams = [torch.Generator(device).manual_seed(seed) for seed in seeds]

    def start(classes: int, seed: int) -> Tensor:  # of a seed alone, whatever other tasks there are
        return (torch.rand(classes, width, generator=torch.Generator().manual_seed(seed)) * 2 - 1) * width**-0.5

    weight = (
        torch.stack([torch.cat([start(k, seed) for k in num_classes]) for seed in seeds]).to(device).requires_grad_()
    )
    bias = torch.zeros(models, 1, sum(num_classes), device=device, requires_grad=True)
    optimiser = torch.optim.Adam([weight, bias], lr=1e-4, eps=1e-7, fused=device.type in ("cpu", "cuda"))
    labels, each = labels.to(device), torch.arange(models, device=device)[:, None]
    for _ in range(EPOCHS):
        order = torch.stack([torch.randperm(num, generator=g, device=device) for g in streams])
        for batch in order.split(BATCH, dim=1):
            x = features[each, batch]
            keep = torch.stack([torch.rand(x.shape[1:], generator=g, device=device) for g in streams]) >= DROPOUT
            logits = torch.baddbmm(bias, x * keep / (1 - DROPOUT), weight.mT).split(list(num_classes), dim=2)
            loss = torch.zeros((), device=device)
            for task, scores in enumerate(logits):  # the mean over a model's pairs, summed over models and tasks
                loss = loss + models * F.cross_entropy(scores.flatten(0, 1), labels[task][batch].flatten())
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    joined = torch.cat([weight.detach(), bias.detach().mT], dim=2).cpu()
    return [list(heads.split(list(num_classes))) for heads in joined]


def fit_paper(x: np.ndarray, y: np.ndarray, num_classes: int, seed: int) -> Any:
    """The paper's probe of one task."""
    return fit_papers(x, [y], [num_classes], seed)[0]


def fit_papers(x: np.ndarray, ys: list[np.ndarray], num_classes: list[int], seed: int) -> list[Any]:
    """The paper's probes of several tasks on the same rows, trained together: a function to class probabilities each."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    labels = torch.from_numpy(np.stack(ys)).long()
    heads = train_heads(torch.from_numpy(x).float()[None].to(device), labels, num_classes, [seed])[0]

    def predict(z: np.ndarray, head: np.ndarray) -> np.ndarray:
        return np.asarray(torch.softmax(torch.from_numpy(z @ head[:, :-1].T + head[:, -1]), 1))

    return [partial(predict, head=head.numpy()) for head in heads]


def fit_knn(x: np.ndarray, y: np.ndarray, num_classes: int, k: int = 20) -> Any:
    """Weighted vote of the k nearest by cosine, as ``diagnostics.knn_accuracy``, giving vote shares per class."""
    bank = F.normalize(torch.from_numpy(x).float(), dim=1)
    labels = torch.from_numpy(y).long()

    def predict(z: np.ndarray) -> np.ndarray:
        near = (F.normalize(torch.from_numpy(z).float(), dim=1) @ bank.T).topk(min(k, len(bank)), dim=1)
        votes = torch.zeros(len(z), num_classes).scatter_add_(1, labels[near.indices], (near.values / 0.07).exp())
        return (votes / votes.sum(1, keepdim=True)).numpy()

    return predict


def spread_out(probabilities: np.ndarray, seen: np.ndarray, num_classes: int) -> np.ndarray:
    """Probabilities over the classes ``seen`` in training as columns of all ``num_classes``."""
    full = np.zeros((len(probabilities), num_classes))
    full[:, seen] = probabilities
    return full
