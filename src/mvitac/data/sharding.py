"""A pack written anew in shards, for ``data/streaming.py`` to read: to a folder, or to any store fsspec knows."""

from __future__ import annotations

import hashlib
import io
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.data.jpeg import Jpegs
from mvitac.data.pack import SHARDED, Pack
from mvitac.data.streaming import reach, shard_name
from mvitac.system.files import brief, digest
from mvitac.system.progress import shown, work


def write_shards(pack: Pack, url: str, *, shard_mb: float = 64, seed: int = 0, quiet: bool = False) -> int:
    """Write ``pack`` to ``url`` in shards of at most ``shard_mb`` MB, all modalities together, and return their number.

    pack.json comes last, so what was interrupted is no pack and is written again. ValueError if there is a pack, or if
    nothing can be written there.
    """
    if not shard_mb > 0:
        raise ValueError(f"shard_mb {shard_mb}: give a positive number of megabytes")
    system, place = reach(url)
    parts = deal_rows(pack, int(shard_mb * 1e6), seed)
    digests = {}

    def put(name: str, data: bytes) -> None:
        system.pipe_file(f"{place}/{name}", data)
        digests[name] = hashlib.sha256(data).hexdigest()

    try:
        if system.exists(f"{place}/pack.json"):
            raise ValueError(f"{url} holds a pack already: choose another place, or delete it first")
        system.makedirs(place, exist_ok=True)
        with shown(quiet=quiet), work("writing shards", len(parts), "shards") as advance:
            for number, rows in enumerate(parts):
                for modality in pack.spec.modalities:
                    put(shard_name(number, modality, pack.store), _stored(pack, modality, rows))
                advance()
        buffer = io.BytesIO()
        pq.write_table(pack.table.take(pa.array(np.concatenate(parts))), buffer)
        put("samples.parquet", buffer.getvalue())
        rest = {key: value for key, value in pack.meta.items() if key != "digest"}
        meta = {**rest, "format": SHARDED, "pack": pack.digest, "shards": [len(rows) for rows in parts]}
        meta = {**meta, "seed": seed, "digests": digests}
        system.pipe_file(f"{place}/pack.json", json.dumps({**meta, "digest": digest(meta)}, indent=1).encode())
    except (ValueError, OSError, KeyboardInterrupt):
        raise
    except Exception as error:  # every kind of store has its own
        raise ValueError(f"{url} cannot be written ({brief(error)})") from None
    return len(parts)


def deal_rows(pack: Pack, limit: int, seed: int) -> list[np.ndarray]:
    """The rows of each shard, ascending, at most ``limit`` bytes of images each (but one row at least).

    First what is pre-trained on, so that training reads nothing else, then val, then test. Touch groups come in random
    order; a group is cut only if it is larger than a shard.
    """
    sizes = np.sum([_bytes_per_row(pack, modality) for modality in pack.spec.modalities], axis=0)
    side = np.select([np.isin(split := pack.column("split"), ("train", "unlabelled")), split == "val"], [0, 1], 2)
    place = np.random.default_rng(seed).permutation(pack.touch_groups.max() + 1)[pack.touch_groups]
    order = np.lexsort((place, side))
    borders = np.flatnonzero((np.diff(side[order]) != 0) | (np.diff(place[order]) != 0)) + 1
    parts: list[list[int]] = []
    room = 0
    for group in np.split(order, borders):
        if not parts or side[parts[-1][0]] != side[group[0]] or sizes[group].sum() > room:
            parts.append([])
            room = limit
        for row in group.tolist():
            if sizes[row] > room and parts[-1]:
                parts.append([])
                room = limit
            parts[-1].append(row)
            room -= sizes[row]
    return [np.sort(rows) for rows in parts]


def _bytes_per_row(pack: Pack, modality: str) -> np.ndarray:
    if pack.store == "jpeg":
        return pack.column(f"bytes_{modality}").astype(np.int64)
    return np.full(pack.num, np.prod(pack.images[modality].shape[1:]))


def _stored(pack: Pack, modality: str, rows: np.ndarray) -> bytes:
    """``rows`` as a pack's image file holds them."""
    images = pack.images[modality]
    if isinstance(images, Jpegs):
        return b"".join(images.jpeg(row) for row in rows.tolist())
    buffer = io.BytesIO()
    np.save(buffer, images[rows])
    return buffer.getvalue()
