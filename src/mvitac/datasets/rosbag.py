"""``--data rosbag``: ROS bags with image topics, and numbers of other topics at their time.

    grasp_1/metadata.yaml  grasp_1_0.mcap or .db3        ROS 2; grasp_1.bag of ROS 1 is read, too

A topic of images (sensor_msgs Image, CompressedImage) is named as ``vision`` or ``touch``. A column is a topic, a dot and
the path of a field, e.g. /wrench.wrench.force.z. Each bag is a recording. Topics are joined by the time in the headers, or
when a message was received where that is 0.
"""

from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from tyro.conf import Fixed

from mvitac.data.images import ros_pixels
from mvitac.datasets.table.clocks import check_moves, joined, nearest
from mvitac.datasets.table.columns import element_of
from mvitac.datasets.table.folders import recording_row
from mvitac.datasets.table.image_refs import ImageRef, Refs
from mvitac.datasets.table.manifest import Manifest, Row, text_of
from mvitac.datasets.table.table import RecordedConfig
from mvitac.registry import unknown
from mvitac.system.files import brief, check_ordinary, walk


@dataclass(frozen=True, kw_only=True)
class RosbagConfig(RecordedConfig):
    """Bags of ROS 2 (mcap, db3) or ROS 1: image topics, joined with each other and with numbers by time."""

    name: ClassVar[str] = "rosbag"

    path: Path = Path("bag")
    """Folder of a bag (with metadata.yaml), a .bag, or a folder of these."""
    vision: str | None = None
    """Topic of camera images."""
    touch: tuple[str, ...] = ()
    """Topic of tactile images, or two to stack. Its images (or else those of vision) are the rows."""
    every: int | None = 5
    allow_missing: Fixed[bool] = False
    """A row has every image."""
    group: str | None = "recording"

    @classmethod
    def reads(cls, path: Path) -> bool:
        return path.suffix == ".bag" or any(any(path.glob(f)) for f in ("metadata.yaml", "*/metadata.yaml", "*.bag"))

    def manifest(self) -> Manifest:
        path, alone = self.path, self.path.suffix == ".bag" or (self.path / "metadata.yaml").is_file()
        bags = [path] if alone else []
        if not alone and path.is_dir():
            found = sorted(walk(path))
            ros2 = (file.parent for file in found if file.name == "metadata.yaml")
            bags = sorted([*ros2, *(file for file in found if file.suffix == ".bag")])
            for file in (file for file in found if file.name.endswith((".mcap", ".db3", ".bag.active"))):
                if file.parent not in bags:
                    raise ValueError(f"{file} was not closed (no metadata.yaml): ros2 bag reindex, or rosbag reindex")
        if not bags:
            raise ValueError(f"{path} is no bag and holds none: give a folder with metadata.yaml, a .bag, or several")
        cameras = [topic for topic in (*self.touch, self.vision) if topic]
        used = *self.labels, *self.numbers(), *self.conditioned(), self.group, self.touch_group, self.split, self.sensor
        smooth, every = self.smooth(), self.every or 1
        rows: list[Row] = []
        images: Refs = {topic: [] for topic in cameras}
        dropped, same = 0, Counter[str]()
        for bag in bags:
            seen = _read(bag, cameras, [name for name in dict.fromkeys(used) if name])
            if not len(own := seen[cameras[0]][0][::every]):
                raise ValueError(f"{bag} has no image of {cameras[0]}: is it complete?")
            good = np.ones(len(own), bool)
            cells: list[Row] = [{} for _ in own]
            at: dict[str, list[Any]] = {}
            for topic, (times, found) in seen.items():
                check_moves(times, f"{bag}, topic {topic}")
                same[topic] += len(times) - len(np.unique(times))
                if topic in cameras:
                    index, away = nearest(times, own)
                    if topic == cameras[0]:  # several may have one stamp
                        index = np.arange(len(own)) * every
                    good &= away <= self.tolerance
                    at[topic] = [found[i] for i in index] if len(times) else []
                    continue
                joins, _ = joined(Manifest.of(bag, found), times, own, smooth, self.tolerance)
                good &= np.array([bool(row) for row in joins], bool)
                cells = [{**known, **row} for known, row in zip(cells, joins, strict=True)]
            if not good.any():
                spans = "; ".join(f"{topic} {t[0]:.3f} to {t[-1]:.3f} s" for topic, (t, _) in seen.items() if len(t))
                raise ValueError(f"{bag} has no image with all others within {self.tolerance:g} s: {spans}")
            dropped += int((~good).sum())
            name = bag.relative_to(self.path).as_posix() if bag != self.path else bag.resolve().name
            for i in np.flatnonzero(good).tolist():
                rows.append(recording_row(name, i * every, float(own[i])) | cells[i])
                for topic in cameras:
                    images[topic].append(Message(str(bag), topic, *at[topic][i]))
        note = f"topics are joined by time within {self.tolerance:g} s; {dropped} images without all others left out"
        stamps = (f"; {num} messages of {topic} have the stamp of another" for topic, num in (+same).items())
        return Manifest.of(self.path, rows, images, group="recording", notes=("".join([note, *stamps]),))


