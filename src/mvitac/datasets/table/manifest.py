"""A table of samples, read from a manifest file or made from class folders.

Cells are text, whatever the file format. Rows are counted from 1, without the header.
"""

import csv
import math
import operator
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.data.images import IMAGES
from mvitac.data.pack_table import SPLITS
from mvitac.data.video import VIDEOS
from mvitac.datasets.table.image_refs import HDF5, File, Frame, ImageRef
from mvitac.datasets.table.splits import likely_split
from mvitac.registry import unknown
from mvitac.system.files import brief, digest, digest_file, parse_json

MANIFESTS = (".csv", ".parquet", ".jsonl")
NAN = ("nan", "NaN", "NAN")  # how programs write a missing number. "Nan" is a name.
COMPARE: dict[str, Callable[[float, float], bool]] = {"<=": operator.le, ">=": operator.ge}


@dataclass(frozen=True)
class Manifest:
    """Rows as text, whatever the file format; "" is an empty cell, NaN or null."""

    file: Path
    """Name for error messages."""
    root: Path
    """Folder that paths are relative to."""
    columns: tuple[str, ...]
    rows: list[dict[str, str]]
    digest: str
    found: dict[str, list[ImageRef | None]] = field(default_factory=dict)
    """Image columns that the reader resolved itself; other image columns hold paths."""
    labels: tuple[str, ...] = ()
    """Default label columns."""
    group: str | None = None
    """Default column of the group."""
    left_out: dict[str, str] = field(default_factory=dict)
    """What the file has and is no column -> why."""

    @classmethod
    def of(cls, root: Path, rows: list[dict[str, str]]) -> "Manifest":
        """Return the table of ``rows`` that a reader made from the files below ``root``."""
        columns = tuple(dict.fromkeys(name for row in rows for name in row))
        return cls(root, root, columns, rows, digest(rows))

    def check(self, column: str) -> None:
        if column not in self.columns and column not in self.found:
            for name in (column, column.partition("[")[0]):
                if name in self.left_out:
                    raise ValueError(f"{self.file}: {name} {self.left_out[name]}")
            raise ValueError(f"{self.file}: {unknown('column', column, (*self.columns, *self.found))}")

    def at(self, number: int) -> str:
        """Name row ``number``, for error messages. Nobody counts the rows of a container, so the id is said too."""
        name = self.rows[number - 1].get("id") if self.found else None
        return f"{self.file} row {number}" + (f" ({name})" if name else "")

    def normalised(self, paths: Collection[str | None]) -> "Manifest":
        """Return this table with the cells in one form (``normal``), except in the columns of ``paths``.

        Else two ways to type a name would be two classes, or one object in train and in test.
        """
        rows = [{name: cell if name in paths else normal(cell) for name, cell in row.items()} for row in self.rows]
        return replace(self, rows=rows)

    def refs(self, column: str) -> list[ImageRef | None]:
        """Return each row's image in ``column``; None where the cell is empty.

        For a video, the frame number (from 0) is in column <column>_frame or, if that does not exist, frame.
        """
        if column in self.found:
            return self.found[column]
        root, refs = str(self.root), []
        counter = f"{column}_frame" if f"{column}_frame" in self.columns else "frame"
        for number, row in enumerate(self.rows, 1):
            cell = row[column]
            path = _find(root, cell)
            if not cell:
                refs.append(None)
            elif not cell.lower().endswith(VIDEOS):
                refs.append(File(path))
            elif (row.get(counter) or "").isdecimal():
                refs.append(Frame(path, int(row[counter])))
            else:
                raise ValueError(
                    f"{self.file} row {number}: {column} {cell} is a video, column {counter!r} says"
                    f" {row.get(counter, 'nothing')!r}: give the frame's number, from 0"
                )
        return refs


def _find(root: str, cell: str) -> str:
    """The path that ``cell`` means: relative to ``root``, ``~`` as the home folder, and Windows' backslashes as slashes.

    A file that has exactly this name is preferred.
    """
    path = os.path.join(root, cell)
    if ("\\" in cell or cell.startswith("~")) and not os.path.lexists(path):
        return os.path.join(root, os.path.expanduser(cell.replace("\\", "/")))
    return path


