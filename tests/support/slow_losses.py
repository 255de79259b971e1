"""InfoNCE written out as the paper has it."""

import math

import torch


def slow_info_nce(query: torch.Tensor, key: torch.Tensor, tau: float) -> float:
    """Eq. 8 word by word, in float64, one query at a time."""
    query, key, total = query.detach(), key.detach(), 0.0
    for i in range(len(query)):
        q = query[i].double() / query[i].double().norm()
        ks = [k.double() / k.double().norm() for k in key]
        numerator = math.exp(float(q @ ks[i]) / tau)
        denominator = sum(math.exp(float(q @ k) / tau) for k in ks)
        total += -math.log(numerator / denominator)
    return total / len(query)
