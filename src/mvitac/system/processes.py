"""Work side by side: processes with their share of the cores or a GPU each, and threads with their share of the cores.

No process outlives the command's own, so a command that was killed can be given again at once, and finds no one writing to
its folders.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")
_device = "auto"


@contextmanager
def _answer(number: int, handler: Any) -> Iterator[None]:
    """``handler`` of a signal for as long as the ``with`` lasts; nothing in other threads than the main one."""
    here = threading.current_thread() is threading.main_thread()
    before = signal.signal(number, handler) if here else None
    try:
        yield
    finally:
        if before is not None:
            signal.signal(number, before)


class _DeafProcess(SpawnProcess):
    """Ctrl-C is for its parent to hear: while it imports, it would only answer with a traceback."""

    def start(self) -> None:
        with _answer(signal.SIGINT, signal.SIG_IGN):
            super().start()


class _Context(SpawnContext):
    Process = _DeafProcess


@contextmanager
def side_by_side(num: int, devices: Sequence[str] = ()) -> Iterator[ProcessPoolExecutor]:
    """A pool of ``num`` spawned processes; each takes one of ``devices``, if given, for its life (``my_device``).

    On Ctrl-C or SIGTERM, which is a KeyboardInterrupt here, or any other error in the ``with``, nothing more is begun and
    what is under way gets SIGTERM: training saves its checkpoint and stops after its step, anything else is cut off.
    """
    context = _Context()
    places, stop = context.Queue(), context.Semaphore(0)  # an Event would wait for sleepers that have died
    for i in range(num):
        places.put(devices[i % len(devices)] if devices else "auto")
    threads = max(1, (os.cpu_count() or 1) // num)
    with (
        _answer(signal.SIGTERM, signal.default_int_handler),
        ProcessPoolExecutor(num, context, initializer=_start, initargs=(places, threads, stop)) as pool,
    ):
        try:
            yield pool
        except BaseException:
            for _ in range(num):
                stop.release()
            pool.shutdown(cancel_futures=True)
            raise


def my_device() -> str:
    """The device of this process: "auto" where none was given to it."""
    return _device


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """``function`` of every item, in order, several at a time, each with its share of torch's threads.

    For work on the CPU that releases the interpreter and draws nothing from global generators: networks of different
    models, fits. Several such of few threads get more out of the cores than one of many.
    """
    threads = torch.get_num_threads()
    num = min(len(items), 2 * threads)
    if threads < 2 or num < 2:
        return [function(item) for item in items]
    share = max(1, threads // num)
    torch.set_num_threads(share)
    try:
        with ThreadPoolExecutor(num, initializer=torch.set_num_threads, initargs=(share,)) as pool:
            return list(pool.map(function, items))
    finally:
        torch.set_num_threads(threads)


def _start(places: Any, threads: int, stop: Any) -> None:
    global _device
    _device = places.get()
    torch.set_num_threads(threads)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    def obey() -> None:
        stop.acquire()
        while True:  # training answers by stopping, but a further task may lie ready
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1)

    threading.Thread(target=follow, daemon=True).start()
    threading.Thread(target=obey, daemon=True).start()
