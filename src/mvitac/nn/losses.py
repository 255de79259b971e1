"""Contrastive losses. Shapes: B queries, B keys, D dimensions. Row i of the keys is the positive of query i."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def info_nce(query: Float[Tensor, "B D"], key: Float[Tensor, "B D"], temperature: float) -> Float[Tensor, ""]:
    """InfoNCE with in-batch negatives, mean over the queries (paper eq. 8 and 11).

    L = -log( exp(q.k+ / tau) / sum_i exp(q.k_i / tau) ), where the sum is over all B keys of the batch, including the
    positive. This function L2-normalises both inputs. It computes in fp32, also under autocast: at tau = .07 the logits
    span +-14, where bf16 keeps only two digits.
    """
    with torch.autocast(query.device.type, enabled=False):
        query, key = F.normalize(query.float(), dim=1), F.normalize(key.float(), dim=1)
        return F.cross_entropy(query @ key.T / temperature, torch.arange(len(query), device=query.device))


def queue_nce(
    query: Float[Tensor, "B D"], key: Float[Tensor, "B D"], queue: Float[Tensor, "K D"], temperature: float
) -> Float[Tensor, ""]:
    """InfoNCE with the K keys of a queue as negatives (MoCo, eq. 1). The other keys of the batch are not negatives.

    L = -log( exp(q.k+ / tau) / (exp(q.k+ / tau) + sum_i exp(q.k_i / tau)) ), mean over the queries. This function
    L2-normalises queries and keys; the queue must hold normalised keys. It computes in fp32, as ``info_nce``.
    """
    with torch.autocast(query.device.type, enabled=False):
        query, key = F.normalize(query.float(), dim=1), F.normalize(key.float(), dim=1)
        logits = torch.cat([(query * key).sum(1, keepdim=True), query @ queue.T], dim=1) / temperature
        return F.cross_entropy(logits, torch.zeros(len(query), dtype=torch.int64, device=query.device))