@contextmanager
def _opened(bag: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError:
        raise ValueError(f"{bag} needs rosbags: pip install 'mvitac[rosbags]'") from None
    for file in [bag] if bag.is_file() else walk(bag):
        check_ordinary(file)  # a pipe never ends
        if file.suffix == ".db3" and file.stat().st_size % 512:  # less than its least page: sqlite would read zeros
            raise ValueError(f"{file} is cut off: fetch it again")
    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except Exception as error:  # rosbags and what it reads with have no common base class
        if isinstance(error, ValueError | OSError) and not isinstance(error, UnicodeError):
            raise
        raise ValueError(f"{bag} cannot be read as a bag ({brief(error)}): is it complete?") from None


def _read(bag: Path, cameras: Sequence[str], asked: Sequence[str]) -> dict[str, tuple[np.ndarray, list[Any]]]:
    """Return topic -> ascending times in seconds, with the place of each message (images) or its fields."""
    with _opened(bag) as reader:
        topics = {connection.topic: connection.msgtype for connection in reader.connections}
        if not cameras:
            shown = [topic for topic, kind in topics.items() if kind.endswith("Image")]
            raise ValueError(f"{bag} has image topics {', '.join(shown) or 'none'}: --data.vision, --data.touch TOPIC")
        if not topics:
            raise ValueError(f"{bag} is empty: leave it out")
        for topic in cameras:
            if topic not in topics:
                raise ValueError(f"{bag}: {unknown('topic', topic, topics)}")
            if not topics[topic].endswith("Image"):
                raise ValueError(f"{bag}: {topic} is of {topics[topic]}, no images")
        for name in asked:
            if name.startswith(tuple(f"{topic}." for topic in cameras)):
                raise ValueError(f"{name} is of a topic of images, which has no columns")
        fields = {t: [name for name in asked if name.startswith(f"{t}.")] for t in sorted(topics) if t not in cameras}
        used = [*cameras, *(topic for topic in fields if fields[topic])]
        found: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in used}
        asked_for = [c for c in reader.connections if c.topic in found]
        for connection, place, raw in _placed(reader.messages(asked_for)):
            received = place[0]
            topic, message = connection.topic, reader.deserialize(raw, connection.msgtype)
            stamp = getattr(getattr(message, "header", None), "stamp", None)
            time = 1e-9 * received if stamp is None else stamp.sec + 1e-9 * stamp.nanosec
            row = {name: _field(message, name[len(topic) + 1 :], f"{bag}, {topic}") for name in fields.get(topic, ())}
            found[topic].append((time or 1e-9 * received, row or place))
        for topic, each in found.items():
            if len(each) != (num := sum(c.msgcount for c in asked_for if c.topic == topic)):
                raise ValueError(f"{bag} has {len(each)} of {num} messages of {topic}: fetch it again, or reindex it")
    ordered = {topic: sorted(each, key=lambda one: one[0]) for topic, each in found.items()}
    return {topic: (np.array([time for time, _ in each]), [v for _, v in each]) for topic, each in ordered.items()}


def _placed(messages: Iterator[Any]) -> Iterator[tuple[Any, tuple[int, int], Any]]:
    """Messages with when they were received in ns, and their number among those of the topic in the same ns."""
    last: dict[str, tuple[int, int]] = {}
    for connection, received, raw in messages:
        if not isinstance(received, int):  # columns of SQLite have no types
            raise TypeError(f"{received!r} is no time stamp")
        stamp, number = last.get(connection.topic, (received, -1))
        last[connection.topic] = place = (received, number + 1 if stamp == received else 0)
        yield connection, place, raw


def _field(message: Any, path: str, where: str) -> str:
    for name in path.split("."):
        vector, number = element_of(name)
        try:
            message = getattr(message, vector)[number] if vector else getattr(message, name)
        except (AttributeError, TypeError, IndexError):
            known = vars(message) if hasattr(message, "__dict__") else ()
            raise ValueError(f"{where}: a message has no field {path}: {unknown('field', name, known)}") from None
    return text_of(message)


@dataclass(frozen=True, slots=True, order=True)
class Message(ImageRef):
    """Message ``number`` (from 0) of those of ``topic`` received at ``stamp`` (ns) in the bag ``path``."""

    topic: str
    stamp: int
    number: int = 0

    def __str__(self) -> str:
        return f"{self.path} {self.topic} at {self.stamp} ns" + f", number {self.number}" * bool(self.number)

    def container(self) -> Hashable:
        return (self.path, self.topic)

    @contextmanager
    def opened(self) -> Iterator[tuple[Any, Iterator[Any]]]:
        with _opened(Path(self.path)) as reader:
            own = [connection for connection in reader.connections if connection.topic == self.topic]
            yield reader, _placed(reader.messages(own, start=self.stamp))

    def stored(self, container: tuple[Any, Iterator[Any]]) -> bytes | np.ndarray:
        reader, messages = container
        found = next((found for found in messages if found[1] == (self.stamp, self.number)), None)
        if not found:
            raise ValueError(f"{self} is not found again: its files are not in the order of time, reindex the bag")
        connection, _, raw = found
        return ros_pixels(reader.deserialize(raw, connection.msgtype), str(self))
