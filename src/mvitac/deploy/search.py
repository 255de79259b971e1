"""Find the nearest known touches and pictures by exact cosine, in memory that does not grow with the number of rows.

    <index>/index.json          format, space, digests
            model.safetensors   the model that embeds a query
            rows.parquet        id, group, split, labels and pack row of each indexed pair
            vision.npy          float32 [N, E], unit length, memory-mapped
            touch.npy

Shapes: N rows, Q queries, E dimensions.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from mvitac.data.pack import Pack
from mvitac.model import Model
from mvitac.model_files import load
from mvitac.registry import from_json, unknown
from mvitac.system.files import digest, digest_file, fields_of, naming, read_json, write_atomic, write_json
from mvitac.system.locks import new_folder
from mvitac.system.progress import work
from mvitac.transforms.preprocess import ImageInput

FORMAT, FORMAT_VERSION = "mvitac-index", 1
BLOCK = 1 << 16  # rows compared at once: 128 MB of float32 at E = 512, the largest part of a search's memory


def neighbours(index: Any, k: int, inputs: Iterable[str]) -> Callable[[dict[str, np.ndarray]], list[str]]:
    """The function ``nearest`` of ``Live``: an engine's outputs to "id (label, ...)" of the k nearest known touches.

    Compared by touch, or by vision where the engine's ``inputs`` have no touch. ValueError if the index lacks it.
    """
    modality = "touch" if "touch" in inputs else "vision"
    if modality not in index.banks:
        raise ValueError(f"{index.folder} holds no {modality} to compare with: index a pack that has it")
    key = f"shared_{modality}" if index.meta["space"] == "shared" else f"embedding_{modality}"

    def find(outputs: dict[str, np.ndarray]) -> list[str]:
        query = outputs[key] / np.maximum(np.linalg.norm(outputs[key], axis=1, keepdims=True), 1e-12)
        rows, _ = nearest(index.banks[modality], query, k)
        return [f"{index.table.column('id')[r]} ({', '.join(index.labels(r).values())})" for r in rows[0].tolist()]

    return find


def nearest(bank: np.ndarray, queries: np.ndarray, k: int, *, block: int = BLOCK) -> tuple[np.ndarray, np.ndarray]:
    """Row numbers and cosines [Q, k] of the ``k`` nearest rows (or all), best first, equal ones in row order.

    An exact search. ``bank`` [N, E], which may be memory-mapped, and ``queries`` [Q, E] are float32 of unit length.
    """
    if queries.ndim != 2 or queries.shape[1] != bank.shape[1]:
        raise ValueError(f"queries are {queries.shape}, the index holds {bank.shape[1]} dimensions: embed them alike")
    if not k >= 1:
        raise ValueError(f"k {k}: give at least 1")
    k = min(k, len(bank))
    queries = np.ascontiguousarray(queries, np.float32)
    rows = np.empty((len(queries), 0), np.int64)
    scores = np.empty((len(queries), 0), np.float32)
    for start in range(0, len(bank), block):
        found = queries @ bank[start : start + block].T
        if rows.shape[1] == k and not (found.max(1) > scores[:, -1]).any():
            continue  # no row of this block is better than those found so far
        if found.shape[1] > k:
            best = np.argpartition(-found, k - 1, axis=1)[:, :k]
            # argpartition cuts a tie at the k-th place anywhere: take the earliest rows instead.
            edge = np.take_along_axis(found, best, 1).min(1, keepdims=True)
            for q in np.flatnonzero((found >= edge).sum(1) > k):
                best[q] = np.argsort(-found[q], kind="stable")[:k]
        else:
            best = np.broadcast_to(np.arange(found.shape[1]), found.shape)
        rows = np.concatenate([rows, best + start], axis=1)
        scores = np.concatenate([scores, np.take_along_axis(found, best, 1)], axis=1)
        order = np.lexsort((rows, -scores))[:, :k]
        rows, scores = np.take_along_axis(rows, order, 1), np.take_along_axis(scores, order, 1)
    return rows, scores


def embeddings(model: Model, pack: Pack, modality: str, rows: np.ndarray, *, shared: bool) -> Iterator[np.ndarray]:
    """Embeddings of pack rows in chunks of at most 256 rows: features, or unit vectors of the shared space."""
    device = next(model.parameters()).device
    with work(f"embedding {modality}", len(rows), "images") as advance:
        for chunk in np.array_split(rows, max(1, -(-len(rows) // 256))):
            images = torch.from_numpy(pack.images[modality][chunk]).permute(0, 3, 1, 2).to(device)
            x = model.features(modality, images, for_heads=shared)
            yield (model.project(modality, x) if shared else x).cpu().numpy()
            advance(len(chunk))


def check_pack(model: Model, pack: Pack) -> tuple[str, ...]:
    """The modalities that model and pack have in common; ValueError if there are none, or the images do not fit."""
    names = tuple(m for m in pack.spec.modalities if m in model.encoders)
    for modality in names:
        if pack.spec.channels(modality) != model.spec.channels(modality):
            raise ValueError(
                f"{pack.path} has {pack.spec.channels(modality)} channels of {modality}, the model was trained with"
                f" {model.spec.channels(modality)}: pack the data alike"
            )
    if "touch" in names and model.spec.difference and not pack.spec.difference:
        raise ValueError(
            f"{pack.path} has touch as the sensor gives it, the model was trained on difference images: pack the data"
            " with --subtract-background"
        )
    if not names:
        raise ValueError(f"{pack.path} has {', '.join(pack.spec.modalities)}, the model {', '.join(model.encoders)}")
    return names


def describe(pack: Pack, rows: np.ndarray) -> pa.Table:
    """id, group, split and labels of pack rows, as a table; column ``row`` is the pack's row number."""
    names = ["id", "group", "split", *(f"label_{task.name}" for task in pack.spec.tasks)]
    return pack.table.select(names).take(rows).append_column("row", pa.array(rows, pa.int64()))


