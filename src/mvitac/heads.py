"""The paper's probe (appendix A): linear heads, dropout .2 on frozen features, Adam 1e-4 (eps 1e-7), 60 epochs, batch 256.

The heads of all tasks and seeds that share rows are trained at once: Adam treats every weight by itself, so a head ends as
it would alone. Shapes: features [S, N, D] of S models, labels [T, N] of T tasks, K classes of all tasks together.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

EPOCHS, BATCH, DROPOUT = 60, 256, 0.2


def train_heads(
    features: Tensor, labels: Tensor, num_classes: Sequence[int], seeds: Sequence[int]
) -> list[list[Tensor]]:
    """Weights [num_classes, D + 1] of every head, the bias last: a list of T for each of the S models.

    Order and dropout are drawn from a model's seed, and are the same for all its tasks. Runs where ``features`` are.
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
