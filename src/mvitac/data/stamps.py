"""Time stamps: the columns that have them, and their units."""

import contextlib
import math
from collections.abc import Iterable
from datetime import UTC, datetime

import numpy as np

STAMPS = ("time", "stamp", "timestamp")
"""Columns with the time of a row."""
UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # stamps since 1970 above so much are in ns, us, ms


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
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()

    stamps = np.array([one(cell) for cell in cells], float)
    size = np.abs(stamps[np.isfinite(stamps)]).max(initial=0)
    return stamps * next((scale for above, scale in UNITS if size > above), 1.0)
