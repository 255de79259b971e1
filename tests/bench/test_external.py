"""Other people's encoders: trunks of timm and Python functions, as models of data of any layout."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import timm
import torch

import mvitac
from mvitac.bench.external import ExternalModel, open_model
from mvitac.bench.external.adapters import Preprocessing
from mvitac.bench.external.model import is_noncommercial, randomised
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.features import features, pack_features
from mvitac.evaluation.probe import probe_model
from mvitac.evaluation.retrieval import cross_modal
from mvitac.model import fresh
from mvitac.nn.encoders import within
from support.toy import toy_pack
from support.training_runs import smoke


def test_frames_are_newest_first_and_the_oldest_is_repeated() -> None:
    made = Preprocessing(frames=3, mean=(0, 0, 0), std=(1, 1, 1), size=(8, 8))
    found = made(torch.tensor([255, 0], dtype=torch.uint8).view(1, -1, 1, 1, 1).expand(1, 2, 3, 8, 8))
    assert found.shape == (1, 9, 8, 8) and found[0, :, 0, 0].tolist() == [1, 1, 1, 0, 0, 0, 0, 0, 0]


TINY = "external:timm/mvitac_tiny,weights=random,size=32"

ROWS = np.arange(6)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    torch.save(timm.create_model("test_resnet", num_classes=0).state_dict(), tmp_path / "trunk.pth")
    return tmp_path / "trunk.pth"


def test_random_weights_for_the_control_leave_the_encoder_as_it_is(weights: Path) -> None:
    found = open_model(f"external:timm/test_resnet,weights={weights},size=32").part
    before = {name: value.clone() for name, value in found.loaded.network.state_dict().items()}
    untrained = found.untrained()
    assert untrained is not None and untrained.loaded.trained_on == "nothing"
    assert all(torch.equal(value, before[name]) for name, value in found.loaded.network.state_dict().items())
    again = randomised(found.loaded.network, 0).state_dict()
    for name, value in untrained.network.state_dict().items():
        assert torch.equal(value, again[name]) and (value.ndim < 2 or not torch.equal(value, before[name]))
    assert open_model(TINY).untrained() is None


@pytest.mark.parametrize("pool", ["last", "stages"])
def test_the_same_network_gives_the_same_features_as_in_a_run(pack: Pack, tmp_path: Path, pool: str) -> None:
    run = smoke(pack)
    ours = fresh(replace(run, encoder=run.encoder.changed(trunk="test_resnet", pool=pool)), pack.spec, pack.size)
    torch.save(within(ours.encoders["touch"]).state_dict(), tmp_path / "trunk.pth")
    text = f"external:timm/test_resnet,weights={tmp_path / 'trunk.pth'},size=32,pool={pool}"
    theirs, same = open_model(text).on(pack)
    assert same is pack
    own, expected = (features(model, pack, "touch", ROWS) for model in (theirs, ours))
    np.testing.assert_allclose(own, expected, atol=1e-4)


def test_load_gives_a_model_that_embeds_and_is_probed(pack: Pack) -> None:
    model = mvitac.load(TINY)
    assert isinstance(model, ExternalModel) and model.seed == 0 and model.trained_on == "nothing"
    model, own = model.on(pack)
    embedded = model.embed(touch=pack.images["touch"][ROWS])["touch"]
    np.testing.assert_allclose(embedded.numpy(), features(model, own, "touch", ROWS), atol=1e-5)
    found = probe_model(model, own, own.spec.tasks, ["touch", "both"], ["linear"])
    asked = {(t.name, m) for t in own.spec.tasks for m in ("touch", "both")}
    assert {(r["task"], r["modality"]) for r in found} == asked
    assert cross_modal(model, own) == []
    with pytest.raises(ValueError, match="has no run"):
        model.trunk("touch")


def test_sensors_are_encoded_one_by_one(pack: Pack, tmp_path: Path) -> None:
    two = toy_pack(tmp_path / "two", touch_channels=6, num=12)
    model, two = open_model(f"{TINY},reads=touch").on(two)
    one = ExternalModel(model.text, model.part, pack.spec, 32)
    both = torch.from_numpy(np.array(two.images["touch"][:3])).permute(0, 3, 1, 2)
    each = [one.features("touch", both[:, at : at + 3]) for at in (0, 3)]
    torch.testing.assert_close(model.features("touch", both), torch.cat(each, dim=1))


FACTORY = """
import time
import torch
from torch import nn

