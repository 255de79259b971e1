"""Messages of ROS 2, of the classes in rosbags."""

import io
from typing import Any

import numpy as np
from PIL import Image
from rosbags.typesys import Stores, get_typestore

START = 1_700_000_000
STORE = get_typestore(Stores.ROS2_HUMBLE)


def stamped(time: float) -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=START + int(time), nanosec=round(time % 1 * 1e9))
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")


def raw(time: float, pixels: np.ndarray, encoding: str) -> Any:
    lines = np.pad(pixels.reshape(pixels.shape[0], -1).view(np.uint8), ((0, 0), (0, 4)))
    shape = {"height": pixels.shape[0], "width": pixels.shape[1], "encoding": encoding, "is_bigendian": 0}
    return STORE.types["sensor_msgs/msg/Image"](header=stamped(time), **shape, step=lines.shape[1], data=lines.ravel())


def compressed(time: float, pixels: np.ndarray) -> Any:
    Image.fromarray(pixels).save(buffer := io.BytesIO(), "PNG")
    data = np.frombuffer(buffer.getvalue(), np.uint8)
    return STORE.types["sensor_msgs/msg/CompressedImage"](header=stamped(time), format="png", data=data)
