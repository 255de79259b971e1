"""The pack: what any dataset becomes on disk, read once, then memory-mapped by every run.

    <pack>/pack.json         format, counts, digests, spec, source, licence, versions
           samples.parquet   one row per sample: id, group, split, label_<task>, sensor, ..., crc_<modality>
                             has_vision, has_touch (bool) where some rows lack an image; zeros stand for it
           vision.npy        uint8 [N, size, size, 3]      absent where the dataset has no camera
           touch.npy         uint8 [N, size, size, 3 or 6]

A pack that stores JPEG has ``vision.jpegs`` and ``touch.jpegs`` instead (``data/jpeg.py``), and bytes_<modality> in its table.
Here it is opened and checked; ``data/build.py`` makes one. No torch here.
"""

from __future__ import annotations

import functools
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.data import notebook
from mvitac.data.jpeg import Jpegs, Lazy
from mvitac.data.spec import DataSpec
from mvitac.registry import from_json, unknown
from mvitac.system.files import brief, digest, digest_file, read_json

FORMAT = "mvitac-pack"
SHARDED = "mvitac-shards"
FORMAT_VERSIONS = {"raw": 1, "jpeg": 2}
"""By how the images are stored."""
SUFFIXES = {"raw": ".npy", "jpeg": ".jpegs"}
SPLITS = ("train", "val", "test", "unlabelled")
"""Pre-training sees train and unlabelled; val chooses (kNN while training, a probe's regularisation); test only scores."""

Store = Literal["raw", "jpeg"]
Images = np.ndarray | Lazy


