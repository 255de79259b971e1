"""Embeddings of a pack in one parquet file, and the nearest of them by cosine.

The file has a row for each pair: id, group, split and labels, ``row`` (its number in the pack), and columns vision and
touch of float32 [D], NaN where the pair lacks the image. Its metadata say which model and pack it is of.

Shapes: N rows, Q queries, D dimensions.
"""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from mvitac.data.pack import Pack
from mvitac.evaluation.features import features, fitting
from mvitac.model import Model
from mvitac.registry import check_known, from_json
from mvitac.system.files import CONTROL, brief, fields_of, write_atomic
from mvitac.transforms.preprocess import ImageInput

ABOUT = b"mvitac-embeddings"  # entry of the file's metadata: JSON


def embed(model: Model, pack: Pack, file: Path, *, shared: bool = False) -> pa.Table:
    """Write the embeddings of a pack: features, or unit vectors of the ``shared`` space."""
    names = ["id", "group", "split", *(f"label_{task.name}" for task in pack.spec.tasks)]
    table = pack.table.select(names).append_column("row", pa.array(range(pack.num), pa.int64()))
    for modality in fitting(model, pack, in_use=True):  # a query's image is in use
        have = pack.has(modality)
        x = features(model, pack, modality, np.flatnonzero(have), for_heads=shared)
        if shared:
            x = model.project(modality, torch.from_numpy(x).to(next(model.parameters()).device)).cpu().numpy()
        whole = np.full((pack.num, x.shape[1]), np.nan, np.float32)
        whole[have] = x
        table = table.append_column(modality, pa.FixedSizeListArray.from_arrays(whole.reshape(-1), x.shape[1]))
    classes = {task.name: list(task.classes) for task in pack.spec.tasks}
    about = {"weights": model.weights_digest(), "shared": shared, "classes": classes}
    about |= {"pack": str(pack.path), "pack_digest": pack.digest}
    table = table.replace_schema_metadata({ABOUT: json.dumps(about)})
    write_atomic(file, lambda out: pq.write_table(table, out, write_page_checksum=True))
    return table


class Embeddings:
    """What ``embed`` wrote, opened for searching."""

    def __init__(self, file: Path, weights: str) -> None:
        """``weights``: digest of the model that embeds the queries. ValueError if another one embedded the rows."""
        self.file = file
        try:
            self.table: pa.Table = pq.read_table(file.absolute(), page_checksum_verification=True)
            about = json.loads((self.table.schema.metadata or {}).get(ABOUT, b""))
        except (pa.ArrowException, OSError, ValueError) as error:
            raise ValueError(f"{file} is no table of mvitac embed: {brief(error)}") from None
        with fields_of(file):
            self.shared, self.pack, self.pack_digest = about["shared"], Path(about["pack"]), about["pack_digest"]
            self.classes = from_json(dict[str, tuple[str, ...]], about["classes"], f"{file}: classes")
            columns = {m: self.table.column(m) for m in ("vision", "touch") if m in self.table.column_names}
            whole = all(column.type.list_size and not column.null_count for column in columns.values())
            parts = {m: column.combine_chunks().flatten() for m, column in columns.items()}
            whole &= not any(part.null_count for part in parts.values())
            assert whole and self.table.num_rows, "not one whole vector in every row"
            given = {m: part.to_numpy() for m, part in parts.items()}
            assert not any(np.isinf(x).any() for x in given.values()), "infinite numbers"
            for task, names in self.classes.items():
                labels = self.table.column(f"label_{task}").to_pylist()
                assert {*map(type, labels)} == {int} and {*labels} <= {*range(-1, len(names))}, f"labels of {task}"
            own = self.table.select(["id", "group", "row"]).to_pydict()
            assert {*map(type, own["row"])} == {int}, "numbers of rows"
            assert not CONTROL.search(json.dumps([own["id"], own["group"]])), "a control character"
            self.banks = {m: unit(x.reshape(self.table.num_rows, -1)) for m, x in given.items()}
            if about["weights"] != weights:
                raise ValueError(f"{file} was embedded by another model: embed the pack again")

    def find(
        self, model: Model, images: ImageInput, source: str, target: str, k: int, background: ImageInput | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The ``k`` nearest images of modality ``target`` to ``images`` of modality ``source``.

        ``images`` [Q], ``background``: as for ``Model.embed``. Returns rows of the file and cosines [Q, k], best first.
        """
        if k < 1:
            raise ValueError(f"num {k}: give 1 or more")
        check_known("modality", [target], self.banks)
        if source != target and not self.shared:
            raise ValueError(f"{self.file} holds features, where {source} finds no {target}: embed with --shared")
        x = model.embed(**{source: images}, background=background, shared=self.shared)[source]
        bank = self.banks[target]
        if not np.isfinite(bank).any() or bank.shape[1] != x.shape[1]:
            raise ValueError(f"{self.file} has no {target} vectors of {x.shape[1]} numbers: embed data that has it")
        return nearest(bank, unit(x.cpu().numpy()), k)

    def labels(self, row: int) -> dict[str, str]:
        """Class names of one row by task, where it has a label."""
        found = {task: self.table.column(f"label_{task}")[row].as_py() for task in self.classes}
        return {task: self.classes[task][label] for task, label in found.items() if label >= 0}


def unit(x: np.ndarray) -> np.ndarray:
    """Unit vectors [N, D]; NaN stays."""
    return x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)


def nearest(bank: np.ndarray, queries: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Row numbers and cosines [Q, k] of the ``k`` nearest rows (or all), best first.

    Exact: one matrix product. ``bank`` [N, D] and ``queries`` [Q, D] are float32 of unit length; rows of NaN are left out.
    """
    k = min(k, int(np.isfinite(bank).all(1).sum()))
    found = np.nan_to_num(queries @ bank.T, nan=-np.inf)
    best = np.sort(np.argpartition(-found, k - 1, axis=1)[:, :k], axis=1)
    scores = np.take_along_axis(found, best, axis=1)
    order = np.argsort(-scores, axis=1, kind="stable")  # equal ones in row order
    return np.take_along_axis(best, order, axis=1), np.take_along_axis(scores, order, axis=1)
