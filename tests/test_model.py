"""What is saved is what is loaded, and embed() sees what the probe saw."""

import copy
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import timm
import torch
from PIL import Image
from torch.utils.data import DataLoader

import mvitac
from mvitac.data.images import difference, fit
from mvitac.data.pack import Pack
from mvitac.evaluation.features import pack_features
from mvitac.methods.calandra import CalandraConfig
from mvitac.model import Model, fresh
from mvitac.transforms.random_views import IMAGENET, plain_view
from support.toy import toy_pack
from support.training_runs import smoke


def batch(pack: Pack, num: int, modality: str = "touch") -> torch.Tensor:
    return torch.from_numpy(np.array(pack.images[modality][:num])).permute(0, 3, 1, 2)


def test_loading_draws_nothing_from_the_callers_chance(smoke_run: Path) -> None:
    state = torch.manual_seed(99).get_state()
    mvitac.load(smoke_run)
    assert torch.equal(torch.get_rng_state(), state)


def test_embed_equals_the_probes_features(model: Model, pack: Pack) -> None:
    rows = np.array([3, 50, 119])
    for modality in ("vision", "touch"):
        expected = pack_features(model, pack, modality, rows)
        assert torch.equal(model.embed(**{modality: pack.images[modality][rows]})[modality], expected)


def test_whole_images_are_seen_at_their_own_size(model: Model, pack: Pack) -> None:
    crops = replace(model.run.augment, size=16, whole=24)
    method, run = model.run.method.build(pack.spec, model.run.encoder), replace(model.run, augment=crops)
    smaller = Model(method, run, pack.spec, 32)
    images = torch.from_numpy(pack.images["touch"][[0, 1, 2, 3]]).permute(0, 3, 1, 2)
    assert torch.equal(smaller.features("touch", images), smaller.encoders["touch"](plain_view(images, 24)).detach())
    as_trained = smaller.encoders["touch"](plain_view(images, 16)).detach()  # heads keep to the side they learned from
    assert torch.equal(smaller.features("touch", images, for_heads=True), as_trained)
    assert torch.equal(smaller.embed(touch=pack.images["touch"][[0]])["touch"], smaller.features("touch", images[:1]))
    shared = smaller.embed(touch=pack.images["touch"][[0]], shared=True)["touch"]
    assert torch.equal(shared, smaller.project("touch", smaller.features("touch", images[:1], for_heads=True)))
    as_crops = Model(model.run.method.build(pack.spec, model.run.encoder), model.run, pack.spec, 32)
    as_crops.load_state_dict(smaller.state_dict())
    assert as_crops.weights_digest() != smaller.weights_digest()  # cached features of one are not the other's


def kinds(array: np.ndarray, folder: Path) -> dict[str, Any]:
    picture, tensor = Image.fromarray(array), torch.from_numpy(array.copy())
    picture.save(folder / "image.png")
    return {
        "array": array,
        "floats": array / 255,
        "channels first": array.transpose(2, 0, 1),
        "tensor": tensor.permute(2, 0, 1),
        "tensor of floats": tensor.permute(2, 0, 1).float() / 255,
        "tensor, channels last": tensor,
        "PIL": picture,
        "path": folder / "image.png",
        "name": str(folder / "image.png"),
    }


def test_embed_takes_paths_arrays_tensors_and_pictures_alike(model: Model, pack: Pack, tmp_path: Path) -> None:
    array = pack.images["touch"][7]
    forms, expected = kinds(array, tmp_path), model.embed(touch=array)["touch"]
    for name, image in forms.items():
        assert torch.equal(model.embed(touch=image)["touch"], expected), name
    several = model.embed(touch=list(forms.values()))["touch"]
    torch.testing.assert_close(several, expected.expand(len(forms), -1))  # a larger batch sums in another order
    stacked = np.array(pack.images["touch"][:3])
    expected = model.embed(touch=stacked)["touch"]
    for form in (torch.from_numpy(stacked), torch.from_numpy(stacked).permute(0, 3, 1, 2), stacked / 255):
        assert torch.equal(model.embed(touch=form)["touch"], expected)
    assert model.embed(touch=np.array([forms["name"]] * 2))["touch"].shape == (2, 64)  # as a column of a table


