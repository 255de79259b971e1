"""Hashes of ids, groups and images of rows, by which packs find rows of each other."""

import hashlib

import numpy as np
from scipy.special import gammainc

from mvitac.data.pack import Pack
from mvitac.data.spec import MODALITIES

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
    """uint64 [N, 2]: modality and checksum (CRC-32) of each image as one number; 0 where a row has none.

    Columns are those of ``MODALITIES``. Images with the same pixels, stored alike at one size, have the same number.
    """
    if pack.parts:
        return np.concatenate([*map(image_sums, pack.parts.values())])
    found = np.zeros((pack.num, len(MODALITIES)), np.uint64)
    for place, modality in enumerate(MODALITIES):
        if f"crc_{modality}" in pack.table.column_names:
            sums = pack.column(f"crc_{modality}").astype(np.uint64) + np.uint64(place + 1 << 32)
            found[:, place] = np.where(pack.has(modality), sums, 0)
    return found


def known_images(pack: Pack, rows: np.ndarray, known: np.ndarray) -> np.ndarray:
    """bool [rows, 2]: which images of ``rows`` are among ``known``, sums of ``image_sums``.

    An image of a single value (nothing) does not count, nor do so few equal checksums that chance may explain them.
    """
    own, known = image_sums(pack)[rows], np.unique(known)
    same = (own > 0) & np.isin(own, known)
    for place, modality in enumerate(MODALITIES):
        for i in np.flatnonzero(same[:, place]):
            same[i, place] = np.ptp(pack.images[modality][rows[i]]) > 0
        expected = len(rows) * np.count_nonzero(known >> np.uint64(32) == place + 1) / 2**32
        if (num := same[:, place].sum()) and gammainc(num, expected) > CHANCE:  # of a Poisson number: num or more
            same[:, place] = False
    return same


def _hash(texts: np.ndarray, name: str, weak: bool) -> np.ndarray:
    unique, inverse = np.unique(texts, return_inverse=True)
    named = (f"{name}/{text}" if weak or text.isdigit() else text for text in unique.tolist())
    hashes = [int.from_bytes(hashlib.blake2b(t.encode(), digest_size=8).digest()) for t in named]
    return np.array(hashes, np.uint64)[inverse]
