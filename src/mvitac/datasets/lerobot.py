"""``--data lerobot``: a LeRobotDataset folder, v3 (https://huggingface.co/docs/lerobot/lerobot-dataset-v3) or v2.

    meta/info.json                                   version, fps, path templates, features (dtype video, image, int64, ...)
    meta/tasks.parquet                               task text -> task_index
    meta/episodes/chunk-000/file-000.parquet         per episode: index, and for each camera video/<key>/{chunk_index,
                                                     file_index, from_timestamp}: several episodes share one file
    data/chunk-000/file-000.parquet                  per frame: timestamp within its episode, episode_index, features
    videos/<camera key>/chunk-000/file-000.mp4

Version 2 has a file per episode, data/chunk-000/episode_000000.parquet and videos/chunk-000/<camera key>/episode_000000.mp4,
and meta/tasks.jsonl.
"""

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mvitac.data.stamps import number_of
from mvitac.data.video import frame_times
from mvitac.datasets.table.clocks import nearest
from mvitac.datasets.table.image_refs import Frame, ImageRef, Refs
from mvitac.datasets.table.manifest import READERS, Manifest, Row
from mvitac.datasets.table.parquet import add_file
from mvitac.datasets.table.table import RecordedConfig
from mvitac.registry import unknown
from mvitac.system.files import brief, check_ordinary, fields_of, read_json

FELT = re.compile(r"touch|tactile|gelsight|digit(?!al)|gel\b|finger", re.IGNORECASE)  # usual names of tactile cameras
RENAMED = {"episode_index": "episode", "frame_index": "frame", "index": "id"}
"""Columns of the format -> names in a pack."""


