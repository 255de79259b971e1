"""``--data hub``: image datasets of the Hugging Face hub, as parquet with columns struct<bytes, path>.

    data/train-00000-of-00002.parquet   data/test-00000-of-00001.parquet      the text before the first - is the split

Class numbers are replaced by the class names in the file's metadata (ClassLabel).
"""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.datasets.table.image_refs import ImageRef, ParquetCell
from mvitac.datasets.table.manifest import Manifest, text_of
from mvitac.datasets.table.table import RowsConfig
from mvitac.system.files import brief, parse_json

SPLITS = {"train": "train", "validation": "val", "valid": "val", "val": "val", "test": "test"}


@dataclass(frozen=True, kw_only=True)
class HubConfig(RowsConfig):
    """Parquet files that contain images (columns struct<bytes, path>), as on the Hugging Face hub."""

    name: ClassVar[str] = "hub"

    path: Path = Path("data")
    """A parquet file, or a folder of them (searched recursively)."""

    def manifest(self) -> Manifest:
        files = sorted(self.path.rglob("*.parquet")) if self.path.is_dir() else [self.path]
        if not files or not files[0].is_file():
            raise ValueError(f"{self.path} is no .parquet and holds none: give a parquet file, or a folder of them")
        rows: list[dict[str, str]] = []
        found: dict[str, list[ImageRef | None]] = {}
        sides = [SPLITS.get(file.stem.split("-")[0]) for file in files]
        for file, side in zip(files, sides, strict=True):
            before = len(rows)
            images = _read(file, rows, found, self.vectors())
            if not images:
                raise ValueError(f"{file} has no image column (struct<bytes, path> or binary): is it the right file?")
            if side:
                for row in rows[before:]:
                    row.setdefault("split", side)
        for column, places in found.items():
            if len(places) < len(rows):
                raise ValueError(f"{self.path}: image column {column!r} is not in every file")
        return Manifest.of(self.path, rows, found)


def _read(
    file: Path, rows: list[dict[str, str]], found: dict[str, list[ImageRef | None]], vectors: Collection[str]
) -> list[str]:
    """Add the rows of ``file`` and the references of its images; return the names of its image columns.

    Nested columns are left out, except those in ``vectors``.
    """
    try:
        opened = pq.ParquetFile(file)
        images = [field.name for field in opened.schema_arrow if _is_image(field.type)]
        classes = _classes(opened.schema_arrow)
        flat = [f.name for f in opened.schema_arrow if not pa.types.is_nested(f.type) or f.name in vectors]
        texts = [name for name in flat if name not in images]
        for group in range(opened.num_row_groups):
            num = opened.metadata.row_group(group).num_rows
            table = opened.read_row_group(group, columns=texts).to_pylist() if texts else [{}] * num
            for place, values in enumerate(table):
                rows.append({name: _text(value, classes.get(name)) for name, value in values.items()})
                for column in images:
                    found.setdefault(column, []).append(ParquetCell(str(file), group, column, place))
            for column in images:
                _mark_gaps(opened, group, column, found[column], num)
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"{file} is not a parquet file ({brief(error)})") from None
    return images


def _is_image(kind: pa.DataType) -> bool:
    if pa.types.is_struct(kind):
        return {field.name for field in kind} == {"bytes", "path"}
    return pa.types.is_binary(kind) or pa.types.is_large_binary(kind)


def _mark_gaps(opened: pq.ParquetFile, group: int, column: str, places: list[ImageRef | None], num: int) -> None:
    """Replace the references of null images by None."""
    leaves = [opened.schema.column(i).path for i in range(len(opened.schema.names))]
    leaf = next(i for i, path in enumerate(leaves) if path in (column, f"{column}.bytes"))
    nulls = opened.metadata.row_group(group).column(leaf).statistics
    if nulls is not None and nulls.has_null_count and nulls.null_count == 0:
        return  # known without reading the images
    for place, value in enumerate(opened.read_row_group(group, columns=[column]).column(0)):
        if not value.is_valid:
            places[len(places) - num + place] = None


def _classes(schema: pa.Schema) -> dict[str, list[str]]:
    """Return column -> class names, from the metadata of Hugging Face's datasets library."""
    try:
        features: dict[str, Any] = parse_json((schema.metadata or {})[b"huggingface"].decode())["info"]["features"]
    except (KeyError, ValueError):
        return {}
    return {k: f["names"] for k, f in features.items() if isinstance(f, dict) and f.get("_type") == "ClassLabel"}


def _text(value: Any, names: list[str] | None) -> str:
    if names and isinstance(value, int):
        return names[value] if 0 <= value < len(names) else ""  # -1: no label
    return text_of(value)
