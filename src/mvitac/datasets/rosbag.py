"""``--data rosbag``: ROS bags with image topics, and numbers of other topics at their time.

    grasp_1/metadata.yaml  grasp_1_0.mcap or .db3        ROS 2; grasp_1.bag of ROS 1 is read, too

A topic of images (sensor_msgs Image, CompressedImage) is named as ``vision`` or ``touch``. A column is a topic, a dot and
the path of a field, e.g. /wrench.wrench.force.z. Each bag is a recording. Topics are joined by the time in the headers, or
when a message was received where that is 0.
"""

import io
import math
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from PIL import Image

from mvitac.data.images import decode
from mvitac.datasets.table.clocks import joined, nearest
from mvitac.datasets.table.columns import element_of
from mvitac.datasets.table.folders import recording_row
from mvitac.datasets.table.image_refs import Damage, ImageRef, picture
from mvitac.datasets.table.manifest import Manifest, Row, text_of
from mvitac.datasets.table.table import RowsConfig
from mvitac.registry import check_range, unknown
from mvitac.system.files import brief

CHANNELS = {"mono": 1, "8UC1": 1, "16UC1": 1, "32FC1": 1, "bgr": 3, "rgb": 3, "8UC3": 3, "bgra": 4, "rgba": 4}


@dataclass(frozen=True, kw_only=True)
class RosbagConfig(RowsConfig):
    """Bags of ROS 2 (mcap, db3) or ROS 1: image topics, joined with each other and with numbers by time."""

    name: ClassVar[str] = "rosbag"

    path: Path = Path("bag")
    """Folder of a bag (with metadata.yaml), a .bag, or a folder of these."""
    vision: str | None = None
    """Topic of camera images."""
    touch: tuple[str, ...] = ()
    """Topic of tactile images, or two to stack. Its images (or else those of vision) are the rows."""
    every: int = 5
    """Use every n-th image."""
    group: str | None = "recording"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, 1, math.inf, "every")

    @classmethod
    def reads(cls, path: Path) -> bool:
        return path.suffix == ".bag" or (path / "metadata.yaml").is_file()

    def unused(self) -> tuple[str, ...]:
        return tuple(name for name in super().unused() if name not in ("tolerance", "interpolate"))

    def manifest(self) -> Manifest:
        cameras = [topic for topic in (*self.touch, self.vision) if topic]
        asked = {
            *self.labels,
            *self.numbers(),
            *self.conditioned(),
            self.group,
            self.touch_group,
            self.split,
            self.sensor,
        }
        rows: list[Row] = []
        images: dict[str, list[ImageRef | None]] = {topic: [] for topic in cameras}
        dropped = 0
        for bag in _bags(self.path):
            seen = _read(bag, cameras, [name for name in asked if name])
            times, stamps = {t: np.array([time for time, _ in seen[t]]) for t in cameras}, {}
            for topic in cameras:
                order = np.argsort(times[topic], kind="stable")
                times[topic], stamps[topic] = times[topic][order], [seen[topic][i][1] for i in order]
            own = times[cameras[0]][:: self.every]
            at = {topic: nearest(times[topic], own) for topic in cameras}
            good = np.max([away for _, away in at.values()], axis=0) <= self.tolerance
            cells: list[Row] = [{} for _ in own]
            for topic in sorted(seen.keys() - set(cameras)):
                log = Manifest.of(bag, [row for _, row in seen[topic]])
                when = np.array([time for time, _ in seen[topic]])
                order = np.argsort(when, kind="stable")
                smooth = self.numbers() if self.interpolate == "linear" else ()
                found, _ = joined(log, order, when[order], own, smooth, self.tolerance)
                good &= np.array([bool(row) for row in found])
                cells = [{**known, **row} for known, row in zip(cells, found, strict=True)]
            dropped += int((~good).sum())
            name = bag.stem if bag != self.path else bag.resolve().stem
            for i in np.flatnonzero(good).tolist():
                rows.append(recording_row(name, i * self.every, float(own[i])) | cells[i])
                for topic in cameras:
                    images[topic].append(Message(str(bag), topic, stamps[topic][int(at[topic][0][i])]))
        note = (
            f"topics are joined by time within {self.tolerance:g} s; {dropped} images without all others are left out"
        )
        return Manifest.of(self.path, rows, images, content=sorted(images), notes=(note,))


