"""Parquet files with images inside, as on the Hugging Face hub: columns of struct<bytes, path>, or of bytes.

Class numbers are replaced by the class names in the file's metadata (ClassLabel). Nested columns are left out, except those
of which an element is named. In a folder, the text before the first - of a file's name, or its own folder, is the split:

    data/train-00000-of-00002.parquet   data/test-00000-of-00001.parquet   validation/0000.parquet
"""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.datasets.table.image_refs import ParquetCell, Refs
from mvitac.datasets.table.manifest import Manifest, Row, listed, text_of
from mvitac.system.files import brief, check_ordinary, parse_json

NAMES = {"train": "train training", "val": "val validation valid dev", "test": "test testing eval evaluation"}
SPLITS = {name: split for split, names in NAMES.items() for name in names.split()}  # as the datasets library names them


def read_parquet(path: Path, files: Sequence[Path], vectors: Collection[str]) -> Manifest | None:
    """Return the table of ``files``, which are ``path`` or in this folder; None if they hold no images."""
    rows, found = list[Row](), Refs()
    for file in files:
        before = len(rows)
        add_file(file, rows, found, vectors)
        inside = file.parent.name if file.parent not in (path, path.parent) else ""
        if side := SPLITS.get(file.stem.split("-")[0]) or SPLITS.get(inside):
            for row in rows[before:]:
                row.setdefault("split", side)
        for column in found:
            if len(found[column]) < len(rows):
                raise ValueError(f"{path}: image column {column!r} is not in every file")
    parts = Counter((f.parent, m[1], int(m[2])) for f in files if (m := re.fullmatch(r"(.*)-\d+-of-(\d+)", f.stem)))
    lost = (f"{num} of the {of} files {stem}-* are here" for (_, stem, of), num in parts.items() if num < of)
    return Manifest.of(path, rows, found, notes=tuple(lost)) if found else None


def add_file(
    file: Path, rows: list[Row], found: Refs, vectors: Collection[str], cameras: Collection[str] | None = None
) -> None:
    """Add the rows of a file, and the references of its images; None where there is none.

    ``cameras``: which columns of images are wanted; by default all, and no row if there is no such column.
    """
    try:
        check_ordinary(file)  # a pipe never ends
        opened = pq.ParquetFile(file.absolute())
        schema, classes = opened.schema_arrow, _classes(opened.schema_arrow)
        images = [field.name for field in schema if _is_image(field.type)]
        flat = [field.name for field in schema if not pa.types.is_nested(field.type) or field.name in vectors]
        texts = [name for name in flat if name not in images]
        for group in range(opened.num_row_groups if images or cameras is not None else 0):
            num = opened.metadata.row_group(group).num_rows
            table = listed(opened.read_row_group(group, columns=texts)) if texts else [{}] * num
            rows += [{name: _text(value, classes.get(name)) for name, value in values.items()} for values in table]
            for column in (column for column in images if cameras is None or column in cameras):
                there = _there(opened, group, column, num)
                cells = (ParquetCell(str(file), group, column, i) if there[i] else None for i in range(num))
                found.setdefault(column, []).extend(cells)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} cannot be read as a table: {brief(error)}") from None


def _is_image(kind: pa.DataType) -> bool:
    if pa.types.is_struct(kind):
        return {field.name for field in kind} == {"bytes", "path"}
    return pa.types.is_binary(kind) or pa.types.is_large_binary(kind)


def _there(opened: pq.ParquetFile, group: int, column: str, num: int) -> list[bool]:
    leaves = [opened.schema.column(i).path for i in range(len(opened.schema.names))]
    leaf = next(i for i, path in enumerate(leaves) if path in (column, f"{column}.bytes"))
    nulls = opened.metadata.row_group(group).column(leaf).statistics
    if nulls is not None and nulls.has_null_count and nulls.null_count == 0:
        return [True] * num  # known without reading the images
    return opened.read_row_group(group, columns=[column]).column(0).is_valid().to_pylist()


def _classes(schema: pa.Schema) -> dict[str, list[str]]:
    try:
        features: dict[str, Any] = parse_json((schema.metadata or {})[b"huggingface"].decode())["info"]["features"]
    except (KeyError, ValueError):
        return {}
    return {k: f["names"] for k, f in features.items() if isinstance(f, dict) and f.get("_type") == "ClassLabel"}


def _text(value: Any, names: list[str] | None) -> str:
    if names and isinstance(value, int):
        return names[value] if 0 <= value < len(names) else ""  # -1: no label
    return text_of(value)
