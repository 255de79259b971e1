"""Memory that is kept instead of handed back to the system between steps: every page taken anew costs a page fault.

Arrays over 128 KiB are mapped and unmapped by glibc one by one, and the kernel zeroes each page on first touch. A loop
that makes the same large temporaries again and again then spends a third of its time there (docs/speed.md).
"""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4  # malloc.h of glibc
_KEPT = 1 << 30


def keep_freed_memory() -> bool:
    """Let this process's malloc keep up to 1 GiB of freed memory; returns whether it can (glibc only).

    Changes no result, only where arrays lie. The price is that the process holds on to its peak.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # musl has no mallopt
        return False
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, _KEPT), (_TOP_PAD, 16 << 20))
    return all(mallopt(name, value) == 1 for name, value in settings)
