"""Keeps freed memory in the process instead of returning it to the system, to avoid page faults.

By default, glibc maps and unmaps each array over 128 KiB separately, and the kernel zeroes each new page. A loop that
allocates the same large arrays repeatedly spends a third of its time there (docs/speed.md).
"""

import ctypes
import sys

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4  # malloc.h of glibc
_KEPT = 1 << 30


def keep_freed_memory() -> bool:
    """Let malloc keep up to 1 GiB of freed memory; return whether this worked (glibc only).

    Results do not change. The process keeps its peak memory usage.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # musl has no mallopt
        return False
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, _KEPT), (_TOP_PAD, 16 << 20))
    return all(mallopt(name, value) == 1 for name, value in settings)
