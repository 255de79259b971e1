"""A ROS 2 node: image topics in, predictions and embeddings out, at a fixed rate and under the time of the images.

    ros2 run mvitac_ros node --ros-args -p export:=exports/first -p vision:=/camera/image_raw -p touch:=/gel/image_raw

Only ``main`` needs ROS. Parameters, topics and messages are described in docs/policies.md.
"""

import array
import contextlib
import io
import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mvitac.data.images import decode, ros_pixels
from mvitac.deploy.engine import Engine
from mvitac.live.cameras import Source, crop_of
from mvitac.live.predictor import Live
from mvitac.live.streams import Stream


class Topic(Source):
    """The newest message of an image topic, captured at the time in its header (0: when it arrived)."""

    message: Any = None
    header: Any = None  # of the message that was read last

    def __init__(self, text: str) -> None:
        self.name, self.crop = crop_of(text)

    def open(self) -> None:
        pass

    def read(self) -> np.ndarray:
        found = ros_pixels(self.message, "an image")
        image = np.array(decode(io.BytesIO(found), "an image")) if isinstance(found, bytes) else found
        if image.dtype != np.uint8:
            raise ValueError(f"encoding {self.message.encoding}: publish 8 bits per channel")
        self.header, stamp = self.message.header, self.message.header.stamp
        self.captured = stamp.sec + 1e-9 * stamp.nanosec or None
        return np.ascontiguousarray(np.broadcast_to(image, (*image.shape[:2], 3)))


class Node:
    """``image`` takes a message; ``tick`` calls ``publish(header, prediction, embedding [D] or None)`` if there is news."""

    def __init__(
        self,
        engine: Engine,
        topics: dict[str, list[str]],
        publish: Callable[[Any, dict[str, Any], np.ndarray | None], None],
        clock: Callable[[], float],
        warn: Callable[..., Any],
        *,
        always: bool = False,
        free: Sequence[np.ndarray] = (),
    ) -> None:
        """``topics`` by modality; ``clock`` is that of the headers, in seconds; ``always`` and ``free`` as of ``Live``."""
        self.publish, self.clock, self.warn = publish, clock, warn
        self.streams = {
            m: [Stream(f"{m} {i}", Topic(text), clock=clock) for i, text in enumerate(given)]
            for m, given in topics.items()
            if given
        }
        told: dict[str, Any] = {"tell": lambda event: warn(event.text), "always": always, "free": free}
        self.live = Live(engine, self.streams, clock=clock, **told)

    def image(self, modality: str, which: int, message: Any) -> None:
        """Make ``message`` the newest of camera or sensor ``which`` of ``modality``."""
        stream = self.streams[modality][which]
        topic: Any = stream.origin
        topic.message = message
        stream.pump()
        age = self.clock() - (topic.captured or self.clock())
        if abs(age) > stream.stale_after:
            text = f"{stream.name}: images are {age:.1f} s old by their headers; are both clocks the same?"
            self.warn(text, throttle_duration_sec=10.0)

    def tick(self) -> None:
        """Predict from the newest images, if there are new ones."""
        if said := self.live.step():
            topic: Any = self.live.leading.origin
            stamp = topic.header.stamp
            said = {"stamp": {"sec": stamp.sec, "nanosec": stamp.nanosec}, **said}
            parts = [x[0] for name, x in self.live.outputs.items() if name.startswith("embedding_")]
            self.publish(topic.header, said, np.concatenate(parts) if self.live.answer else None)


def main() -> None:
    import rclpy  # pyright: ignore[reportMissingImports]
    from rclpy.executors import ExternalShutdownException  # pyright: ignore[reportMissingImports]
    from rclpy.qos import QoSProfile, ReliabilityPolicy  # pyright: ignore[reportMissingImports]
    from sensor_msgs.msg import CompressedImage, Image  # pyright: ignore[reportMissingImports]
    from std_msgs.msg import String  # pyright: ignore[reportMissingImports]

    rclpy.init()
    ros = rclpy.create_node("mvitac")

    def parameter(name: str, default: Any = "") -> Any:
        return ros.declare_parameter(name, default).value

    engine = Engine(parameter("export"))
    topics = {modality: parameter(modality).split() for modality in ("vision", "touch")}
    predictions = ros.create_publisher(String, "~/prediction", 10)
    embeddings = ros.create_publisher(Image, "~/embedding", 10)

    def publish(header: Any, said: dict[str, Any], embedding: np.ndarray | None) -> None:
        predictions.publish(String(data=json.dumps(said)))
        if embedding is not None:
            data = array.array("B", embedding.astype("<f4").tobytes())
            shape = {"height": 1, "width": len(embedding), "step": len(data)}
            embeddings.publish(Image(header=header, encoding="32FC1", is_bigendian=0, data=data, **shape))

    node = Node(
        engine,
        topics,
        publish,
        lambda: 1e-9 * ros.get_clock().now().nanoseconds,
        ros.get_logger().warning,
        always=parameter("always", False),
        free=[np.array(decode(path)) for path in parameter("background").split()],
    )
    # Keep only the newest message: the usual sensor profile queues five and delivers the oldest first.
    newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    for modality, streams in node.streams.items():
        for which, stream in enumerate(streams):
            topic = stream.origin.name  # type: ignore[attr-defined]
            kind = CompressedImage if topic.endswith("/compressed") else Image
            ros.create_subscription(kind, topic, lambda m, of=(modality, which): node.image(*of, m), newest)
    ros.create_timer(1 / parameter("rate", 30.0), node.tick)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):  # Ctrl-C, or the end of a launch
        rclpy.spin(ros)
    rclpy.try_shutdown()  # a signal may have done it


if __name__ == "__main__":
    main()