def _bags(path: Path) -> list[Path]:
    found = [path] if (path / "metadata.yaml").is_file() or path.suffix == ".bag" else []
    if not found and path.is_dir():
        found = sorted([*(file.parent for file in path.rglob("metadata.yaml")), *path.rglob("*.bag")])
    if not found:
        raise ValueError(
            f"{path} is no bag and holds none: give a folder with metadata.yaml, a .bag, or a folder of them"
        )
    return found


def _open(bag: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError:
        raise ValueError(f"{bag} needs rosbags: pip install 'mvitac[rosbags]'") from None
    try:
        return AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
    except Exception as error:  # rosbags has no common base class
        raise ValueError(f"{bag} cannot be read as a bag ({brief(error)})") from None


def _read(bag: Path, cameras: Sequence[str], asked: Sequence[str]) -> dict[str, list[tuple[float, Any]]]:
    """Return topic -> time in seconds of each message, with when it was received in ns (images) or its fields."""
    with _open(bag) as reader:
        topics = {connection.topic: connection.msgtype for connection in reader.connections}
        if not cameras:
            shown = [topic for topic, kind in topics.items() if kind.endswith("Image")]
            raise ValueError(
                f"{bag} has the image topics {', '.join(shown) or 'none'}: --data.vision or --data.touch TOPIC"
            )
        for topic in cameras:
            if topic not in topics:
                raise ValueError(f"{bag}: {unknown('topic', topic, topics)}")
        wanted = {topic for topic in topics for name in asked if name.startswith(f"{topic}.")}
        found: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in (*cameras, *wanted)}
        for connection, received, raw in reader.messages([c for c in reader.connections if c.topic in found]):
            message = reader.deserialize(raw, connection.msgtype)
            stamp = getattr(getattr(message, "header", None), "stamp", None)
            time = 1e-9 * received if stamp is None else stamp.sec + 1e-9 * stamp.nanosec
            topic, fields = connection.topic, {}
            for name in asked if topic in wanted else ():
                if name.startswith(f"{topic}."):
                    fields[name] = _field(message, name.removeprefix(f"{topic}."))
            value = received if topic in cameras else fields
            found[topic].append((time or 1e-9 * received, value))
    return found


def _field(message: Any, path: str) -> str:
    for name in path.split("."):
        vector, number = element_of(name)
        if not hasattr(message, vector or name):
            raise ValueError(f"a message has no field {path}: {unknown('field', vector or name, vars(message))}")
        message = getattr(message, vector)[number] if vector else getattr(message, name)
    return text_of(message)


@dataclass(frozen=True, slots=True, order=True)
class Message(ImageRef):
    """The message of ``topic`` received at ``stamp`` (ns) in the bag ``path``."""

    topic: str
    stamp: int

    def __str__(self) -> str:
        return f"{self.path} {self.topic} at {self.stamp} ns"

    def container(self) -> Hashable:
        return (self.path, self.topic)

    @staticmethod
    def read(refs: Sequence[Any], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        at = {ref.stamp: ref for ref in refs}
        with _open(Path(refs[0].path)) as reader:
            own = [connection for connection in reader.connections if connection.topic == refs[0].topic]
            for connection, received, raw in reader.messages(own, start=min(at), stop=max(at) + 1):
                if ref := at.pop(received, None):
                    try:
                        yield ref, _image(reader.deserialize(raw, connection.msgtype), ref)
                    except ValueError as error:
                        lost[ref] = str(error)


def _image(message: Any, ref: ImageRef) -> Image.Image:
    if not hasattr(message, "encoding"):
        return decode(io.BytesIO(message.data.tobytes()), str(ref))
    code = message.encoding
    channels = CHANNELS.get(code) or CHANNELS.get(code.rstrip("168"), 0)
    kind = np.dtype(np.float32 if "32F" in code else np.uint16 if "16" in code else np.uint8)
    if not channels:
        raise ValueError(f"{ref} has the encoding {code}: {', '.join(CHANNELS)} are read")
    lines = message.data.view(kind.newbyteorder(">" if message.is_bigendian else "<")).reshape(message.height, -1)
    pixels = lines[:, : message.width * channels].reshape(message.height, message.width, channels)[:, :, :3]
    return picture(pixels[:, :, ::-1] if code.startswith("bgr") else pixels, ref)