class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv = nn.Conv2d(3, 5, 4, 4)
    def forward(self, x):
        return self.conv(x)

def good():
    return Net(), {"size": 16, "licence": "MIT", "title": "net", "trained_on": "ours"}

def tokens():
    return nn.Flatten(2), {"size": 16, "mean": (0, 0, 0), "std": (1, 1, 1)}

def same():
    return nn.Flatten(2), {"size": 16, "mean": (0, 0, 0), "std": (1, 1, 1)}

def two_frames():
    return nn.Conv2d(6, 5, 4, 4), {"size": 16, "frames": 2}

def nan():
    net = Net()
    nn.init.constant_(net.conv.weight, float("nan"))
    return net, {}

def batch():
    net = nn.Sequential(Net(), nn.BatchNorm2d(5))
    net.train = lambda mode=True: net  # stays in training mode
    return net, {"size": 16}

def zero():
    net = Net()
    nn.init.zeros_(net.conv.weight)
    return net, {"size": 16}

def complex():
    return type("FFT", (nn.Module,), {"forward": lambda self, x: torch.fft.fft(x.mean((2, 3)))})(), {"size": 16}

def late():
    late = {"forward": lambda self, x: x.flatten(1).requires_grad_()[:, : 9 * len(x)]}
    return type("Late", (nn.Module,), late)(), {"size": 16}

def exits():
    raise SystemExit(0)

def levels():
    return Net(), {"mean": (123, 117, 104)}

def wrong():
    return Net(), {"sides": 3}

def six():
    return nn.Conv2d(6, 5, 4, 4), {}

class Buffer(nn.Module):
    out, busy = torch.zeros(128, 3), False
    def forward(self, x):
        assert not self.busy
        self.busy = True
        time.sleep(0.005)
        self.out[: len(x)] = x.mean((2, 3))
        self.busy = False
        return self.out[: len(x)]

def buffer():
    return Buffer(), {"size": 16, "mean": (0, 0, 0), "std": (1, 1, 1)}

def nothing():
    return type("Nothing", (nn.Module,), {"forward": lambda self, x: x[:, :0, 0, 0]})(), {}
