"""Writes a pack as a LeRobotDataset v3 that the lerobot library opens (the layout is in ``reader.py``).

Images are embedded as PNG, without loss. An episode is a touch group; timestamps are nominal (``fps``).
"""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from mvitac.data.pack import Pack
from mvitac.datasets.lerobot.reader import RENAMED, VERSION
from mvitac.system.files import write_json
from mvitac.system.locks import new_folder

ROWS_PER_GROUP = 100  # rows per parquet row group, which is the smallest unit of reading
FILE_BYTES = 100 << 20  # size after which the next data file begins, as in lerobot
FILES_PER_CHUNK = 1000
TAKEN = {"timestamp", "task_index", "task", *RENAMED, *RENAMED.values()}
"""Column names reserved by the format or by our reader; a pack column of such a name is renamed."""
NUM_FOR_STATS = 256  # number of images used for mean and standard deviation
ONE_FILE = "chunk-000/file-000.parquet"
KINDS = {
    "int64": (pa.int64(), pa.types.is_integer),
    "bool": (pa.bool_(), pa.types.is_boolean),
    "float64": (pa.float64(), pa.types.is_float64),
    "float32": (pa.float32(), pa.types.is_floating),
}
"""lerobot's name of a type of numbers -> arrow's type, and whether a column of a pack has it; all others are text."""


def check_fps(fps: float) -> None:
    """Raise ValueError unless a LeRobotDataset can have this rate."""
    if not (1 <= fps <= 1000 and fps == int(fps)):
        raise ValueError(f"fps {fps:g}: give the nominal rate, a whole number from 1 to 1000")


def write_lerobot(pack: Pack, out: Path, *, fps: int = 10) -> int:
    """Write the rows of ``pack`` that have every modality to the new folder ``out``, and return their number.

    Raises Busy if another process writes ``out``; ValueError if it exists, cannot be written, or no row has every
    modality.
    """
    check_fps(fps)
    rows = pack.rows("train", "val", "test", "unlabelled", having=pack.spec.modalities)
    if not len(rows):
        raise ValueError(f"{pack.path} has no row with all of {', '.join(pack.spec.modalities)}: nothing to write")
    rows = rows[np.argsort(pack.touch_groups[rows], kind="stable")]
    _, starts, lengths = np.unique(pack.touch_groups[rows], return_index=True, return_counts=True)
    ends = starts + lengths
    with new_folder(out) as partial:
        features = _features(pack)
        homes = _write_data(pack, rows, starts, ends, fps, partial, features)
        _write_episodes(pack, partial, starts, ends, homes)
        _write_tasks(pack, partial)
        write_json(partial / "meta" / "stats.json", _stats(pack, rows, starts, fps))
        write_json(partial / "meta" / "info.json", _info(len(rows), len(starts), fps, features))
    return len(rows)


