"""ROS bags, written by rosbags itself: image and wrench topics joined by time."""

import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from mvitac.data.build import build
from mvitac.data.images import ros_pixels
from mvitac.data.pack import Pack
from mvitac.datasets.base import dataset
from mvitac.datasets.rosbag import Message, RosbagConfig
from support.forged_packs import refuse_pipe
from support.ros import START, STORE, compressed, raw, stamped

GEL, FRONT, WRENCH = "/digit/image_raw", "/camera/image/compressed", "/ft/wrench"


def wrench(time: float, fz: float) -> Any:
    vector, kind = STORE.types["geometry_msgs/msg/Vector3"], STORE.types["geometry_msgs/msg/WrenchStamped"]
    force, torque = vector(x=0.0, y=1.0, z=fz), vector(x=0.0, y=0.0, z=0.0)
    return kind(header=stamped(time), wrench=STORE.types["geometry_msgs/msg/Wrench"](force=force, torque=torque))


def write_bag(path: Path, plugin: StoragePlugin, number: int, pixels: Any = None) -> Path:
    """2 s: gel at 25 Hz (blue = frame) and camera at 10 Hz, or a depth ``pixels``; Fz = 3 t at 100 Hz; 1 to 30 ms late."""
    rng, messages = np.random.default_rng(number), []
    for i in range(50):
        frame = np.zeros((16, 20, 3), np.uint8) if pixels is None else pixels
        if pixels is None:
            frame[..., 0], frame[..., 2] = 5 * i, 100 + number
        messages.append((GEL, i / 25, raw(i / 25, frame, "bgr8" if pixels is None else "16UC1")))
    for i in range(20):
        shown = np.full((24, 32, 3), (10 * i, 0, 0), np.uint8) if pixels is None else pixels[..., 0]
        messages.append((FRONT, i / 10 + 0.004, compressed(i / 10 + 0.004, shown)))
    messages += [(WRENCH, i / 100 + 0.001, wrench(i / 100 + 0.001, 3 * (i / 100 + 0.001))) for i in range(200)]
    kinds = {topic: message.__msgtype__ for topic, _, message in messages}
    with Writer(path, version=9, storage_plugin=plugin) as bag:
        connections = {topic: bag.add_connection(topic, kind, typestore=STORE) for topic, kind in kinds.items()}
        late = [(time + rng.uniform(0.001, 0.03), number) for number, (_, time, _) in enumerate(messages)]
        for time, number in sorted(late):
            topic, _, message = messages[number]
            bag.write(connections[topic], START * 10**9 + int(time * 1e9), STORE.serialize_cdr(message, kinds[topic]))
    return path