def text_of(value: Any) -> str:
    """Return a cell as text, the same for each file format: whole numbers without '.0', NaN and null as ''."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    text = str(value).strip()
    if text in NAN:
        return ""
    # pandas writes an integer column with a missing value as 1.0, 2.0, ...: these are the classes 1 and 2.
    return re.sub(r"^(-?\d+)\.0+$", r"\1", text) if ".0" in text else text


@lru_cache(1 << 16)
def normal(text: str) -> str:
    """Return ``text`` in Unicode form NFC, with single blanks between words and none around them."""
    return " ".join(unicodedata.normalize("NFC", text).split())


def number_of(text: str) -> float | None:
    """Return ``text`` as a finite number, or None. 1_2 is not a number here, although Python accepts it."""
    try:
        value = float("" if "_" in text else text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def in_clone(path: Path, inside: str, pattern: str, url: str) -> Path:
    """Return folder ``inside`` of a clone of ``url`` at ``path``, or ``path`` itself; it must contain ``pattern``."""
    for root in (path / inside, path):
        if next(root.glob(pattern), None) is not None:
            return root
    lacks = f"holds no {inside}/{pattern}" if path.is_dir() else "does not exist"
    raise ValueError(f"{path} {lacks}: git clone {url}, and give the clone as --data.path")


def find_manifest(path: Path) -> Path | None:
    """Return the manifest at ``path`` or in that folder; None if the folder has none."""
    if path.is_dir():
        found = [path / f"manifest{suffix}" for suffix in MANIFESTS if (path / f"manifest{suffix}").is_file()]
        if len(found) > 1:
            raise ValueError(f"{path} holds {' and '.join(p.name for p in found)}: give the path of one of them")
        return found[0] if found else None
    if not path.is_file():
        raise ValueError(
            f"{path} does not exist: give a manifest ({', '.join(MANIFESTS)}), an HDF5 file ({', '.join(HDF5)}) or a"
            " folder as --data.path"
        )
    if path.suffix.lower() not in MANIFESTS:
        raise ValueError(
            f"{path} is not a manifest or HDF5 file: its name must end in {', '.join((*MANIFESTS, *HDF5))}"
        )
    return path


def read_manifest(file: Path) -> Manifest:
    """Read a manifest; ValueError unless it is a table with named columns and at least one row."""
    try:
        columns, rows = {".csv": _read_csv, ".jsonl": _read_jsonl, ".parquet": _read_parquet}[file.suffix.lower()](file)
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is not UTF-8 text ({error.reason} at byte {error.start}): save it as UTF-8") from None
    if not rows:
        raise ValueError(f"{file} is empty: a manifest needs a row per sample")
    return Manifest(file, file.parent, tuple(columns), rows, digest_file(file))


def _read_csv(file: Path) -> tuple[list[str], list[dict[str, str]]]:
    with file.open(newline="", encoding="utf-8-sig") as stream:
        try:
            lines = [line for line in csv.reader(stream) if line]
        except csv.Error as error:
            raise ValueError(f"{file} is not CSV: {error}") from None
    if not lines:
        return [], []
    columns = [name.strip() for name in lines[0]]
    if len(columns) == 1 and re.search("[;\t]", columns[0]):
        raise ValueError(f"{file} has one column {columns[0]!r}: separate columns by commas")
    _check_header(file, columns)
    for number, line in enumerate(lines[1:], 1):
        if len(line) != len(columns):
            raise ValueError(
                f"{file} row {number} has {len(line)} cells for {len(columns)} columns: quote cells that hold commas"
            )
    return columns, [dict(zip(columns, map(text_of, line), strict=True)) for line in lines[1:]]


def _read_jsonl(file: Path) -> tuple[list[str], list[dict[str, str]]]:
    rows: list[dict[str, Any]] = []
    for number, line in enumerate(file.read_text(encoding="utf-8-sig").splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = parse_json(line)
        except ValueError as error:
            raise ValueError(f"{file} line {number} is not JSON ({error}): write one object per line") from None
        if not isinstance(row, dict):
            raise ValueError(f"{file} line {number} is not an object: write one {{...}} per line")
        rows.append(row)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return columns, [{name: text_of(row.get(name)) for name in columns} for row in rows]


def _read_parquet(file: Path) -> tuple[list[str], list[dict[str, str]]]:
    try:
        table = pq.ParquetFile(file).read()
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"{file} is not a parquet file ({brief(error)}): write it again") from None
    _check_header(file, table.column_names)
    columns = {name: [text_of(v) for v in table.column(name).to_pylist()] for name in table.column_names}
    return table.column_names, [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]


def _check_header(file: Path, columns: Sequence[str]) -> None:
    twice = [name for name, count in Counter(columns).items() if count > 1]
    if twice or not all(columns):
        what = f"column {twice[0]!r} twice" if twice else "a column without a name"
        raise ValueError(f"{file} has {what}: give every column its own name in the first line")


def list_class_folders(root: Path, *, pictures: str = "touch", allow_missing: bool = False) -> Manifest:
    """Return the manifest of a tree of class folders (the layouts are in ``mvitac.datasets.folder``).

    ``pictures`` is the modality of the images if no folders name it; ``allow_missing`` leaves a cell without image
    empty.
    """
    rows: list[dict[str, str]] = []
    for split in _split_folders(root) or [""]:
        rows += _split_rows(root, split, pictures, allow_missing)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    for number, row in enumerate(rows, 1):
        if len(row) < len(columns) and not allow_missing:
            lacking = next(name for name in columns if name not in row)
            raise ValueError(f"{root} has {lacking} images in some splits only (row {number} has none): add or remove")
    rows = [{name: row.get(name, "") for name in columns} for row in rows]
    if not rows:
        raise ValueError(f"{root} holds no images ({', '.join(IMAGES)}): put them in <class> folders")
    return Manifest(root, root, tuple(columns), rows, digest(rows), labels=("label",))


def _split_folders(root: Path) -> list[str]:
    """Return the folders of ``root`` named after splits; ValueError if other folders next to them hold images."""
    splits = [split for split in SPLITS if (root / split).is_dir()]
    for other in sorted(root.iterdir()) if splits else ():
        if other.name not in SPLITS and other.is_dir() and _images_below(other):
            hint = f"write {wanted!r} instead" if (wanted := likely_split(other.name)) else "remove it"
            raise ValueError(f"{root} has images in folder {other.name!r} beside {' and '.join(splits)}: {hint}")
    return splits


def _split_rows(root: Path, split: str, pictures: str, allow_missing: bool) -> list[dict[str, str]]:
    """Return the rows of the class folders in folder ``split`` ("" = ``root`` itself)."""
    base = root / split
    named = [name for name in ("vision", "touch", "left", "right") if (base / name).is_dir()]
    found = {name: _images_below(base / name) for name in named} or {pictures: _images_below(base)}
    if not named and not any("/" in key for key in found[pictures]):
        raise ValueError(
            f"{base} has no manifest.csv (.parquet, .jsonl), no HDF5 file and no folder vision, touch, left or right"
            " nor class folders with images: make them, or give another path"
        )
    rows = []
    for key in sorted(set().union(*found.values())):
        first = next(images[key] for images in found.values() if key in images)
        lacking = next((name for name, images in found.items() if key not in images), None)
        if lacking and not allow_missing:
            raise ValueError(
                f"{first} has no counterpart {base / lacking / key}.*: add it, remove the other, or --data.allow-missing"
            )
        label, *below = key.split("/")
        if not below:
            raise ValueError(f"{first} is not in a class folder: put it in one, named by its class")
        row = {n: images[key].relative_to(root).as_posix() if key in images else "" for n, images in found.items()}
        group = key.rpartition("/")[0] if len(below) > 1 else f"{split}/{key}"
        rows.append({**row, "label": label, "group": group, **({"split": split} if split else {})})
    return rows


def _images_below(folder: Path) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in IMAGES and path.is_file():
            key = path.relative_to(folder).with_suffix("").as_posix()
            if key in found:
                raise ValueError(f"{found[key]} and {path} differ in their suffix only: keep one of them")
            found[key] = path
    return found


@dataclass(frozen=True)
class Condition:
    """A row filter: a column, one of = != <= >=, and a value."""

    column: str
    sign: str
    value: str

    @classmethod
    def parse(cls, text: str) -> "Condition":
        match = re.fullmatch(r"\s*([^<>=!]+?)\s*(<=|>=|!=|=)\s*([^<>=!]*?)\s*", text)
        if match is None:
            raise ValueError(f"condition {text!r}: write column=value, column!=value, column<=number or column>=number")
        condition = cls(*match.groups())
        if condition.sign in COMPARE and number_of(condition.value) is None:
            raise ValueError(f"condition {text!r}: {condition.sign} needs a number, not {condition.value!r}")
        return condition

    def __str__(self) -> str:
        return f"{self.column}{self.sign}{self.value}"

    def holds(self, row: dict[str, str]) -> bool:
        """Return whether ``row`` meets the condition; an empty cell is neither <= nor >= anything."""
        cell, wanted = row[self.column], normal(text_of(self.value))
        if self.sign in COMPARE:
            number = number_of(cell)
            return number is not None and COMPARE[self.sign](number, float(wanted))
        return (cell == wanted) == (self.sign == "=")
