"""Time stamps: the columns that have them, and their units."""

import contextlib
import math
import re
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone

import numpy as np

STAMPS = ("time", "stamp", "timestamp")
"""Columns with the time of a row."""
UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # stamps since 1970 above so much are in ns, us, ms


def number_of(text: str) -> float | None:
    """Return ``text`` as a finite number, or None. 1_2 is not a number here, although Python accepts it."""
    try:
        value = float("" if "_" in text else text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def in_order(names: Iterable[str]) -> list[str]:
    """Names of images as people count: 2 comes before 10, and 2.25 before 2.5 where all are numbers."""
    names = sorted(names)
    if all(number_of(name) is not None for name in names):
        return sorted(names, key=float)
    return sorted(names, key=lambda name: [int(n) if n.isdecimal() else n for n in re.split(r"(\d+)", name)])


def stamped(names: Sequence[str]) -> np.ndarray | None:
    """Times [N] in seconds of images named by stamps since 1970; None of other names. ValueError if only most are stamps."""
    other = [name for name in names if (number_of(name) or 0) <= 1e9]
    if other and 2 * len(other) < len(names):
        raise ValueError(f"image {other[0]!r} has no time in its name, as the others have: take it away")
    times = np.zeros(1) if other else seconds(names, "names")
    return times if times.min() > 1e9 else None


def seconds(cells: Iterable[str], where: object) -> np.ndarray:
    """Return the stamps of ``where`` [N] in seconds, NaN for an empty cell.

    They are seconds, or ms, us or ns since 1970, or dates as in ISO 8601 (without an offset: UTC).
    """

    def one(cell: str) -> float:
        if not cell:
            return math.nan
        with contextlib.suppress(ValueError):
            if math.isfinite(number := float(cell)):
                return number
        try:
            moment = datetime.fromisoformat(cell)
        except ValueError:
            raise ValueError(f"{where}: {cell!r} is no time: give seconds, or a date as in ISO 8601") from None
        return (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp()  # noqa: UP017 - a robot has Python 3.10

    stamps = np.array([one(cell) for cell in cells], float)
    size = np.abs(stamps[np.isfinite(stamps)]).max(initial=0)
    return stamps * next((scale for above, scale in UNITS if size > above), 1.0)
