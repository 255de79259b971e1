"""Work side by side: the order, the errors and the threads of `in_threads`, and that probes do not depend on it."""

import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.model_files import load
from mvitac.system.threads import in_threads


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Torch with two threads, as on a machine of two cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_several_at_a_time_and_in_order(two_threads: None) -> None:
    met = threading.Barrier(4, timeout=30)  # passes only if four run at the same time

    def work(item: int) -> tuple[int, int]:
        met.wait()
        return item * item, torch.get_num_threads()

    assert in_threads(work, range(4)) == [(0, 1), (1, 1), (4, 1), (9, 1)]
    assert torch.get_num_threads() == 2


def test_an_error_is_raised_and_the_threads_come_back(two_threads: None) -> None:
    def work(item: int) -> int:
        if item == 2:
            raise ValueError("item 2")
        return item

    with pytest.raises(ValueError, match="item 2"):
        in_threads(work, range(5))
    assert torch.get_num_threads() == 2


def test_one_thread_or_one_item_stay_in_this_thread(two_threads: None) -> None:
    here = threading.get_ident()
    assert in_threads(lambda _: threading.get_ident(), [0]) == [here]
    torch.set_num_threads(1)
    assert in_threads(lambda _: threading.get_ident(), [0, 1]) == [here, here]


def test_probes_do_not_depend_on_it(
    two_threads: None, smoke_run: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs and their controls, probed together and one after the other, each time from an empty cache."""

    def scores(threads: int) -> object:
        torch.set_num_threads(threads)
        monkeypatch.setenv("MVITAC_CACHE", str(tmp_path / str(threads)))
        model = load(smoke_run)
        model.run = replace(model.run, seed=1)
        other = shutil.copytree(smoke_run, tmp_path / f"run{threads}")
        model.save(other / "model.safetensors")
        return probe_runs([smoke_run, other], ProbeConfig(tasks=("bright",), modalities=("both",)), pack)["summary"]

    assert scores(2) == scores(1)
