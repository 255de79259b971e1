"""The parts that controls and probes are made of, against arithmetic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mvitac.controls import borders, start_weights, thumbnails
from mvitac.encoders import SCRATCH, EncoderConfig
from mvitac.heads import fit_knn, spread_out
from mvitac.methods.moco import MoCoConfig
from mvitac.recipes import recipe


def pictures(*images: np.ndarray) -> Any:
    return SimpleNamespace(images={"touch": np.stack(images)})


def test_a_thumbnail_is_the_mean_of_its_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 255, (32, 32, 6), np.uint8)
    found = thumbnails(pictures(image), "touch", np.array([0]), side=8)
    blocks = image.reshape(8, 4, 8, 4, 6).mean((1, 3)) / 255
    assert np.allclose(found[0], blocks.transpose(2, 0, 1).ravel(), atol=1e-6)


def test_the_border_sees_nothing_of_the_middle() -> None:
    """Two of sixteen thumbnails deep: the outer four of 32 pixels."""
    plain = np.full((32, 32, 3), 7, np.uint8)
    middle, edge = plain.copy(), plain.copy()
    middle[4:-4, 4:-4] = 200
    edge[16, 3] = 200
    found = borders(pictures(plain, middle, edge), "touch", np.arange(3))
    assert found.shape == (3, 3 * (16 * 16 - 12 * 12))
    assert np.array_equal(found[0], found[1]) and not np.array_equal(found[0], found[2])


def test_start_weights_are_named_once_and_scratch_is_none() -> None:
    run = replace(recipe("smoke"), encoder=EncoderConfig(trunk="mvitac_tiny", weights=SCRATCH))
    trained = replace(run, encoder=replace(run.encoder, weights="b.pth"))
    assert start_weights([run, run], None) == []
    assert start_weights([trained, run, trained], Path("a.pth")) == ["a.pth", "b.pth"]
    assert start_weights([trained], Path("b.pth")) == ["b.pth"]


def test_neighbours_are_by_cosine_and_vote_in_shares() -> None:
    x, y = np.array([[1.0, 0.0], [0.0, 10.0]]), np.array([0, 2])
    nearest = fit_knn(x, y, 3, k=1)(np.array([[3.0, 4.0]]))  # nearer to the first, but turned towards the second
    assert nearest.tolist() == [[0, 0, 1]]
    shares = fit_knn(x, y, 3)(np.array([[3.0, 4.0]]))[0]  # more neighbours asked for than there are
    assert shares[2] / shares[0] == pytest.approx(np.exp((0.8 - 0.6) / 0.07), rel=1e-4)
    assert shares.sum() == pytest.approx(1) and shares[1] == 0


def test_classes_never_seen_get_probability_zero() -> None:
    assert spread_out(np.array([[0.2, 0.8]]), np.array([0, 2]), 4).tolist() == [[0.2, 0, 0.8, 0]]


@pytest.mark.parametrize(("num_rows", "size"), [(30, 10), (12, 6), (1, 1)])
def test_a_queue_is_never_more_than_half_the_rows(num_rows: int, size: int) -> None:
    assert MoCoConfig(queue=10).queue_size(num_rows) == size