def packed(config: RosbagConfig, out: Path) -> Pack:
    return build(config.source(), out, size=16, quiet=True)


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_topics_are_joined_by_the_time_in_their_headers(tmp_path: Path, plugin: StoragePlugin) -> None:
    for number in range(3):
        write_bag(tmp_path / f"bags/grasp.{number}", plugin, number)
    options: dict[str, Any] = {"touch": (GEL,), "vision": FRONT, "values": (f"{WRENCH}.wrench.force.z:N",), "size": 16}
    config = RosbagConfig(path=tmp_path / "bags", every=1, tolerance=0.045, **options)
    assert all(isinstance(dataset(str(path)), RosbagConfig) for path in (config.path, config.path / "grasp.1"))
    assert replace(config, interpolate="nearest").source().items()  # values are joined without --log, too
    pack = packed(config, tmp_path / "pack")
    time, which = pack.column("time").astype(float) - START, pack.column("recording")
    assert set(which) == {"grasp.0", "grasp.1", "grasp.2"} and pack.spec.group_by == "recording"
    assert np.allclose(pack.values(pack.spec.values[0])[:, 0], 3 * time, atol=1e-5)
    blue, red = pack.images["touch"][:, 0, 0, 2].astype(int), pack.images["touch"][:, 0, 0, 0].astype(int)
    assert (blue == np.round(125 * time)).all() and (red == [100 + int(name[-1]) for name in which]).all()
    seen = pack.images["vision"][:, 0, 0, 0] / 100 + 0.004
    assert (abs(seen - time) <= 0.0451).all() and (pack.column("frame").astype(int) == np.round(25 * time)).all()
    assert pack.num == 3 * 48 and "6 images without all others left out" in pack.spec.notes[0]
    one = packed(replace(config, group=f"{WRENCH}.wrench.force.y", values=()), tmp_path / "one")
    assert {*one.column("group")} == {"1"} and {*one.column("touch_group")} == {f"1/grasp.{k}" for k in range(3)}
    few = packed(RosbagConfig(path=tmp_path / "bags/grasp.1", touch=(GEL,)), tmp_path / "few")
    assert few.images["touch"][:, 0, 0, 2].tolist() == list(range(0, 250, 25))


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_messages_received_in_the_same_moment_are_not_one(tmp_path: Path, plugin: StoragePlugin) -> None:
    """A recorder that writes in bursts gives many messages one time of receipt; each image was the first of them."""
    for number in range(3):
        with Writer(tmp_path / f"bags/{number}", version=9, storage_plugin=plugin) as bag:
            kind = "sensor_msgs/msg/Image"
            gel, _ = (bag.add_connection(topic, kind, typestore=STORE) for topic in (GEL, "/none"))
            for i in range(30):
                message = raw(i / 25, np.full((16, 20, 3), 5 * i, np.uint8), "rgb8")
                bag.write(gel, (START + i // 10) * 10**9, STORE.serialize_cdr(message, kind))
    pack = packed(RosbagConfig(path=tmp_path / "bags", touch=(GEL,), every=1), tmp_path / "pack")
    assert pack.images["touch"][:, 0, 0, 0].tolist() == [*range(0, 150, 5)] * 3
    with pytest.raises(ValueError, match="0 has no image of /none"):
        RosbagConfig(path=tmp_path / "bags", touch=("/none",)).source()


def test_a_bag_of_ros_1_beside_its_conversion_is_another_recording(tmp_path: Path) -> None:
    kind, noetic = "sensor_msgs/msg/Image", get_typestore(Stores.ROS1_NOETIC)
    with (
        Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.MCAP) as new,
        rosbag1.Writer(tmp_path / "run.bag") as old,
    ):
        to = new.add_connection(GEL, kind, typestore=STORE)
        came = old.add_connection(GEL, kind, typestore=noetic)
        for i in range(20):
            message = raw(i / 25, np.full((16, 20, 3), 5 * i, np.uint8), "rgb8")
            new.write(to, START * 10**9 + i, STORE.serialize_cdr(message, kind))
            header = noetic.types["std_msgs/msg/Header"](seq=i, stamp=message.header.stamp, frame_id="gel")
            old.write(came, START * 10**9 + i, noetic.serialize_ros1(replace(message, header=header), kind))
    pack = packed(RosbagConfig(path=tmp_path, touch=(GEL,), every=1), tmp_path / "pack")
    assert pack.images["touch"][:, 0, 0, 0].tolist() == [*range(0, 100, 5)] * 2
    assert pack.column("recording").tolist() == ["run"] * 20 + ["run.bag"] * 20


@pytest.mark.parametrize(
    ("gel", "front", "says"),
    [
        ([1.0] * 9, [1.0, 2.0], rf"topic {GEL}: all 9 times are .* a clock that stands still"),
        ([1.0, 1.0, 2.0], [7.0, 8.0], rf"no image with all others within 0\.04 s: {GEL} \d+1\.000 to .*{FRONT}"),
        ([], [], "bag is empty: leave it out"),
        ([1.0, 1.0, 2.0], [1.0, 2.0], ""),
    ],
)
def test_clocks_that_pair_nothing(tmp_path: Path, gel: list[float], front: list[float], says: str) -> None:
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for topic, times in ((GEL, gel), (FRONT, front)):
            to = bag.add_connection(topic, "sensor_msgs/msg/Image", typestore=STORE) if times else None
            for i, time in enumerate(times):
                message = raw(time, np.full((16, 20, 3), i, np.uint8), "rgb8")
                bag.write(to, START * 10**9 + i, STORE.serialize_cdr(message, message.__msgtype__))  # type: ignore
    config = RosbagConfig(path=tmp_path / "bag", touch=(GEL,), vision=FRONT, every=1, tolerance=0.04)
    if says:
        with pytest.raises(ValueError, match=says):
            config.source()
    else:
        table = config.manifest()
        assert f"1 messages of {GEL} have the stamp of another" in table.notes[0]
        assert [ref and ref.stamp - START * 10**9 for ref in table.images[GEL]] == [0, 1, 2]  # type: ignore[attr-defined]
        killed = tmp_path / "killed.bag.active"
        for file in (killed, tmp_path / "bag" / "bag.mcap"):
            killed.touch() if file == killed else killed.unlink()
            with pytest.raises(ValueError, match=f"{file.name} was not closed"):
                RosbagConfig(path=tmp_path, touch=(GEL,)).source()
            (tmp_path / "bag" / "metadata.yaml").unlink(missing_ok=True)


def test_messages_that_are_not_there_are_told(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", StoragePlugin.MCAP, 0)
    about = bag / "metadata.yaml"
    about.write_text(about.read_text().replace("message_count: 50\n", "message_count: 70\n"))
    with pytest.raises(ValueError, match=f"bag has 50 of 70 messages of {GEL}: fetch it again"):
        RosbagConfig(path=bag, touch=(GEL,)).source()
    ref = Message(str(bag), FRONT, START * 10**9, 9)
    with pytest.raises(ValueError, match="number 9 is not found again: its files are"), ref.opened() as opened:
        ref.stored(opened)


def test_a_bag_that_is_cut_or_no_file(tmp_path: Path) -> None:
    file = next(write_bag(tmp_path / "bag", StoragePlugin.SQLITE3, 0).glob("*.db3"))
    with sqlite3.connect(file) as base:
        base.execute("UPDATE messages SET timestamp = 'x' WHERE id < 9")
    with pytest.raises(ValueError, match=r"bag cannot be read as a bag \('x' is no time stamp\)"):
        RosbagConfig(path=tmp_path / "bag", touch=(GEL,)).source()
    file.write_bytes(file.read_bytes()[:-100])  # sqlite reads the end as zeros
    with pytest.raises(ValueError, match=r"db3 is cut off: fetch it again"):
        packed(RosbagConfig(path=tmp_path / "bag", touch=(GEL,)), tmp_path / "pack")
    refuse_pipe(file, lambda: packed(RosbagConfig(path=tmp_path / "bag", touch=(GEL,)), tmp_path / "pack"))


def test_a_short_image_is_named() -> None:
    message = raw(0.0, np.zeros((16, 20, 3), np.uint8), "rgb8")
    for data, height in ((message.data[:-40], 16), (message.data, 0), (message.data[:-128], 16)):
        message.data, message.height = data, height
        with pytest.raises(ValueError, match=rf"it has {len(data)} bytes for 20 x {height} pixels of rgb8"):
            ros_pixels(message, "it")


def test_depth_and_what_cannot_be(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", StoragePlugin.MCAP, 0, np.full((16, 20, 1), 900, np.uint16))
    scale = (f"{GEL}=0:1000", f"{FRONT}=0:1800")
    pack = packed(RosbagConfig(path=bag, touch=(GEL,), vision=FRONT, range=scale, tolerance=0.1), tmp_path / "p")
    assert (pack.images["touch"] == 230).all() and (pack.images["vision"] == 128).all()
    assert f"{GEL} has more than 8 bits: 0 is black, 1000 white" in pack.spec.notes
    for options, says in (
        ({}, rf"has image topics {GEL}, {FRONT}: --data\.vision, --data\.touch TOPIC"),
        ({"touch": ("/digit/image",)}, rf"unknown topic '/digit/image': .*did you mean '{GEL}'"),
        ({"touch": (GEL,), "values": (f"{WRENCH}.wrench.force.w:N",)}, f"{WRENCH}: .*no field wrench.force.w"),
        ({"touch": (GEL,), "values": (f"{WRENCH}.wrench.force.z[1]:N",)}, r"no field wrench\.force\.z\[1\]: unknown"),
        ({"touch": (GEL,), "values": ("/ft/wrong.x:N",)}, "unknown column '/ft/wrong.x'"),
        ({"touch": (WRENCH,)}, f"{WRENCH} is of geometry_msgs/msg/WrenchStamped, no images"),
    ):
        with pytest.raises(ValueError, match=says):
            RosbagConfig(path=bag, **options).source()
    whole = (file := bag / "bag.mcap").read_bytes()
    for harmed in (whole[:5000], whole.replace(GEL.encode(), b"\xff" * len(GEL))):  # cut, and no UTF-8
        file.write_bytes(harmed)
        with pytest.raises(ValueError, match=r"bag cannot be read as a bag \(.*\): is it complete"):
            RosbagConfig(path=bag, touch=(GEL,)).source()
    with pytest.raises(ValueError, match="is no bag and holds none"):
        RosbagConfig(path=tmp_path / "none", touch=(GEL,)).source()
