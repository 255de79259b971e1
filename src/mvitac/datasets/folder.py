"""``--data folder``: anybody's images, named by a manifest or laid out in class folders.

A **manifest** (.csv, .parquet or .jsonl) has one row per sample; its paths are relative to its own folder, or absolute:

    vision,touch,material,object,split
    vision/0001.jpg,touch/0001.jpg,wood,table_3,train

**Class folders** need no manifest. Files are paired by their path below the modality's folder, without the suffix:

    <root>/vision/<class>/<name>.jpg            <root>/touch/<class>/<name>.png          every file its own group
    <root>/vision/<class>/<group>/<name>.jpg    ...                                      or grouped by a folder
    <root>/train/vision/<class>/...             <root>/test/vision/<class>/...           or split by a folder above
    <root>/left/<class>/...                     <root>/right/<class>/...                 two sensors instead of touch

They read as the manifest that they amount to, with columns vision, touch (or left, right), label, group and, where the
folders split, split. Everything that can be wrong with a manifest is said before the first image is decoded; rows are
counted from 1, the header not counted.
"""

from __future__ import annotations

import csv
import json
import math
import operator
import os
import re
import stat
import struct
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image, ImageOps

from mvitac.datasets.base import DatasetConfig
from mvitac.pack import SPLITS, Sample, Source
from mvitac.record import digest, digest_file
from mvitac.registry import to_json, unknown
from mvitac.spec import DataSpec, Task

VERSION = 1
"""Raised when the same manifest would give another pack."""
BY_GROUP = "by-group"
MANIFESTS = (".csv", ".parquet", ".jsonl")
IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm", ".gif")
CONTROL_NAMES = ("majority", "pixels", "border", "untrained", "imagenet")
"""What the probe itself calls its controls."""
MAX_ONE_HOT = 64
COMPARE: dict[str, Callable[[float, float], bool]] = {"<=": operator.le, ">=": operator.ge}


