"""Progress bars with the time left, by tqdm, on stderr.

``work`` adds one from any thread. Without ``shown``, e.g. if a function is called from Python, nothing is printed.
"""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from tqdm import tqdm


class _Bar(tqdm):
    monitor_interval = 0  # no thread of tqdm's own


_Bar.set_lock(threading.RLock())  # not one between processes
_num_shown = 0
_bars: list[_Bar] = []


@contextmanager
def shown(*, quiet: bool = False) -> Iterator[None]:
    """Show all ``work`` inside this ``with`` block; no change if ``quiet``."""
    global _num_shown
    _num_shown += not quiet
    try:
        yield
    finally:
        _num_shown -= not quiet


@contextmanager
def work(what: str, total: int | None = None, unit: str = "", *, done: int = 0) -> Iterator[Callable[..., None]]:
    """Show one piece of work of ``total`` units, ``done`` of them earlier.

    Yields a function to call with the number of units just finished, and optionally a text to show beside.
    """
    if not _num_shown:
        yield lambda num=1, text="": None
        return
    look: dict[str, Any] = {"mininterval": 10, "delay": 3, "position": 0, "ncols": 80, "leave": True}
    if sys.stderr.isatty():  # a pipe or a file gets a line now and then
        look = {"mininterval": 0.1, "delay": 0.5, "dynamic_ncols": True, "leave": None}
    with _Bar(desc=what, total=total, unit=f" {unit}", initial=done, miniters=1, **look) as bar:
        _bars.append(bar)
        try:
            yield partial(_advance, bar)
        finally:
            _bars.remove(bar)


def _advance(bar: _Bar, num: int = 1, text: str = "") -> None:
    with _Bar.get_lock():
        if text:
            bar.set_postfix_str(text, refresh=False)
        bar.update(num)


def tick(unit: str) -> None:
    """Count one more ``unit`` for the innermost ``work`` with that unit, if there is one."""
    for bar in [bar for bar in _bars if bar.unit == f" {unit}"][-1:]:
        _advance(bar)


def say(text: str) -> None:
    """Print a line on stdout, above the bars; nothing outside ``shown``."""
    if _num_shown:
        _Bar.write(text)


def duration(seconds: float) -> str:
    """Seconds as rounded text, e.g. "42 s", "11 min", "2.5 h"."""
    minutes, hours = seconds / 60, seconds / 3600
    return f"{seconds:.0f} s" if minutes < 2 else f"{minutes:.0f} min" if hours < 2 else f"{hours:.1f} h"
