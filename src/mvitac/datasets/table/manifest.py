"""A table of samples, read from a manifest file, or made by a reader of another layout.

Cells are text, whatever the file format, because a pack keeps them so: typing a CSV would turn the label 007 into 7.
Rows are counted from 1, without the header.
"""

import csv
import json
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.data.images import IMAGES
from mvitac.data.video import VIDEOS
from mvitac.datasets.table.image_refs import Frame, ImageRef, Refs
from mvitac.registry import unknown
from mvitac.system.files import CONTROL, brief, digest, digest_file, parse_json, walk

NAN = ("nan", "NaN", "NAN")  # how programs write a missing number. "Nan" is a name.
Row = dict[str, str]


@dataclass(frozen=True)
class Manifest:
    """Rows as text, all with the same columns; "" is an empty cell, NaN or null."""

    path: Path
    """The file or folder that was read. Paths in cells are relative to its folder."""
    rows: list[Row]
    digest: str
    numbers: Sequence[int]
    """Number of each row, for messages and ids."""
    images: Refs = field(default_factory=dict)
    """Image columns that the reader resolved itself; other image columns hold paths."""
    labels: tuple[str, ...] = ()
    """Default label columns."""
    group: str | None = None
    """Default column of the group."""
    left_out: dict[str, str] = field(default_factory=dict)
    """What the file has and is no column -> why."""
    notes: tuple[str, ...] = ()
    """What is printed with every result."""

    @classmethod
    def of(cls, path: Path, rows: Iterable[Mapping[str, Any]], images: Refs | None = None, **known: Any) -> "Manifest":
        """Return the table of ``rows`` that a reader made from ``path``; cells that a row lacks are empty.

        Cells become texts by ``text_of``; the text "nan" may be a name. ``images`` and ``known`` are other fields.
        """
        if not (rows := [*rows]):
            raise ValueError(f"{path} holds no rows: is it the right one, and whole?")
        for column in (column for column, refs in (images or {}).items() if len(refs) != len(rows)):
            raise ValueError(f"{path}: column {column!r} has {len((images or {})[column])} images for {len(rows)} rows")
        names = dict.fromkeys(name for row in rows for name in row)
        rows = [{n: text_of(c := row.get(n)) or (c if isinstance(c, str) else "") for n in names} for row in rows]
        where = {c: [str(ref).removeprefix(str(path)) for ref in refs] for c, refs in (images or {}).items()}
        known.setdefault("digest", digest([rows, where] if where else rows))
        return cls(path, rows, numbers=range(1, len(rows) + 1), images=images or {}, **known)

    @property
    def root(self) -> Path:
        """Folder that paths are relative to."""
        return self.path if self.path.is_dir() else self.path.parent

    @property
    def columns(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self.rows[0], *self.images)))

    def check(self, *columns: str | None, images: bool = False) -> None:
        """Raise ValueError unless each of ``columns`` that is not None exists, and holds text, not ``images``."""
        for column in columns:
            if not images and column in self.images and column not in self.rows[0]:
                raise ValueError(f"{self.path}: column {column!r} holds images, not text or numbers: name another")
            if column is not None and column not in self.columns:
                for name in {column, column.partition("[")[0]} & self.left_out.keys():
                    raise ValueError(f"{self.path}: {name} {self.left_out[name]}")
                raise ValueError(f"{self.path}: {unknown('column', column, self.columns)}")
            if CONTROL.search(json.dumps(column, ensure_ascii=False)):
                raise ValueError(f"{self.path}: control character in the name of column {column!r}: rename it")
            cells = [row.get(column or "", "") for row in self.rows]
            if bad := {cell for cell in {*cells} if CONTROL.search(json.dumps(cell, ensure_ascii=False))}:
                row, cell = next(each for each in zip(self.numbers, cells, strict=True) if each[1] in bad)
                where = f"{self.path} row {row}, column {column!r}"
                raise ValueError(f"{where}: control character in a name, {cell!r}: rename it, a terminal would obey it")

    def at(self, i: int) -> str:
        """Name row index ``i`` in an error: nobody counts rows, so its id or first image is said too."""
        row = self.rows[i]
        name = row.get("id") or next((row[column] for column in self.images if row.get(column)), "")
        return f"{self.path} row {self.numbers[i]}" + (f" ({name})" if name else "")

    def filtered(self, holds: Sequence[bool], why: str) -> "Manifest":
        """Return the rows for which ``holds``; ValueError says ``why`` there are none."""
        if not (rows := [i for i, kept in enumerate(holds) if kept]):
            raise ValueError(f"{self.path}: {why}")
        images = {column: [refs[i] for i in rows] for column, refs in self.images.items()}
        return replace(self, rows=[self.rows[i] for i in rows], numbers=[self.numbers[i] for i in rows], images=images)

    def filled(self, column: str, what: str) -> list[str]:
        """Return the cells of ``column``; ValueError if one of them is empty."""
        if "" in (cells := [row[column] for row in self.rows]):
            raise ValueError(f"{self.at(cells.index(''))}: column {column!r} ({what}) is empty")
        return cells

    def ids(self) -> list[str]:
        """Return the column "id" if there is one, else the row numbers."""
        if "id" not in self.rows[0]:
            return [f"{number:06d}" for number in self.numbers]
        ids = self.filled("id", "id")
        name, count = Counter(ids).most_common(1)[0]
        if count > 1:
            raise ValueError(f"{self.path}: id {name!r} occurs in several rows: ids must differ")
        return ids

    def resolved(self, columns: Sequence[str], paths: Collection[str]) -> "Manifest":
        """Return this table with ``columns`` as its images, and all cells but those of ``paths`` in one form.

        Else two ways to type a name would be two classes, or one object in train and in test.
        """
        rows = [{name: cell if name in paths else normal(cell) for name, cell in row.items()} for row in self.rows]
        return replace(self, rows=rows, images={column: self.refs(column) for column in columns})

    def refs(self, column: str) -> list[ImageRef | None]:
        """Return each row's image in ``column``; None where the cell is empty.

        For a video, the frame number (from 0) is in column <column>_frame or, if that does not exist, frame.
        """
        if column in self.images:
            return self.images[column]
        root, refs = str(self.root), []
        counter = f"{column}_frame" if f"{column}_frame" in self.columns else "frame"
        for i, row in enumerate(self.rows):
            cell, number = row[column], row.get(counter, "")
            path = os.path.join(root, cell)
            if cell != cell.strip() and not os.path.lexists(path):  # blanks of who typed the table
                path = os.path.join(root, cell := cell.strip())
            if not cell:
                refs.append(None)
            elif not cell.lower().endswith(VIDEOS):
                refs.append(ImageRef(path))
            elif number.isdecimal():
                refs.append(Frame(path, int(number)))
            else:
                raise ValueError(f"{self.at(i)}: {cell} is a video, {counter} {number!r}: give the frame, from 0")
        return refs