def test_floats_are_taken_as_levels_or_refused(model: Model, pack: Pack) -> None:
    """Everywhere: floats in [0, 1] were taken for levels 0 to 255, which are all black."""
    images = batch(pack, 4)
    scaled, normalised = images / 255, (images / 255 - 0.45) / 0.22
    close = {"atol": 1e-4, "rtol": 1e-4}
    expected = model.features("touch", images)
    torch.testing.assert_close(model.features("touch", scaled), expected, **close)
    torch.testing.assert_close(model(touch=scaled)["touch"].detach(), expected, **close)
    torch.testing.assert_close(model.embed(touch=scaled)["touch"], expected, **close)
    torch.testing.assert_close(model.predict(touch=scaled), model.predict(touch=images), **close)
    for call in (
        lambda x: model.features("touch", x),
        lambda x: model(touch=x),
        lambda x: model.embed(touch=x),
        lambda x: model.predict(touch=x),
        lambda x: model.transform("touch")(x[0]),
    ):
        for wrong in (images.float(), normalised, torch.full_like(scaled, torch.nan)):
            with pytest.raises(ValueError, match=r"expected floats in \[0, 1\] or uint8, got .*float32 from"):
                call(wrong)
        with pytest.raises(ValueError, match=r"uint8.*float.*int64"):
            call(images.long())


def test_forward_gives_the_features_of_embed_with_gradients(model: Model, pack: Pack) -> None:
    images = {m: batch(pack, 6, m) for m in ("vision", "touch")}
    for shared in (False, True):
        found, expected = model(**images, shared=shared), model.embed(**images, shared=shared)
        assert list(found) == ["vision", "touch"]
        for modality, features in found.items():
            assert features.requires_grad and torch.equal(features, expected[modality])
    large = torch.randint(0, 256, (2, 3, 50, 80), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    twice = copy.deepcopy(model)
    twice.run = replace(model.run, augment=replace(model.run.augment, size=20))
    expected = twice.embed(touch=large)["touch"]  # other sizes are resized like raw images: to 32, then to 20
    assert (twice(touch=large)["touch"] - expected).norm() < 0.01 * expected.norm()
    squeezed = torch.nn.functional.interpolate(large.float(), (32, 32), mode="bilinear", antialias=True)
    floats = (squeezed / 255).requires_grad_()
    model(touch=floats)["touch"].sum().backward()
    assert floats.grad is not None and floats.grad.abs().sum() > 0


class Touches(torch.utils.data.Dataset):  # at module level, so that a worker that is a new process can unpickle it
    def __init__(self, images: np.ndarray, transform: Any) -> None:
        self.images, self.transform = images, transform

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, item: int) -> torch.Tensor:
        return self.transform(Image.fromarray(self.images[item]))


def test_transform_prepares_images_in_a_data_loader(model: Model) -> None:
    images = np.random.default_rng(1).integers(0, 256, (5, 40, 60, 3), dtype=np.uint8)
    expected = model.embed(touch=images)["touch"]
    (loaded,) = DataLoader(Touches(images, model.transform("touch")), batch_size=5, num_workers=1)
    assert loaded.shape == (5, 3, 32, 32) and loaded.dtype == torch.uint8
    assert torch.equal(model(touch=loaded)["touch"], expected)
    normalised = pickle.loads(pickle.dumps(model.transform("touch", normalize=True)))
    inputs = torch.stack([normalised(image) for image in images])
    assert torch.equal(model.trunk("touch")(inputs.contiguous(memory_format=torch.channels_last)), expected)


