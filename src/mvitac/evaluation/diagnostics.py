"""Measures of feature quality and collapse: spread, rank, a linear probe, retrieval. Shapes: features [N, D]."""

from collections.abc import Iterable, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor


def spread(z: Float[Tensor, "N D"]) -> float:
    """Mean std of L2-normalised features times sqrt(D): 1 spread out, 0 collapsed (SimSiam, arXiv:2011.10566, 4.1)."""
    z = F.normalize(z.float(), dim=1)
    return float(z.std(dim=0).mean() * z.shape[1] ** 0.5)


def rank_me(z: Float[Tensor, "N D"]) -> float:
    """Effective rank (RankMe, arXiv:2210.02885, eq. 2), exp of the entropy of singular values: 1 to min(N, D)."""
    p = torch.linalg.svdvals(z.double())
    p = p / p.sum().clamp(min=1e-12)
    return float(torch.exp(-(p * torch.log(p + 1e-12)).sum()))


ALPHAS = (10.0, 100.0, 1e3, 1e4, 1e5)  # candidate strengths of the ridge regularisation of ``linear_probe``
BEYOND = 0.5
"""Ridge regression clips each feature at this share of its range in the fitted rows, below and above that range.

After a ReLU, a feature may be 0 in all fitted rows but one. Its standard deviation is then so small that an ordinary value
in another row comes to thousands of them, and to predictions of metres where millimetres are measured. Leaving such
features out instead would lose what only few rows have, such as contact.
"""


def linear_probe(
    train: Float[Tensor, "N D"], targets: Float[Tensor, "N T"], groups: Int[Tensor, " N"], new: Float[Tensor, "M D"]
) -> Float[Tensor, "M T"]:
    """A linear probe in closed form: ridge regression of ``targets`` on standardised features, evaluated at ``new``.

    Its strength is chosen on a fifth of the ``groups`` of the training rows; the final fit uses all of them. It costs
    milliseconds where logistic regression costs seconds. For classes, give one column per class and take the largest.
    """
    y = targets.float()
    names = torch.unique(groups)
    names = names[torch.randperm(len(names), generator=torch.Generator().manual_seed(0))]
    held = torch.isin(groups, names[: len(names) // 5])
    alpha = 100.0
    if held.any():
        x, z = _standardised(train[~held], train[held])
        errors = {a: float((_ridge(x, y[~held], z, a) - y[held]).square().sum()) for a in ALPHAS}
        alpha = min(errors, key=errors.__getitem__)
    x, z = _standardised(train, new)
    return _ridge(x, y, z, alpha)


def _standardised(train: Tensor, new: Tensor) -> tuple[Tensor, Tensor]:
    """Both in mean and std of ``train``, ``new`` clipped (``BEYOND``); a dimension not finite is constant."""
    mean, std = train.mean(0), train.std(0)
    std = std.where(std > 1e-6 * train.abs().amax(0), 1.0)  # as ``classifiers.spread``
    least, most = train.amin(0), train.amax(0)
    clipped = new.clamp(least - BEYOND * (most - least), most + BEYOND * (most - least))
    x, z = (((part - mean) / std).nan_to_num(0.0, 0.0, 0.0) for part in (train, clipped))
    return x, z


def _ridge(x: Tensor, y: Tensor, new: Tensor, alpha: float) -> Tensor:
    centre, offset = x.mean(0), y.mean(0)
    x, y = x - centre, y - offset
    wide = x.shape[1] > len(x)
    gram = x @ x.T if wide else x.T @ x
    gram.diagonal().add_(alpha)
    factor = torch.linalg.cholesky(gram)
    weight = x.T @ torch.cholesky_solve(y, factor) if wide else torch.cholesky_solve(x.T @ y, factor)
    return (new - centre) @ weight + offset


def mean_error(scores: Iterable[Sequence[float]]) -> float:
    """Geometric mean of 1 - score over tasks, each a mean over targets; an error under .01 counts as .01.

    Halving the error counts alike for every task. A plain mean would follow the worst R2, which has no lower end.
    """
    logs = [(1 - torch.tensor(task, dtype=torch.float64)).clamp(min=0.01).log().mean() for task in scores]
    return float(torch.stack(logs).mean().exp())


def retrieval_ranks(
    query: Float[Tensor, "N D"], gallery: Float[Tensor, "N D"], groups: Int[Tensor, " N"]
) -> Int[Tensor, " N"]:
    """Rank (0 = first) of each query's own group, of which each is represented by its mean gallery embedding.

    With one gallery entry per group, chance level R@k is exactly k / number of groups.
    """
    gallery, groups = F.normalize(gallery.float(), dim=1), groups.unique(return_inverse=True)[1]
    sums = torch.zeros(int(groups.max()) + 1, gallery.shape[1]).index_add_(0, groups, gallery)
    similarity = F.normalize(query.float(), dim=1) @ F.normalize(sums, dim=1).T
    # Ties count against the query, or constant embeddings would score.
    return (similarity >= similarity.gather(1, groups[:, None])).sum(1) - 1


def recall_at(ranks: Int[Tensor, " N"], ks: Sequence[int] = (1, 5, 10)) -> dict[str, float]:
    """R@k: fraction of queries whose own group is among the first k."""
    return {f"R@{k}": float((ranks < k).float().mean()) for k in ks}
