"""Short runs on the striped pairs: the smoke recipe, training that dies on the way, weights compared bit for bit."""

import json
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.methods.base import Views
from mvitac.recipes import recipe
from mvitac.run import Run
from mvitac.training.loader import ImageLoader
from mvitac.training.loop import Interrupted, train
from mvitac.training.sampler import Batches
from mvitac.training.views import StepViews


def smoke(pack: Pack, **changes: object) -> Run:
    return replace(recipe("smoke", PackConfig(path=pack.path)), **changes)  # type: ignore[arg-type]


@contextmanager
def power_cut(after: int) -> Iterator[None]:
    """Training dies (RuntimeError "power cut") when it asks for its views after ``after`` batches."""
    left, make = iter(range(after)), StepViews.make

    def dying(self: StepViews, rows: np.ndarray, seed: int) -> Views:
        if next(left, None) is None:
            raise RuntimeError("power cut")
        return make(self, rows, seed)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StepViews, "make", dying)
        yield


def batches(run: Run, pack: Pack, rows: np.ndarray, start: int, num_steps: int) -> list[np.ndarray]:
    order = Batches(run, pack, rows)
    return [order[step] for step in range(start, num_steps)]


def views_by(feed: type[ImageLoader], run: Run, pack: Pack, rows: np.ndarray, num_views: int = 2) -> Views:
    made = StepViews(run, pack, num_views, torch.device("cpu"))
    made.images = feed(pack, made.device)
    return made.make(rows, 0)


def weights(path: Path) -> dict[str, torch.Tensor]:
    return safetensors.torch.load_file(path / "model.safetensors")


def log_of(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


def assert_equal_weights(a: Path, b: Path) -> None:
    torch.testing.assert_close(weights(a), weights(b), rtol=0, atol=0)


def train_twice(run: Run, folder: Path, *, cut: int, **options: bool) -> Path:
    """Train ``folder``/straight, and ``folder``/cut, which dies after ``cut`` batches and is resumed: the same weights bit
    for bit. The latter is returned."""
    straight, resumed = folder / "straight", folder / "cut"
    train(run, straight, quiet=True, **options)
    with power_cut(cut), pytest.raises(RuntimeError, match="power cut"):
        train(run, resumed, quiet=True, **options)
    train(run, resumed, resume=True, quiet=True, **options)
    assert_equal_weights(straight, resumed)
    return resumed


def stopped_at(number: int, pack: Path, out: Path) -> None:
    """Train in ``out`` until Ctrl-C comes in step ``number``, and print what is said then."""

    def press(step: int, values: dict[str, float]) -> None:
        if step == number and "loss" in values:  # not also at its evaluation: a second Ctrl-C stops at once
            os.kill(os.getpid(), signal.SIGINT)

    try:
        train(smoke(Pack(pack)), out, quiet=True, loggers=(press,))
    except Interrupted as error:
        print(error)
