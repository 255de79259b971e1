"""Views: replayed parameters, exact special cases, and the statistics the paper names."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from mvitac.transforms import random_views
from mvitac.transforms.random_views import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    Augment,
    Drawn,
    ViewAugment,
    draw,
    plain_view,
    random_view,
)


def images(num: int = 8, channels: int = 3, side: int = 40) -> torch.Tensor:
    """Smooth uint8 pictures, as photographs are."""
    noise = torch.rand(num, channels, 6, 6, generator=torch.Generator().manual_seed(3))
    return (F.interpolate(noise, (side, side), mode="bicubic").clamp(0, 1) * 255).to(torch.uint8)


ROUTES = (random_views._one_by_one, random_views._batched)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def denormalise(view: torch.Tensor) -> torch.Tensor:
    sensors = view.unflatten(1, (-1, 3))
    mean, std = (torch.tensor(v).view(3, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
    return (sensors * std + mean).flatten(1, 2)


def test_plain_view_is_the_normalised_image() -> None:
    raw = images(side=32)
    torch.testing.assert_close(denormalise(plain_view(raw, 32)), raw.float() / 255, atol=1e-6, rtol=0)


def test_same_generator_same_view() -> None:
    config = ViewAugment(jitter=0.4)
    torch.testing.assert_close(
        random_view(images(), config, 24, generator()), random_view(images(), config, 24, generator()), atol=0, rtol=0
    )
    assert not torch.equal(
        random_view(images(), config, 24, generator()), random_view(images(), config, 24, generator(1))
    )


@pytest.mark.parametrize("size", [24, 40, 56])
@pytest.mark.parametrize("channels", [3, 6])
def test_both_routes_replay_the_same_parameters(size: int, channels: int) -> None:
    """Crop, flip, jitter and grayscale of the batched route are the one-by-one route's to within a level's rounding."""
    raw = images(16, channels, side=40)
    drawn = draw(ViewAugment(scale=(0.3, 1.0), grayscale=0.3, jitter=0.2), 16, 40, generator())
    one_by_one, batched = (
        f(raw, drawn, size, torch.float32) for f in (random_views._one_by_one, random_views._batched)
    )
    off = 255 * (denormalise(one_by_one) - denormalise(batched)).abs()
    assert off.max() < 2.5 and off.mean() < 0.5
    wrong = Drawn(drawn.boxes.roll(1, 0), drawn.flip, drawn.grayscale, drawn.gains)
    other = denormalise(random_views._batched(raw, wrong, size, torch.float32))
    assert 255 * (denormalise(one_by_one) - other).abs().mean() > 5  # the bound can fail


def test_both_routes_have_the_same_statistics() -> None:
    """Mean and spread of every channel over many random views of the same pictures."""
    raw = images(8, side=40).repeat(40, 1, 1, 1)
    config = ViewAugment()
    a, b = (route(raw, draw(config, 320, 40, generator(i)), 24, torch.float32) for i, route in enumerate(ROUTES))
    torch.testing.assert_close(a.mean((0, 2, 3)), b.mean((0, 2, 3)), atol=0.06, rtol=0)
    torch.testing.assert_close(a.std((0, 2, 3)), b.std((0, 2, 3)), atol=0.04, rtol=0)


@pytest.mark.parametrize("route", [random_views.apply, random_views._one_by_one, random_views._batched])
def test_views_are_rounded_to_bf16_once(route: Callable[..., torch.Tensor]) -> None:
    drawn = draw(ViewAugment(), 8, 40, generator())
    exact, rounded = (route(images(), drawn, 24, dtype) for dtype in (torch.float32, torch.bfloat16))
    assert torch.equal(exact.bfloat16(), rounded)
    assert rounded.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize(("side", "size"), [(40, 28), (42, 28), (40, 40), (40, 56), (9, 9)])
@pytest.mark.parametrize("channels", [3, 6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_compiled_views_are_torchs_bit_for_bit(side: int, size: int, channels: int, dtype: torch.dtype) -> None:
    """On noise, with crops from a pixel to the whole; gray alone sums three products, in an order of its own."""
    pytest.importorskip("numba")
    raw = torch.randint(0, 256, (24, channels, side, side), dtype=torch.uint8, generator=generator())
    drawn = draw(ViewAugment(scale=(0.01, 1.0), grayscale=0.3), 24, side, generator())
    drawn.boxes[0], drawn.boxes[1] = torch.tensor([0, 0, side, side]), torch.tensor([side - 2, side - 1, 2, 1])
    torchs, compiled = (route(raw, drawn, size, dtype) for route in (random_views._one_by_one, random_views.apply))
    gray = drawn.grayscale
    assert torch.equal(torchs[~gray], compiled[~gray])
    torch.testing.assert_close(torchs[gray], compiled[gray], atol=1e-6, rtol=0.01 if dtype == torch.bfloat16 else 1e-5)
    assert compiled.is_contiguous(memory_format=torch.channels_last)


def test_compiled_rounding_to_bf16_is_torchs() -> None:
    """Also of halves, which go to the even neighbour, and of what is a bit less or more."""
    pytest.importorskip("numba")
    from mvitac.transforms.numba_views import _bfloat16

    bits = [
        high << 16 | low for high in (0x3F80, 0x3F81, 0xBF80, 0xBF81) for low in (0, 1, 0x7FFF, 0x8000, 0x8001, 0xFFFF)
    ]
    values = np.array(bits, np.uint32).view(np.float32)
    rounded = np.array([_bfloat16(value) for value in values])
    assert rounded.tolist() == torch.from_numpy(values).bfloat16().view(torch.uint16).tolist()


def test_compiled_views_are_shared_among_torchs_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """One share for each, and the same views however many there are."""
    pytest.importorskip("numba")
    from mvitac.transforms import numba_views

    shares, views = [], numba_views.views

    def counted(*arrays: np.ndarray) -> None:
        shares.append(len(arrays[0]))
        views(*arrays)

    monkeypatch.setattr(numba_views, "views", counted)
    drawn = draw(ViewAugment(), 8, 40, generator())
    alone = random_views.apply(images(), drawn, 32)
    assert shares == [8]
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    assert torch.equal(random_views.apply(images(), drawn, 32), alone)
    assert sorted(shares[1:]) == [2, 3, 3]
    shares.clear()
    random_views.apply(images(2), draw(ViewAugment(), 2, 40, generator()), 32)
    assert shares == [1, 1]


def test_torchs_route_where_the_compiled_one_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jitter, other precisions, images far larger than the view, no numba; and whole images do not wait for numba."""

    class Cannot:
        MAX_SHRINK = 1.5

        def views(self, *_: object) -> None:
            raise AssertionError("the compiled route was taken")

    monkeypatch.setattr(random_views, "fused", Cannot)
    plain, jittered = (draw(ViewAugment(jitter=j), 8, 40, generator()) for j in (0.0, 0.3))
    for drawn, size, dtype in ((jittered, 32, torch.float32), (plain, 32, torch.float64), (plain, 26, torch.float32)):
        expected = random_views._one_by_one(images(), drawn, size, dtype)
        assert torch.equal(random_views.apply(images(), drawn, size, dtype), expected)
    plain_view(images(), 32)
    with pytest.raises(AssertionError, match="compiled"):
        random_views.apply(images(), plain, 32)
    monkeypatch.setattr(random_views, "fused", lambda: None)
    assert torch.equal(
        random_views.apply(images(), plain, 32), random_views._one_by_one(images(), plain, 32, torch.float32)
    )