def test_trunk_is_a_plain_timm_model(pack: Pack, tmp_path: Path) -> None:
    run = smoke(pack)
    run = replace(run, encoder=run.encoder.changed(trunk="resnet10t"), augment=replace(run.augment, whole=24))
    model = fresh(run, pack.spec, 32)
    before = [type(layer) for layer in model.modules()]
    trunk = model.trunk("touch")
    config = timm.data.resolve_model_data_config(trunk)
    assert (config["input_size"], config["mean"], config["std"]) == ((3, 24, 24), *IMAGENET)
    assert trunk.num_features == 512 and trunk.pretrained_cfg["num_classes"] == 0
    kinds, theirs = ({type(m) for m in net.modules()} for net in (trunk, timm.create_model("resnet10t")))
    assert kinds == theirs - {torch.nn.Linear} | {torch.nn.Identity}
    timm.models.save_for_hf(trunk, str(tmp_path), safe_serialization=True)
    again = timm.create_model(f"local-dir:{tmp_path}", pretrained=True).eval()
    images = pack.images["touch"][:2]
    inputs = torch.stack([model.transform("touch", normalize=True)(image) for image in images])
    torch.testing.assert_close(again(inputs), model.embed(touch=images)["touch"])
    assert timm.data.resolve_model_data_config(again)["input_size"] == config["input_size"]
    next(trunk.parameters()).data.zero_()  # a copy
    assert [type(layer) for layer in model.modules()] == before
    torch.testing.assert_close(again(inputs), model.embed(touch=images)["touch"])


def test_trunk_of_two_sensors_has_six_channels(tmp_path: Path) -> None:
    pack = toy_pack(tmp_path / "p", touch_channels=6, num=12)
    model = fresh(smoke(pack), pack.spec, 32)
    cfg = model.trunk("touch").pretrained_cfg
    assert cfg["input_size"] == (6, 32, 32) and cfg["mean"] == IMAGENET[0] * 2 and len(cfg["std"]) == 6
    with pytest.raises(ValueError, match="no single timm model but a Streams"):
        fresh(replace(model.run, method=CalandraConfig()), pack.spec, 32).trunk("touch")


def test_models_can_be_copied_and_pickled(model: Model, pack: Pack) -> None:
    expected = model.predict(touch=pack.images["touch"][:3])
    for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        assert repr(twin) == repr(model)
        torch.testing.assert_close(twin.predict(touch=pack.images["touch"][:3]), expected)


def test_embed_resizes_as_the_pack_does(model: Model) -> None:
    large = np.random.default_rng(0).integers(0, 255, (100, 80, 3), dtype=np.uint8)
    small = np.asarray(Image.fromarray(large).resize((32, 32), Image.Resampling.BILINEAR))
    assert torch.equal(model.embed(vision=large)["vision"], model.embed(vision=small)["vision"])


def test_background_is_subtracted_at_the_stored_size_as_in_packs(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    large = np.random.default_rng(3).integers(0, 255, (2, 2, 80, 100, 3), dtype=np.uint8)
    free, press = (np.stack([fit(image, 32) for image in images]) for images in large)
    with pytest.raises(ValueError, match="background cannot be used"):
        model.embed(touch=press, background=free)
    monkeypatch.setattr(model, "spec", replace(model.spec, difference=True))
    expected = model.embed(touch=[difference(press[0], free[0]), difference(press[1], free[1])])["touch"]
    assert torch.equal(model.embed(touch=press, background=free)["touch"], expected)
    of_one = model.embed(touch=[difference(press[0], free[0]), difference(press[1], free[0])])["touch"]
    assert torch.equal(model.embed(touch=press, background=Image.fromarray(free[0]))["touch"], of_one)
    assert not torch.equal(of_one[1], expected[1])
    found = model(touch=model.transform("touch", background=free[0])(press[1])[None])["touch"]
    torch.testing.assert_close(found, of_one[1:])
    with pytest.raises(ValueError, match="background cannot be used"):
        model.embed(vision=press, background=free)


def test_embed_takes_images_in_batches(smoke_run: Path, pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that memory does not grow with their number; the result is that of one batch."""
    model, images = mvitac.load(smoke_run), pack.images["touch"][:10]
    whole, sizes, features = model.embed(touch=images)["touch"], [], model.features
    monkeypatch.setattr("mvitac.model.EMBED_BATCH", 4)
    monkeypatch.setattr(model, "features", lambda m, x, **how: sizes.append(len(x)) or features(m, x, **how))
    torch.testing.assert_close(model.embed(touch=images)["touch"], whole, atol=1e-4, rtol=1e-4)
    assert sizes == [4, 4, 2]
    model.encoders["touch"].train()
    with pytest.raises(ValueError, match=r"call model.eval\(\) first"):
        model.embed(touch=images)
