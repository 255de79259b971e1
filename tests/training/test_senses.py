"""A network of its own for each sense, locked or not: training, resuming, momentum copies, probes, export, loading."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from safetensors.torch import save_file

import mvitac
from mvitac.data.pack import Pack
from mvitac.deploy.export_module import ExportModule
from mvitac.evaluation import features
from mvitac.evaluation.controls import _untrained, frozen_trunks
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.methods.base import MethodConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.nn.encoders import SCRATCH, EncoderConfig, Encoders, build_trunk, num_features, within
from mvitac.nn.momentum import Momentum
from mvitac.recipes import recipe
from mvitac.run import Run
from mvitac.training import setup
from mvitac.training.loop import train
from mvitac.training.start import load_trunk
from mvitac.transforms.random_views import Augment, ViewAugment
from support.small_methods import TINY, small
from support.toy import Toy
from support.training_runs import smoke, train_twice, weights

VISION = "test_resnet.r160_in1k"  # 96 features; its inputs are normalised by .5, not by ImageNet's mean and deviation
TWO = Encoders(vision=EncoderConfig(trunk=VISION, weights=SCRATCH), touch=TINY.touch)
SIZES = Augment(size=32, vision=ViewAugment(size=24, whole=28), touch=ViewAugment(whole=30))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(7)
    path = tmp_path_factory.mktemp("weights") / "vision.safetensors"
    save_file(build_trunk(TWO.vision, 3).state_dict(), path)
    return path


def started(pack: Pack, file: Path, **vision: object) -> Run:
    encoder = replace(TWO, vision=replace(TWO.vision, weights=str(file), **vision))  # type: ignore[arg-type]
    method = MViTacConfig(hidden=32, out=16)
    return smoke(pack, encoder=encoder, augment=SIZES, method=method, steps=4, eval_every=0, checkpoint_every=2)


def test_from_training_to_the_exported_model(pack: Pack, file: Path, tmp_path: Path) -> None:
    run = started(pack, file)
    trained, start = weights(train_twice(run, tmp_path, cut=3)), build_trunk(run.encoder.vision, 3).state_dict()
    assert not any(torch.equal(trained[f"encoders.vision.{name}"], value) for name, value in start.items())
    model = mvitac.load(tmp_path / "cut")
    assert "vision test_resnet.r160_in1k, touch mvitac_tiny" in repr(model)
    images = {m: pack.images[m][:5].copy() for m in ("vision", "touch")}
    features = model.embed(**images)
    assert {m: tuple(z.shape) for m, z in features.items()} == {"vision": (5, 96), "touch": (5, 64)}
    assert model.transform("vision", normalize=True)(images["vision"][0]).shape == (3, 28, 28)
    pixels = (images["vision"][:1] / 255 - 0.5) / 0.5
    model.run = replace(run, augment=replace(SIZES, vision=ViewAugment(size=32)))
    expected = model.encoders["vision"](torch.from_numpy(pixels).float().permute(0, 3, 1, 2)).detach()
    torch.testing.assert_close(model.embed(vision=images["vision"][0])["vision"], expected)
    scores = probe_runs([tmp_path / "cut"], ProbeConfig(probes=("linear",)), pack)["records"]
    assert {r["modality"] for r in scores if r.get("source") == "mvitac"} == {"vision", "touch", "both"}
    assert {r["modality"] for r in scores if r["source"] == "start"} == {"vision"}  # touch starts from random weights
    assert {r["modality"] for r in scores if r["source"] == "imagenet"} == {"vision", "touch", "both"}
    model = mvitac.load(tmp_path / "cut")
    graph = ExportModule(model)  # what is exported
    found = dict(zip(graph.outputs, graph(*(torch.from_numpy(images[m]) for m in graph.modalities)), strict=True))
    shared = model.embed(**images, shared=True)
    for m in images:
        torch.testing.assert_close(found[f"embedding_{m}"], features[m], atol=1e-3, rtol=1e-3)
        torch.testing.assert_close(found[f"shared_{m}"], shared[m], atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("name", [name for name, kind in MethodConfig.choices.items() if not kind.needs_vit])  # type: ignore[attr-defined]
def test_every_method_trains_two_and_leaves_a_locked_one(pack: Pack, file: Path, tmp_path: Path, name: str) -> None:
    run = replace(started(pack, file, locked=True), method=small(name), steps=2)
    train(run, tmp_path / "run", quiet=True)
    trained = weights(tmp_path / "run")
    for parameter, value in build_trunk(run.encoder.vision, 3).state_dict().items():
        inner = "trunks.0." if name == "calandra" else ""
        assert torch.equal(trained[f"encoders.vision.{inner}{parameter}"], value), parameter
    assert all(p.requires_grad for p in mvitac.load(tmp_path / "run").parameters())  # it can be trained further


@pytest.mark.parametrize("name", ["mvitac", "supervised"])
def test_a_locked_trunk(pack: Pack, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Sees each whole image once: as if at every step, to rounding, and resumed bit for bit. Probes read the same."""
    whole = ViewAugment(scale=(1.0, 1.0), flip=0.0, grayscale=0.0, size=24)
    run = started(pack, file, locked=True, pool="stages")
    run = replace(run, method=small(name), augment=replace(SIZES, vision=whole))
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path))
    read = Mock(wraps=features.pack_features)
    monkeypatch.setattr(features, "pack_features", read)
    once = train_twice(run, tmp_path, cut=3)
    mvitac.probe(once, tasks=("bright",), controls=False)
    assert [call.args[2] for call in read.call_args_list].count("vision") == 1
    monkeypatch.setattr(setup, "_once", lambda *_: False)
    train(run, tmp_path / "seen", quiet=True, validate=False)
    torch.testing.assert_close(weights(once), weights(tmp_path / "seen"), rtol=1e-3, atol=1e-4)


