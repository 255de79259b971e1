"""The encoders inside a policy, and the ROS 2 node on a fake publisher."""

import json
import sys
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

import mvitac
from mvitac.data.pack import Pack
from mvitac.deploy.policy import ObservationEncoder
from mvitac.model import Model
from support.examples import load_example
from support.faults import Clock, Rig

KEYS = {"observation.images.wrist": "vision", "observation.images.gel": "touch"}


@pytest.fixture
def model(artifact: Path) -> Model:
    return mvitac.load(artifact)


def observe(pack: Pack, rows: list[int]) -> dict[str, torch.Tensor]:
    return {k: torch.from_numpy(pack.images[m][rows]).permute(0, 3, 1, 2) for k, m in KEYS.items()}


def test_features_are_the_models(model: Model, pack: Pack) -> None:
    """uint8 or float, single steps or a history: what embed() gives."""
    encoder, seen = ObservationEncoder(model, KEYS), observe(pack, [3, 50])
    expected = model.embed(vision=pack.images["vision"][[3, 50]], touch=pack.images["touch"][[3, 50]])
    wanted = torch.cat([expected["vision"], expected["touch"]], dim=1)
    torch.testing.assert_close(encoder(seen), wanted, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(encoder({k: v / 255 for k, v in seen.items()}), wanted, atol=1e-4, rtol=1e-4)
    history = {k: v[None].expand(4, -1, -1, -1, -1) for k, v in seen.items()}
    torch.testing.assert_close(encoder(history), wanted[None].expand(4, -1, -1), atol=1e-4, rtol=1e-4)
    assert encoder.out_features == wanted.shape[1]


def test_images_are_seen_at_the_side_the_model_predicts_at(model: Model, pack: Pack) -> None:
    """Which may be larger than that of the views it was trained on."""
    model.run = replace(model.run, augment=replace(model.run.augment, size=24, whole=32))
    expected = model.embed(touch=pack.images["touch"][:4])["touch"]
    found = ObservationEncoder(model, {"gel": "touch"})({"gel": observe(pack, [0, 1, 2, 3])["observation.images.gel"]})
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_a_policy_trains_its_head_and_leaves_the_encoders_alone(model: Model, pack: Pack) -> None:
    encoder = ObservationEncoder(model, KEYS, state=2)
    policy = torch.nn.Sequential(encoder, torch.nn.Linear(encoder.out_features, 3))
    before = {k: v.clone() for k, v in encoder.state_dict().items()}
    policy.train()
    optimiser = torch.optim.Adam([p for p in policy.parameters() if p.requires_grad], lr=0.01)
    seen = {**observe(pack, list(range(12))), "observation.state": torch.zeros(12, 2)}
    target = torch.from_numpy(pack.column("label_pattern")[:12].astype(int))
    losses = []
    for _ in range(30):
        loss = torch.nn.functional.cross_entropy(policy(seen), target)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.5 * losses[0]
    assert all(torch.equal(before[k], v) for k, v in encoder.state_dict().items())


def test_tuned_encoders_get_gradients_but_keep_their_batchnorm(model: Model, pack: Pack) -> None:
    encoder = ObservationEncoder(model, KEYS, tune=True).train()
    before = {k: v.clone() for k, v in encoder.named_buffers()}
    encoder(observe(pack, [0, 1])).sum().backward()
    assert all(p.grad is not None for p in encoder.encoders.parameters())
    assert all(torch.equal(before[k], v) for k, v in encoder.named_buffers())


def test_what_does_not_fit_is_named(model: Model, pack: Pack) -> None:
    with pytest.raises(ValueError, match=r"takes 1 image\(s\), given: left, right"):
        ObservationEncoder(model, {"left": "touch", "right": "touch"})
    encoder, seen = ObservationEncoder(model, KEYS), observe(pack, [0])
    not_divided = {k: v.float() for k, v in seen.items()}
    normalised_already = {k: (v / 255 - 0.45) / 0.22 for k, v in seen.items()}
    for wrong in (not_divided, normalised_already):
        with pytest.raises(ValueError, match=r"expected floats in \[0, 1\] or uint8"):
            encoder(wrong)


def message(image: np.ndarray, encoding: str, pad: int = 5) -> SimpleNamespace:
    """A sensor_msgs/Image with padded rows."""
    height, width, _ = image.shape
    pixels = image[..., ::-1] if encoding == "bgr8" else image
    rows = np.concatenate([pixels.reshape(height, -1), np.full((height, pad), 99, np.uint8)], axis=1)
    return SimpleNamespace(height=height, width=width, step=3 * width + pad, encoding=encoding, data=rows.tobytes())


def test_the_ros_node(onnx: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Its topics, answers and log, where ``rclpy.spin`` sends what a camera and a gel would: calibrates in 0.6 s, touched
    from 1.0 s on, and silent at the end."""
    ros2_node = load_example("ros2_node")
    clock, ros, rclpy = Clock(), MagicMock(), MagicMock()
    rigs = {"/camera": (Rig(clock, 1), "rgb8"), "/gel": (Rig(clock, 2), "bgr8")}

    def spin(node: Any) -> None:
        callbacks = {topic: callback for _, topic, callback, _ in map(attrgetter("args"), subscribed.call_args_list)}
        for frame in range(80):
            clock.now = 99 + frame / 50
            for topic, (rig, encoding) in rigs.items():
                callbacks[topic](message(rig.read(), encoding))
        clock.now += 5
        ros.create_timer.call_args.args[1]()
        callbacks["/gel"](SimpleNamespace(encoding="mono8"))

    rclpy.create_node.return_value, rclpy.spin, subscribed = ros, spin, ros.create_subscription
    for name in ("rclpy", "rclpy.qos", "sensor_msgs.msg", "std_msgs.msg"):
        monkeypatch.setitem(sys.modules, name, rclpy)
    monkeypatch.setattr(ros2_node.Node.__init__, "__kwdefaults__", {"warn": print, "clock": clock})
    monkeypatch.setattr(sys, "argv", ["ros2_node.py", str(onnx), "--vision", "/camera", "--touch", "/gel"])
    ros2_node.main()
    assert [call.args[1] for call in ros.create_publisher.call_args_list] == ["~/prediction", "~/embedding"]
    assert rclpy.QoSProfile.call_args.kwargs["depth"] == 1  # a queue would hand over old frames as new ones
    *said, last = (json.loads(call.kwargs["data"]) for call in rclpy.String.call_args_list)
    embeddings = [call.kwargs["data"] for call in rclpy.Float32MultiArray.call_args_list]
    assert len(said) == len(embeddings) == pytest.approx(30, abs=2) and len(embeddings[0]) == 128
    assert set(said[0]) == {"touch", "contact", "age_ms", "pattern", "bright"} and said[0]["touch"] == 1
    assert said[0]["contact"] and said[0]["pattern"]["class"] in ("columns", "rows", "checks")
    assert said[0]["age_ms"] == 0  # the fake clock stands still meanwhile
    assert last == {"touch": 1, "contact": False}
    calibrated, *silent, unread = (call.args[0] for call in ros.get_logger().warning.call_args_list)
    assert calibrated == "touch 0 is calibrated without contact" and "publish rgb8 or bgr8" in unread
    assert sorted(silent) == ["touch 0 gives no frames since 5.0 s", "vision 0 gives no frames since 5.0 s"]
    monkeypatch.setattr(sys, "argv", ["ros2_node.py", str(onnx), "--vision", "/camera"])
    with pytest.raises(SystemExit):
        ros2_node.main()
    assert "the model needs 1 touch topic(s): give --touch TOPIC" in capsys.readouterr().err


def test_a_message_is_read_as_rgb() -> None:
    image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    to_rgb = load_example("ros2_node").to_rgb
    for encoding in ("rgb8", "bgr8"):
        assert np.array_equal(to_rgb(message(image, encoding)), image)
