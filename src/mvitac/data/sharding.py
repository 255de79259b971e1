"""Writes a pack as shards for ``data/streaming.py``, to a folder or any store that fsspec supports."""

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

MAX_SHARD_MB = 1_000_000  # a terabyte: a shard is read whole


def write_shards(pack: Pack, url: str, *, shard_mb: float = 64, seed: int = 0, quiet: bool = False) -> int:
    """Write ``pack`` to ``url`` (a folder, or what fsspec supports) in shards and return their number.

    pack.json is written last, so an interrupted call leaves no valid pack and can be repeated. ``shard_mb`` is the
    largest size of a shard, all modalities together; ``seed`` is that of the order of touch groups.
    """
    if not 0 < shard_mb <= MAX_SHARD_MB:
        raise ValueError(f"shard_mb {shard_mb}: give a number of megabytes above 0, at most {MAX_SHARD_MB:,}")
    system, place = reach(url)
    parts = assign_rows(pack, int(shard_mb * 1e6), seed)
    digests: dict[str, str] = {}
    try:
        if system.exists(f"{place}/pack.json"):
            raise ValueError(f"{url} holds a pack already: choose another place, or delete it first")
        system.makedirs(place, exist_ok=True)
        with shown(quiet=quiet), work("writing shards", len(parts), "shards") as advance:
            for number, rows in enumerate(parts):
                for modality in pack.spec.modalities:
                    name, data = shard_name(number, modality, pack.store), _stored(pack, modality, rows)
                    system.pipe_file(f"{place}/{name}", data)
                    digests[name] = hashlib.sha256(data).hexdigest()
                advance()
        buffer = io.BytesIO()
        pq.write_table(pack.table.take(pa.array(np.concatenate(parts))), buffer)
        system.pipe_file(f"{place}/samples.parquet", buffer.getvalue())
        digests["samples.parquet"] = hashlib.sha256(buffer.getvalue()).hexdigest()
        rest = {key: value for key, value in pack.meta.items() if key != "digest"}
        meta = {**rest, "format": SHARDED, "pack": pack.digest, "shards": [len(rows) for rows in parts]}
        meta = {**meta, "seed": seed, "digests": digests}
        system.pipe_file(f"{place}/pack.json", json.dumps({**meta, "digest": digest(meta)}, indent=1).encode())
    except (ValueError, KeyboardInterrupt):
        raise
    except OSError as error:
        error.filename = error.filename or url  # a full disk has no file name
        raise
    except Exception as error:  # each kind of store raises its own
        raise ValueError(f"{url} cannot be written ({brief(error)})") from None
    return len(parts)


def assign_rows(pack: Pack, limit: int, seed: int) -> list[np.ndarray]:
    """Return the rows of each shard, ascending, with at most ``limit`` bytes of images (but at least one row).

    Shards of train and unlabelled rows come first, then val, then test, so that training reads no others. Touch groups
    are in random order; only a group larger than a shard is divided.
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
    """Return the content of the image file of ``rows``."""
    images = pack.images[modality]
    if isinstance(images, Jpegs):
        return b"".join(images.jpeg(row) for row in rows.tolist())
    buffer = io.BytesIO()
    np.save(buffer, images[rows])
    return buffer.getvalue()
