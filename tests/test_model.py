"""What is saved is what is loaded, and embed() sees what the probe saw."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import mvitac
from mvitac.data.images import difference
from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation.features import pack_features
from mvitac.model import Model
from mvitac.recipes import recipe
from mvitac.training.loop import train
from mvitac.transforms.random_views import plain_view
from support.toy import toy_pack


def trained(pack: Pack, out: Path) -> Path:
    return train(replace(recipe("smoke", PackConfig(path=pack.path)), steps=2), out, quiet=True)


@pytest.fixture(scope="module")
def run(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(pack, tmp_path_factory.mktemp("model") / "run")


@pytest.fixture(scope="module")
def model(run: Path) -> Model:
    return mvitac.load(run)


def test_loading_draws_nothing_from_the_callers_chance(smoke_run: Path) -> None:
    torch.manual_seed(5)
    expected = torch.rand(2)
    torch.manual_seed(5)
    mvitac.load(smoke_run)
    assert torch.equal(torch.rand(2), expected)


def test_embed_equals_the_probes_features(model: Model, pack: Pack) -> None:
    rows = np.array([3, 50, 119])
    for modality in ("vision", "touch"):
        expected = pack_features(model, pack, modality, rows)
        found = model.embed(**{modality: pack.images[modality][rows]})[modality]
        assert torch.equal(found, expected)


def test_whole_images_are_seen_at_their_own_size(model: Model, pack: Pack) -> None:
    crops = replace(model.run.augment, size=16, whole=24)
    smaller = Model(
        model.run.method.build(pack.spec, model.run.encoder), replace(model.run, augment=crops), pack.spec, 32
    )
    images = torch.from_numpy(pack.images["touch"][[0, 1, 2, 3]]).permute(0, 3, 1, 2)
    expected = smaller.encoders["touch"](plain_view(images, 24)).detach()
    assert torch.equal(smaller.features("touch", images), expected)
    as_trained = smaller.encoders["touch"](plain_view(images, 16)).detach()  # heads keep to the side they learned from
    assert torch.equal(smaller.features("touch", images, for_heads=True), as_trained)
    assert torch.equal(smaller.embed(touch=pack.images["touch"][[0]])["touch"], smaller.features("touch", images[:1]))
    shared = smaller.embed(touch=pack.images["touch"][[0]], shared=True)["touch"]
    assert torch.equal(shared, smaller.project("touch", smaller.features("touch", images[:1], for_heads=True)))
    as_crops = Model(model.run.method.build(pack.spec, model.run.encoder), model.run, pack.spec, 32)
    as_crops.load_state_dict(smaller.state_dict())
    assert as_crops.weights_digest() != smaller.weights_digest()  # cached features of one are not the other's


def test_embed_takes_arrays_tensors_and_pictures_alike(model: Model, pack: Pack) -> None:
    array = pack.images["touch"][7]
    expected = model.embed(touch=array)["touch"]
    assert torch.equal(model.embed(touch=torch.from_numpy(array.copy()).permute(2, 0, 1))["touch"], expected)
    assert torch.equal(model.embed(touch=Image.fromarray(array))["touch"], expected)
    several = model.embed(touch=[Image.fromarray(array), array])["touch"]
    torch.testing.assert_close(several, expected.expand(2, -1))  # a larger batch sums in another order


def test_embed_resizes_as_the_pack_does(model: Model) -> None:
    large = np.random.default_rng(0).integers(0, 255, (100, 80, 3), dtype=np.uint8)
    small = np.asarray(Image.fromarray(large).resize((32, 32), Image.Resampling.BILINEAR))
    assert torch.equal(model.embed(vision=large)["vision"], model.embed(vision=small)["vision"])


def test_background_is_subtracted_before_resizing(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    free, press = (rng.integers(0, 255, (2, 80, 100, 3), dtype=np.uint8) for _ in range(2))
    with pytest.raises(ValueError, match="was not trained on difference images"):
        model.embed(touch=press, background=free)
    monkeypatch.setattr(model, "spec", replace(model.spec, difference=True))
    expected = model.embed(touch=[difference(press[0], free[0]), difference(press[1], free[1])])["touch"]
    assert torch.equal(model.embed(touch=press, background=free)["touch"], expected)
    of_one = model.embed(touch=[difference(press[0], free[0]), difference(press[1], free[0])])["touch"]
    assert torch.equal(model.embed(touch=press, background=Image.fromarray(free[0]))["touch"], of_one)
    assert not torch.equal(of_one[1], expected[1])
    for wrong, says in [
        ({"touch": press, "background": [*free, *free]}, "got 4 images for 2 of touch"),
        ({"touch": press, "background": free[:, :40]}, "image is 100 x 80, its background 100 x 40"),
        ({"vision": press, "background": free}, "there is no touch"),
    ]:
        with pytest.raises(ValueError, match=says):
            model.embed(**wrong)


def test_shared_space_is_normalised(model: Model, pack: Pack) -> None:
    both = model.embed(vision=pack.images["vision"][:5], touch=pack.images["touch"][:5], shared=True)
    assert both["vision"].shape == both["touch"].shape == (5, 16)
    for z in both.values():
        torch.testing.assert_close(z.norm(dim=1), torch.ones(5))


def test_is_in_eval_mode_and_leaves_itself_alone(model: Model, pack: Pack) -> None:
    assert not any(module.training for module in model.modules())
    before = model.weights_digest()
    model.embed(touch=pack.images["touch"][:4])
    assert model.weights_digest() == before


def test_two_sensors_keep_their_order(tmp_path: Path) -> None:
    pack = toy_pack(tmp_path / "p", touch_channels=6, num=90)
    model = mvitac.load(trained(pack, tmp_path / "r"))
    stacked = pack.images["touch"][:2]
    swapped = np.concatenate([stacked[..., 3:], stacked[..., :3]], axis=-1)
    assert model.embed(touch=stacked)["touch"].shape == (2, 64)
    assert not torch.allclose(model.embed(touch=stacked)["touch"], model.embed(touch=swapped)["touch"])
    with pytest.raises(ValueError, match="takes 6 channels"):
        model.embed(touch=stacked[..., :3])


def test_changed_weights_are_refused(run: Path, tmp_path: Path) -> None:
    data = bytearray((run / "model.safetensors").read_bytes())
    data[-2] ^= 1
    (tmp_path / "model.safetensors").write_bytes(data)
    with pytest.raises(ValueError, match="does not match its digest"):
        mvitac.load(tmp_path)


def test_loading_needs_no_network_and_no_start_weights(pack: Pack, tmp_path: Path) -> None:
    """A run that started from a weights file loads where that file is gone."""
    import safetensors.torch
    import timm

    from mvitac.nn.encoders import EncoderConfig

    torch.manual_seed(0)
    start = tmp_path / "start.safetensors"
    safetensors.torch.save_file(timm.create_model("resnet10t").state_dict(), start)
    base = recipe("smoke", PackConfig(path=pack.path))
    run = replace(base, steps=1, encoder=EncoderConfig(trunk="resnet10t", weights=str(start)))
    out = train(run, tmp_path / "r", quiet=True)
    start.unlink()
    assert mvitac.load(out).embed(touch=pack.images["touch"][0])["touch"].shape == (1, 512)


def test_shows_itself_in_a_notebook(artifact: Path) -> None:
    model = mvitac.load(artifact)
    width = model.embed(touch=np.zeros((32, 32, 3), np.uint8))["touch"].shape[1]
    assert repr(model) == f"Model(mvitac of mvitac_tiny, trained on toy: features vision {width}, touch {width})"
    page = model._repr_html_()
    assert f"<td>touch</td><td>{width}</td>" in page
    assert all(f"<td>{task}</td><td>{', '.join(classes)}</td>" in page for task, classes in model.classes.items())
