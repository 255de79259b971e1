"""Convolutions and ViTs against closed forms, plain torch and timm; a loss under autocast."""

import copy
from threading import Thread
from unittest.mock import patch

import pytest
import timm
import torch
import torch.nn.functional as F
from timm.layers.conv2d_same import Conv2dSame
from timm.models.vision_transformer import VisionTransformer
from torch import nn

from mvitac.nn.encoders import SCRATCH, EncoderConfig, Seeded, build_trunk, sin_cos_positions
from mvitac.nn.folded import folded
from mvitac.nn.losses import info_nce
from mvitac.nn.small_conv import DepthwiseConv2d, SmallMapConv2d, _Product, use_convolutions, use_products
from mvitac.nn.vit import encode_visible, patches, row_uniform


def test_is_fp32_under_autocast() -> None:
    """bf16 embeddings under bf16 autocast give the loss of their fp32 copies exactly."""
    q, k = torch.randn(32, 16).bfloat16(), torch.randn(32, 16).bfloat16()
    with torch.autocast("cpu", torch.bfloat16):
        inside = info_nce(q, k, 0.07)
    assert inside.dtype == torch.float32 and float(inside) == float(info_nce(q.float(), k.float(), 0.07))


def test_seeded_draws_what_the_seed_gives_while_another_thread_draws() -> None:
    def drawn() -> list[torch.Tensor]:
        first, kept = nn.Linear(4, 4), torch.empty(9)
        begun.append(Thread(target=torch.randn, args=(5,)))
        begun[-1].start(), begun[-1].join()
        nn.init.trunc_normal_(kept)
        other = F.scaled_dot_product_attention(kept.view(1, 3, 3), kept.view(1, 3, 3), kept.view(1, 3, 3))
        integers = torch.randint(9, (5,)), torch.randint(2, 9, (5,)), torch.randperm(9)
        free = torch.randn(4), *integers, torch.rand_like(kept)
        return [first.weight, *free, F.dropout(kept), torch.bernoulli(kept.abs() / 2), other]

    begun: list[Thread] = []
    with Seeded(3):
        found = drawn()
    with patch.object(Thread, "start"), patch.object(Thread, "join"), torch.random.fork_rng():
        torch.manual_seed(3)
        torch.testing.assert_close(found, drawn(), atol=0, rtol=0)


