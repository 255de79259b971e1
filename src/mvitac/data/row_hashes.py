"""Hashes of ids and groups of rows, by which packs find rows of each other."""

import hashlib

import numpy as np

from mvitac.data.pack import Pack


def row_hashes(pack: Pack) -> tuple[np.ndarray, np.ndarray]:
    """uint64 [N] hashes of the ids and of the groups of all rows, of a mix as in its parts.

    Numbers, and groups that are single rows, mean nothing outside their dataset: its name is part of them.
    """
    if pack.parts:
        ids, groups = zip(*map(row_hashes, pack.parts.values()), strict=True)
        return np.concatenate(ids), np.concatenate(groups)
    name = pack.spec.name.split(" (")[0]
    ids, groups = pack.own_ids, pack.column("group").astype(str)
    weak = pack.spec.group_by == "row"
    return _hash(ids, name, False), _hash(groups, name, weak)


def image_sums(pack: Pack) -> np.ndarray:
    """uint64 [N]: the checksums (CRC-32) of all images of each row as one number; 0 where the pack has none.

    Rows with the same images, stored alike at one size, have the same number, whatever their ids are.
    """
    if pack.parts:
        return np.concatenate([*map(image_sums, pack.parts.values())])
    found = np.zeros(pack.num, np.uint64)
    names = [f"crc_{modality}" for modality in sorted(pack.spec.modalities)]
    if set(names) <= set(pack.table.column_names):
        for name in names:
            found = found << np.uint64(32) | pack.column(name).astype(np.uint64)
    return found


def number_hint(name: str, pack: Pack) -> str:
    """What to do if rows of ``pack`` are taken for those of other data of this ``name``; "" if that cannot be.

    Rows without an id have their number as one.
    """
    if pack.spec.name != name or not all(text.isdigit() for text in pack.own_ids.tolist()):
        return ""
    return f" (rows without an id are compared by number: if these are other data than {name!r}, pack with another --title)"


def _hash(texts: np.ndarray, name: str, weak: bool) -> np.ndarray:
    unique, inverse = np.unique(texts, return_inverse=True)
    named = (f"{name}/{text}" if weak or text.isdigit() else text for text in unique.tolist())
    hashes = [int.from_bytes(hashlib.blake2b(t.encode(), digest_size=8).digest()) for t in named]
    return np.array(hashes, np.uint64)[inverse]
