"""Views: replayed parameters, exact special cases, and the statistics the paper names."""

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F

from mvitac.transforms import random_views
from mvitac.transforms.random_views import IMAGENET, Drawn, ViewAugment, apply, draw, plain_view


def images(num: int = 8, channels: int = 3, side: int = 40) -> torch.Tensor:
    noise = torch.rand(num, channels, 6, 6, generator=torch.Generator().manual_seed(3))
    return (F.interpolate(noise, (side, side), mode="bicubic").clamp(0, 1) * 255).to(torch.uint8)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def denormalise(view: torch.Tensor) -> torch.Tensor:
    mean, std = (torch.tensor(v).view(3, 1, 1) for v in IMAGENET)
    return (view.unflatten(1, (-1, 3)) * std + mean).flatten(1, 2)


@pytest.mark.parametrize("size", [24, 40, 56])
@pytest.mark.parametrize("channels", [3, 6])
def test_both_routes_replay_the_same_parameters(size: int, channels: int) -> None:
    """Crop, flip, jitter and grayscale of the batched route are the one-by-one route's to within a level's rounding."""
    raw = images(16, channels, side=40)
    drawn = draw(ViewAugment(scale=(0.3, 1.0), grayscale=0.3, jitter=0.2), 16, 40, generator())
    routes = random_views._one_by_one, random_views._batched
    one_by_one, batched = (route(raw, drawn, size, torch.float32, IMAGENET) for route in routes)
    off = 255 * (denormalise(one_by_one) - denormalise(batched)).abs()
    assert off.max() < 2.5 and off.mean() < 0.5
    wrong = Drawn(drawn.boxes.roll(1, 0), drawn.flip, drawn.grayscale, drawn.gains)
    other = denormalise(random_views._batched(raw, wrong, size, torch.float32))
    assert 255 * (denormalise(one_by_one) - other).abs().mean() > 5  # the bound can fail


@pytest.mark.parametrize("route", [random_views._one_by_one, random_views._batched])
def test_views_are_rounded_to_bf16_once(route: Callable[..., torch.Tensor]) -> None:
    drawn = draw(ViewAugment(), 8, 40, generator())
    exact, rounded = (route(images(), drawn, 24, dtype, IMAGENET) for dtype in (torch.float32, torch.bfloat16))
    assert torch.equal(exact.bfloat16(), rounded) and rounded.is_contiguous(memory_format=torch.channels_last)


def test_the_plain_view_is_the_normalised_image_and_a_flip_is_exact() -> None:
    raw, every = images(4, side=32), torch.ones(4, dtype=torch.bool)
    torch.testing.assert_close(denormalise(plain_view(raw, 32)), raw.float() / 255, atol=1e-6, rtol=0)
    turned = Drawn(torch.tensor([[0, 0, 32, 32]] * 4), every, ~every, torch.ones(4, 5))
    view = random_views.apply(raw, turned, 32, torch.float32)
    torch.testing.assert_close(denormalise(view), raw.flip(-1).float() / 255, atol=1e-6, rtol=0)


def test_statistics_of_the_paper() -> None:
    """Area uniform in .2-1 (where the crop fits), ratio within 3/4-4/3, flips .5, grayscale .2."""
    top, left, height, width = (drawn := draw(ViewAugment(), 20000, 256, generator())).boxes.T
    assert (top >= 0).all() and (left >= 0).all() and (top + height <= 256).all() and (left + width <= 256).all()
    area, ratio = height * width / 256**2, width / height
    assert 0.19 < float(area.min()) < 0.22 and 0.95 < float(area.max()) <= 1
    assert float(ratio.min()) > 0.73 and float(ratio.max()) < 1.37
    assert float(drawn.flip.float().mean()) == pytest.approx(0.5, abs=0.02)
    assert float(drawn.grayscale.float().mean()) == pytest.approx(0.2, abs=0.02) and (drawn.gains == 1).all()


def test_grayscale_makes_channels_equal_before_normalisation() -> None:
    view = denormalise(apply(images(), draw(ViewAugment(grayscale=1.0), 8, 40, generator()), 24, torch.float32))
    torch.testing.assert_close(view, view[:, :1].expand_as(view), atol=1e-5, rtol=0)


def test_stacked_sensors_move_together() -> None:
    raw = images()
    together = apply(torch.cat([raw, raw], dim=1), draw(ViewAugment(jitter=0.3), 8, 40, generator()), 24, torch.float32)
    assert torch.equal(together[:, :3], together[:, 3:])
