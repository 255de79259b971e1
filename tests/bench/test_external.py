"""Adapters to other people's encoders: small weights with their names give what their networks are by definition."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from torch import Tensor, nn

from mvitac.bench.external.base import parse
from mvitac.bench.external.encoder import open_encoder, randomised
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.bench.external.tower import Tower
from support.owners import OWNERS, tvl


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


def test_a_pickle_is_never_run(tmp_path: Path) -> None:
    torch.save({"model": nn.Linear(2, 2)}, tmp_path / "tvl.pth")
    with pytest.raises(ValueError, match="without running code"):
        open_encoder(f"external:tvl:{tmp_path / 'tvl.pth'}")


def test_positions_are_interpolated_to_another_size(tmp_path: Path) -> None:
    text, _ = tvl(tmp_path)
    plain, larger = open_encoder(text).loaded.network, open_encoder(f"{text},size=96x64").loaded.network
    assert isinstance(plain, Tower) and isinstance(larger, Tower)
    assert (plain.grid, larger.grid) == ((1, 3, 3), (1, 6, 4))
    assert torch.equal(larger.positions[:, 0], plain.positions[:, 0])  # that of the class token
    rows = plain.positions[0, 1:].unflatten(0, (3, 3)).mean(1)
    assert larger.positions[0, 1:].unflatten(0, (6, 4)).mean((0, 1)) == pytest.approx(rows.mean(0), abs=0.02)


def levels(*values: int) -> Tensor:
    """One image of 8 x 8 pixels per value, uint8 [1, F, 3, 8, 8]."""
    return torch.tensor(values, dtype=torch.uint8).view(1, -1, 1, 1, 1).expand(1, len(values), 3, 8, 8)


def test_frames_are_newest_first_or_oldest_first_and_the_oldest_is_repeated() -> None:
    plain = {"mean": (0, 0, 0), "std": (1, 1, 1), "size": (8, 8)}
    stacked = Preprocessing(frames=2, **plain)(levels(255, 0, 51))
    assert stacked.shape == (1, 6, 8, 8) and stacked[0, :, 0, 0].tolist() == [1, 1, 1, 0, 0, 0]
    film = Preprocessing(frames=3, oldest_first=True, layout="video", **plain)(levels(255, 0))
    assert film.shape == (1, 3, 3, 8, 8) and film[0, 0, :, 0, 0].tolist() == [0, 0, 1]
    still = Preprocessing(frames=3, still=True, layout="frames", **plain)(levels(255, 0))
    assert still.shape == (1, 3, 3, 8, 8) and still[0, :, 0, 0, 0].tolist() == [1, 1, 1]


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
