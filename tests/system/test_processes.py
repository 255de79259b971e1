"""Work side by side: the order, the errors and the threads of `in_threads`, and that probes do not depend on it."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.model_files import load
from mvitac.system.processes import side_by_side
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


SLEEP_AND_TELL = (
    "import pathlib, time; pathlib.Path({0!r} + '.begun').touch(); time.sleep(300); pathlib.Path({0!r}).touch()"
)
"""For exec, because a function of this file would make each new process import the file, and torch with it."""


@pytest.mark.usefixtures("ctrl_c")
def test_an_error_beside_them_cuts_off_what_is_under_way_and_begins_no_more(tmp_path: Path) -> None:
    def work() -> None:
        with side_by_side(2) as pool:
            # From their first import on they leave Ctrl-C to the parent.
            assert pool.submit(signal.getsignal, signal.SIGINT).result() is signal.SIG_IGN
            assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
            for i in range(6):
                pool.submit(exec, SLEEP_AND_TELL.format(str(tmp_path / str(i))))
            while len(list(tmp_path.glob("*.begun"))) < 2:
                time.sleep(0.02)
            raise ValueError("enough")

    with pytest.raises(ValueError, match="enough"):
        work()
    assert len(list(tmp_path.glob("*.begun"))) <= 4  # the executor has up to two more in its pipe
    assert not [path for path in tmp_path.iterdir() if not path.suffix]


def test_a_process_that_dies_is_an_error_and_no_wait() -> None:
    """Also on Linux short of memory, where the kernel chooses one of them."""
    said: list[type] = []

    def work() -> None:
        try:
            with side_by_side(2) as pool:
                pool.submit(os.getpid).result()
                pool.submit(os._exit, 9).result()
        except BaseException as error:
            said.append(type(error))

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(300)
    assert said == [BrokenProcessPool]


@pytest.mark.usefixtures("ctrl_c")
def test_sigterm_is_ctrl_c_beside_them() -> None:
    before = signal.getsignal(signal.SIGTERM)

    def work() -> None:
        with side_by_side(1):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert signal.getsignal(signal.SIGTERM) is before
