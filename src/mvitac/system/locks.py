"""File locks: one process per pack or run, and new folders. A lock is released even if its process is killed."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from mvitac.system.files import check_place, naming


class Busy(ValueError):
    """Another process holds the lock."""


@contextmanager
def hold_lock(place: Path, busy: str, *, wait: bool, quiet: bool = False) -> Iterator[bool]:
    """Hold the file lock ``<place>.lock``; yields whether the file was there, left by a process that was killed.

    A thread may hold the same lock twice. Locks work between machines if their shared file system supports them. If
    another process holds it, ``wait`` after printing ``busy`` (unless ``quiet``), or raise ``Busy`` with that message.
    """
    # No soft lock: it would remain after a process is killed.
    lock = FileLock(f"{place.absolute()}.lock", fallback_to_soft=False, is_singleton=True)
    left = os.path.exists(lock.lock_file)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        if not wait:
            raise Busy(busy) from None
        if not quiet:
            print(busy)
        lock.acquire()
    except OSError as error:
        if error.errno != errno.ENOSYS:
            raise
    try:
        yield left
    finally:
        if lock.lock_counter <= 1:  # not held once more by an outer block
            Path(lock.lock_file).unlink(missing_ok=True)  # filelock detects a deleted lock file
        lock.release()


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield the new folder ``<out>.partial``. It is renamed to ``out`` at the end, or deleted after an error.

    Raises Busy if another process writes ``out``, ValueError if it exists or cannot be written.
    """
    check_new(out, before_lock=True)
    with hold_lock(out, f"{out} is being written by another process: wait, or choose another", wait=False) as left:
        partial = out.with_name(out.name + ".partial")
        for place in (out, *[partial] * (not left)):
            check_new(place)
        shutil.rmtree(partial, ignore_errors=True)  # of a process that was killed
        partial.mkdir(parents=True)
        try:
            with naming(out):  # an error of a full disk has no file name
                yield partial
            os.rename(partial, out)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def check_new(place: Path, *, before_lock: bool = False) -> None:
    """ValueError if ``place`` exists or cannot be written. ``before_lock``: whoever takes a lock left there checks again."""
    check_place(place)
    if os.path.lexists(place) and not (before_lock and os.path.exists(f"{place}.lock")):
        raise ValueError(f"{place} already exists: choose another place, or delete it first")
