"""The ROS 2 node: rclpy is a mock, the messages are those of rosbags and travel as CDR."""

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from mvitac.deploy.engine import Engine
from support.examples import load_example
from support.faults import Clock, Rig
from support.ros import START, STORE, compressed, raw

VISION, TOUCH = "/camera/image/compressed", "/gel/image_raw"
LATE = 0.02  # seconds from an image's stamp to its arrival
load_node = partial(load_example, "node", "ros/mvitac_ros/mvitac_ros")
SENSOR_MSGS, STD_MSGS = (
    SimpleNamespace(**{name.rpartition("/")[2]: kind for name, kind in STORE.types.items() if name.startswith(package)})
    for package in ("sensor_msgs/msg", "std_msgs/msg")
)


def carried(message: Any) -> Any:
    kind = message.__msgtype__
    if not isinstance(message.data, str):
        message = replace(message, data=np.frombuffer(message.data, np.uint8))
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


class ExternalShutdown(Exception):
    pass


class Robot:
    """A ROS in which a camera and a gel publish at 100 Hz: touched from 1.0 to 1.6 s, then silent, then without encoding."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **parameters: Any) -> None:
        self.clock, self.ros, self.parameters = Clock(), MagicMock(), parameters
        self.sent: dict[str, list[Any]] = {"~/prediction": [], "~/embedding": []}
        self.seen: dict[int, dict[str, np.ndarray]] = {}
        self.ros.declare_parameter = lambda name, default: SimpleNamespace(value=parameters.get(name, default))
        self.ros.get_clock().now = lambda: SimpleNamespace(nanoseconds=int((START + self.clock()) * 1e9))
        self.ros.create_publisher = lambda kind, topic, _: SimpleNamespace(
            publish=lambda message: self.sent[topic].append(carried(message))
        )
        self.rclpy = MagicMock(create_node=lambda name: self.ros, spin=self.spin)
        self.rclpy.executors.ExternalShutdownException = ExternalShutdown
        modules = {"rclpy": self.rclpy, "rclpy.qos": self.rclpy.qos, "rclpy.executors": self.rclpy.executors}
        for name, module in (modules | {"sensor_msgs.msg": SENSOR_MSGS, "std_msgs.msg": STD_MSGS}).items():
            monkeypatch.setitem(sys.modules, name, module)

    def spin(self, ros: Any) -> None:
        calls = [call.args for call in ros.create_subscription.call_args_list]
        put = {topic: (kind, callback) for kind, topic, callback, _ in calls}
        rigs = {VISION: Rig(self.clock, 1), TOUCH: Rig(self.clock, 2)}
        tick = ros.create_timer.call_args.args[1]
        for frame in range(160):
            self.clock.now = 99 + frame / 100
            images = {topic: rig.read() for topic, rig in rigs.items()}
            stamp = self.clock.now - LATE
            messages = {VISION: compressed(stamp, images[VISION]), TOUCH: raw(stamp, images[TOUCH][..., ::-1], "bgr8")}
            self.seen[round(1000 * stamp)] = {"vision": images[VISION][None], "touch": images[TOUCH][None]}
            for topic, message in messages.items():
                kind, callback = put[topic]
                assert isinstance(message, kind)
                callback(carried(message))
            if frame % 2:
                tick()
        self.clock.now += 5
        tick()
        put[TOUCH][1](replace(messages[TOUCH], encoding="yuv422"))
        put[TOUCH][1](messages[TOUCH])
        raise ExternalShutdown  # as rclpy does at Ctrl-C


@pytest.mark.parametrize("always", [False, True])
def test_it_answers_at_its_rate_under_image_times(onnx: Path, monkeypatch: pytest.MonkeyPatch, always: bool) -> None:
    robot = Robot(monkeypatch, export=str(onnx), vision=VISION, touch=TOUCH, rate=50.0, always=always)
    load_node().main()
    robot.rclpy.try_shutdown.assert_called_once()
    assert robot.ros.create_timer.call_args.args[0] == 1 / 50
    assert robot.rclpy.qos.QoSProfile.call_args.kwargs["depth"] == 1  # a queue would hand over old frames as new ones
    *said, last = (json.loads(message.data) for message in robot.sent["~/prediction"])
    embeddings = robot.sent["~/embedding"]
    assert len(said) == len(embeddings) == pytest.approx(80 if always else 30, abs=2)
    engine = Engine(onnx)
    times = [one["stamp"]["sec"] - START + 1e-9 * one["stamp"]["nanosec"] for one in said]
    assert np.diff(times) == pytest.approx(1 / 50)
    assert {one["contact"] for one in said} == ({True, False, None} if always else {True})
    assert set(said[-1]) == {"stamp", "touch", "contact", "age_ms", "pattern", "bright"} and said[-1]["touch"] == 1
    assert said[-1]["age_ms"] == pytest.approx(1000 * LATE, abs=0.1)
    assert said[-1]["pattern"]["class"] in ("columns", "rows", "checks")
    for message, time, one in zip(embeddings, times, said, strict=True):
        assert (message.encoding, message.height, message.step) == ("32FC1", 1, 4 * message.width)
        assert one["stamp"] == {name: getattr(message.header.stamp, name) for name in ("sec", "nanosec")}
        expected = engine(**robot.seen[round(1000 * time)])
        wanted = np.concatenate([expected["embedding_vision"], expected["embedding_touch"]], axis=1)[0]
        assert np.allclose(np.frombuffer(message.data, np.float32), wanted, atol=1e-3)
    assert last == {"stamp": said[-1]["stamp"], "touch": 1, "contact": False}
    heard = [call.args[0] for call in robot.ros.get_logger().warning.call_args_list]
    assert heard[0] == "touch 0 is calibrated without contact"
    assert sorted(heard[1:3]) == ["touch 0 gives no frames since 5.0 s", "vision 0 gives no frames since 5.0 s"]
    assert "an image has the encoding yuv422" in heard[3]
    assert heard[-1].startswith("touch 0: images are 5.0 s old by their headers")


def test_other_topics_than_the_model_takes_and_depth_are_refused(onnx: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Robot(monkeypatch, export=str(onnx), vision=VISION)
    with pytest.raises(ValueError, match=r"the model takes \{'vision': 1, 'touch': 1\}"):
        load_node().main()
    topic = load_node().Topic("/gel")
    topic.message = raw(0, np.zeros((4, 6, 1), np.uint16), "16UC1")
    with pytest.raises(ValueError, match="encoding 16UC1: publish 8 bits"):
        topic.read()


@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "bgr8", "rgba8", "bgra8", "compressed"])
def test_an_image_is_read_as_rgb(encoding: str) -> None:
    image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    pixels = image[..., ::-1] if encoding.startswith("bgr") else image
    if encoding.endswith("a8"):
        pixels = np.dstack([pixels, np.full((4, 6), 9, np.uint8)])
    if encoding == "mono8":
        pixels = image[..., :1]
        image[..., 1:] = pixels
    topic = load_node().Topic("/gel")
    topic.message = compressed(7.5, image) if encoding == "compressed" else raw(7.5, pixels, encoding)
    assert np.array_equal(topic.read(), image) and topic.captured == START + 7.5


ROBOT = """
import datetime, hashlib, sys
import av, numpy as np, onnxruntime, PIL.Image, safetensors.numpy, simplejpeg
del datetime.UTC, hashlib.file_digest  # new in Python 3.11, as is tomllib
for name in {"tomllib", "torch", "scipy", "sklearn", "pyarrow", "tyro", "openvino"}:
    sys.modules[name] = None
sys.path.insert(0, "ros/mvitac_ros")
from mvitac_ros.node import Engine
engine = Engine(sys.argv[1], engine="onnxruntime")
print(*engine(**{m: np.zeros((1, *shape), np.uint8) for m, shape in engine.inputs.items()}))
"""


def test_a_robot_with_python_310_needs_what_the_docs_say(onnx: Path) -> None:
    found = subprocess.run([sys.executable, "-c", ROBOT, str(onnx)], capture_output=True, text=True, check=False)
    assert "embedding_touch" in found.stdout, found.stderr
