"""Runs side by side: processes with their share of the cores or a GPU each, and no life after the command's own.

So a command that was killed can be given again at once, and finds no one writing to its folders.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import torch

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