class Pack:
    """An opened pack: ``table`` (pyarrow), ``images[modality]`` (uint8 [N, S, S, C], memory-mapped or decoded as they are
    indexed), ``spec``."""

    format: ClassVar[str] = FORMAT
    window: int = 0
    """Shards whose rows training may mix at a time; 0 where all rows are equally near (``data/streaming.py`` has others)."""

    def __init__(self, path: str | Path, *, verify: bool = True) -> None:
        """Open and check ``path``; ``verify`` also recomputes the image digests (about 1 s per GB)."""
        self.path = Path(path)
        if not self.path.is_dir():
            raise ValueError(f"no pack at {self.path}: make one with `mvitac data simulate` or `mvitac data pack`")
        meta = read_json(self.path / "pack.json", "a pack's description")
        if isinstance(meta, dict) and meta.get("format") == SHARDED != self.format:
            raise ValueError(f"{self.path} is a pack in shards: read it with --data stream --data.url {self.path}")
        if not isinstance(meta, dict) or meta.get("format") != self.format:
            raise ValueError(f"{self.path / 'pack.json'} does not describe a pack: choose a folder `mvitac data` wrote")
        if (version := meta.get("format_version")) not in FORMAT_VERSIONS.values():
            known = " and ".join(map(str, FORMAT_VERSIONS.values()))
            raise ValueError(f"{self.path} has pack format {version}, this version reads {known}: re-pack it")
        rest = {key: value for key, value in meta.items() if key != "digest"}
        if meta.get("digest", given := digest(rest)) != given:
            raise ValueError(
                f"{self.path / 'pack.json'} does not match its digest: it was changed or damaged, re-pack it"
            )
        self.meta: dict[str, Any] = meta
        try:
            self.spec: DataSpec = from_json(DataSpec, meta.get("spec"), "spec")
            self.num, self.size = (int(from_json(int, meta.get(name), name)) for name in ("num", "size"))
            self.store: Store = from_json(Store, meta.get("store", "raw"), "store")
            if FORMAT_VERSIONS[self.store] != version:
                raise ValueError(f"store: {self.store} is not of format {version}")
            self.digests: dict[str, str] = from_json(dict[str, str], meta.get("digests"), "digests")
            files = self._files()
            if sorted(self.digests) != sorted(names := ("samples.parquet", *files)):
                raise ValueError(f"digests: expected those of {', '.join(names)}")
        except ValueError as error:
            raise ValueError(f"{self.path / 'pack.json'} is damaged ({error}): re-pack it") from None
        self._check_digest("samples.parquet")
        try:
            self.table: pa.Table = pq.read_table(self._file("samples.parquet"))
        except Exception as error:  # arrow raises several kinds for a damaged file
            raise ValueError(
                f"{self.path / 'samples.parquet'} cannot be read ({brief(error)}): the pack is damaged, make it again"
            ) from None
        if self.table.num_rows != self.num:
            raise ValueError(
                f"{self.path / 'samples.parquet'} has {self.table.num_rows} rows, pack.json promises {self.num}: re-pack it"
            )
        try:
            check_table(self.table, self.spec)
        except ValueError as error:
            raise ValueError(f"{self.path / 'samples.parquet'}: {error} (make the pack again)") from None
        self.images: dict[str, Images] = self._open(files)
        for name, modality in files.items() if verify else ():
            self._check_digest(name, modality)

    def __repr__(self) -> str:
        return f"Pack({str(self.path)!r}: {self.num} rows of {self.spec.name} at {self.size} px)"

    def _repr_html_(self) -> str:
        return notebook.pack_html(self)

    @property
    def digest(self) -> str:
        """Content address of images and table: equal content, equal digest, whatever the spec says of it."""
        return digest(self.digests)

    def column(self, name: str) -> np.ndarray:
        """One table column as numpy [N]; ValueError names the columns there are."""
        if name not in self.table.column_names:
            raise unknown("column", name, self.table.column_names)
        return np.array(self.table.column(name).to_numpy(zero_copy_only=False))  # arrow memory is read-only

    def labels(self, task: str, *splits: str) -> np.ndarray:
        """[N] int64 labels of ``task``, -1 where there is none or the task is not about the row (``Task.only``).

        With ``splits``, -1 also where the row is, for this task, on another side (``Task.split``).
        """
        if (task, *splits) not in self._labels:
            about = next(t for t in self.spec.tasks if t.name == task)
            known = self.column(f"label_{task}").astype(np.int64)
            for name, value in about.only.items():
                known[self.column(name).astype(str) != value] = -1
            if splits:
                known[~np.isin(self.column(about.split), splits)] = -1
            self._labels[task, *splits] = known
        return self._labels[task, *splits]

    @functools.cached_property
    def _labels(self) -> dict[tuple[str, ...], np.ndarray]:
        return {}

    def has(self, modality: str) -> np.ndarray:
        """bool [N]: which rows have an image of ``modality``; the others hold zeros, which nothing should look at."""
        name = f"has_{modality}"
        return self.column(name) if name in self.table.column_names else np.ones(self.num, bool)

    def rows(
        self, *splits: str, only: dict[str, str] | None = None, having: Sequence[str] = (), by: str = "split"
    ) -> np.ndarray:
        """Ascending int64 row numbers whose split (column ``by``) is among ``splits``, whose columns equal ``only`` and
        which have an image of every modality in ``having``."""
        mask = np.isin(self.column(by), splits)
        for modality in having:
            mask &= self.has(modality)
        for name, value in (only or {}).items():
            mask &= self.column(name).astype(str) == value
        return np.flatnonzero(mask)

    @functools.cached_property
    def touch_groups(self) -> np.ndarray:
        """[N] int64: number of each row's touch group (column touch_group, else group), in which rows are near-copies."""
        name = "touch_group" if "touch_group" in self.table.column_names else "group"
        return np.unique(self.column(name).astype(str), return_inverse=True)[1]

    @functools.cached_property
    def _rows_by_touch_group(self) -> list[np.ndarray]:
        order = np.argsort(self.touch_groups, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.touch_groups))[:-1])

    def rows_of(self, touch_group: int) -> np.ndarray:
        """Ascending row numbers of touch group number ``touch_group``."""
        return self._rows_by_touch_group[touch_group]

    @functools.cached_property
    def shards(self) -> np.ndarray:
        """[N] int: number of the shard each row lies in; a pack on the disk is one."""
        return np.zeros(self.num, np.int64)

    def near(self, rows: np.ndarray, num: int) -> np.ndarray:
        """Those of ``rows`` (ascending) in the first shards, as many shards as hold ``num`` of them: to draw a sample from.
        All of a pack on the disk; shards are in random order."""
        return rows[self.shards[rows] <= self.shards[rows[:num]].max(initial=0)]

    def expect(self, rows: np.ndarray) -> None:
        """Be told that ``rows`` are read next, in this order, and no others are soon: shards are fetched ahead by it."""

    def _files(self) -> dict[str, str]:
        """Name of each image file that pack.json promises -> its modality."""
        return {f"{m}{SUFFIXES[self.store]}": m for m in self.spec.modalities}

    def _open(self, files: dict[str, str]) -> dict[str, Images]:
        """The images of each modality, which lie in ``files``."""
        reader = {"raw": self._map, "jpeg": self._jpegs}[self.store]
        return {m: reader(m, self._file(name)) for name, m in files.items()}

    def _check_digest(self, name: str, modality: str = "") -> None:
        if digest_file(self._file(name)) != self.digests[name]:
            where = self._damaged_rows(modality, self.images[modality]) if modality else ""
            raise ValueError(f"{self.path / name} does not match its digest{where}: the pack is damaged, make it again")

    def _damaged_rows(self, modality: str, images: Images, first: int = 0) -> str:
        """Which rows of a damaged image file, from row ``first`` on, do not match their own sums, for the error; "" if
        that cannot be said."""
        if f"crc_{modality}" not in self.table.column_names:
            return ""
        sums = self.table.column(f"crc_{modality}").slice(first, len(images)).to_pylist()
        stored: Any = images.jpeg if isinstance(images, Jpegs) else images.__getitem__
        rows = [first + i for i in range(len(images)) if zlib.crc32(stored(i)) != sums[i]]
        if not rows:
            return " in its header"
        name = self.table.column("id")[rows[0]].as_py()
        return f" in {len(rows)} of {len(images)} rows, first row {rows[0]} (id {name!r})"

    def _file(self, name: str) -> Path:
        path = self.path / name
        if not path.is_file():
            raise ValueError(f"{path} is missing: the pack is damaged, make it again")
        return path

    def _shape(self, modality: str, num: int) -> tuple[int, int, int, int]:
        return num, self.size, self.size, self.spec.channels(modality)

    def _jpegs(self, modality: str, path: Path, rows: slice = slice(None)) -> Jpegs:
        name = f"bytes_{modality}"
        if name not in self.table.column_names or not pa.types.is_uint32((column := self.table.column(name)).type):
            raise ValueError(f"{self.path / 'samples.parquet'} has no column {name} of uint32: make the pack again")
        if column.null_count:
            raise ValueError(f"{self.path / 'samples.parquet'}: column {name} has empty rows: make the pack again")
        try:
            return Jpegs(path, self._shape(modality, len(lengths := self.column(name)[rows])), lengths)
        except (ValueError, OSError) as error:
            raise ValueError(f"{brief(error)}: the pack is damaged, make it again") from None

    def _map(self, modality: str, path: Path) -> np.ndarray:
        expected = self._shape(modality, self.num)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about headers that only damage can produce
                images = np.load(path, mmap_mode="r", allow_pickle=False)
        except Exception as error:  # numpy raises whatever a damaged header leads its parser to
            raise ValueError(f"{path} cannot be mapped ({brief(error)}): the pack is damaged, make it again") from None
        if not isinstance(images, np.ndarray) or images.shape != expected or images.dtype != np.uint8:
            held = f"{images.dtype} {images.shape}" if isinstance(images, np.ndarray) else "no array"
            raise ValueError(f"{path} holds {held}, pack.json promises uint8 {expected}")
        return images


