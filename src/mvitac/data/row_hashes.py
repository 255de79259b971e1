"""Hashes of ids, groups and images of rows, by which packs find rows of each other."""

import hashlib
import zlib
from collections.abc import Sequence

import numpy as np
from scipy.special import gammainc

from mvitac.data.pack import Pack
from mvitac.data.spec import MODALITIES, AnyTask

IMAGES = *((m, slice(None)) for m in MODALITIES), ("touch", slice(3)), ("touch", slice(3, 6))
"""Modality and channels of what ``image_sums`` compares: the last two are each of two touch sensors."""
_KNOWN: dict[str, np.ndarray] = {}  # digest of a pack -> ``_each_sensor``
CHANCE = 1e-4  # how often equal checksums of different images may be taken for a leak


def row_hashes(pack: Pack) -> tuple[np.ndarray, np.ndarray]:
    """uint64 [N] hashes of the ids and of the groups of all rows, of a mix as in its parts.

    Numbers, and groups that are single rows, mean nothing outside their dataset: its name is part of them.
    """
    if pack.parts:
        ids, groups = zip(*map(row_hashes, pack.parts.values()), strict=True)
        return np.concatenate(ids), np.concatenate(groups)
    name = pack.spec.name.split(" (")[0]
    ids, groups = pack.own_ids, pack.column("group").astype(str)
    return _hash(ids, name, False), _hash(groups, name, pack.spec.group_by == "row")


def image_sums(pack: Pack) -> np.ndarray:
    """uint64 [N, 4]: modality and checksum (CRC-32) of each image as one number; 0 where a row has none.

    Columns are those of ``IMAGES``: a row of two touch sensors has one for both, and one of each. Images with the same
    pixels, stored alike at one size, have the same number.
    """
    if pack.parts:
        return np.concatenate([*map(image_sums, pack.parts.values())])
    found = np.zeros((pack.num, len(IMAGES)), np.uint64)
    for place, modality in enumerate(MODALITIES):
        if f"crc_{modality}" in pack.table.column_names:
            sums = pack.column(f"crc_{modality}").astype(np.uint64) + np.uint64(place + 1 << 32)
            found[:, place] = np.where(pack.has(modality), sums, 0)
    if pack.spec.touch_channels > 3:
        sums = _each_sensor(pack) + np.uint64(len(MODALITIES) + 1 << 32)
        found[:, len(MODALITIES) :] = np.where(pack.has("touch")[:, None], sums, 0)
    return found


def _each_sensor(pack: Pack) -> np.ndarray:
    """Checksums uint64 [N, 2] of the images of two touch sensors, which the table has for both together only."""
    if pack.digest not in _KNOWN:
        images = getattr(pack.images["touch"], "frames", pack.images["touch"])  # of windows, single frames
        several = (images[i : i + 64] for i in range(0, pack.num, 64))
        pairs = [np.split(image, 2, axis=2) for some in several for image in np.asarray(some)]
        _KNOWN[pack.digest] = np.array([[zlib.crc32(one.tobytes()) for one in pair] for pair in pairs], np.uint64)
    return _KNOWN[pack.digest]


def shown(pack: Pack, rows: np.ndarray) -> list[np.ndarray]:
    """By ``IMAGES``, the rows [n, F] whose images ``rows`` [n] show: those of windows show earlier frames, too."""
    return [getattr(pack.images.get(m), "index", np.arange(pack.num)[:, None])[rows] for m, _ in IMAGES]


def known_images(pack: Pack, rows: np.ndarray, known: np.ndarray) -> np.ndarray:
    """bool [rows, 4]: which images of ``rows`` are among ``known``, sums of ``image_sums``; of windows, any of the frames.

    An image of a single value (nothing) does not count, nor do so few equal checksums that chance may explain them.
    """
    every = np.unique(np.concatenate([at.ravel() for at in shown(pack, rows)]))
    own, known = image_sums(pack)[every], np.unique(known)
    same = (own > 0) & np.isin(own, known)
    for place, (modality, channels) in enumerate(IMAGES):
        for i in np.flatnonzero(same[:, place]):
            images = getattr(pack.images[modality], "frames", pack.images[modality])  # of windows, single frames
            same[i, place] = np.ptp(images[every[i]][..., channels]) > 0
        kind = min(place, len(MODALITIES)) + 1
        expected = len(every) * np.count_nonzero(known >> np.uint64(32) == kind) / 2**32
        if (num := same[:, place].sum()) and gammainc(num, expected) > CHANCE:  # of a Poisson number: num or more
            same[:, place] = False
    where = enumerate(shown(pack, rows))
    return np.stack([same[np.searchsorted(every, at), place].any(axis=1) for place, at in where], axis=1)


def shown_sums(pack: Pack, rows: np.ndarray) -> np.ndarray:
    """``image_sums`` of all images that ``rows`` show, each once."""
    sums = image_sums(pack)
    found = np.unique(np.concatenate([sums[at, place].ravel() for place, at in enumerate(shown(pack, rows))]))
    return found[found > 0]


def split_leaks(pack: Pack, tasks: Sequence[AnyTask]) -> dict[str, str]:
    """Column of each split that ``tasks`` use (or "split") -> how much of its test is in its train, if anything is."""
    groups, said = pack.column("group").astype(str), {}
    for column in dict.fromkeys(task.split for task in tasks) or ("split",):
        mine = [task for task in tasks if task.split == column != "split"]
        own = f" of {' and '.join(task.name for task in mine)}" if mine else ""
        asked = np.any([pack.answered(task) for task in mine] or [np.ones(pack.num, bool)], axis=0)
        train, test = (rows[asked[rows]] for rows in (pack.rows(split, by=column) for split in ("train", "test")))
        names, copied = {*groups[test]}, known_images(pack, test, shown_sums(pack, train)).any(axis=1)
        num, by = len(names & {*groups[train]}), pack.spec.group_by
        found = [f"{num} of {len(names)} test {by}s{own}"] * bool(num)
        found += [f"images of {copied.sum()} of {len(test)} test rows{own}"] * bool(copied.any())
        if found:
            said[column] = f"{' and '.join(found)} are also in train: this split leaks"
    return said


def _hash(texts: np.ndarray, name: str, weak: bool) -> np.ndarray:
    unique, inverse = np.unique(texts, return_inverse=True)
    named = (f"{name}/{text}" if weak or text.isdigit() else text for text in unique.tolist())
    hashes = [int.from_bytes(hashlib.blake2b(t.encode(), digest_size=8).digest()) for t in named]
    return np.array(hashes, np.uint64)[inverse]
