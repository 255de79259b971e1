"""Keeps freed memory in the process instead of returning it to the system, to avoid page faults.

By default, glibc maps and unmaps each array over 128 KiB separately, and the kernel zeroes each new page. A loop that
allocates the same large arrays repeatedly spends a third of its time there (docs/speed.md).
"""

import contextlib
import ctypes

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4  # malloc.h of glibc
_KEPT = 1 << 30


def keep_freed_memory() -> None:
    """Let malloc keep up to 1 GiB of freed memory (glibc only). Results do not change; the process keeps its peak usage."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # musl has no mallopt
        for name, value in ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, _KEPT), (_TOP_PAD, 16 << 20)):
            ctypes.CDLL(None).mallopt(name, value)