@pytest.mark.parametrize(("name", "left"), [("tf_efficientnet_lite0", 0), ("resnet10t", 1)])
def test_folded_batch_norm_changes_nothing(name: str, left: int) -> None:
    """That after a ResNet's stem of several convolutions is not beside the last of them."""
    trunk = build_trunk(EncoderConfig(trunk=name, weights=SCRATCH, pool="stages"), 3)
    trunk(torch.randn(4, 3, 64, 64))  # statistics
    images, before = torch.randn(2, 3, 64, 64), copy.deepcopy(trunk.eval().state_dict())
    got = folded(trunk)
    torch.testing.assert_close(got(images), trunk(images))
    assert sum(isinstance(module, nn.BatchNorm2d) for module in got.modules()) == left
    assert all(torch.equal(before[name], value) for name, value in trunk.state_dict().items())


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize(
    ("kind", "kernel"), [("Product", 3), ("Depthwise", 3), ("Depthwise", 5), ("DepthwiseSame", 3), ("DepthwiseSame", 5)]
)
@pytest.mark.parametrize("side", [(1, 1), (2, 2), (3, 1), (3, 4), (6, 8), (7, 8)])
def test_equals_the_convolution_and_its_gradients(
    side: tuple[int, int], kind: str, kernel: int, stride: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mvitac.nn.small_conv.MAX_PIXELS", 64)
    monkeypatch.setattr("mvitac.nn.small_conv.MAX_PIXELS_DEPTHWISE", {3: 64, 5: 64})
    out, groups, dtype = (7, 1, torch.float64) if kind == "Product" else (6, 6, torch.float32)
    same = kind == "DepthwiseSame"
    shape = (6, out, kernel, stride, 0 if same else kernel // 2)
    theirs = (Conv2dSame if same else nn.Conv2d)(*shape, groups=groups, bias=False).to(dtype)
    ours = use_products(nn.Sequential(copy.deepcopy(theirs))).get_submodule("0")
    for layout in (torch.channels_last, torch.contiguous_format):
        images = torch.randn(4, 6, *side, dtype=dtype).to(memory_format=layout).requires_grad_()
        got, want = ours.train()(images), theirs(images)
        assert kind.removesuffix("Same") in type(got.grad_fn).__name__
        torch.testing.assert_close(got, want)
        torch.testing.assert_close(ours.eval()(images), want)
        towards = torch.randn_like(want)
        mine = torch.autograd.grad(got, (images, *ours.parameters()), towards)
        torch.testing.assert_close(mine, torch.autograd.grad(want, (images, *theirs.parameters()), towards))
    assert type(use_convolutions(nn.Sequential(ours)).get_submodule("0")) is type(theirs)


def test_gradients_have_the_weights_layout_and_bf16_autocast_is_as_close_as_the_convolution() -> None:
    network = use_products(nn.Sequential(nn.Conv2d(5, 7, 3, padding=1, bias=False)))
    conv = network.to(memory_format=torch.channels_last)[0]  # type: ignore[index]
    images = torch.randn(4, 5, 2, 2).to(memory_format=torch.channels_last)
    conv(images).square().sum().backward()
    assert conv.weight.grad is not None
    assert conv.weight.grad.stride() == conv.weight.stride()  # the fused optimiser reads both as they lie in memory
    want = F.conv2d(images, conv.weight, padding=1)
    with torch.autocast("cpu", torch.bfloat16):
        got = conv(images)
    assert got.dtype == torch.bfloat16
    torch.testing.assert_close(got.float(), want, atol=0.02, rtol=0.02)
    for kind, groups in ((SmallMapConv2d, 1), (DepthwiseConv2d, 5)):
        conv = kind(5, 5, 3, padding=1, groups=groups)  # with a bias
        torch.testing.assert_close(conv(images), nn.Conv2d.forward(conv, images))


def products(trunk: nn.Module, images: torch.Tensor) -> int:
    with patch.object(_Product, "apply", side_effect=_Product.apply) as counted:
        trunk(images)
    return counted.call_count


def test_only_small_maps_in_training_take_the_product() -> None:
    trunk, images = build_trunk(EncoderConfig(trunk="resnet10t", weights=SCRATCH), 3), torch.randn(2, 3, 48, 48)
    # Stages 3 (3x3 pixels) and 4 (2x2) have two 3x3 convolutions each; larger maps stay with the convolution.
    assert products(trunk.train(), images) == 4 and products(trunk.train(), torch.randn(2, 3, 160, 160)) == 0
    assert products(trunk.eval(), images) == 0


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
    assert all(type(conv) is nn.Conv2d for conv in use_products(others).children())
    assert list(others.state_dict()) == names


@pytest.mark.parametrize("channels", [3, 6])
def test_a_vit_takes_images_of_any_size(channels: int) -> None:
    """At its own size it is timm's; at others its positions are interpolated, and the last patches padded."""
    vit = build_trunk(EncoderConfig(trunk="mvitac_tiny_vit", weights=SCRATCH), channels).eval()
    assert isinstance(vit, VisionTransformer)
    images = torch.randn(2, channels, 72, 72)
    for size in (64, 72, 48, 50, 16):
        assert vit(images[:, :, :size, :size]).shape == (2, 64)
    fixed = VisionTransformer(64, 8, channels, 0, "avg", 64, 2, 2, class_token=False, fc_norm=False).eval()
    fixed.load_state_dict(vit.state_dict())
    torch.testing.assert_close(vit(images[:, :, :64, :64]), fixed(images[:, :, :64, :64]))
    fixed.set_input_size((48, 48))
    torch.testing.assert_close(vit(images[:, :, :48, :48]), fixed(images[:, :, :48, :48]))


def test_timms_vits_take_images_of_any_size_and_keep_their_weights() -> None:
    trunk = build_trunk(EncoderConfig(trunk="vit_tiny_patch16_224", weights=SCRATCH), 3)
    assert trunk(torch.randn(1, 3, 48, 80)).shape == (1, 192)
    names = timm.create_model("vit_tiny_patch16_224", num_classes=0).state_dict()
    assert {k: v.shape for k, v in trunk.state_dict().items()} == {k: v.shape for k, v in names.items()}


@pytest.mark.parametrize("registers", [0, 4])
def test_visible_patches_keep_their_positions_behind_class_token_and_registers(registers: int) -> None:
    shape = {"embed_dim": 64, "depth": 2, "num_heads": 2, "reg_tokens": registers}
    vit = VisionTransformer(32, 8, 3, 0, **shape, dynamic_img_size=True).eval()  # type: ignore[arg-type]
    images, order = torch.randn(2, 3, 32, 32), torch.stack([torch.randperm(16) for _ in range(2)])
    whole, seen = vit.forward_features(images), encode_visible(vit, images, order).values
    front = 1 + registers
    assert seen.shape == (2, front + 16, 64)
    for i in range(2):
        torch.testing.assert_close(seen[i, :front], whole[i, :front], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(seen[i, front:], whole[i, front:][order[i]], rtol=1e-4, atol=1e-5)


def test_patches_are_those_that_the_vit_embeds() -> None:
    """Pixels of each patch times the kernel = its embedding, also where the image is padded."""
    vit = build_trunk(EncoderConfig(trunk="mvitac_tiny_vit", weights=SCRATCH), 3)
    assert isinstance(vit, VisionTransformer)
    images, kernel = torch.randn(2, 3, 20, 12), vit.patch_embed.proj
    found = patches(vit, images)
    assert found.shape == (2, 6, 192)
    embedded = found @ kernel.weight.flatten(1).mT + kernel.bias  # type: ignore[operator]
    torch.testing.assert_close(embedded, vit.patch_embed(images).flatten(1, 2), rtol=1e-4, atol=1e-5)


def test_numbers_of_rows_are_uniform_and_a_function_of_seed_stream_and_row() -> None:
    rows = torch.arange(200)
    u = row_uniform(torch.tensor(5), rows, 500, 0)
    assert u.shape == (200, 500) and float(u.min()) >= 0 and float(u.max()) < 1
    counts = torch.histc(u, 10, 0, 1)
    assert float(((counts - 10000) ** 2 / 10000).sum()) < 30  # chi-squared with 9 degrees of freedom: p .0004
    for a, b in ((u[:, :-1], u[:, 1:]), (u[:-1], u[1:]), (u, row_uniform(torch.tensor(6), rows, 500, 0))):
        assert abs(float(torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1])) < 0.015
    assert torch.equal(row_uniform(torch.tensor(5), rows[7:9], 500, 0), u[7:9])
    assert not torch.equal(row_uniform(torch.tensor(5), rows, 500, 1), u)


def test_positions_are_sines_and_cosines_of_row_and_column() -> None:
    found = sin_cos_positions(2, 3, 8)
    row, column, rates = torch.tensor(1.0), torch.tensor(2.0), torch.tensor([1.0, 0.01])
    expected = torch.cat([(row * rates).sin(), (row * rates).cos(), (column * rates).sin(), (column * rates).cos()])
    torch.testing.assert_close(found[5], expected)