def test_flip_is_exact() -> None:
    raw = images(4, side=32)
    drawn = Drawn(
        torch.tensor([[0, 0, 32, 32]] * 4),
        torch.ones(4, dtype=torch.bool),
        torch.zeros(4, dtype=torch.bool),
        torch.ones(4, 5),
    )
    torch.testing.assert_close(
        denormalise(random_views.apply(raw, drawn, 32)), raw.flip(-1).float() / 255, atol=1e-6, rtol=0
    )


def test_statistics_of_the_paper() -> None:
    """Area uniform in .2-1 (where the crop fits), ratio within 3/4-4/3, flips .5, grayscale .2."""
    drawn = draw(ViewAugment(), 20000, 256, generator())
    top, left, height, width = drawn.boxes.T
    assert (top >= 0).all() and (left >= 0).all()
    assert (top + height <= 256).all() and (left + width <= 256).all()
    area, ratio = height * width / 256**2, width / height
    assert 0.19 < float(area.min()) < 0.22 and 0.95 < float(area.max()) <= 1
    assert float(ratio.min()) > 0.73 and float(ratio.max()) < 1.37
    assert float(drawn.flip.float().mean()) == pytest.approx(0.5, abs=0.02)
    assert float(drawn.grayscale.float().mean()) == pytest.approx(0.2, abs=0.02)
    assert (drawn.gains == 1).all()