def build(model: Model, pack: Pack, out: Path, splits: tuple[str, ...] = ()) -> "Index":
    """Index the complete pairs of a pack in the new folder ``out``, with a copy of the model for queries.

    A model with a space that both modalities share is indexed there, so that touch finds vision and vision finds touch;
    any other by features, where each modality finds only itself. Only ``splits`` are indexed, if some are given.
    """
    with new_folder(out) as partial:
        _fill(model, pack, partial, splits)
    return Index(out, verify=False)


def _fill(model: Model, pack: Pack, folder: Path, splits: tuple[str, ...]) -> None:
    """Write the files of an index into ``folder``."""
    modalities = check_pack(model, pack)
    rows = pack.rows(*(splits or np.unique(pack.column("split"))), having=modalities)
    if not len(rows):
        raise ValueError(f"{pack.path} has no whole pairs{' in ' * bool(splits)}{', '.join(splits)}: nothing to index")
    shared = all(m in model.projectors for m in modalities)
    for modality in modalities:
        _write_bank(folder / f"{modality}.npy", embeddings(model, pack, modality, rows, shared=shared), len(rows))
    model.save(folder / "model.safetensors")
    write_atomic(folder / "rows.parquet", lambda file: pq.write_table(describe(pack, rows), file))
    meta = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "num": len(rows),
        "space": "shared" if shared else "features",
        "pack": str(pack.path.absolute()),
        "pack_digest": pack.digest,
        "weights": model.weights_digest(),
        "classes": {task.name: list(task.classes) for task in pack.spec.tasks},
        "files": {path.name: digest_file(path) for path in sorted(folder.iterdir())},
    }
    write_json(folder / "index.json", {**meta, "digest": digest(meta)})


def _write_bank(path: Path, chunks: Iterator[np.ndarray], num: int) -> None:
    """``num`` unit vectors as .npy, chunk by chunk, so that memory does not grow with the number of rows.

    Not by a memory map: on a full disk, writing to one kills the process.
    """
    first = next(chunks)
    header = {"descr": "<f4", "fortran_order": False, "shape": (num, first.shape[1])}
    with naming(path), path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for x in chain([first], chunks):
            file.write((x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)).astype("<f4", order="C").data)


