"""Windows: a row that shows several frames of its touch, the current one and earlier ones, stacked on channels.

A pack stores every frame once. A window never crosses the edge of a touch (column touch_group, else group).
"""

import copy
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mvitac.data.images import difference
from mvitac.data.lazy import Lazy
from mvitac.data.pack import Images, Pack
from mvitac.data.spec import Window
from mvitac.data.stamps import number_of
from mvitac.registry import check_known
from mvitac.system.files import digest

ORDER = ("frame", "seq", "time")  # columns that order the frames of a touch, by default the first that exists


def windowed(pack: Pack, window: Window) -> Pack:
    """Return ``pack`` with windows as images: channels 0 to 2 are the current frame, then come earlier ones.

    ValueError if no column orders the frames, two frames of a touch have the same place, the frames of a touch are
    farther apart than the stride, or no touch is as long as a window.
    """
    if not window.active and window.order is None:
        return pack
    if not window.active:  # frames have an order also for positives
        made = copy.copy(pack)
        made.spec = replace(pack.spec, window=replace(pack.spec.window, order=window.order))
        return made
    check_known("modality of windows", window.of, pack.spec.modalities)
    index, whole, first = frames_of(pack, window)
    columns = pack.spec.split_columns if window.short == "leave-out" else ()
    made = pack.with_splits({name: np.where(whole, pack.column(name).astype(str), "hidden") for name in columns})
    made.spec = replace(pack.spec, window=replace(window, order=places(pack, window)[0]))
    kind = [window.frames, float(window.stride), *window.of, window.minus_first, made.spec.window.order, window.short]
    made.digests = {**pack.digests, "window": digest(kind)}
    rest = first if window.minus_first else None
    made.images = {m: Windows(pack.images[m], index, rest) if m in window.of else pack.images[m] for m in pack.images}
    return made


class Windows(Lazy):
    """Images uint8 [N, S, S, F C]: the frames of ``index`` [N, F], minus the frame ``first`` [N] if it is given."""

    def __init__(self, frames: Images, index: np.ndarray, first: np.ndarray | None) -> None:
        num, height, width, channels = frames.shape
        super().__init__((num, height, width, channels * index.shape[1]))
        self.frames, self.index, self.first = frames, index, first

    def _made(self, rows: np.ndarray) -> np.ndarray:
        # Each frame is read once, also if it is in several of the windows.
        asked = self.index[rows]
        known = np.unique(asked if self.first is None else np.concatenate([asked, self.first[rows, None]], axis=1))
        images = np.asarray(self.frames[known])
        found = images[np.searchsorted(known, asked)]  # [n, F, S, S, C]
        if self.first is not None:
            rest = images[np.searchsorted(known, self.first[rows])]
            found = np.stack([difference(found[:, f], rest) for f in range(found.shape[1])], axis=1)
        num, frames, height, width, channels = found.shape
        return found.transpose(0, 2, 3, 1, 4).reshape(num, height, width, frames * channels)


def recordings(pack: Pack, place: np.ndarray, *, distinct: bool = True) -> Iterator[np.ndarray]:
    """Yield the rows of each touch in the order of ``place`` [N]; if ``distinct``, ValueError where two have the same."""
    for group in range(int(pack.touch_groups.max()) + 1):
        rows = pack.rows_of(group)
        rows = rows[np.argsort(place[rows], kind="stable")]
        if distinct and (same := np.diff(place[rows]) == 0).any():
            two = f"two rows of touch {_touch(pack, rows)!r} are at {place[rows[int(np.flatnonzero(same)[0])]]:g}"
            raise ValueError(f"{two}: pack with --touch-group RECORDING, or name another --data.order")
        yield rows


def frames_of(pack: Pack, window: Window) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of each row's frames [N, F], newest first; whether its touch is long enough [N]; the touch's first row [N]."""
    name, place = places(pack, window)
    back = window.stride * np.arange(window.frames)
    index, whole = np.zeros((pack.num, window.frames), np.int64), np.zeros(pack.num, bool)
    first = np.zeros(pack.num, np.int64)
    for rows in recordings(pack, place):
        times = place[rows]
        if window.frames > 1 and len(times) > 2 and (step := np.median(np.diff(times))) > 1.25 * window.stride:
            far = f"the distance of frames in touch {_touch(pack, rows)!r}, {step:g} (column {name})"
            raise ValueError(f"stride {window.stride:g} is shorter than {far}: give more, or another --data.order")
        asked = times[:, None] - back  # the newest frame that is old enough, else the first
        index[rows] = rows[np.maximum(np.searchsorted(times, asked + 1e-9, side="right") - 1, 0)]
        whole[rows] = asked[:, -1] >= times[0] - 1e-9
        first[rows] = rows[0]
    if window.minus_first and (first == np.arange(pack.num)).all():
        raise ValueError(f"{pack.path}: every touch has one row, its own first: pack with --touch-group RECORDING")
    if not whole.any():
        raise ValueError(f"{pack.path}: frames {window.frames} at stride {window.stride:g} are longer than every touch")
    return index, whole, first


def _touch(pack: Pack, rows: np.ndarray) -> str:
    return str(pack.column("touch_group" if "touch_group" in pack.table.column_names else "group")[rows[0]])


def places(pack: Pack, window: Window) -> tuple[str, np.ndarray]:
    """Name and values [N] of the column that orders the frames."""
    asked = (window.order,) if window.order else ORDER
    if (name := next((column for column in asked if column in pack.table.column_names), None)) is None:
        raise ValueError(f"{pack.path} has no {', '.join(asked)} to order frames: name another --data.order")
    cells = pack.column(name)
    text = cells.dtype.kind not in "biuf"
    place = np.array([number_of(str(cell)) for cell in cells] if text else cells, float)  # None is NaN
    if not np.isfinite(place).all():
        row = pack.own_ids[~np.isfinite(place)][0]
        raise ValueError(f"{pack.path}: column {name!r} is not a number in row {row}: give all rows one")
    return name, place