def check_table(table: pa.Table, spec: DataSpec) -> None:
    """What every reader of a pack's table relies on; ValueError names the column, the row and what is allowed."""
    labels = {f"label_{task.name}": len(task.classes) for task in spec.tasks}
    for name in ("id", "group", "split", *labels, *(c for columns in spec.controls.values() for c in columns)):
        if name not in table.column_names:
            raise unknown("column", name, table.column_names)
    for name in (name for task in spec.tasks for name in task.only):
        if name not in table.column_names:
            raise unknown("column", name, table.column_names)

    def first(bad: Any) -> int:
        return int(np.flatnonzero(np.asarray(bad))[0])

    for name in ("id", "group", "split", "touch_group", *labels):
        if name in table.column_names and table.column(name).null_count:
            row = first(table.column(name).is_null().to_numpy())
            raise ValueError(f"column {name} is empty in row {row}: every row needs one")
    for name in (f"has_{modality}" for modality in spec.modalities):
        if name in table.column_names and (table.column(name).null_count or table.column(name).type != pa.bool_()):
            raise ValueError(f"column {name} holds {table.column(name).type}: write true or false in every row")
    for column in dict.fromkeys(("split", *(task.split for task in spec.tasks))):
        if column not in table.column_names:
            raise unknown("column", column, table.column_names)
        for split in table.column(column).unique().to_pylist():
            if split not in SPLITS:
                raise unknown(column, str(split), SPLITS)
    for name, num in labels.items():
        kind = table.column(name).type
        if not pa.types.is_integer(kind):
            raise ValueError(f"column {name} holds {kind}: a label is a whole number, 0 to {num - 1}, or -1 for none")
        values = table.column(name).to_numpy()
        if ((values < -1) | (values >= num)).any():
            row = first((values < -1) | (values >= num))
            raise ValueError(f"{name} is {values[row]} in row {row}: give 0 to {num - 1}, or -1 for none")
    for name in (c for columns in spec.controls.values() for c in columns):
        kind = table.column(name).type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
            raise ValueError(f"column {name} holds {kind}: a control needs a number in every row")
        values = table.column(name).to_numpy(zero_copy_only=False).astype(float)
        if not np.isfinite(values).all():
            raise ValueError(f"column {name} is no number in row {first(~np.isfinite(values))}: a control needs one")
    _check_ids(table.column("id").to_pylist())


def _check_ids(ids: list[Any]) -> None:
    seen: set[Any] = set()
    for one in ids:
        if one in seen:
            raise ValueError(f"id {one!r} is there twice: give every sample its own")
        seen.add(one)


def has_difference(pack: Pack) -> bool:
    """Whether touch is stored minus its background; packs from before their description said so tell by how they were
    asked for."""
    asked = pack.meta.get("fingerprint") or {}
    return pack.spec.difference or bool((asked.get("options") or asked).get("difference"))
