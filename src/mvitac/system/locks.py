"""One process at a time: who makes a pack or trains a run holds a lock beside it, which ends with the process, however."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from filelock import FileLock, Timeout
from rich.console import Console

_held: ContextVar[frozenset[Path]] = ContextVar("_held", default=frozenset())
"""Places that this thread holds."""


class Busy(ValueError):
    """Another process is at it."""


@contextmanager
def hold_lock(place: Path, busy: str, *, wait: bool, quiet: bool = False) -> Iterator[None]:
    """Hold ``<place>.lock``. If another process does: say ``busy`` (not if ``quiet``) and wait for it, or raise Busy(busy).

    Between machines, too, as far as their shared file system keeps locks; on one that knows none nobody waits. A thread may
    hold a place it holds already.
    """
    place = place.absolute()
    if place in _held.get():
        yield
        return
    # No soft lock there: it would outlive a process that was killed.
    lock = FileLock(place.with_name(place.name + ".lock"), fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        if not wait:
            raise Busy(busy) from None
        if not quiet:
            Console().print(busy, soft_wrap=True, highlight=False, markup=False)
        lock.acquire()
    except OSError as error:
        if error.errno != errno.ENOSYS:
            raise
    token = _held.set(_held.get() | {place})
    try:
        yield
    finally:
        _held.reset(token)
        Path(lock.lock_file).unlink(missing_ok=True)  # filelock tells a deleted file from a lock
        lock.release()