@dataclass(frozen=True, kw_only=True)
class FolderConfig(DatasetConfig):
    """An image folder, or a manifest naming vision path, touch path, labels, group and split."""

    name: ClassVar[str] = "folder"

    path: Path = Path("data")
    """A manifest (.csv, .parquet, .jsonl), a folder with a manifest.* in it, or a folder of class folders."""
    title: str | None = None
    """Name in results; default: the folder's name."""
    vision: str | None = None
    """Column of camera image paths; default: "vision" if there is one; "" = none."""
    touch: tuple[str, ...] = ()
    """Column of tactile image paths, or two columns (left right) to stack on channels; default: "touch", else "left"
    and "right", if there are any; "" = none."""
    labels: tuple[str, ...] = ()
    """Columns that become tasks; classes are their sorted distinct values, an empty cell or NaN is unlabelled."""
    group: str | None = None
    """Column of the unit of splits and of intervals (object, recording); default: "group" if there is one, else every
    row is alone, which is wrong for frames of one video."""
    touch_group: str | None = None
    """Column of near-duplicates (one touch, one grasp), kept apart in batches; default: the group."""
    split: str | None = None
    """Column with train, val, test or unlabelled; default: "split" if there is one, else "by-group", which deals the
    groups out by the three fields below."""
    test_share: float = 0.25
    """Share of the groups that only score (by-group)."""
    val_share: float = 0.15
    """Share of the groups that choose (by-group)."""
    split_seed: int = 0
    """Another number is another dealing of the groups (by-group)."""
    allow_leak: bool = False
    """Accept a split that puts one group, touch group or image on two sides."""
    controls: tuple[str, ...] = ()
    """Controls as "name=column[,column]": a logistic regression gets these columns instead of features; columns that
    are not numbers become one-hot."""
    only: tuple[str, ...] = ()
    """Rows to read, e.g. "seq<=4" "sensor=digit" "label_conflict!=1"; all conditions must hold."""
    label_only: tuple[str, ...] = ()
    """Rows whose labels count, in the same form; the others stay as unlabelled rows for pre-training."""
    licence: str = "unknown"
    """Under which terms the data may be used."""
    source_url: str = ""
    """Where the data is found."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.touch) > 2:
            raise ValueError(f"touch {' '.join(self.touch)}: give one column, or two to stack (left right)")
        named = Counter([*self.touch, *([self.vision] if self.vision else [])])
        if max(named.values(), default=1) > 1:
            raise ValueError(f"column {named.most_common(1)[0][0]!r} is named twice: every image needs its own column")
        if len(set(self.labels)) < len(self.labels):
            raise ValueError(f"labels {' '.join(self.labels)}: name every column once")
        for name, share in (("test_share", self.test_share), ("val_share", self.val_share)):
            if not 0 <= share < 1:
                raise ValueError(f"{name} {share}: give a share of the groups in [0, 1)")
        if self.test_share + self.val_share >= 1:
            raise ValueError(f"test_share {self.test_share} and val_share {self.val_share} leave nothing to train on")
        if self.split_seed < 0:
            raise ValueError(f"split_seed {self.split_seed}: give a number >= 0")
        for name, columns in self.control_columns().items():
            if not name or not all(columns):
                raise ValueError(f"control {name!r}: write it as name=column or name=column,column")
            if name in CONTROL_NAMES:
                raise ValueError(f"control {name!r} is made anyway: choose a name not among {', '.join(CONTROL_NAMES)}")
        for text in (*self.only, *self.label_only):
            Condition.parse(text)

    def control_columns(self) -> dict[str, tuple[str, ...]]:
        """Control name -> manifest columns."""
        pairs = [text.partition("=") for text in self.controls]
        if len({name.strip() for name, _, _ in pairs}) < len(pairs):
            raise ValueError(f"controls {' '.join(self.controls)}: give every control a name of its own")
        return {name.strip(): tuple(c.strip() for c in columns.split(",")) for name, _, columns in pairs}

    def source(self) -> Source:
        return Folder(self)


# -- manifests --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Manifest:
    """Rows as text, however they were stored; "" is an empty cell, NaN or null."""

    file: Path
    """What to call it in errors."""
    root: Path
    """What its paths are relative to."""
    columns: tuple[str, ...]
    rows: list[dict[str, str]]
    digest: str

    def check(self, column: str) -> None:
        if column not in self.columns:
            raise ValueError(f"{self.file}: {unknown('column', column, self.columns)}")


def text_of(value: Any) -> str:
    """A cell as text that does not depend on the file format: whole numbers without '.0', NaN and null as ''."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    text = str(value).strip()
    if text.lower() == "nan":
        return ""
    # pandas writes an integer column with one gap as 1.0, 2.0, ...: still the classes 1 and 2.
    return re.sub(r"^(-?\d+)\.0+$", r"\1", text) if ".0" in text else text


