"""Work side by side: processes with their share of the cores or a GPU each, and threads with their share of the cores.

No process outlives the command's own, so a command that was killed can be given again at once, and finds no one writing to
its folders.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any, TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")
_device = "auto"


def side_by_side(num: int, devices: Sequence[str] = ()) -> ProcessPoolExecutor:
    """A pool of ``num`` spawned processes; each takes one of ``devices``, if given, for its life (``my_device``)."""
    context = multiprocessing.get_context("spawn")
    places = context.Queue()
    for i in range(num):
        places.put(devices[i % len(devices)] if devices else "auto")
    threads = max(1, (os.cpu_count() or 1) // num)
    return ProcessPoolExecutor(num, context, initializer=_start, initargs=(places, threads))


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


def _start(places: Any, threads: int) -> None:
    global _device
    _device = places.get()
    torch.set_num_threads(threads)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
