"""Heads that start as linear probes of the trunks they belong to: LP-FT (Kumar et al., arXiv:2202.10054)."""

import numpy as np
import torch
from torch import nn

from mvitac.data.pack import Pack
from mvitac.data.spec import AnyTask, Task
from mvitac.evaluation.classifiers import fit_linear
from mvitac.evaluation.pack_features import pack_features
from mvitac.evaluation.regressors import fit_ridge
from mvitac.methods.base import Method
from mvitac.methods.supervised import ValueHead
from mvitac.model import Model
from mvitac.run import Run


@torch.no_grad()
def fit_heads(method: Method, run: Run, pack: Pack, rows: np.ndarray) -> None:
    """Set each head of ``method`` to a linear probe fitted on features of ``rows``, as the head sees them.

    C or alpha is chosen on the groups of split val among ``rows``, or on a fifth of their groups. A task with labels of one
    class keeps its head.
    """
    model = Model(method, run, pack.spec, pack.size)
    x = np.concatenate([pack_features(model, pack, m, rows, for_heads=True).numpy() for m in model.encoders], axis=1)
    splits = run.method.label_splits
    for task in run.method.tasks_of(pack.spec):  # type: ignore[attr-defined]
        there = pack.answered(task, *splits)[rows]
        held = _held(pack, task, rows[there])
        order = np.concatenate([np.flatnonzero(there)[~held], np.flatnonzero(there)[held]])
        _fit_head(method.classifiers()[task.name], x[order], pack, task, rows[order], int(held.sum()))


def _held(pack: Pack, task: AnyTask, rows: np.ndarray) -> np.ndarray:
    """bool [len(rows)]: rows to choose C or alpha on."""
    held = pack.column(task.split)[rows] == "val"
    if held.any() and not held.all():
        return held
    groups = pack.column("group")[rows].astype(str)
    names = np.random.default_rng(0).permutation(np.unique(groups))
    return np.isin(groups, names[: len(names) // 5])


def _fit_head(head: nn.Module, x: np.ndarray, pack: Pack, task: AnyTask, rows: np.ndarray, num_val: int) -> None:
    """Fit on ``x`` [N, D] of ``rows``, the last ``num_val`` of which C or alpha is chosen on."""
    num = len(x) - num_val
    if isinstance(task, Task):
        y = pack.labels(task.name)[rows]
        if len(set(y[:num])) < 2:
            return
        chosen_on = slice(num, None) if num_val else slice(None)
        fitted, _ = fit_linear(x[:num], y[:num], x[chosen_on], y[chosen_on], len(task.classes))
    else:
        fitted, _ = fit_ridge(x, pack.values(task)[rows], num_val)
    weight, bias = map(torch.from_numpy, fitted.weights())
    if isinstance(head, ValueHead):
        mean, std = head.mean.cpu(), head.std.cpu()
        weight, bias = weight / std[:, None], (bias - mean) / std
        head = head.layers
    assert isinstance(head, nn.Linear)
    head.weight.copy_(weight)
    head.bias.copy_(bias)