def number_of(text: str) -> float | None:
    """``text`` as a finite number, or None."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def size_of(path: str) -> int:
    """Bytes of a regular file, -1 if it is none. (Strings and one call: a manifest may name 200,000 files.)"""
    try:
        found = os.stat(path)
    except (OSError, ValueError):  # a NUL in the name is a ValueError
        return -1
    return found.st_size if stat.S_ISREG(found.st_mode) else -1


def find_manifest(path: Path) -> Path | None:
    """The manifest that ``path`` is or holds; None if it is a folder without one."""
    if path.is_dir():
        found = [path / f"manifest{suffix}" for suffix in MANIFESTS if (path / f"manifest{suffix}").is_file()]
        if len(found) > 1:
            raise ValueError(f"{path} holds {' and '.join(p.name for p in found)}: give the path of one of them")
        return found[0] if found else None
    if not path.is_file():
        raise ValueError(f"{path} does not exist: give a manifest ({', '.join(MANIFESTS)}) or a folder as path")
    if path.suffix.lower() not in MANIFESTS:
        raise ValueError(f"{path} is no manifest: its name must end in {', '.join(MANIFESTS)}")
    return path


def read_manifest(file: Path) -> Manifest:
    """Read ``file``; ValueError for anything that is not a table with named columns and at least one row."""
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
            row = json.loads(line)
        except json.JSONDecodeError as error:
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
        raise ValueError(
            f"{file} is not a parquet file ({' '.join(str(error).split())[:120]}): write it again"
        ) from None
    _check_header(file, table.column_names)
    columns = {name: [text_of(v) for v in table.column(name).to_pylist()] for name in table.column_names}
    return table.column_names, [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]


def _check_header(file: Path, columns: Sequence[str]) -> None:
    twice = [name for name, count in Counter(columns).items() if count > 1]
    if twice or not all(columns):
        what = f"column {twice[0]!r} twice" if twice else "a column without a name"
        raise ValueError(f"{file} has {what}: give every column its own name in the first line")


def list_class_folders(root: Path) -> Manifest:
    """The manifest that a tree of class folders amounts to (see the module's docstring)."""
    splits = [split for split in SPLITS if (root / split).is_dir()]
    rows: list[dict[str, str]] = []
    for split in splits or [""]:
        base = root / split
        have = [name for name in ("vision", "touch", "left", "right") if (base / name).is_dir()]
        if not have:
            raise ValueError(
                f"{base} has no manifest.csv (.parquet, .jsonl) and no folder vision, touch, left or right:"
                " make one of them, or give another path"
            )
        found = {name: _images_below(base / name) for name in have}
        for key in sorted(set().union(*found.values())):
            lacking = next((name for name in have if key not in found[name]), None)
            if lacking:
                other = next(found[name][key] for name in have if key in found[name])
                raise ValueError(f"{other} has no counterpart {base / lacking / key}.*: add it, or remove the other")
            parts = key.split("/")
            if len(parts) < 2:
                raise ValueError(f"{found[have[0]][key]} is not in a class folder: put it in one, named by its class")
            row = {name: found[name][key].relative_to(root).as_posix() for name in have}
            group = "/".join(parts[:-1]) if len(parts) > 2 else f"{split}/{key}"
            rows.append({**row, "label": parts[0], "group": group, **({"split": split} if split else {})})
    columns = list(dict.fromkeys(name for row in rows for name in row))
    for number, row in enumerate(rows, 1):
        if len(row) < len(columns):
            lacking = next(name for name in columns if name not in row)
            raise ValueError(
                f"{root} has {lacking} images in some splits only (row {number} has none): add or remove them"
            )
    if not rows:
        raise ValueError(f"{root} holds no images ({', '.join(IMAGES)}): put them in <class> folders")
    return Manifest(root, root, tuple(columns), rows, digest(rows))


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
    """One row filter: column, one of = != <= >=, value."""

    column: str
    sign: str
    value: str

    @classmethod
    def parse(cls, text: str) -> Condition:
        match = re.fullmatch(r"\s*([^<>=!]+?)\s*(<=|>=|!=|=)\s*([^<>=!]*?)\s*", text)
        if match is None:
            raise ValueError(f"condition {text!r}: write column=value, column!=value, column<=number or column>=number")
        condition = cls(*match.groups())
        if condition.sign in COMPARE and number_of(condition.value) is None:
            raise ValueError(f"condition {text!r}: {condition.sign} needs a number, not {condition.value!r}")
        return condition

    def holds(self, row: dict[str, str]) -> bool:
        """Whether ``row`` meets it; an empty cell is neither <= nor >= anything."""
        cell, wanted = row[self.column], text_of(self.value)
        if self.sign in COMPARE:
            number = number_of(cell)
            return number is not None and COMPARE[self.sign](number, float(wanted))
        return (cell == wanted) == (self.sign == "=")


# -- the source -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One manifest row, ready to be read."""

    number: int
    vision: str | None
    touch: tuple[str, ...]
    columns: dict[str, Any] = field(default_factory=dict)


class Folder(Source):
    """One item is one manifest row. Everything but the images' content is checked here, before any is decoded."""

    def __init__(self, config: FolderConfig) -> None:
        file = find_manifest(config.path)
        manifest = read_manifest(file) if file else list_class_folders(config.path)
        self._manifest_digest = manifest.digest
        self._options = {k: v for k, v in to_json(config).items() if k not in ("path", "workers", "size")}
        self._title = config.title or (config.path if config.path.is_dir() else config.path.parent).resolve().name

        vision, touch = _image_columns(config, manifest)
        labels = config.labels or (("label",) if file is None else ())
        group = config.group or ("group" if "group" in manifest.columns else None)
        split = config.split or ("split" if "split" in manifest.columns else BY_GROUP)
        conditions = [Condition.parse(text) for text in config.only]
        label_conditions = [Condition.parse(text) for text in config.label_only]
        controls = config.control_columns()
        asked = [*labels, group, config.touch_group, split if split != BY_GROUP else None]
        asked += [c.column for c in (*conditions, *label_conditions)] + [c for cs in controls.values() for c in cs]
        for column in asked:
            if column is not None:
                manifest.check(column)

        numbered = [
            (number, row)
            for number, row in enumerate(manifest.rows, 1)
            if all(condition.holds(row) for condition in conditions)
        ]
        if not numbered:
            raise ValueError(f"{manifest.file}: none of {len(manifest.rows)} rows meets {' and '.join(config.only)}")
        numbers, rows = [n for n, _ in numbered], [row for _, row in numbered]
        paths = self._check_files(manifest, numbers, rows, [c for c in (vision, *touch) if c])

        where = str(manifest.file)
        groups = _filled(where, numbers, rows, group, "group")
        touch_groups = (
            _filled(where, numbers, rows, config.touch_group, "touch_group") if config.touch_group else groups
        )
        counts = [all(condition.holds(row) for condition in label_conditions) for row in rows]
        tasks, targets = [], []
        for column in labels:
            task, target = _task(where, column, rows, counts)
            tasks.append(task)
            targets.append(target)
        if split == BY_GROUP:
            splits = deal(groups, targets, config.test_share, config.val_share, config.split_seed)
        else:
            splits = _filled(where, numbers, rows, split, "split")
            _check_split_names(where, split, numbers, splits)
        if not config.allow_leak:
            _check_leak(where, split, f"groups ({group})", groups, splits)
            _check_leak(where, split, f"touch groups ({config.touch_group or group})", touch_groups, splits)
            for column in [c for c in (vision, *touch) if c]:
                _check_leak(where, split, f"{column} images", [row[column] for row in rows], splits)
        _check_sides(where, split, splits, tasks, targets, len(set(groups)))

        extra, names = _controls(where, controls, numbers, rows, targets)
        images = {c for c in (vision, *touch) if c}
        ids = _ids(where, manifest, numbers, rows)
        self._rows: list[Row] = []
        for i, row in enumerate(rows):
            carried = {name: cell for name, cell in row.items() if name not in images}
            own = {"id": ids[i], "group": groups[i], "touch_group": touch_groups[i], "split": splits[i]}
            own |= {f"label_{task.name}": target[i] for task, target in zip(tasks, targets, strict=True)}
            found = iter(paths[i])
            first = next(found) if vision else None
            # Column order is part of the pack's digest: ours first, then the manifest's that we do not interpret.
            columns = {
                **own,
                **{k: v for k, v in carried.items() if k not in own},
                **{k: v[i] for k, v in extra.items()},
            }
            self._rows.append(Row(numbers[i], first, tuple(found), columns))
        self._spec = DataSpec(
            name=self._title,
            vision_channels=3 if vision else 0,
            touch_channels=3 * len(touch),
            tasks=tuple(tasks),
            group_by=group or "row",
            controls=names,
            licence=config.licence,
            source=config.source_url or "not given",
        )

    def _check_files(
        self, manifest: Manifest, numbers: list[int], rows: list[dict[str, str]], columns: list[str]
    ) -> list[list[str]]:
        """Image paths per row, in the order of ``columns``; keeps their sizes for the fingerprint."""
        paths: list[list[str]] = []
        root = str(manifest.root)
        missing: list[str] = []
        self._sizes: list[int] = []
        for number, row in zip(numbers, rows, strict=True):
            for column in columns:
                if not row[column]:
                    raise ValueError(
                        f"{manifest.file} row {number} has no {column} path: fill it, or leave the row out (only)"
                    )
            paths.append([os.path.join(root, row[column]) for column in columns])
            for column, path in zip(columns, paths[-1], strict=True):
                size = size_of(path)
                self._sizes.append(size)
                if size <= 0:
                    missing.append(f"row {number} {column} {row[column]}{' (0 bytes)' if size == 0 else ''}")
        if missing:
            raise ValueError(
                f"{manifest.file}: {len(missing)} of {len(self._sizes)} image files are missing or empty, e.g."
                f" {'; '.join(missing[:3])} (paths are relative to {manifest.root})"
            )
        return paths

    def spec(self) -> DataSpec:
        return self._spec

    def items(self) -> list[str]:
        return [f"row {row.number}" for row in self._rows]

    def fingerprint(self) -> dict[str, Any]:
        return {
            "reader": f"folder {VERSION}",
            "title": self._title,
            "manifest": self._manifest_digest,
            "file_sizes": digest(self._sizes),
            "options": self._options,
        }

    def read(self, item: int) -> list[Sample]:
        row = self._rows[item]
        touches = [decode(path) for path in row.touch]
        if len(touches) == 2 and touches[0].shape != touches[1].shape:
            (h, w, _), (h2, w2, _) = touches[0].shape, touches[1].shape
            raise ValueError(
                f"{row.touch[0]} is {w} x {h}, {row.touch[1]} is {w2} x {h2}: stacked sensors need one size"
            )
        touch = np.concatenate(touches, axis=2) if touches else None
        return [Sample(vision=decode(row.vision) if row.vision else None, touch=touch, columns=row.columns)]


def decode(path: str | Path) -> np.ndarray:
    """An image file as uint8 RGB [H, W, 3]: upright (EXIF), 16 bits scaled to 8, transparent parts black."""
    try:
        with Image.open(path) as image:
            # A camera's MPO hides a second picture behind the first; a GIF or TIFF stack is no photo.
            if getattr(image, "n_frames", 1) > 1 and image.format != "MPO":
                raise ValueError(f"it holds {getattr(image, 'n_frames', 0)} frames, not one: store one image per row")
            image.load()
            return _to_rgb(ImageOps.exif_transpose(image))
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist any more: it was there when packing began") from None
    # What PIL raises for damaged files is not one family.
    except (OSError, ValueError, SyntaxError, TypeError, IndexError, EOFError, struct.error) as error:
        raise ValueError(f"{path} cannot be read as an image ({' '.join(str(error).split())})") from None
    except Image.DecompressionBombError as error:
        raise ValueError(f"{path} is too large ({error})") from None


def _to_rgb(image: Image.Image) -> np.ndarray:
    if image.mode.startswith("I"):
        values = np.asarray(image).astype(np.int64)
        if values.min() < 0 or values.max() > 65535:
            raise ValueError(f"its values lie in {values.min()} to {values.max()}, not in 16 bits: scale it first")
        gray = ((values + 128) // 257).astype(np.uint8)  # 65535 -> 255; PIL's own conversion clips instead
        return np.repeat(gray[:, :, None], 3, axis=2)
    if image.mode == "F":
        raise ValueError("it holds floating-point values of unknown range: store it with 8 or 16 bits")
    if image.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in image.info:
        image = image.convert("RGBA")
        black = Image.new("RGBA", image.size, (0, 0, 0, 255))
        image = Image.alpha_composite(black, image)
    return np.asarray(image.convert("RGB"))


# -- checks -----------------------------------------------------------------------------------------------------------


def _image_columns(config: FolderConfig, manifest: Manifest) -> tuple[str | None, tuple[str, ...]]:
    """The columns of vision and touch paths, asked for or found by their usual names."""
    have = manifest.columns
    vision = ("vision" if "vision" in have else None) if config.vision is None else config.vision or None
    if config.touch:
        touch = tuple(c for c in config.touch if c)
    else:
        touch = ("touch",) if "touch" in have else ("left", "right") if {"left", "right"} <= set(have) else ()
    for column in (vision, *touch):
        if column:
            manifest.check(column)
    if not (vision or touch):
        raise ValueError(
            f"{manifest.file} has no column vision, touch, or left and right (it has {', '.join(have)}):"
            " name the image columns by vision and touch"
        )
    return vision, touch


def _filled(
    where: str, numbers: Sequence[int], rows: Sequence[dict[str, str]], column: str | None, what: str
) -> list[str]:
    """The cells of ``column``, none of them empty; without a column, every row's own number."""
    if column is None:
        return [f"{number:06d}" for number in numbers]
    empty = [number for number, row in zip(numbers, rows, strict=True) if not row[column]]
    if empty:
        hint = f"; write one of {', '.join(SPLITS)}" if what == "split" else ""
        raise ValueError(
            f"{where}: column {column!r} ({what}) is empty in {len(empty)} rows, first row {empty[0]}{hint}"
        )
    return [row[column] for row in rows]


def _task(where: str, column: str, rows: Sequence[dict[str, str]], counts: Sequence[bool]) -> tuple[Task, list[int]]:
    """The task of a label column, and its class number per row (-1 = unlabelled or not counted)."""
    cells = [row[column] if counted else "" for row, counted in zip(rows, counts, strict=True)]
    names = {cell for cell in cells if cell}
    labelled = sum(bool(cell) for cell in cells)
    if len(names) < 2:
        what = f"only the class {min(names)!r}" if names else "no labels"
        raise ValueError(f"{where}: column {column!r} has {what} in {len(rows)} rows: a task needs two classes")
    if len(names) == labelled >= 10:
        raise ValueError(
            f"{where}: column {column!r} has another value in each of its {labelled} rows (e.g. {min(names)!r}):"
            " classes must repeat; is it a measurement or a name?"
        )
    if all(number_of(name) is not None for name in names):
        classes = sorted(names, key=lambda name: (float(name), name))
    else:
        classes = sorted(names)
    places = {name: i for i, name in enumerate(classes)}
    return Task(name=column, classes=tuple(classes)), [places.get(cell, -1) for cell in cells]


def _check_split_names(where: str, column: str, numbers: Sequence[int], splits: Sequence[str]) -> None:
    for number, split in zip(numbers, splits, strict=True):
        if split not in SPLITS:
            near = {"validation": "val", "valid": "val", "dev": "val", "eval": "val", "training": "train"}
            near |= {"testing": "test", "unseen": "test", "unlabeled": "unlabelled"}
            wanted = near.get(split.lower()) or (split.lower() if split.lower() in SPLITS else None)
            hint = f"; write {wanted!r} instead" if wanted else f"; or split={BY_GROUP} ignores the column"
            raise ValueError(f"{where} row {number}: {unknown(f'split in column {column!r}', split, SPLITS)}{hint}")


def _check_leak(where: str, split: str, what: str, values: Sequence[str], splits: Sequence[str]) -> None:
    """Refuse a value that is on two sides; train and unlabelled are one side, as pre-training sees both."""
    sides: dict[str, set[str]] = defaultdict(set)
    for value, side in zip(values, splits, strict=True):
        sides[value].add("train" if side == "unlabelled" else side)
    leaks = [value for value, found in sides.items() if len(found) > 1]
    if leaks:
        advice = "give the group that holds them together" if split == BY_GROUP else f"split={BY_GROUP} splits by group"
        raise ValueError(
            f"{where}: split {split!r} leaks: {len(leaks)} of {len(sides)} {what} are on two sides, e.g. {leaks[0]!r}"
            f" in {' and '.join(sorted(sides[leaks[0]]))}; {advice}, or allow_leak accepts it"
        )


def _check_sides(
    where: str, split: str, splits: Sequence[str], tasks: Sequence[Task], targets: Sequence[Sequence[int]], num: int
) -> None:
    """Something to pre-train on; for every task something to learn from and to be scored on."""
    counts = Counter(splits)
    what = f"dealing {num} groups" if split == BY_GROUP else f"column {split!r}"
    if not counts["train"] + counts["unlabelled"]:
        raise ValueError(f"{where}: {what} gives no rows of train or unlabelled: nothing to pre-train on")
    for task, target in zip(tasks, targets, strict=True):
        for side in ("train", "test"):
            if not any(label >= 0 and s == side for label, s in zip(target, splits, strict=True)):
                hint = (
                    "more groups or another share are needed" if split == BY_GROUP else "a probe needs train and test"
                )
                raise ValueError(f"{where}: {what} gives label {task.name!r} no labelled rows in {side}: {hint}")


def _controls(
    where: str,
    controls: dict[str, tuple[str, ...]],
    numbers: Sequence[int],
    rows: Sequence[dict[str, str]],
    targets: Sequence[Sequence[int]],
) -> tuple[dict[str, list[float]], dict[str, tuple[str, ...]]]:
    """Numeric columns for the pack, and which of them every control uses."""
    labelled = [any(target[i] >= 0 for target in targets) for i in range(len(rows))]
    made: dict[str, dict[str, list[float]]] = {}
    for column in dict.fromkeys(c for columns in controls.values() for c in columns):
        cells = [row[column] for row in rows]
        empty = [n for n, cell, counted in zip(numbers, cells, labelled, strict=True) if counted and not cell]
        if empty:
            raise ValueError(
                f"{where}: control column {column!r} is empty in {len(empty)} labelled rows, first row {empty[0]}"
            )
        values = [number_of(cell) for cell in cells]
        if all(value is not None or not cell for value, cell in zip(values, cells, strict=True)):
            # An unlabelled row is never probed; 0 stands for its gap.
            made[column] = {column: [value or 0.0 for value in values]}
            continue
        names = sorted({cell for cell in cells if cell})
        if len(names) > MAX_ONE_HOT:
            raise ValueError(
                f"{where}: control column {column!r} has {len(names)} values that are not numbers, e.g. {names[0]!r}:"
                f" at most {MAX_ONE_HOT} become one-hot"
            )
        made[column] = {f"{column}={name}": [float(cell == name) for cell in cells] for name in names}
    columns = {name: values for each in made.values() for name, values in each.items()}
    return columns, {name: tuple(c for column in given for c in made[column]) for name, given in controls.items()}


def _ids(where: str, manifest: Manifest, numbers: Sequence[int], rows: Sequence[dict[str, str]]) -> list[str]:
    """The column "id" if there is one, else the row numbers."""
    if "id" not in manifest.columns:
        return [f"{number:06d}" for number in numbers]
    ids = _filled(where, numbers, rows, "id", "id")
    twice = [name for name, count in Counter(ids).items() if count > 1]
    if twice:
        raise ValueError(f"{where}: id {twice[0]!r} stands in several rows: ids must differ")
    return ids


def deal(
    groups: Sequence[str], targets: Sequence[Sequence[int]], test_share: float, val_share: float, seed: int
) -> list[str]:
    """A split per row, whole groups dealt to train, val and test, stratified over the first label's classes.

    The first group of every class goes to train, every next one to the split that lacks most: a class of one group is
    never tested. Groups without any label are "unlabelled" where others have some.
    """
    votes: dict[str, Counter[int]] = {group: Counter() for group in groups}
    known: set[str] = set()
    for i, group in enumerate(groups):
        votes[group].update([target[i] for target in targets[:1] if target[i] >= 0])
        if not targets or any(target[i] >= 0 for target in targets):
            known.add(group)
    strata: dict[int, list[str]] = defaultdict(list)
    for group in sorted(known):
        # Ties go to the smaller class number, so that the dealing does not depend on the order of rows.
        strata[min(votes[group], key=lambda c: (-votes[group][c], c), default=-1)].append(group)
    shares = {"train": 1 - test_share - val_share, "test": test_share, "val": val_share}
    rng = np.random.default_rng(seed)
    dealt: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for stratum in rng.permutation(sorted(strata)).tolist():
        for place, j in enumerate(rng.permutation(len(strata[stratum])).tolist()):
            lacks = {name: share * (len(dealt) + 1) - counts[name] for name, share in shares.items() if share > 0}
            choice = "train" if place == 0 else max(lacks, key=lambda name: lacks[name])
            dealt[strata[stratum][j]] = choice
            counts[choice] += 1
    return [dealt.get(group, "unlabelled") for group in groups]