"""


@pytest.fixture
def functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nets_here.py").write_text(FACTORY)
    return "external:python:nets_here:"


def test_python_functions(pack: Pack, functions: str) -> None:
    images = torch.from_numpy(pack.images["touch"][ROWS]).permute(0, 3, 1, 2)
    about = (net := open_model(f"{functions}good").on(pack)[0]).describe()["encoders"]["touch"]
    assert (about["title"], about["licence"], about["features"], about["trained_on"]) == ("net", "MIT", 5, "ours")
    expected = net.parts["touch"].network.network(net.parts["touch"].preprocessing(images[:, None])).mean((2, 3))
    torch.testing.assert_close(net.features("touch", images), expected)
    tokens = open_model(f"{functions}tokens,size=32").on(pack)[0].features("touch", images)
    torch.testing.assert_close(tokens, (images.float() / 255).mean(1).flatten(1))
    with pytest.raises(ValueError, match="NaN or infinite features of touch"):
        open_model(f"{functions}nan").on(pack)[0].features("touch", images)
    with pytest.raises(ValueError, match="batch: features of touch depend on the other images, or on chance"):
        open_model(f"{functions}batch").on(pack)[0].features("touch", images)
    with pytest.raises(ValueError, match="late: features of touch depend on the other images"):
        open_model(f"{functions}late").on(pack)[0].features("touch", images)
    with pytest.raises(ValueError, match=f"features of touch are the same for all {pack.num} images"):
        features(open_model(f"{functions}zero").on(pack)[0], pack, "touch", np.arange(pack.num))
    keys = [open_model(f"{functions}{name}").on(pack)[0] for name in ("tokens", "same", "same")]
    assert len({net.features_key("touch") for net in keys}) == 3 and len({net.weights_digest() for net in keys}) == 2
    for name, words in (
        ("exits", "no torch module and dict"),
        ("levels", "images are in 0 to 1"),
        ("complex", "of torch.complex64 for two images"),
        ("wrong", "'sides'"),
        ("six", "does not take images"),
        ("nothing", r"nets_here:nothing: .*returns \[2, 0\] of torch"),
        ("no", "has no attribute 'no'"),
    ):
        with pytest.raises(ValueError, match=words):
            open_model(f"{functions}{name}")


def test_one_buffer_for_all_features_and_one_call_at_a_time(pack: Pack, functions: str, two_threads: None) -> None:
    rows, images = np.tile(np.arange(pack.num), 3), pack.images["touch"][:]
    model = open_model(f"{functions}buffer,size=32").on(pack)[0]
    expected = torch.from_numpy(images / np.float32(255)).mean((1, 2))
    torch.testing.assert_close(pack_features(model, pack, "touch", rows), expected[rows])
    torch.testing.assert_close(model.embed(touch=images)["touch"], expected)


def test_windows_are_opened_where_the_data_has_an_order(pack: Pack, tmp_path: Path, functions: str) -> None:
    text = f"{functions}two_frames,reads=touch"
    frames = toy_pack(tmp_path / "frames", values=True)
    model, own = open_model(text).on(frames)
    assert own.spec.window.frames == 2 and not model.notes
    later = np.flatnonzero(frames.column("frame") == 1)[:3]
    found = features(model, own, "touch", later)
    still, plain = open_model(text).on(pack)
    assert plain is pack and "repeated" in still.notes[0]
    images = torch.from_numpy(frames.images["touch"][later]).permute(0, 3, 1, 2)
    assert not np.allclose(found, still.features("touch", images).numpy(), atol=1e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("external:sparsh:file.safetensors", "choose from external:timm/NAME, external:python"),
        ("external:timm/resnet19,weights=random", "unknown trunk 'resnet19'"),
        ("external:timm/vit_base_patch16_clip_224.openai", "clip_quickgelu_224.openai"),
        (f"{TINY},seed=1,seed=2", "an option is given twice"),
        (f"{TINY},sice=32", "unknown option.*'sice'.*'size'"),
        (TINY.replace("size=32", "size=0"), "or less"),
        (f"{TINY},seed=one", "seed: expected int"),
        (f"{TINY},trained-on=ours", "random weights are trained on nothing: leave trained-on out"),
        (f"{TINY},place=resnet18", "unknown option of external:timm 'place': choose from .*, trained-on"),
    ],
)
def test_bad_encoders_are_named_in_one_line(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        open_model(text)
    assert len(str(caught.value).splitlines()) == 1


def test_what_probe_writes(pack: Pack, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encoder = f"external:timm/test_resnet,weights={weights},size=32,licence=CC-BY-NC-4.0,title=theirs,reads=touch"
    out = tmp_path / "scores.json"
    assert main(["probe", "--encoder", encoder, "--on", str(pack.path), "--tasks", "pattern", "--json", str(out)]) == 0
    printed, result = capsys.readouterr().out, json.loads(out.read_text())
    assert "theirs (NC)" in printed and "no commercial use" in printed.replace("\n", " ") and "LEAK?" in printed
    (described,) = result["encoders"]
    about = described["encoders"]["touch"]
    assert about["licence"] == "CC-BY-NC-4.0" and len(about["files"]["trunk.pth"]) == 64
    assert about["parameters"] == sum(p.numel() for p in timm.create_model("test_resnet", num_classes=0).parameters())
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
        ({"encoders": [TINY + ",title=mvitac"]}, "two rows would be called 'mvitac'"),
        ({"encoders": [TINY + ",title=pixels"]}, "two rows would be called 'pixels'"),
        ({"encoders": ["external:timm/test_resnet,weights=none.pth"]}, "a file that exists"),
    ):
        with pytest.raises(ValueError, match=words):
            probe_runs([smoke_run], config, pack, **bad)
    with pytest.raises(ValueError, match="--on PACK"):
        probe_runs([], config, encoders=[TINY])
    with pytest.raises(ValueError, match="unknown probe 'l': choose from linear, paper, knn"):
        ProbeConfig(probes="linear")  # type: ignore[arg-type]


def test_non_commercial_licences() -> None:
    assert is_noncommercial("CC-BY-NC-4.0") and is_noncommercial("cc-by-nc-sa-4.0")
    for licence in ("MIT", "unknown", "Apache-2.0 (owner's code: CC-BY-NC-4.0)"):
        assert not is_noncommercial(licence)
