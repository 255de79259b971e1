"""Processes for tests that kill or connect them. Forked from one that has imported torch, they start at once."""

import multiprocessing
import os
import sys
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

CONTEXT: Any = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["support.warm", "torch._dynamo"])


def _work(work: Callable[..., int | None], args: tuple[Any, ...], output: str, environment: dict[str, str]) -> None:
    import torch

    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(file, 1)
    os.dup2(file, 2)
    os.environ.clear()
    os.environ.update(environment)
    torch.set_num_threads(1)
    sys.exit(work(*args))


def begin(
    work: Callable[..., int | None], *args: Any, output: Path | str = os.devnull, **environment: str
) -> BaseProcess:
    """``work(*args)`` in a new process, under this one's environment and ``environment``; it prints into ``output``."""
    process = CONTEXT.Process(target=_work, args=(work, args, str(output), {**os.environ, **environment}))
    process.start()
    return process


def finish(process: BaseProcess, output: Path | None = None) -> None:
    process.join()
    assert process.exitcode == 0, output.read_text() if output else process