@dataclass(frozen=True, kw_only=True)
class LeRobotConfig(RecordedConfig):
    """A LeRobotDataset (v3, v2) on disk: cameras as vision and touch, paired by time."""

    name: ClassVar[str] = "lerobot"

    path: Path = Path("dataset")
    """Folder of the dataset, with meta/info.json."""
    vision: str | None = None
    """Camera key, e.g. observation.images.front; default: the first one that is not tactile by its name; "" = none."""
    touch: tuple[str, ...] = ()
    """Camera key, or two to stack; default: those with touch, tactile, gelsight, digit or finger in their name."""
    tolerance: float = 0.04
    """Largest allowed time difference between a row and its video frame, in seconds."""
    every: int | None = 1
    group: str | None = "episode"

    @classmethod
    def reads(cls, path: Path) -> bool:
        return (path / "meta" / "info.json").is_file()

    def manifest(self) -> Manifest:
        info = _info(self.path)
        cameras = [key for key, feature in info["features"].items() if feature["dtype"] in ("video", "image")]
        names = choose(cameras, self.vision, self.touch, self.path)
        embedded = [key for key in names.values() if info["features"][key]["dtype"] == "image"]
        episodes = _episodes(self.path, info)
        rows, cells, notes = self._table(info, episodes, embedded)
        videos = {key: self._in_videos(info, key, rows, episodes) for key in names.values() if key not in cells}
        found: Refs = {column: {**cells, **videos}[key] for column, key in names.items()}
        return Manifest.of(self.path, rows, found, group="episode", notes=notes)

    def _table(
        self, info: dict[str, Any], episodes: dict[str, dict[str, Any]], embedded: Sequence[str]
    ) -> tuple[list[Row], Refs, tuple[str, ...]]:
        """Return the table rows as text, the references of ``embedded`` images, and a note if rows are lacking."""
        tasks, rows, cells = _tasks(self.path, info), list[Row](), Refs()
        for file in sorted((self.path / "data").glob("*/[!.]*.parquet")):
            num = len(rows)
            add_file(file, rows, cells, self.vectors(), embedded)
            for name in sorted(rows[0].keys() - rows[num].keys() if rows[num:] else ()):
                raise ValueError(f"{file} has no column {name!r}: fetch the whole dataset")
        for name in ("timestamp", "episode_index", "frame_index", *embedded):
            if name not in ({**rows[0], **cells} if rows else {}):
                raise ValueError(f"{self.path / 'data'} has no column {name!r}: fetch the whole dataset")
        _check(self.path, rows, episodes)
        kept = [i for i, row in enumerate(rows) if int(row["frame_index"]) % (self.every or 1) == 0]
        named = [{RENAMED.get(name, name): cell for name, cell in rows[i].items()} for i in kept]
        for row in named if tasks and "task_index" in rows[0] else ():
            if row["task_index"] not in tasks:
                raise ValueError(f"{self.path}: meta/tasks has no task_index {row['task_index']}: fetch it again")
            row["task"] = tasks[row["task_index"]]
        few = f"meta/info.json counts {info.get('total_frames')} frames, {len(rows)} are here"
        notes = (few,) if info.get("total_frames", len(rows)) != len(rows) else ()
        return named, {key: [refs[i] for i in kept] for key, refs in cells.items()}, notes

    def _in_videos(
        self, info: dict[str, Any], key: str, rows: Sequence[Row], episodes: dict[str, dict[str, Any]]
    ) -> list[ImageRef | None]:
        """Return the frame of camera ``key`` at each row's time; None if no frame is near enough."""
        is_new = info["codebase_version"].startswith("v3")
        wanted: dict[str, list[int]] = {}
        for i, row in enumerate(rows):
            wanted.setdefault(row["episode"], []).append(i)
        times: dict[Path, np.ndarray] = {}
        used: dict[Path, list[tuple[float, float, str]]] = {}
        places: list[ImageRef | None] = [None] * len(rows)
        for name, numbers in wanted.items():
            number = int(name)
            episode = episodes.get(name, {}) if is_new else {f"videos/{key}/from_timestamp": 0.0}
            if episode.get(f"videos/{key}/from_timestamp") is None:
                raise ValueError(f"{self.path}: meta/episodes has no entry for {key} in episode {name}")
            where = f"{self.path}: meta/info.json or meta/episodes, {key} in episode {name},"
            place = {part: episode.get(f"videos/{key}/{part}") for part in ("chunk_index", "file_index")}
            with fields_of(where):
                place |= {"episode_index": number, "episode_chunk": number // info.get("chunks_size", 1000)}
                if re.search(r"[{}]", re.sub(r"\{\w+(:0?\d?d)?\}", "", info["video_path"])):  # a width can fill memory
                    raise ValueError(f"video_path is {info['video_path']}, not of fields such as {{file_index:03d}}")
                file = self.path / info["video_path"].format(video_key=key, **place)
                if not Path(os.path.normpath(file)).is_relative_to(os.path.normpath(self.path)):
                    raise ValueError(f"video_path leads out of the dataset, to {file}")
                start, end = episode[f"videos/{key}/from_timestamp"], episode.get(f"videos/{key}/to_timestamp")
                if not -1e-3 <= start < np.inf:
                    raise ValueError(f"{where} begins at {start} s: fetch it again")
                low, high = start - 1e-3, (np.inf if end is None else end) - 1e-3
            used.setdefault(file, []).append((low, high, name))
            if file not in times:
                if not file.is_file():
                    raise ValueError(f"{file} is missing: fetch the videos too, or leave {key} out")
                times[file] = frame_times(file)
            # One file has several episodes: the nearest frame must be of the same episode.
            low, high = np.searchsorted(times[file], [low, high])
            when = start + np.array([float(rows[i]["timestamp"]) for i in numbers])
            at, away = nearest(times[file][low:high], when)
            for i, frame, miss, moment in zip(numbers, (low + at).tolist(), away.tolist(), when.tolist(), strict=True):
                if miss <= self.tolerance:
                    places[i] = Frame(str(file), frame)
                elif not self.allow_missing:
                    far = f"{file}: no frame within {self.tolerance:g} s of {moment:.3f} s (episode {name}, the nearest is"
                    raise ValueError(f"{far} {miss:.3f} s away): --data.tolerance, or --data.allow-missing")
        for file, parts in used.items():
            for (_, end, one), (start, _, other) in pairwise(sorted(parts)):
                if start < end - 2e-3:
                    two = f"episodes {one} and {other} share frames of {file}"
                    raise ValueError(f"{self.path}: by meta/episodes, {two}")
        return places


def choose(cameras: Sequence[str], vision: str | None, touch: tuple[str, ...], where: Path) -> dict[str, str]:
    """Return column -> camera key: requested keys by their own name, guessed ones as vision, touch, left and right."""
    felt = [key for key in cameras if FELT.search(key) and key != vision]
    for key in (*touch, vision):
        if key and key not in cameras:
            raise ValueError(f"{where}: {unknown('camera', key, cameras)}")
    names: dict[str, str] = {key: key for key in touch if key}
    if not touch and len(felt) > 2:
        raise ValueError(f"{where} has {len(felt)} cameras that may be touch ({', '.join(felt)}): choose by touch")
    if not touch and felt:
        names = dict(zip(("touch",) if len(felt) == 1 else ("left", "right"), felt, strict=True))
    if vision:
        names[vision] = vision
    elif vision is None and (left := [key for key in cameras if key not in (*felt, *touch)]):
        names["vision"] = left[0]
    if not names:
        raise ValueError(f"{where} has no cameras to choose from: features of dtype video or image are needed")
    return names


def _info(root: Path) -> dict[str, Any]:
    info = read_json(root / "meta" / "info.json", "a LeRobotDataset's description")
    version = str(info.get("codebase_version")) if isinstance(info, dict) else "none"
    if not version.startswith(("v2.", "v3.")):
        raise ValueError(f"{root} has LeRobotDataset version {version}: v2 and v3 are read")
    if not isinstance(info.get("features"), dict) or not all(
        isinstance(f, dict) and "dtype" in f for f in info["features"].values()
    ):
        raise ValueError(f"{root / 'meta/info.json'} lists no features: fetch it again")
    return info


def _episodes(root: Path, info: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return what meta/episodes says of each episode; nothing if version 2 lacks the file."""
    file = root / "meta" / ("episodes" if info["codebase_version"].startswith("v3") else "episodes.jsonl")
    with fields_of(file):
        return {str(each["episode_index"]): each for each in _rows(file, ("episode_index", "length", "videos/"))}


def _check(root: Path, rows: Sequence[Row], episodes: dict[str, dict[str, Any]]) -> None:
    """Raise ValueError unless frames and times rise in each episode, which has as many as meta/episodes says."""
    number, frame, time = (_numbers(root, rows, name) for name in ("episode_index", "frame_index", "timestamp"))
    order = np.lexsort((frame, number))
    for name, values in (("frame_index", frame), ("timestamp", time)):
        if (stands := (np.diff(values[order]) <= 0) & (np.diff(number[order]) == 0)).any():
            row = rows[order[np.argmax(stands) + 1]]
            where = f"{root / 'data'}: episode {row['episode_index']}, frame {row['frame_index']}"
            raise ValueError(f"{where}: {name} {row[name]} does not rise: fetch it again")
    for name, num in Counter(row["episode_index"] for row in rows).items():
        said = episodes.get(name, {}).get("length", num if name in episodes else "nothing")
        if episodes and said != num:
            raise ValueError(f"{root}: episode {name} has {num} rows, meta/episodes says {said}: fetch it again")


def _numbers(root: Path, rows: Sequence[Row], name: str) -> np.ndarray:
    values = np.array([number_of(row[name]) for row in rows], float)
    if not np.isfinite(values).all():
        i = int(np.argmin(np.isfinite(values)))
        raise ValueError(f"{root / 'data'}: {name} of row {i + 1} is {rows[i][name]!r}: fetch it again")
    return values


def _tasks(root: Path, info: dict[str, Any]) -> dict[str, str]:
    file = root / "meta" / ("tasks.parquet" if info["codebase_version"].startswith("v3") else "tasks.jsonl")
    with fields_of(file):
        pairs = [(str(row.pop("task_index")), row.popitem()[1]) for row in (_rows(file) if file.is_file() else [])]
        assert all(isinstance(text, str) for _, text in pairs), "a task that is no text"
    if len(tasks := dict(pairs)) < len({*pairs}):
        raise ValueError(f"{file} has a task_index with two texts: fetch it again")
    return tasks


def _rows(path: Path, begins: tuple[str, ...] = ("",)) -> list[dict[str, Any]]:
    """Return the rows of a .jsonl file, if there is one, or of parquet, of columns whose name ``begins`` so."""
    if path.suffix == ".jsonl":
        try:
            return READERS[".jsonl"](path) if path.is_file() else []
        except ValueError as error:
            raise ValueError(f"{path} cannot be read ({brief(error)}): fetch it again") from None
    try:
        check_ordinary(path)
        table = pq.read_table(path.absolute())
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"{path} cannot be read ({brief(error)}): fetch the whole dataset") from None
    return table.select([name for name in table.column_names if name.startswith(begins)]).to_pylist()
