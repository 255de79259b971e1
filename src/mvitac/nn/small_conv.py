"""3x3 convolutions over maps of a few pixels as one matrix product: for training at small images on a CPU.

The last stages of a ResNet at 48 px have maps of 3x3 and 2x2 pixels. oneDNN spends ten times as long on them as their
arithmetic takes, most of it on the weights' gradient (docs/speed.md); as a product over the unrolled neighbourhoods
(im2col) they are plain matrix products. The same sums in another order, so equal to rounding (tests/nn/test_small_conv.py).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

MAX_PIXELS = 9
"""Of the output map, up to which the product is the faster one."""


class SmallMapConv2d(nn.Conv2d):
    """``Conv2d`` that takes the product where it pays: in training, on a CPU, up to ``MAX_PIXELS`` pixels out."""

    def forward(self, input: Tensor) -> Tensor:
        height, width = input.shape[-2:]
        stride = self.stride[0]
        pixels = ((height - 1) // stride + 1) * ((width - 1) // stride + 1)
        # Exports and compiled graphs keep the convolution as such.
        if not self.training or input.device.type != "cpu" or pixels > MAX_PIXELS or torch.compiler.is_compiling():
            return super().forward(input)
        weight = self.weight
        if torch.is_autocast_enabled("cpu"):
            dtype = torch.get_autocast_dtype("cpu")
            input, weight = input.to(dtype), weight.to(dtype)
        return _Product.apply(input, weight, stride)  # type: ignore[return-value]


def use_products(trunk: nn.Module) -> nn.Module:
    """``trunk``, its plain 3x3 convolutions made ``SmallMapConv2d``; parameters and their names stay as they are."""
    for conv in trunk.modules():
        if type(conv) is not nn.Conv2d or conv.bias is not None or conv.groups != 1:
            continue
        shape = (conv.kernel_size, conv.padding, conv.dilation, conv.padding_mode)
        if shape == ((3, 3), (1, 1), (1, 1), "zeros") and conv.stride[0] == conv.stride[1]:
            conv.__class__ = SmallMapConv2d
    return trunk


@lru_cache
def _neighbours(height: int, width: int, stride: int) -> tuple[int, list[tuple[int, int, int]]]:
    """How many pixels there are out, and all (pixel out, place 0-8 in the kernel, pixel in) but those in the padding."""
    down, across = (height - 1) // stride + 1, (width - 1) // stride + 1
    places = []
    for out in range(down * across):
        for place in range(9):
            row = out // across * stride + place // 3 - 1
            column = out % across * stride + place % 3 - 1
            if 0 <= row < height and 0 <= column < width:
                places.append((out, place, row * width + column))
    return down * across, places


class _Product(torch.autograd.Function):
    """Input [B, C, H, W], weight [O, C, 3, 3] -> [B, O, H', W'], all channels-last in memory."""

    @staticmethod
    def forward(ctx: Any, input: Tensor, weight: Tensor, stride: int) -> Tensor:
        num, channels, height, width = input.shape
        pixels, places = _neighbours(height, width, stride)
        flat = input.permute(0, 2, 3, 1).reshape(num, height * width, channels)
        columns = flat.new_zeros(num, pixels, 9, channels)
        for out, place, pixel in places:
            columns[:, out, place] = flat[:, pixel]
        columns = columns.view(num * pixels, 9 * channels)
        kernel = weight.permute(0, 2, 3, 1).reshape(len(weight), 9 * channels)
        ctx.save_for_backward(columns, kernel)
        ctx.shape, ctx.stride = input.shape, stride
        result = (columns @ kernel.mT).view(num, -1, (width - 1) // stride + 1, len(weight))
        return result.permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        columns, kernel = ctx.saved_tensors
        num, channels, height, width = ctx.shape
        pixels, places = _neighbours(height, width, ctx.stride)
        gradient = gradients[0].permute(0, 2, 3, 1).reshape(num * pixels, len(kernel))
        of_input = of_weight = None
        if ctx.needs_input_grad[1]:
            of_weight = (gradient.mT @ columns).view(len(kernel), 3, 3, channels).permute(0, 3, 1, 2)
        if ctx.needs_input_grad[0]:
            spread = (gradient @ kernel).view(num, pixels, 9, channels)
            flat = spread.new_zeros(num, height * width, channels)
            for out, place, pixel in places:
                flat[:, pixel] += spread[:, out, place]
            of_input = flat.view(num, height, width, channels).permute(0, 3, 1, 2)
        return of_input, of_weight, None