def text_of(value: Any) -> str:
    """Return a cell as text, the same for each file format: whole numbers without '.0', NaN and null as ''."""
    text = "" if value is None else str(value).strip()
    if text in NAN:
        return ""
    if text.lower().endswith((*IMAGES, *VIDEOS)):  # " 1.png" and "1.png" may both exist
        return str(value)
    # pandas writes an integer column with a missing value as 1.0, 2.0, ...: these are the classes 1 and 2.
    return re.sub(r"^(-?\d+)\.0+$", r"\1", text) if ".0" in text else text


@lru_cache(1 << 16)
def normal(text: str) -> str:
    """Return ``text`` in Unicode form NFC, with single blanks between words and none around them."""
    return " ".join(unicodedata.normalize("NFC", text).split())


def in_clone(path: Path, inside: str, pattern: str, url: str) -> Path:
    """Return folder ``inside`` of a clone of ``url`` at ``path``, or ``path`` itself; it must contain ``pattern``."""
    for root in (path / inside, path):
        if next(root.glob(pattern), None) is not None:
            list(walk(root))  # OSError for a folder that may not be read
            return root
    raise ValueError(f"{path} holds no {inside}/{pattern}: git clone {url}, and give the clone as --data.path")


def read_manifest(file: Path) -> Manifest:
    try:
        if file.suffix.lower() not in READERS or (file.exists() and not file.is_file()):  # a pipe never ends
            raise ValueError(f"it is no file of {', '.join(READERS)}")
        rows = READERS[file.suffix.lower()](file)
    except (ValueError, OSError, KeyError, csv.Error, pa.ArrowException) as error:  # ValueError: not UTF-8, too
        raise ValueError(f"{file} cannot be read as a table: {brief(error)}") from None
    texts = [{name: text_of(cell) for name, cell in row.items() if name} for row in rows]
    return Manifest.of(file, texts, digest=digest_file(file))


def _read_csv(file: Path) -> list[dict[str, Any]]:
    with file.open(newline="", encoding="utf-8-sig") as stream:
        header = stream.readline()
        stream.seek(0)
        sign = next((sign for sign in ",;\t" if sign in header), ",")
        names, *lines = [line for line in csv.reader(stream, delimiter=sign, strict=True) if line] or [[]]
    names = [name.strip() for name in names]
    if len(set(names)) < len(names):
        raise ValueError(f"it has two columns of one name: {', '.join(names)}")
    for number, line in enumerate(lines, 1):
        if any("\n" in cell or "\r" in cell for cell in line):
            raise ValueError(f"row {number} has a line break in a cell: close its quotes, or take it out")
        if len(line) != len(names):
            raise ValueError(f"row {number} has {len(line)} cells for {len(names)} columns: quote cells with commas")
    return [dict(zip(names, line, strict=True)) for line in lines]


def _read_parquet(file: Path) -> list[dict[str, Any]]:
    table = pq.ParquetFile(file.absolute()).read()
    return listed(table.select(table.column_names))  # KeyError for two columns of one name


def listed(table: pa.Table) -> list[dict[str, Any]]:
    """The rows of ``table``; of times whole microseconds, as Python knows none below."""
    whole = [f.with_type(pa.timestamp("us", f.type.tz)) if pa.types.is_timestamp(f.type) else f for f in table.schema]
    return table.cast(pa.schema(whole), safe=False).to_pylist()


def _read_jsonl(file: Path) -> list[dict[str, Any]]:
    rows = []
    for number, line in enumerate(file.read_text(encoding="utf-8-sig").split("\n"), 1):
        try:
            rows += [parse_json(line)] if line.strip() else []
        except ValueError as error:
            raise ValueError(f"line {number}: {str(error).partition(': line 1')[0]}") from None
        if rows and not isinstance(rows[-1], dict):
            raise ValueError(f"line {number}: write one object {{...}} per line")
    return rows


READERS = {".csv": _read_csv, ".parquet": _read_parquet, ".jsonl": _read_jsonl}
