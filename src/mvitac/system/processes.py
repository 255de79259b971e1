"""Parallel work in processes, each with its share of cores or one GPU.

Child processes end when the command's process ends, so a killed command can be started again immediately.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

import torch

_device = "auto"


@contextmanager
def _answer(number: int, handler: Any) -> Iterator[None]:
    """Set a signal handler inside the ``with``; do nothing in threads other than the main thread."""
    here = threading.current_thread() is threading.main_thread()
    before = signal.signal(number, handler) if here else None
    try:
        yield
    finally:
        if before is not None:
            signal.signal(number, before)


class _DeafProcess(SpawnProcess):
    """A process that ignores Ctrl-C, which its parent handles: during imports it would only print a traceback."""

    def start(self) -> None:
        with _answer(signal.SIGINT, signal.SIG_IGN):
            super().start()


class _Context(SpawnContext):
    Process = _DeafProcess


@contextmanager
def side_by_side(num: int, devices: Sequence[str] = ()) -> Iterator[ProcessPoolExecutor]:
    """Create a pool of ``num`` spawned processes; each uses one of ``devices``, if given (``my_device``).

    On Ctrl-C, SIGTERM (raised as KeyboardInterrupt) or any other error in the ``with``, no further task is started and
    running ones get SIGTERM: training saves a checkpoint after its step and stops, other tasks are killed.
    """
    context = _Context()
    places, stop = context.Queue(), context.Semaphore(0)  # not an Event: that would wait for processes that died
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
    """Return the device of this process; "auto" if it was given none."""
    return _device


def _start(places: Any, threads: int, stop: Any) -> None:
    global _device
    _device = places.get()
    torch.set_num_threads(threads)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_exit_after, args=(parent,), daemon=True).start()
    threading.Thread(target=_terminate_on, args=(stop,), daemon=True).start()


def _exit_after(parent: Any) -> None:
    """End this process when its parent ends."""
    parent.join()
    os._exit(1)


def _terminate_on(stop: Any) -> None:
    """Send SIGTERM to this process after ``stop`` is released."""
    stop.acquire()
    while True:  # training stops after one signal, but the next task may be queued
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1)
