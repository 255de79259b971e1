"""The collapse panel on cases whose answer is known."""

from __future__ import annotations

import math

import pytest
import torch

from mvitac.evaluation import diagnostics as d


def test_collapsed_features_look_collapsed() -> None:
    same = torch.ones(50, 8)
    assert d.spread(same) == pytest.approx(0, abs=1e-6)
    assert d.rank_me(same) == pytest.approx(1, abs=1e-3)
    assert d.uniformity(same) == pytest.approx(0, abs=1e-6)


def test_isotropic_features_look_spread() -> None:
    z = torch.randn(4000, 16, generator=torch.Generator().manual_seed(0))
    assert d.spread(z) == pytest.approx(1, abs=0.03)
    assert d.rank_me(z) == pytest.approx(16, abs=0.2)
    assert d.rank_me(torch.eye(7)) == pytest.approx(7, rel=1e-4)


def test_uniformity_of_opposite_poles() -> None:
    """Two points at distance 2: log exp(-2 * 4) = -8."""
    assert d.uniformity(torch.tensor([[1.0, 0.0], [-1.0, 0.0]])) == pytest.approx(-8)


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
