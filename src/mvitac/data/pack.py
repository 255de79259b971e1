"""The pack: a dataset on disk, built once and memory-mapped by every run.

    <pack>/pack.json         format, counts, digests, spec, source, licence, versions
           samples.parquet   one row per sample: id, group, split, label_<task>, sensor, ..., crc_<modality>;
                             has_vision, has_touch (bool) if some rows lack an image, which is stored as zeros
           vision.npy        uint8 [N, size, size, 3]      absent if the dataset has no camera
           touch.npy         uint8 [N, size, size, 3 or 6]

A pack stored as JPEG has ``vision.jpegs`` and ``touch.jpegs`` instead (``data/jpeg.py``) and columns bytes_<modality>.
"""

import copy
import functools
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.data.jpeg import Jpegs
from mvitac.data.lazy import Lazy
from mvitac.data.pack_table import check_table
from mvitac.data.spec import PHASES, SUFFIXES, AnyTask, DataSpec, Store, ValueTask
from mvitac.registry import check_known, from_json
from mvitac.system.files import brief, digest, digest_file, read_json

FORMAT, FORMAT_VERSION = "mvitac-pack", 2

Images = np.ndarray | Lazy


class Pack:
    """An opened pack.

    Attributes:
        spec: Description of the dataset.
        table: One row per sample (pyarrow).
        images: Modality -> uint8 [N, S, S, C], memory-mapped, or decoded when indexed.

    Examples:
        >>> pack = Pack("packs/materials")
        >>> pack.images["touch"][pack.rows("test")]
    """

    config: Any = None
    """The dataset's settings that it was opened by (``DatasetConfig.open``)."""
    parts: "Mapping[str, Pack]" = MappingProxyType({})
    """Name -> pack, for several packs that are opened as one (``data/several``)."""

    def __init__(self, path: str | Path, *, verify: bool = True) -> None:
        """Open and check the pack at ``path``; ``verify`` also recomputes the image digests (about 1 s per GB)."""
        self.path = Path(path)
        self.meta: dict[str, Any] = self._read_meta()
        try:
            self.spec: DataSpec = from_json(DataSpec, self.meta.get("spec"), "spec")
            self.num, self.size = (int(from_json(int, self.meta.get(name), name)) for name in ("num", "size"))
            self.store: Store = from_json(Store, self.meta.get("store"), "store")
            self.digests: dict[str, str] = from_json(dict[str, str], self.meta.get("digests"), "digests")
            files = {f"{m}{SUFFIXES[self.store]}": m for m in self.spec.modalities}
            if sorted(self.digests) != sorted(names := ("samples.parquet", *files)):
                raise ValueError(f"digests: expected those of {', '.join(names)}")
        except ValueError as error:
            raise ValueError(f"{self.path / 'pack.json'} is damaged ({error}): re-pack it") from None
        self._check_digest("samples.parquet")
        table = self._file("samples.parquet")
        try:
            self.table: pa.Table = pq.read_table(table.absolute())  # pyarrow expands ~
            if len(self.table) != self.num:
                raise ValueError(f"it has {len(self.table)} rows, pack.json promises {self.num}")
            check_table(self.table, self.spec)
        except Exception as error:  # arrow raises several kinds for a damaged file
            raise ValueError(f"{table} cannot be used ({brief(error)}): make the pack again") from None
        self.images: dict[str, Images] = {m: self._opened(m, self._file(name)) for name, m in files.items()}
        for name in files if verify else ():
            self._check_digest(name)

    def _read_meta(self) -> dict[str, Any]:
        """Return the content of pack.json; ValueError unless it describes a pack that this version reads."""
        if not self.path.is_dir():
            raise ValueError(f"no pack at {self.path}: make one with `mvitac data pack`")
        meta = read_json(path := self.path / "pack.json", "a pack's description")
        if not isinstance(meta, dict) or meta.get("format") != FORMAT:
            raise ValueError(f"{path} does not describe a pack: choose a folder `mvitac data` wrote")
        if (version := meta.get("format_version")) != FORMAT_VERSION:
            raise ValueError(f"{self.path} has pack format {version}, this version reads {FORMAT_VERSION}: re-pack it")
        rest = {key: value for key, value in meta.items() if key != "digest"}
        if meta.get("digest", given := digest(rest)) != given:
            raise ValueError(f"{path} does not match its digest: it was changed or damaged, re-pack it")
        return meta

    def __repr__(self) -> str:
        return f"Pack({str(self.path)!r}: {self.num} rows of {self.spec.name} at {self.size} px)"

    @property
    def digest(self) -> str:
        """Digest of images and table. It does not depend on the spec."""
        return digest(self.digests)

    def column(self, name: str) -> np.ndarray:
        """Return a table column as numpy [N]; the ValueError for an unknown one lists the columns."""
        check_known("column", [name], self.table.column_names)
        return np.array(self.table.column(name).to_numpy(zero_copy_only=False))  # arrow memory is read-only

    def labels(self, task: str, *splits: str) -> np.ndarray:
        """Return int64 labels [N] of ``task``; -1 if a row has none or is excluded by ``Task.only``.

        With ``splits``, labels of rows in other splits (column ``Task.split``) are -1, too.
        """
        tasks = {t.name: t for t in self.spec.tasks}
        check_known("task", [task], tasks)
        return self._known(tasks[task], splits, lambda: self.column(f"label_{task}").astype(np.int64), -1)

    def values(self, task: ValueTask, *splits: str) -> np.ndarray:
        """Return float64 values [N, T] of the targets of ``task``; NaN if not measured or excluded by ``task.only``.

        With ``splits``, values of rows in other splits (column ``ValueTask.split``) are NaN, too.
        """
        names = [target.name for target in task.targets]
        return self._known(task, splits, lambda: np.stack([self.column(n).astype(float) for n in names], 1), np.nan)

    def _known(self, task: AnyTask, splits: tuple[str, ...], read: Callable[[], np.ndarray], fill: float) -> np.ndarray:
        """What ``read`` returns, with ``fill`` in rows that are not of the task or not in ``splits``, if any."""
        if (key := (repr(task), *splits)) not in self._answers:
            known = read()
            for name, value in task.only.items():
                known[self.column(name).astype(str) != value] = fill
            if splits:
                known[~np.isin(self.column(task.split), splits)] = fill
            self._answers[key] = known
        return self._answers[key].copy()  # callers may change it

    def answered(self, task: AnyTask, *splits: str) -> np.ndarray:
        """Return bool [N], which rows (of ``splits``) have a label, or a value of at least one target."""
        if isinstance(task, ValueTask):
            return np.asarray(np.isfinite(self.values(task, *splits)).any(axis=1))
        return self.labels(task.name, *splits) >= 0

    @functools.cached_property
    def _answers(self) -> dict[tuple[str, ...], np.ndarray]:
        return {}

    def has(self, modality: str) -> np.ndarray:
        """Return bool [N]: which rows have an image of ``modality``. The images of the others are zeros: do not use them."""
        name = f"has_{modality}"
        return self.column(name) if name in self.table.column_names else np.ones(self.num, bool)

    @functools.cached_property
    def whole(self) -> np.ndarray:
        """bool [N], rows with an image of every modality of their dataset."""
        return np.logical_and.reduce([self.has(modality) for modality in self.spec.modalities])

    def rows(
        self, *splits: str, only: dict[str, str] | None = None, having: Sequence[str] = (), by: str = "split"
    ) -> np.ndarray:
        """Return row numbers, ascending int64. Without ``by``, rows that are ``hidden`` are left out.

        Args:
            only: Column -> value that a row must have.
            having: Modalities of which a row must have an image.
            by: Column with the split.
        """
        mask = np.isin(self.column(by), splits)
        if by == "split":
            mask &= ~self.hidden
        for modality in having:
            mask &= self.has(modality)
        for name, value in (only or {}).items():
            mask &= self.column(name).astype(str) == value
        return np.flatnonzero(mask)

    def with_splits(self, splits: "Mapping[str, Iterable[str]]") -> "Pack":
        """This pack with other cells in columns of splits."""
        made = copy.copy(self)
        for cached in ("_answers", "hidden"):  # of the other split
            made.__dict__.pop(cached, None)
        for name, cells in splits.items():
            column = pa.array(list(cells), pa.string())
            made.table = made.table.set_column(made.table.schema.get_field_index(name), name, column)
        return made

    @functools.cached_property
    def touch_groups(self) -> np.ndarray:
        """int64 [N], number of each row's touch group (column touch_group, else group): its rows are near-duplicates."""
        name = "touch_group" if "touch_group" in self.table.column_names else "group"
        return np.unique(self.column(name).astype(str), return_inverse=True)[1]

    @property
    def own_ids(self) -> np.ndarray:
        """The rows' ids as text [N], as in the pack they are from."""
        return self.column("id").astype(str)

    @functools.cached_property
    def hidden(self) -> np.ndarray:
        """bool [N], rows of val and test that are labelled only for a task with a split of its own.

        In this split only that task may see them (Touch and Go's official split: frames that only the rough lists name).
        """
        shared, others = ([t for t in self.spec.all_tasks if (t.split == "split") == same] for same in (True, False))
        if not shared or not others:
            return np.zeros(self.num, bool)
        seen, alone = (np.any([self.answered(task) for task in some], axis=0) for some in (shared, others))
        return np.isin(self.column("split"), ("val", "test")) & alone & ~seen

    @functools.cached_property
    def phased(self) -> bool:
        """Whether rows of a touch group show the phases of a grasp (column phase), not repeated touches or frames."""
        return "phase" in self.table.column_names and set(self.column("phase").astype(str)) <= set(PHASES)

    @functools.cached_property
    def presses(self) -> np.ndarray:
        """int64 [N], number of each row's press: of one spot, through several sensors. ValueError without that column."""
        if "press" not in self.table.column_names:
            raise ValueError("the table has no column press: simulate with --data.sensors-per-press 2")
        return np.unique(self.column("press").astype(str), return_inverse=True)[1]

    @functools.cached_property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the touch sensors (column sensor), sorted. Without the column, all rows are of one sensor."""
        if "sensor" not in self.table.column_names:
            return (self.spec.name,)
        return tuple(np.unique(self.column("sensor").astype(str)).tolist())

    @functools.cached_property
    def sensors(self) -> np.ndarray:
        """int64 [N], number of each row's touch sensor in ``sensor_names``."""
        if "sensor" not in self.table.column_names:
            return np.zeros(self.num, np.int64)
        return np.searchsorted(self.sensor_names, self.column("sensor").astype(str))

    @functools.cached_property
    def _rows_by(self) -> dict[str, list[np.ndarray]]:
        return {}

    def rows_of(self, number: int, of: Literal["touch_groups", "presses"] = "touch_groups") -> np.ndarray:
        """Return the row numbers of a touch group (or press), ascending."""
        if of not in self._rows_by:
            numbers = getattr(self, of)
            self._rows_by[of] = np.split(np.argsort(numbers, kind="stable"), np.cumsum(np.bincount(numbers))[:-1])
        return self._rows_by[of][number]

    def _check_digest(self, name: str) -> None:
        if digest_file(self._file(name)) != self.digests[name]:
            raise ValueError(f"{self.path / name} does not match its digest: the pack is damaged, make it again")

    def _file(self, name: str) -> Path:
        path = self.path / name
        if not path.is_file():
            raise ValueError(f"{path} is missing: the pack is damaged, make it again")
        return path

    def _shape(self, modality: str, num: int) -> tuple[int, int, int, int]:
        return num, self.size, self.size, self.spec.channels(modality)

    def _opened(self, modality: str, path: Path) -> Images:
        expected = self._shape(modality, self.num)
        try:
            if self.store == "jpeg":
                return Jpegs(path, expected, self.column(f"bytes_{modality}"))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about damaged headers
                images = np.load(path, mmap_mode="r", allow_pickle=False)
            if images.shape != expected or images.dtype != np.uint8:
                raise ValueError(f"it holds {images.dtype} {images.shape}, pack.json promises uint8 {expected}")
            if (rest := path.stat().st_size - images.nbytes) != images.offset:  # else a sparse file is hashed for hours
                raise ValueError(f"it has {rest} bytes beside its images, not {images.offset}")
            return images
        except Exception as error:  # numpy raises many kinds for a damaged header
            raise ValueError(f"{path} cannot be mapped ({brief(error)}): the pack is damaged, make it again") from None
