"""A ROS 2 node that subscribes to image topics and publishes predictions and embeddings.

    python examples/ros2_node.py exports/first --vision /camera/image_raw --touch /gel/image_raw

It subscribes to sensor_msgs/Image (rgb8 or bgr8), and publishes std_msgs/String on ~/prediction and
std_msgs/Float32MultiArray on ~/embedding. A prediction is JSON: number of the touch, contact (true; false once, when
the contact ends), age in ms, and for each task its class and confidence, or the value, unit and spread (usual error) of
each target. Errors are written to the node's log.

Only ``main`` needs ROS. ``Node`` accepts any object with the fields of an Image message, so it can be tested without
ROS.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from mvitac.deploy.engine import Engine, frame_shapes
from mvitac.live.cameras import Source
from mvitac.live.predictor import Live
from mvitac.live.streams import Stream


def to_rgb(message: Any) -> np.ndarray:
    """Convert a sensor_msgs/Image to uint8 RGB [H, W, 3]. Rows may be padded.

    Raises:
        ValueError: The encoding is not rgb8 or bgr8.
    """
    if message.encoding not in ("rgb8", "bgr8"):
        raise ValueError(f"encoding {message.encoding!r}: publish rgb8 or bgr8")
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    image = rows[:, : 3 * message.width].reshape(message.height, message.width, 3)
    return np.ascontiguousarray(image[..., ::-1] if message.encoding == "bgr8" else image)


class Topic(Source):
    """A topic as a camera source. Call ``put`` with each message, then pump the stream."""

    def __init__(self) -> None:
        self.message: Any = None

    def open(self) -> None:
        pass

    def put(self, message: Any) -> None:
        self.message = message

    def read(self) -> np.ndarray:
        return to_rgb(self.message)


class Node:
    """Take image messages and call ``publish(kind, value)``: "prediction" (str) or "embedding" (list of float)."""

    def __init__(
        self,
        engine: Engine,
        publish: Callable[[str, Any], None],
        *,
        warn: Callable[[str], None] = print,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.publish, self.outputs = publish, {}
        self.topics = {m: [Topic() for _ in range(shape[2] // 3)] for m, shape in frame_shapes(engine).items()}
        self.streams = {
            m: [Stream(f"{m} {i}", topic, clock=clock) for i, topic in enumerate(topics)]
            for m, topics in self.topics.items()
        }
        # Live does not return embeddings, so the last outputs of the engine are kept to publish them.
        self.live = Live(Kept(engine, self.outputs), self.streams, clock=clock, tell=lambda event: warn(event.text))  # type: ignore[arg-type]

    def image(self, modality: str, message: Any, which: int = 0) -> None:
        """Take one Image message, and publish if there is a new prediction."""
        self.topics[modality][which].put(message)
        self.streams[modality][which].pump()
        self.tick()

    def tick(self) -> None:
        """Publish new results. Also called by a timer, because a topic that stops sends no message."""
        said = self.live.step()
        if said:
            self.publish("prediction", json.dumps(said))
        if said and said["contact"]:
            names = [n for n in self.outputs if n.startswith("embedding_")]
            self.publish("embedding", np.concatenate([self.outputs[n][0] for n in names]).tolist())


class Kept:
    """An engine that stores its last outputs in a dict."""

    def __init__(self, engine: Engine, outputs: dict[str, np.ndarray]) -> None:
        self.engine, self.outputs, self.inputs, self.classes = engine, outputs, engine.inputs, engine.classes
        self.values, self.difference, self.window = engine.values, engine.difference, engine.window

    def __call__(self, **images: np.ndarray) -> dict[str, np.ndarray]:
        self.outputs.update(self.engine(**images))
        return self.outputs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("export", help="folder written by `mvitac export`")
    parser.add_argument("--vision", action="append", default=[], help="image topic of the camera")
    parser.add_argument(
        "--touch", action="append", default=[], help="image topic of a touch sensor; give it twice for two"
    )
    options, rest = parser.parse_known_args()
    engine = Engine(options.export)
    for modality in ("vision", "touch"):
        takes = frame_shapes(engine).get(modality, (0, 0, 0))[2] // 3
        if len(getattr(options, modality)) != takes:
            parser.error(f"the model needs {takes} {modality} topic(s): give --{modality} TOPIC {takes} times")

    import rclpy  # pyright: ignore[reportMissingImports]
    from rclpy.qos import QoSProfile, ReliabilityPolicy  # pyright: ignore[reportMissingImports]
    from sensor_msgs.msg import Image  # pyright: ignore[reportMissingImports]
    from std_msgs.msg import Float32MultiArray, String  # pyright: ignore[reportMissingImports]

    rclpy.init(args=rest)
    ros = rclpy.create_node("mvitac")
    publishers = {
        "prediction": (ros.create_publisher(String, "~/prediction", 10), String),
        "embedding": (ros.create_publisher(Float32MultiArray, "~/embedding", 10), Float32MultiArray),
    }

    def publish(kind: str, value: Any) -> None:
        publisher, message = publishers[kind]
        publisher.publish(message(data=value))

    node = Node(engine, publish, warn=ros.get_logger().warning)
    # Keep only the newest message: the usual sensor profile queues five and delivers the oldest first.
    newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    for modality, topics in (("vision", options.vision), ("touch", options.touch)):
        for which, topic in enumerate(topics):
            ros.create_subscription(Image, topic, lambda m, k=modality, i=which: node.image(k, m, i), newest)
    ros.create_timer(0.1, node.tick)
    try:
        rclpy.spin(ros)
    finally:
        ros.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