def test_grayscale_makes_channels_equal_before_normalisation() -> None:
    view = denormalise(random_view(images(), ViewAugment(grayscale=1.0), 24, generator()))
    torch.testing.assert_close(view[:, 0], view[:, 1], atol=1e-5, rtol=0)
    torch.testing.assert_close(view[:, 0], view[:, 2], atol=1e-5, rtol=0)


def test_stacked_sensors_move_together_unless_told() -> None:
    raw = images()
    stacked = torch.cat([raw, raw], dim=1)
    together = random_view(stacked, ViewAugment(jitter=0.3), 24, generator())
    assert torch.equal(together[:, :3], together[:, 3:])
    apart = random_view(stacked, ViewAugment(independent_sensors=True), 24, generator())
    assert not torch.equal(apart[:, :3], apart[:, 3:])


def test_jitter_keeps_the_range() -> None:
    view = denormalise(random_view(images(), ViewAugment(jitter=0.9), 24, generator()))
    assert float(view.min()) >= -1e-5 and float(view.max()) <= 1 + 1e-5


@pytest.mark.parametrize(("channels", "apart"), [(3, False), (6, False), (6, True)])
def test_noise_is_as_strong_as_drawn_and_stays_in_range(channels: int, apart: bool) -> None:
    gray = torch.full((400, channels, 32, 32), 128, dtype=torch.uint8)
    config = ViewAugment(scale=(1.0, 1.0), flip=0, grayscale=0, noise=20, independent_sensors=apart)
    levels = 255 * denormalise(random_view(gray, config, 32, generator())) - 128
    spread = levels.flatten(1).std(1)  # of each image: uniform on [0, 20]
    assert float(spread.min()) < 0.5 and 19 < float(spread.max()) < 20.5
    assert float(spread.mean()) == pytest.approx(10, abs=0.9) and float(spread.std()) == pytest.approx(5.8, abs=0.5)
    assert abs(float(levels.mean())) < 0.1
    assert float((levels[:, 0] * levels[:, 1]).mean()) == pytest.approx(0, abs=1)  # each channel has its own
    black = 255 * denormalise(random_view(torch.zeros_like(gray), config, 32, generator()))
    assert float(black.min()) >= -1e-3 and float(black.max()) > 20
    assert torch.equal(random_view(gray, config, 32, generator()), random_view(gray, config, 32, generator()))
    assert random_view(gray, config, 32, generator()).is_contiguous(memory_format=torch.channels_last)
    assert random_view(gray, config, 32, generator(), torch.bfloat16).dtype == torch.bfloat16


def test_without_noise_a_view_is_what_it_was() -> None:
    """No draw is taken for noise that is not there, so runs of before can be continued and repeated."""
    after = []
    for noise in (0.0, 5.0):
        drawing = generator()
        random_view(images(), ViewAugment(noise=noise), 24, drawing)
        after.append(torch.rand(1, generator=drawing))
    plain = generator()
    random_views.apply(images(), draw(ViewAugment(), 8, 40, plain), 24)
    assert after[0] == torch.rand(1, generator=plain) and after[0] != after[1]


def test_coloured_flips_of_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match=r"has no effect at touch\.flip 0: also give --augment\.touch\.flip 0\.5"):
        Augment(gel_flip="colour", touch=ViewAugment(flip=0.0))
