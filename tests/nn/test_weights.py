"""Other people's weights are loaded whole or refused: what is scored is never a random network under their name."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import timm
import torch
from torch import Tensor, nn

from mvitac.bench.external import open_model
from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.nn.encoders import EncoderConfig, build_trunk
from mvitac.nn.initial import Init
from mvitac.nn.weights import State, load_weights, read_tensors
from mvitac.recipes import recipe
from mvitac.training.start import load_start, read_start

NAME = "test_resnet"
OUTSIDE = {"queue": torch.zeros(2), "module.encoder_k.conv1.weight": torch.zeros(2)}


@pytest.fixture(scope="module")
def state() -> State:
    """Weights with a classifier, as timm has them."""
    torch.manual_seed(5)
    return timm.create_model(NAME).state_dict()


def behind(start: str, state: State) -> State:
    return {start + name: value for name, value in state.items()}


def loaded(whole: dict[str, Any], folder: Path) -> nn.Module:
    torch.save(whole, folder / "w.pth")
    return build_trunk(EncoderConfig(trunk=NAME, weights=str(folder / "w.pth")), 3)


WRAPPED: dict[str, Callable[[State], dict[str, Any]]] = {
    "": dict,
    "module.": lambda state: behind("module.", state),
    "state_dict.module.encoder_q.": lambda state: {
        "state_dict": behind("module.encoder_q.", state) | OUTSIDE,
        "epoch": 3,
    },
    "model.backbone.": lambda state: {
        "model": behind("backbone.", state),
        "optimizer": {"state": {0: {"m": torch.ones(2)}}},
    },
    "encoder.": lambda state: behind("encoder.", state),
}


@pytest.mark.parametrize("start", WRAPPED)
def test_usual_beginnings_of_names_are_understood_and_said(
    start: str, state: State, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trunk = loaded(WRAPPED[start](state), tmp_path)
    for name, value in trunk.state_dict().items():
        assert torch.equal(value, state[name]), name
    build_trunk(EncoderConfig(trunk=NAME, weights=str(tmp_path / "w.pth")), 3)  # the other sense
    said = capsys.readouterr().err
    assert said.count("\n") == bool(start) and f"weights read below {start!r}" * bool(start) in said
    assert ("left out: 2 tensors (state_dict.queue, state_dict.module.encoder_k.conv1.weight)" in said) == (
        "_q" in start
    )
    assert ("left out: 1 tensor (optimizer.state.0.m)" in said) == ("backbone" in start)


def without(start: str, state: State) -> State:
    return {name: value for name, value in state.items() if not name.startswith(start)}


def vit(state: State) -> State:
    return timm.create_model("test_vit").state_dict()


WRONG: dict[str, tuple[Callable[[State], dict[str, Any]], str]] = {
    "empty": (lambda w: {}, "holds no named weights"),
    "nothing but settings": (lambda w: {"args": {"lr": 0.1}}, "holds no named weights"),
    "vit": (vit, r"\d+ tensors \(conv1.*\) missing, \d+ tensors \(cls_token"),
    "no layer4": (lambda w: without("layer4.", w), r"does not fit test_resnet: \d+ tensors \(layer4\.0.*\) missing$"),
    "one more": (lambda w: w | {"layer5.weight": torch.ones(1)}, r"1 tensor \(layer5\.weight\) left over"),
    "a stranger's names": (lambda w: behind("visual.", w), r"\(visual\.conv1.*\) left over"),
    "wider": (lambda w: w | {"bn1.weight": torch.ones(99)}, r"1 tensor \(bn1\.weight \[99\] for \[32\]\) of another"),
    "two": (lambda w: behind("encoder.", w) | behind("backbone.", w), "two sets of weights fit, below 'encoder.' and"),
    "nan": (lambda w: w | {"bn1.weight": w["bn1.weight"] * torch.nan}, r"NaN or infinite numbers: 1 tensor \(bn1"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_weights_that_do_not_fit_are_refused(kind: str, state: State, tmp_path: Path) -> None:
    change, words = WRONG[kind]
    with pytest.raises(ValueError, match=words) as caught:
        loaded(change(state), tmp_path)
    assert len(str(caught.value).splitlines()) == 1 and str(tmp_path / "w.pth") in str(caught.value)


def from_init(file: Path, pack: Pack) -> None:
    run = recipe("smoke", PackConfig(path=pack.path))
    run = replace(run, encoder=run.encoder.changed(trunk=NAME))
    start = read_start(Init(path=file))
    load_start(start, run.method.build(pack.spec, run.encoder))  # type: ignore[arg-type]


ROUTES: dict[str, Callable[[Path, Pack, Path], Any]] = {
    "external file": lambda file, pack, run: open_model(f"external:{file},trunk={NAME}"),
    "external timm": lambda file, pack, run: open_model(f"external:timm/{NAME},weights={file}"),
    "--init": lambda file, pack, run: from_init(file, pack),
}


@pytest.mark.parametrize("route", ROUTES)
def test_every_way_to_weights_is_strict(route: str, state: State, pack: Pack, smoke_run: Path, tmp_path: Path) -> None:
    import safetensors.torch

    safetensors.torch.save_file(without("layer4.", state), tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match=r"w\.safetensors does not fit .* missing"):
        ROUTES[route](tmp_path / "w.safetensors", pack, smoke_run)


def test_positions_of_another_size_are_those_that_timm_makes(tmp_path: Path) -> None:
    """timm knows the names and positions of its owners' files."""
    torch.manual_seed(0)
    large = timm.create_model("test_vit", img_size=160)
    small = timm.create_model("test_vit", img_size=96, num_classes=0)
    load_weights(small, large.state_dict(), "file")
    expected = timm.create_model(
        "test_vit",
        img_size=96,
        num_classes=0,
        pretrained=True,
        pretrained_cfg_overlay={"state_dict": large.state_dict()},
    )
    for name, value in small.state_dict().items():
        assert torch.equal(value, expected.state_dict()[name]), name


def test_a_file_of_objects_is_not_run(tmp_path: Path) -> None:
    torch.save({"model": nn.Linear(2, 2)}, tmp_path / "w.pth")
    with pytest.raises(ValueError, match="without running code"):
        read_tensors(tmp_path / "w.pth")
    torch.save({"a": {"b": Tensor([1.0])}, "c": 3}, tmp_path / "w.pth")
    assert list(read_tensors(tmp_path / "w.pth")) == ["a.b"]