class Index:
    """An opened index: ``table`` describes the rows, ``banks[modality]`` are their unit vectors, memory-mapped."""

    def __init__(self, folder: str | Path, *, verify: bool = True) -> None:
        """``verify`` recomputes the digests (about 1 s per GB). ValueError if the index is damaged or was changed."""
        self.folder = folder = Path(folder)
        meta = read_json(folder / "index.json", "an index's description")
        if not isinstance(meta, dict) or meta.get("format") != FORMAT or meta.get("format_version") != FORMAT_VERSION:
            raise ValueError(f"{folder / 'index.json'} does not describe an index: make one with `mvitac index`")
        if meta.get("digest") != digest({key: value for key, value in meta.items() if key != "digest"}):
            raise ValueError(f"{folder / 'index.json'} does not match its digest: it was changed: make it again")
        with fields_of(folder / "index.json"):
            self._open(meta, verify)

    def _open(self, meta: dict[str, Any], verify: bool) -> None:
        folder = self.folder
        for name in ("pack", "pack_digest", "weights", "space"):
            from_json(str, meta[name], name)
        allowed = {"model.safetensors", "rows.parquet", "vision.npy", "touch.npy"}
        if not {"model.safetensors", "rows.parquet"} <= set(meta["files"]) <= allowed:
            raise ValueError(f"{folder / 'index.json'} names other files than {', '.join(sorted(allowed))}: refused")
        for name, expected in meta["files"].items():
            if not (folder / name).is_file() or (verify and digest_file(folder / name) != expected):
                raise ValueError(f"{folder / name} is missing or does not match its digest: make the index again")
        self.meta: dict[str, Any] = meta
        self.table: pa.Table = pq.read_table(folder / "rows.parquet")
        self.table.select(["id", "group", "row"])
        self.banks: dict[str, np.ndarray] = {}
        for modality in ("vision", "touch"):
            if f"{modality}.npy" in meta["files"]:
                bank = np.load(folder / f"{modality}.npy", mmap_mode="r", allow_pickle=False)
                if bank.ndim != 2 or bank.dtype != np.float32 or len(bank) != self.table.num_rows:
                    raise ValueError(f"{folder}: {modality}.npy does not fit its table: make the index again")
                self.banks[modality] = bank
        for task, classes in from_json(dict[str, tuple[str, ...]], meta["classes"], "classes").items():
            if self.table.column(f"label_{task}").to_numpy().max() >= len(classes):
                raise ValueError(f"{folder}: task {task!r} has labels that are no classes: make the index again")

    def model(self) -> Model:
        """The model that embedded the rows, for queries."""
        return load(self.folder / "model.safetensors")

    def find(
        self,
        model: Model,
        images: ImageInput,
        source: str,
        target: str,
        k: int = 5,
        *,
        background: ImageInput | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The ``k`` nearest indexed images of modality ``target`` to ``images`` of modality ``source``.

        ``model`` is that of ``model()``; ``images`` [Q] and ``background`` are as for ``Model.embed``. Returns row
        numbers and cosines, both [Q, k], best first.
        """
        for name in (source, target):
            if name not in self.banks:
                raise unknown("modality", name, self.banks)
        shared = self.meta["space"] == "shared"
        if source != target and not shared:
            raise ValueError(
                f"{self.folder} has no space that vision and touch share (its method trains none):"
                f" search {source} -> {source}"
            )
        x = model.embed(**{source: images}, background=background, shared=shared)[source]
        x = torch.nn.functional.normalize(x, dim=1).cpu().numpy()
        return nearest(self.banks[target], x, k)

    def labels(self, row: int) -> dict[str, str]:
        """Class names of one row by task, where it has a label."""
        found = {}
        for task, classes in self.meta["classes"].items():
            label = self.table.column(f"label_{task}")[row].as_py()
            if label >= 0:
                found[task] = classes[label]
        return found