def test_precision_is_measured_on_what_a_step_computes(pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    """The features of a locked trunk are there already; eight small images take other kernels than a batch."""
    run, seen = recipe("locked", pack), []
    made = build_trunk(TINY.touch, 3)
    made.register_forward_pre_hook(lambda _, args: seen.append(args[0].shape))
    built: list[str] = []
    monkeypatch.setattr(setup, "build_trunk", lambda config, *_: (built.append(config.trunk), made)[1])
    setup._trial_pass(run, pack, torch.device("cpu"))()
    assert built == [run.encoder.touch.trunk] and seen == [(32, 3, run.augment.size, run.augment.size)]


def test_features_of_all_stages() -> None:
    config = EncoderConfig(trunk=TWO.vision.trunk, weights="scratch", temporal="mean", pool="stages")
    trunk, images = build_trunk(config, 6, frames=2).eval(), torch.rand(3, 6, 40, 40)
    maps = within(trunk).forward_intermediates(images.unflatten(1, (2, 3)).flatten(0, 1))[1]  # type: ignore[operator]
    expected = torch.cat([each.flatten(2).mean(2) for each in maps], 1).unflatten(0, (3, 2)).mean(1)
    torch.testing.assert_close(trunk(images), expected)
    assert expected.shape[1] == num_features(trunk)
    other = build_trunk(replace(config, pool="last", temporal="stack"), 3)
    load_trunk(other, trunk.state_dict())
    ((_, control),) = frozen_trunks([recipe("locked")])  # of both senses, as the run has them of one
    assert {control.encoder[m].pool for m in ("vision", "touch")} == {"stages"}
    assert torch.equal(other.state_dict()["conv1.0.weight"], within(trunk).state_dict()["conv1.0.weight"])


def test_the_untrained_control_keeps_a_locked_tower(pack: Pack, file: Path) -> None:
    """It is the run before its first step, so the gain by both senses is that of training."""
    run, trained = started(pack, file, locked=True), started(pack, file)
    kept, fresh = _untrained(run, [run]).encoder, _untrained(trained, [trained]).encoder
    assert _untrained(run, [run, trained]).encoder.vision.weights == SCRATCH  # a control for both
    assert kept.vision == run.encoder.vision and {kept.touch.weights, fresh.vision.weights} == {SCRATCH}
    lost = replace(run, encoder=replace(run.encoder, vision=replace(run.encoder.vision, weights="gone.pt")))
    assert _untrained(lost, [lost]).encoder.vision.weights == SCRATCH


def test_a_momentum_copy_shares_a_locked_trunk() -> None:
    locked = replace(TWO, vision=replace(TWO.vision, locked=True))
    method = MViTacConfig(hidden=32, out=16).build(Toy().spec(), locked).train()
    copies = {m: key.module for m, key in method.key.items() if isinstance(key, Momentum)}
    assert copies["vision"].trunk is method.query["vision"].trunk and not copies["vision"].trunk.training  # type: ignore[union-attr]
    assert copies["touch"].trunk is not method.query["touch"].trunk and copies["touch"].trunk.training  # type: ignore[union-attr]


def test_kept_norms_of_one_trunk() -> None:
    """BatchNorm keeps its statistics while its own parameters learn."""
    encoders = replace(TWO, vision=replace(TWO.vision, keep_norms=True))
    method = MViTacConfig(hidden=32, out=16).build(Toy().spec(), encoders).train()
    layers = {m: tower.trunk.modules() for m, tower in method.query.items()}  # type: ignore[union-attr]
    norms = {m: [x for x in found if isinstance(x, torch.nn.BatchNorm2d)] for m, found in layers.items()}  # type: ignore
    assert {m: {x.training for x in found} for m, found in norms.items()} == {"vision": {False}, "touch": {True}}
    assert all(p.requires_grad for p in method.query.parameters())


def test_what_cannot_be_locked_is_said(pack: Pack) -> None:
    with pytest.raises(ValueError, match=r"touch is locked at random weights: give --encoder\.touch\.weights"):
        smoke(pack, encoder=replace(TWO, touch=replace(TWO.touch, locked=True))).check(pack.spec, 80, 32)
