"""Other people's encoders: adapters against their networks written out, and as models of data of any layout."""

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import safetensors.torch
import torch
from onnx import TensorProto, helper
from torch import Tensor, nn

import mvitac
from mvitac.bench.external import ExternalModel, open_model
from mvitac.bench.external.base import parse
from mvitac.bench.external.encoder import open_encoder, randomised
from mvitac.bench.external.model import is_noncommercial
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.features import features
from mvitac.evaluation.probe import probe_model
from mvitac.evaluation.retrieval import cross_modal
from mvitac.model import fresh
from mvitac.recipes import recipe
from support.owners import OWNERS, tvl
from support.toy import toy_pack


@pytest.mark.parametrize("owner", OWNERS)
def test_features_are_those_of_the_network_written_out(owner: Callable[..., Any], tmp_path: Path) -> None:
    text, slow = owner(tmp_path)
    found = open_encoder(text)
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(2, *found.preprocessing.input_shape(), generator=generator)
    with torch.no_grad():
        expected = slow(x)
        assert expected.std() > 0.01
        torch.testing.assert_close(found.network(x), expected, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("owner", OWNERS)
def test_files_that_are_not_the_owners_are_refused_in_one_line(owner: Callable[..., Any], tmp_path: Path) -> None:
    text, _ = owner(tmp_path)
    adapter = parse(text)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    for file in files:
        whole = (
            safetensors.torch.load_file(file) if file.suffix == ".safetensors" else torch.load(file, weights_only=True)
        )
        tensors = next((whole[key] for key in ("model", "state_dict") if key in whole), whole)
        wrong = {n: v[: len(v) // 2].clone() if v.ndim >= 2 and len(v) > 8 else v for n, v in tensors.items()}
        for spoilt in (wrong, {"something.weight": torch.ones(3)}):
            safetensors.torch.save_file(spoilt, file) if file.suffix == ".safetensors" else torch.save(spoilt, file)
            with pytest.raises(ValueError, match=adapter.name) as caught:
                open_encoder(text)
            assert len(str(caught.value).splitlines()) == 1
            assert adapter.expects in str(caught.value)
        safetensors.torch.save_file(whole, file) if file.suffix == ".safetensors" else torch.save(whole, file)


def test_positions_are_interpolated_to_another_size(tmp_path: Path) -> None:
    text, _ = tvl(tmp_path)
    plain, larger = open_encoder(text).loaded.network, open_encoder(f"{text},size=96x64").loaded.network
    assert (plain.patch_embed.grid_size, larger.patch_embed.grid_size) == ((3, 3), (6, 4))  # type: ignore[union-attr]
    few, many = (network.pos_embed.detach() for network in (plain, larger))  # type: ignore[operator, union-attr]
    assert torch.equal(many[:, 0], few[:, 0])  # that of the class token
    rows = few[0, 1:].unflatten(0, (3, 3)).mean(1)
    assert many[0, 1:].unflatten(0, (6, 4)).mean((0, 1)) == pytest.approx(rows.mean(0), abs=0.02)


def levels(*values: int) -> Tensor:
    """One image of 8 x 8 pixels per value, uint8 [1, F, 3, 8, 8]."""
    return torch.tensor(values, dtype=torch.uint8).view(1, -1, 1, 1, 1).expand(1, len(values), 3, 8, 8)


def test_frames_are_newest_first_and_the_oldest_is_repeated() -> None:
    made = Preprocessing(frames=3, mean=(0, 0, 0), std=(1, 1, 1), size=(8, 8))
    found = made(levels(255, 0))
    assert found.shape == (1, 9, 8, 8) and found[0, :, 0, 0].tolist() == [1, 1, 1, 0, 0, 0, 0, 0, 0]


def test_difference_images_get_the_owners_offset_and_scale() -> None:
    made = Preprocessing(mean=(0, 0, 0), std=(1, 1, 1), size=(8, 8), offset=0.5, whole_levels=True)
    for stored in (100, 128, 130, 250):  # (image - background) / 2 + 128
        minus = 2 * (stored - 128)
        expected = math.floor(255 * min(max(minus / 255 + 0.5, 0), 1)) / 255
        assert made(levels(stored), gain=2.0).flatten()[0].item() == pytest.approx(expected, abs=1e-6)
        assert made(levels(stored)).flatten()[0].item() == pytest.approx(
            stored / 255
        )  # of plain images none is subtracted
    shifted = Preprocessing(size=(8, 8), mean=(0.5,) * 3, std=(0.25,) * 3)(levels(255))  # type: ignore[arg-type]
    assert shifted.unique().tolist() == [2.0]


def test_landscape_images_are_rotated_and_cut_as_sparsh_does() -> None:
    made = Preprocessing(size=(32, 24), mean=(0, 0, 0), std=(1, 1, 1), portrait=True)
    image = torch.zeros(1, 1, 3, 24, 32)
    image[..., :12, :] = 1  # the upper half of a 4:3 landscape is the right half once rotated clockwise
    found = made(image)[0, 0]
    assert found[:, 12:].min() == 1 and found[:, :12].max() == 0
    tall = torch.zeros(1, 1, 3, 64, 24)
    tall[..., 8:56, :] = 1  # the middle three quarters
    assert made(tall).min() == 1


def test_tvl_pads_and_rotates_and_t3_cuts_the_centre() -> None:
    plain = {"mean": (0, 0, 0), "std": (1, 1, 1), "size": (16, 16)}
    image = torch.ones(1, 1, 3, 16, 8)
    image[..., :8, :] = 0.5
    padded = Preprocessing(pad=True, **plain)(image)[0, 0]
    assert padded[8].tolist() == [0.5] * 8 + [1.0] * 8 and padded[0].max() == padded[-1].max() == 0
    wide = torch.zeros(1, 1, 3, 32, 64)
    wide[..., 8:24, 24:40] = 1
    assert Preprocessing(shorter=32, **plain)(wide).min() == 1


def test_random_weights_for_the_control_leave_the_encoder_as_it_is(tmp_path: Path) -> None:
    found = open_encoder(tvl(tmp_path)[0])
    before = {name: value.clone() for name, value in found.loaded.network.state_dict().items()}
    untrained = found.untrained()
    assert untrained is not None and untrained.loaded.trained_on == "nothing"
    assert all(torch.equal(value, before[name]) for name, value in found.loaded.network.state_dict().items())
    again = randomised(found.loaded.network, 0).state_dict()
    for name, value in untrained.network.state_dict().items():
        assert torch.equal(value, again[name]) and (value.ndim < 2 or not torch.equal(value, before[name]))
    assert open_encoder("external:timm/mvitac_tiny,weights=random,size=32").untrained() is None


TINY = "external:timm/mvitac_tiny,weights=random,size=32"


def rows(pack: Pack, num: int = 6) -> np.ndarray:
    return np.arange(num)


def test_the_same_network_gives_the_same_features_as_in_a_run(pack: Pack, tmp_path: Path) -> None:
    run = recipe("smoke", PackConfig(path=pack.path))
    run = replace(run, encoder=run.encoder.changed(trunk="test_resnet"))
    ours = fresh(replace(run, augment=replace(run.augment, size=32, whole=None)), pack.spec, pack.size)
    trunk = ours.encoders["touch"]
    torch.save(trunk.state_dict(), tmp_path / "trunk.pth")
    text = f"external:timm/test_resnet,weights={tmp_path / 'trunk.pth'},size=32"
    theirs, same = open_model(text).on(pack)
    assert same is pack
    np.testing.assert_allclose(
        features(theirs, pack, "touch", rows(pack)), features(ours, pack, "touch", rows(pack)), atol=1e-4
    )
    text = f"external:{tmp_path / 'trunk.pth'},trunk=test_resnet,size=32"
    by_file = open_model(text).on(pack)[0]
    np.testing.assert_array_equal(
        features(by_file, pack, "touch", rows(pack)), features(theirs, pack, "touch", rows(pack))
    )


def test_load_gives_a_model_that_embeds_and_is_probed(pack: Pack) -> None:
    model = mvitac.load(TINY)
    assert isinstance(model, ExternalModel) and model.seed == 0 and model.trained_on == "nothing"
    model, own = model.on(pack)
    embedded = model.embed(touch=pack.images["touch"][rows(pack)])["touch"]
    np.testing.assert_allclose(embedded.numpy(), features(model, own, "touch", rows(pack)), atol=1e-5)
    found = probe_model(model, own, own.spec.tasks, ["touch", "both"], ["linear"])
    assert {(r["task"], r["modality"]) for r in found} == {
        (t.name, m) for t in own.spec.tasks for m in ("touch", "both")
    }
    assert cross_modal(model, own) == []
    with pytest.raises(ValueError, match="has no run"):
        model.trunk("touch")


def test_seeds_draw_other_weights_and_repeat_themselves() -> None:
    digests = [open_model(f"{TINY},seed={seed}").weights_digest() for seed in (0, 1, 0)]
    assert digests[0] == digests[2] != digests[1]
    assert open_model(f"{TINY},mean=none").weights_digest() != digests[0]  # features depend on it, so their cache does


def test_sensors_are_encoded_one_by_one(pack: Pack, tmp_path: Path) -> None:
    two = toy_pack(tmp_path / "two", touch_channels=6, num=12)
    model, two = open_model(f"{TINY},reads=touch").on(two)
    one = ExternalModel(model.text, model.part, pack.spec, 32)
    both = torch.from_numpy(np.array(two.images["touch"][:3])).permute(0, 3, 1, 2)
    each = [one.features("touch", both[:, at : at + 3]) for at in (0, 3)]
    torch.testing.assert_close(model.features("touch", both), torch.cat(each, dim=1))


def test_windows_are_opened_where_the_data_has_an_order(pack: Pack, tmp_path: Path) -> None:
    text = f"{TINY},reads=touch,frames=2"
    frames = toy_pack(tmp_path / "frames", values=True)
    model, own = open_model(text).on(frames)
    assert own.spec.window.frames == 2 and not model.notes
    later = np.flatnonzero(frames.column("frame") == 1)[:3]
    found = features(model, own, "touch", later)
    still, plain = open_model(text).on(pack)
    assert plain is pack and "repeated" in still.notes[0]
    images = torch.from_numpy(frames.images["touch"][later]).permute(0, 3, 1, 2)
    assert not np.allclose(found, still.features("touch", images).numpy(), atol=1e-3)
    with pytest.raises(ValueError, match="name its order"):
        open_model(f"{text},stride=1").on(pack)


def test_backgrounds_are_subtracted_where_the_pack_has_them(pack: Pack) -> None:
    model = open_model(f"{TINY},reads=touch,offset=0.5,mean=none,std=none")
    assert "no" in model.on(pack)[0].notes[0]
    changed = ExternalModel(model.text, model.part, replace(pack.spec, difference=True), 32)
    grey = torch.full((1, 3, 32, 32), 128, dtype=torch.uint8)
    half = torch.full((1, 3, 32, 32), 0.5)
    network = model.parts["touch"].network
    torch.testing.assert_close(changed.features("touch", grey), network(half), atol=1e-5, rtol=1e-4)
    assert changed.describe()["encoders"]["touch"]["background_subtracted"] is True


def test_an_encoder_may_read_one_sense() -> None:
    assert set(open_model(f"{TINY},reads=vision").encoders) == {"vision"}


@pytest.mark.parametrize("owner", OWNERS)
def test_every_owners_checkpoint_gives_features_of_a_pack(
    owner: Callable[..., Any], pack: Pack, tmp_path: Path
) -> None:
    text, _ = owner(tmp_path)
    model, own = open_model(text).on(pack)
    found = features(model, own, "touch", rows(pack))
    assert (
        found.shape == (6, model.encoders["touch"].num_features) and np.isfinite(found).all() and found.std(0).max() > 0
    )
    about = model.describe()["encoders"]["touch"]
    assert about["files"] and about["frames_given"] == 1 and about["trained_on"] == "unknown"
    wanted = model.parts["touch"].preprocessing
    assert len(model.notes) == (wanted.frames > 1) + (wanted.offset is not None)


def onnx_mean(path: Path, side: int | str = 16, batch: int | str = "n", channels: int = 3) -> Path:
    """A network that gives the mean of each channel."""
    value = helper.make_tensor_value_info
    nodes = [helper.make_node("GlobalAveragePool", ["x"], ["y"]), helper.make_node("Flatten", ["y"], ["z"])]
    ends: Any = [value("x", TensorProto.FLOAT, [batch, channels, side, side])]
    ends = ends, [value("z", TensorProto.FLOAT, [batch, channels])]
    made = helper.make_model(helper.make_graph(nodes, "mean", *ends), opset_imports=[helper.make_opsetid("", 13)])
    made.ir_version = 8
    onnx.save(made, path)
    return path


class Means(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.mean(3)


FACTORY = """
from torch import nn

class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv = nn.Conv2d(3, 5, 4, 4)
    def forward(self, x):
        return self.conv(x)

def good():
    return Net(), {"size": 16, "licence": "MIT", "title": "net", "trained_on": "ours"}

def nan():
    net = Net()
    nn.init.constant_(net.conv.weight, float("nan"))
    return net, {}

def bare():
    return Net()

def wrong():
    return Net(), {"sides": 3}

def six():
    return nn.Conv2d(6, 5, 4, 4), {}

class Nothing(nn.Module):
    def forward(self, x):
        return x[:, :0, 0, 0]

def nothing():
    return Nothing(), {}
"""


def test_onnx_torchscript_and_python_files(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    onnx_mean(tmp_path / "mean.onnx", 32)
    (tmp_path / "nets_here.py").write_text(FACTORY)
    images = torch.from_numpy(pack.images["touch"][rows(pack)]).permute(0, 3, 1, 2)
    plain = images.float() / 255
    found = open_model("external:mean.onnx,mean=none,std=none").on(pack)[0]
    torch.testing.assert_close(found.features("touch", images), plain.mean((2, 3)))
    assert found.parts["touch"].preprocessing.size == (32, 32) and found.untrained() is None
    onnx_mean(tmp_path / "one.onnx", 32, batch=1)
    single = open_model("external:one.onnx,mean=none,std=none").on(pack)[0]
    torch.testing.assert_close(single.features("touch", images), plain.mean((2, 3)))
    with pytest.raises(ValueError, match="it takes 1 channels, the images have 3"):
        open_model(f"external:{onnx_mean(tmp_path / 'gray.onnx', 32, channels=1).name}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.jit is deprecated
        torch.jit.script(Means()).save("mean.ts")
    tokens = open_model("external:mean.ts,mean=none,std=none,size=32,prefix=1").on(pack)[0]
    torch.testing.assert_close(tokens.features("touch", images), plain.mean(3)[:, 1:].mean(1))  # three tokens of 32
    net = open_model("external:python:nets_here:good").on(pack)[0]
    about = net.describe()["encoders"]["touch"]
    assert (about["title"], about["licence"], about["features"], about["trained_on"]) == ("net", "MIT", 5, "ours")
    with pytest.raises(ValueError, match="NaN or infinite features of touch"):
        open_model("external:python:nets_here:nan").on(pack)[0].features("touch", images)
    for name, words in (
        ("bare", "no torch module and dict"),
        ("wrong", "'sides'"),
        ("six", "does not take images"),
        ("nothing", r"nets_here:nothing: .*returns \[2, 0\] for two images"),
        ("no", "has no attribute 'no'"),
    ):
        with pytest.raises(ValueError, match=words):
            open_model(f"external:python:nets_here:{name}")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("external:sparks:file.safetensors", "choose from external:.*sparsh"),
        ("external:timm/resnet19,weights=random", "unknown trunk 'resnet19'"),
        ("external:timm/vit_base_patch16_clip_224.openai", "clip_quickgelu_224.openai"),
        (f"{TINY},sice=32", "unknown field.*'sice'.*'size'"),
        (f"{TINY},size=0", "or less"),
        (f"{TINY},mean=grey", "give 3 numbers"),
        (f"{TINY},pool=cls", "needs a network with tokens"),
        ("external:none.onnx", "does not exist"),
    ],
)
def test_bad_encoders_are_named_in_one_line(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        open_model(text)
    assert len(str(caught.value).splitlines()) == 1


def test_probe_writes_what_is_needed_to_check_an_encoder(
    pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (weights := tmp_path / "w.pth").parent.mkdir(exist_ok=True)
    network = open_model("external:timm/test_resnet,weights=random").parts["touch"].loaded.network
    torch.save(network.state_dict(), weights)
    encoder = f"external:{weights},trunk=test_resnet,size=32,licence=CC-BY-NC-4.0,title=theirs,reads=touch"
    out = tmp_path / "scores.json"
    assert main(["probe", "--encoder", encoder, "--on", str(pack.path), "--tasks", "pattern", "--json", str(out)]) == 0
    printed, result = capsys.readouterr().out, json.loads(out.read_text())
    assert "theirs (NC)" in printed and "no commercial use" in printed.replace("\n", " ") and "LEAK?" in printed
    (described,) = result["encoders"]
    about = described["encoders"]["touch"]
    assert (
        about["licence"] == "CC-BY-NC-4.0"
        and len(about["files"]["w.pth"]) == 64
        and about["parameters"] == sum(p.numel() for p in network.parameters())
    )
    assert about["preprocessing"]["size"] == [32, 32] and described["encoder"] == encoder
    sources = {r["source"]: r.get("leak") for r in result["records"]}
    assert sources["theirs (NC)"] == "unknown" and sources["theirs, untrained"] == "" and "pixels" in sources
    assert {r["modality"] for r in result["records"] if r["source"] == "theirs (NC)"} == {"touch"}


def test_an_encoder_is_probed_beside_a_run(smoke_run: Path, pack: Pack) -> None:
    config = ProbeConfig(tasks=("pattern",), controls=False)
    result = probe_runs([smoke_run], config, pack, encoders=[TINY])
    alone = probe_runs([smoke_run], config, pack)
    assert {r["source"] for r in result["records"]} == {"mvitac", "mvitac_tiny, random"}
    assert [r for r in result["records"] if "run" in r] == alone["records"]  # the run's scores are those without it
    for bad, words in (
        ({"encoders": [TINY, TINY]}, "given twice"),
        ({"encoders": ["external:none.onnx"]}, "does not exist"),
    ):
        with pytest.raises(ValueError, match=words):
            probe_runs([smoke_run], config, pack, **bad)
    with pytest.raises(ValueError, match="--on PACK"):
        probe_runs([], config, encoders=[TINY])


def test_non_commercial_licences() -> None:
    assert is_noncommercial("CC-BY-NC-4.0") and is_noncommercial("cc-by-nc-sa-4.0")
    for licence in ("MIT", "unknown", "Apache-2.0 (owner's code: CC-BY-NC-4.0)"):
        assert not is_noncommercial(licence)
