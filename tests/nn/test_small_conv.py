"""Convolutions over small maps as products: the same values and gradients, and the convolution where it must stay."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from mvitac.nn.encoders import SCRATCH, EncoderConfig, build_trunk
from mvitac.nn.small_conv import SmallMapConv2d, _Product, use_products

CHANNELS_LAST = torch.channels_last


def layer(stride: int, dtype: torch.dtype = torch.float32) -> SmallMapConv2d:
    torch.manual_seed(0)
    conv = nn.Conv2d(5, 7, 3, stride, padding=1, bias=False, dtype=dtype)
    return use_products(nn.Sequential(conv)).to(memory_format=CHANNELS_LAST)[0]  # type: ignore[index, return-value]


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("side", [(1, 1), (2, 2), (3, 3), (2, 4), (3, 1), (5, 4)])
def test_equals_the_convolution_and_its_gradients(
    side: tuple[int, int], stride: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mvitac.nn.small_conv.MAX_PIXELS", 20)
    conv = layer(stride, torch.float64)
    images = torch.randn(4, 5, *side, dtype=torch.float64).to(memory_format=CHANNELS_LAST).requires_grad_()
    asked, want = conv(images), F.conv2d(images, conv.weight, stride=stride, padding=1)
    assert asked.grad_fn is not None and "Product" in type(asked.grad_fn).__name__
    torch.testing.assert_close(asked, want)
    towards = torch.randn_like(want)
    mine = torch.autograd.grad(asked, (images, conv.weight), towards)
    theirs = torch.autograd.grad(want, (images, conv.weight), towards)
    torch.testing.assert_close(mine, theirs)


def test_gradients_have_the_weights_layout() -> None:
    conv = layer(1)
    conv(torch.randn(4, 5, 2, 2).to(memory_format=CHANNELS_LAST)).square().sum().backward()
    assert conv.weight.grad is not None
    assert conv.weight.grad.stride() == conv.weight.stride()  # the fused optimiser reads both as they lie in memory


def test_bf16_autocast_is_as_close_as_the_convolution() -> None:
    conv = layer(1)
    images = torch.randn(4, 5, 2, 2).to(memory_format=CHANNELS_LAST)
    want = F.conv2d(images, conv.weight, padding=1)
    with torch.autocast("cpu", torch.bfloat16):
        got = conv(images)
    assert got.dtype == torch.bfloat16
    torch.testing.assert_close(got.float(), want, atol=0.02, rtol=0.02)


def products(trunk: nn.Module, images: torch.Tensor, monkeypatch: pytest.MonkeyPatch) -> int:
    count = 0
    original = _Product.apply

    def counted(*arguments: object) -> object:
        nonlocal count
        count += 1
        return original(*arguments)

    monkeypatch.setattr(_Product, "apply", counted)
    trunk(images)
    monkeypatch.setattr(_Product, "apply", original)
    return count


def test_only_small_maps_in_training_take_the_product(monkeypatch: pytest.MonkeyPatch) -> None:
    trunk = build_trunk(EncoderConfig(trunk="resnet10t", weights=SCRATCH), 3)
    images = torch.randn(2, 3, 48, 48)
    # Stages 3 (3x3 pixels) and 4 (2x2) have two 3x3 convolutions each; larger maps stay with the convolution.
    assert products(trunk.train(), images, monkeypatch) == 4
    assert products(trunk.train(), torch.randn(2, 3, 160, 160), monkeypatch) == 0
    assert products(trunk.eval(), images, monkeypatch) == 0


def test_other_convolutions_stay_as_they_are() -> None:
    others = nn.Sequential(
        nn.Conv2d(4, 4, 1),
        nn.Conv2d(4, 4, 3, padding=1),  # has a bias
        nn.Conv2d(4, 4, 3, padding=1, groups=2, bias=False),
        nn.Conv2d(4, 4, 3, padding=2, dilation=2, bias=False),
        nn.Conv2d(4, 4, 3, padding=1, stride=(1, 2), bias=False),
        nn.Conv2d(4, 4, 5, padding=2, bias=False),
        nn.Conv2d(4, 4, 3, padding=1, padding_mode="reflect", bias=False),
    )
    names = list(others.state_dict())
    assert all(type(conv) is nn.Conv2d for conv in use_products(others))
    assert list(others.state_dict()) == names