def _info(num_rows: int, num_episodes: int, fps: int, features: dict[str, Any]) -> dict[str, Any]:
    return {
        "codebase_version": VERSION,
        "robot_type": "unknown",
        "total_episodes": num_episodes,
        "total_frames": num_rows,
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": FILE_BYTES >> 20,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{num_episodes}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }


def _cameras(pack: Pack) -> dict[str, tuple[str, int]]:
    """Return camera key -> modality and first channel."""
    keys = {"observation.images.vision": ("vision", 0)} if pack.spec.vision_channels else {}
    if pack.spec.touch_channels == 3:
        keys["observation.images.touch"] = ("touch", 0)
    else:
        names = ("touch_left", "touch_right", *(f"touch_{k}" for k in range(2, pack.spec.touch_channels // 3)))
        for k in range(pack.spec.touch_channels // 3):
            keys[f"observation.images.{names[k]}"] = ("touch", 3 * k)
    return keys


def _carried(pack: Pack) -> dict[str, tuple[str, str]]:
    """Return feature -> table column and lerobot's name of its type.

    Columns about the pack's image files (checksums, lengths, has_<modality>) and names with a / are left out.
    """
    own = {f"{kind}_{modality}" for kind in ("crc", "bytes") for modality in pack.spec.modalities}
    carried: dict[str, tuple[str, str]] = {}
    for field in pack.table.schema:
        if field.name in own or "/" in field.name or field.name.startswith("has_"):
            continue
        name, kind = field.name, field.type
        while name in TAKEN or (name != field.name and name in pack.table.column_names):
            name += "_in_pack"
        carried[name] = (field.name, next((dtype for dtype, (_, has) in KINDS.items() if has(kind)), "string"))
    return carried


def _features(pack: Pack) -> dict[str, Any]:
    image = {"dtype": "image", "shape": [pack.size, pack.size, 3], "names": ["height", "width", "channels"]}
    indices = dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    carried = {name: kind for name, (_, kind) in _carried(pack).items()}
    scalars = {**carried, "timestamp": "float32", **indices}
    units = {target.name: [f"{target.name} ({target.unit})"] for task in pack.spec.values for target in task.targets}
    return {
        **dict.fromkeys(_cameras(pack), image),
        **{name: {"dtype": kind, "shape": [1], "names": units.get(name)} for name, kind in scalars.items()},
    }


def _write_data(
    pack: Pack, rows: np.ndarray, starts: np.ndarray, ends: np.ndarray, fps: int, out: Path, features: dict[str, Any]
) -> list[tuple[int, int]]:
    """Write the data files; return (chunk, file) of each episode, which is in a single file."""
    picture = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    kinds = {"string": pa.string(), "image": picture, **{name: kind for name, (kind, _) in KINDS.items()}}
    schema = pa.schema([(name, kinds[feature["dtype"]]) for name, feature in features.items()])
    homes: list[tuple[int, int]] = []
    writer: pq.ParquetWriter | None = None
    number, written = -1, 0
    try:
        for episode, (start, end) in enumerate(zip(starts, ends, strict=True)):
            if writer is None or written > FILE_BYTES:
                if writer:
                    writer.close()
                number, written = number + 1, 0
                path = out / f"data/chunk-{number // FILES_PER_CHUNK:03d}/file-{number % FILES_PER_CHUNK:03d}.parquet"
                path.parent.mkdir(parents=True, exist_ok=True)
                writer = pq.ParquetWriter(path, schema)
            homes.append(divmod(number, FILES_PER_CHUNK))
            for table in _tables(pack, rows, int(start), int(end), episode, fps, schema):
                writer.write_table(table, row_group_size=ROWS_PER_GROUP)
                written += table.nbytes
    finally:
        if writer:
            writer.close()
    return homes


def _tables(
    pack: Pack, rows: np.ndarray, start: int, end: int, episode: int, fps: int, schema: pa.Schema
) -> Iterator[pa.Table]:
    """Yield the rows ``start`` to ``end`` (one episode) in pieces that fit into memory."""
    for first in range(start, end, ROWS_PER_GROUP):
        piece = np.arange(first, min(first + ROWS_PER_GROUP, end))
        columns: dict[str, Any] = {
            key: [{"bytes": _png(pack.images[m][row, :, :, c : c + 3]), "path": None} for row in rows[piece]]
            for key, (m, c) in _cameras(pack).items()
        }
        for name, (column, kind) in _carried(pack).items():
            values = pack.table.column(column).take(pa.array(rows[piece])).to_pylist()
            columns[name] = ["" if value is None else str(value) for value in values] if kind == "string" else values
        columns["timestamp"] = (piece - start) / fps
        columns["frame_index"] = piece - start
        columns["episode_index"] = np.full(len(piece), episode)
        columns["index"] = piece
        columns["task_index"] = np.zeros(len(piece), np.int64)
        yield pa.table({name: pa.array(columns[name], schema.field(name).type) for name in schema.names}, schema)


def _png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def _write_episodes(pack: Pack, out: Path, starts: np.ndarray, ends: np.ndarray, homes: list[tuple[int, int]]) -> None:
    num = len(starts)
    table = pa.table(
        {
            "episode_index": pa.array(range(num), pa.int64()),
            "tasks": pa.array([[_task(pack)]] * num, pa.list_(pa.string())),
            "length": pa.array(ends - starts, pa.int64()),
            "data/chunk_index": pa.array([chunk for chunk, _ in homes], pa.int64()),
            "data/file_index": pa.array([file for _, file in homes], pa.int64()),
            "dataset_from_index": pa.array(starts, pa.int64()),
            "dataset_to_index": pa.array(ends, pa.int64()),
            "meta/episodes/chunk_index": pa.array([0] * num, pa.int64()),
            "meta/episodes/file_index": pa.array([0] * num, pa.int64()),
        }
    )
    path = out / "meta/episodes" / ONE_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _task(pack: Pack) -> str:
    return f"touch what is seen ({pack.spec.name})"


def _write_tasks(pack: Pack, out: Path) -> None:
    """Write the only task. Its text is the index of the pandas data frame that lerobot reads."""
    index = "__index_level_0__"
    column = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None, "name": "task_index"}
    column = {**column, "field_name": "task_index"}
    text = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None, "name": None, "field_name": index}
    note = {"index_columns": [index], "column_indexes": [], "columns": [column, text], "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array([0], pa.int64()), index: pa.array([_task(pack)])})
    pq.write_table(table.replace_schema_metadata({b"pandas": json.dumps(note).encode()}), out / "meta/tasks.parquet")


def _stats(pack: Pack, rows: np.ndarray, starts: np.ndarray, fps: int) -> dict[str, Any]:
    """Return min, max, mean, std and count per feature; of images per channel in [0, 1], from evenly spaced rows."""
    some = rows[np.unique(np.linspace(0, len(rows) - 1, NUM_FOR_STATS).astype(int))]
    stats = {}
    for key, (modality, channel) in _cameras(pack).items():
        images = pack.images[modality][some][..., channel : channel + 3].astype(np.float32) / 255
        stats[key] = _summary(images, (0, 1, 2), (3, 1, 1))
    places = np.arange(len(rows))
    episodes = np.searchsorted(starts, places, side="right") - 1
    numbers = {name: pack.column(c)[rows] for name, (c, kind) in _carried(pack).items() if kind != "string"}
    numbers |= {"index": places, "episode_index": episodes, "frame_index": places - starts[episodes]}
    numbers |= {"timestamp": numbers["frame_index"] / fps, "task_index": np.zeros(len(rows))}
    for name, values in numbers.items():
        measured = np.asarray(values, float)
        if len(measured := measured[~np.isnan(measured)]):
            stats[name] = _summary(measured, (0,), (1,))
    return stats


def _summary(values: np.ndarray, axes: tuple[int, ...], shape: tuple[int, ...]) -> dict[str, Any]:
    found = {name: getattr(values, name)(axis=axes) for name in ("min", "max", "mean", "std")}
    stats = {name: value.astype(float).reshape(shape).tolist() for name, value in found.items()}
    return {**stats, "count": [len(values)]}
