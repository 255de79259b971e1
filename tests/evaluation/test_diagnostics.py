"""The collapse panel on cases whose answer is known."""

import math

import numpy as np
import pytest
import torch
from sklearn.linear_model import Ridge

from mvitac.evaluation import diagnostics as d


def test_collapsed_features_look_collapsed_and_isotropic_ones_spread() -> None:
    same = torch.ones(50, 8)
    assert d.spread(same) == pytest.approx(0, abs=1e-6)
    assert d.rank_me(same) == pytest.approx(1, abs=1e-3)
    assert d.uniformity(same) == pytest.approx(0, abs=1e-6)
    assert d.uniformity(torch.tensor([[1.0, 0.0], [-1.0, 0.0]])) == pytest.approx(-8)  # at distance 2: log exp(-2 * 4)
    z = torch.randn(4000, 16, generator=torch.Generator().manual_seed(0))
    assert d.spread(z) == pytest.approx(1, abs=0.03)
    assert d.rank_me(z) == pytest.approx(16, abs=0.2)
    assert d.rank_me(torch.eye(7)) == pytest.approx(7, rel=1e-4)


def test_alignment_and_gap() -> None:
    eye = torch.eye(4)
    assert d.alignment(eye, 5 * eye) == pytest.approx(0)
    assert d.alignment(eye, eye.roll(1, 0)) == pytest.approx(2)
    assert d.modality_gap(torch.tensor([[1.0, 0.0]]), torch.tensor([[-3.0, 0.0]])) == pytest.approx(2)


def test_knn_votes_of_the_near_weigh_more() -> None:
    """One neighbour at cosine 1 outvotes three at cosine 0: exp(1 / .07) > 3."""
    train = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [0.0, 1.0]])
    labels = torch.tensor([0, 1, 1, 1])
    assert d.knn_accuracy(train, labels, torch.tensor([[1.0, 0.0]]), torch.tensor([0]), k=4) == 1.0


def test_retrieval_by_group() -> None:
    """Three groups of two rows; queries point at their own group, at the next one, or nowhere."""
    groups = torch.tensor([0, 0, 1, 1, 2, 2])
    gallery = torch.eye(3)[groups]
    assert d.retrieval_ranks(gallery, gallery, groups).tolist() == [0] * 6
    wrong = torch.eye(3)[(groups + 1) % 3] + 0.1 * torch.eye(3)[groups]
    assert d.retrieval_ranks(wrong, gallery, groups).tolist() == [1] * 6
    constant = torch.ones(6, 3)
    assert d.retrieval_ranks(constant, constant, groups).tolist() == [2] * 6, "ties must not retrieve"
    assert d.recall_at(torch.tensor([0, 1, 4, 9]), (1, 5, 10)) == {"R@1": 0.25, "R@5": 0.75, "R@10": 1.0}


def test_group_means_are_means_of_directions() -> None:
    means = d.group_means(torch.tensor([[2.0, 0.0], [0.0, 5.0]]), torch.tensor([0, 0]))
    assert means[0].tolist() == pytest.approx([math.sqrt(0.5)] * 2)


@pytest.mark.parametrize(("rows", "width"), [(60, 8), (40, 64)])
def test_linear_probe_is_ridge_regression_with_a_chosen_strength(rows: int, width: int) -> None:
    """Equal to scikit-learn's at one of the strengths, in both forms; a value that half the features carry is found."""
    rng = torch.Generator().manual_seed(0)
    x, new = (3 * torch.randn(n, width, generator=rng) + 5 for n in (rows, 30))
    weight = torch.randn(width, 2, generator=rng)
    groups = torch.arange(rows) // 4
    guess = d.linear_probe(x, x @ weight, groups, new)
    scaled = ((x - x.mean(0)) / (x.std(0) + 1e-6)).double(), ((new - x.mean(0)) / (x.std(0) + 1e-6)).double()
    expected = [Ridge(alpha=a).fit(scaled[0], (x @ weight).double()).predict(scaled[1]) for a in d.ALPHAS]
    distances = [np.abs(guess.numpy() - each).max() for each in expected]
    assert min(distances) < 1e-3 < sorted(distances)[1]
    assert int(np.argmin(distances)) == 0  # without noise the weakest is best
    noise = torch.randn(rows, 1, generator=rng)
    assert float(d.linear_probe(x, noise, groups, new).std()) < 0.5 * float(noise.std())  # and here a strong one
    broken = torch.cat([x, torch.full((rows, 1), torch.inf)], 1), torch.cat([new, torch.ones(30, 1)], 1)
    assert torch.isfinite(d.linear_probe(broken[0], x @ weight, groups, broken[1])).all()


def test_a_feature_that_is_hardly_there_in_the_fitted_rows_does_not_decide_the_linear_probe() -> None:
    rng = torch.Generator().manual_seed(0)
    x, new = (torch.randn(n, 20, generator=rng) for n in (200, 100))
    x[:, 7], new[:, 7] = 0.0, 0.0
    x[3, 7], new[5, 7] = 1e-4, 0.2
    y = x[:, :1] + 0.3 * torch.randn(200, 1, generator=rng)
    error = d.linear_probe(x, y, torch.arange(200) // 4, new) - new[:, :1]
    assert float(error.abs().max()) < 1


def test_an_r2_far_below_0_weighs_no_more_than_a_few_accuracies() -> None:
    assert d.mean_error([[0.9], [0.6]]) == pytest.approx((0.1 * 0.4) ** 0.5)
    assert d.mean_error([[1.0], [0.5, 0.98]]) == pytest.approx((0.01 * (0.5 * 0.02) ** 0.5) ** 0.5)
    assert d.mean_error([[0.95], [-403.7]]) < d.mean_error([[0.1], [-300.0]])
