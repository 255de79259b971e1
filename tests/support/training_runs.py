"""Short runs on the striped pairs: the smoke recipe, training that dies on the way, weights compared bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch

from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.recipes import recipe
from mvitac.run import Run
from mvitac.training import views as batches
from mvitac.training.views import make_views


def smoke(pack: Pack, **changes: object) -> Run:
    return replace(recipe("smoke", PackConfig(path=pack.path)), **changes)  # type: ignore[arg-type]


@contextmanager
def power_cut(after: int) -> Iterator[None]:
    """Training dies (RuntimeError "power cut") when it asks for its views after ``after`` batches."""
    left = iter(range(after))

    def dying(*args: object) -> object:
        if next(left, None) is None:
            raise RuntimeError("power cut")
        return make_views(*args)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batches, "make_views", dying)
        yield


def weights(path: Path) -> dict[str, torch.Tensor]:
    return safetensors.torch.load_file(path / "model.safetensors")


def assert_equal_weights(a: Path, b: Path) -> None:
    first, second = weights(a), weights(b)
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
