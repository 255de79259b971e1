"""3x3 convolutions over maps of a few pixels as matrix products: for training at small images on a CPU.

The last stages of a ResNet at 48 px have maps of 3x3 and 2x2 pixels. oneDNN takes up to six times as long for them as
the arithmetic needs, and up to 56 % of that is with the zeros of the padding (docs/speed.md). Here each output pixel is a
sum of matrix products, one for each row of the kernel, over those places of the kernel that lie on the map. Operands are
slices of the tensors as they lie in memory; nothing is copied. The same sums in another order, so equal to the
convolution to rounding (tests/nn/test_small_conv.py).
"""

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

MAX_PIXELS = 9  # of the output map, up to which products are faster than the convolution


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


def use_convolutions(trunk: nn.Module) -> nn.Module:
    """``trunk``, the work of ``use_products`` undone."""
    for conv in trunk.modules():
        if type(conv) is SmallMapConv2d:
            conv.__class__ = nn.Conv2d  # type: ignore[assignment]
    return trunk


@lru_cache
def _rows(height: int, width: int, stride: int) -> list[tuple[int, int, slice, slice]]:
    """Every (pixel out, row of the kernel, its columns over the map, the pixels in under them)."""
    down, across = (height - 1) // stride + 1, (width - 1) // stride + 1
    rows = []
    for out in range(down * across):
        top, left = out // across * stride - 1, out % across * stride - 1
        columns = slice(max(0, -left), min(3, width - left))
        for row in range(max(0, -top), min(3, height - top)):
            start = (top + row) * width + left
            rows.append((out, row, columns, slice(start + columns.start, start + columns.stop)))
    return rows


class _Product(torch.autograd.Function):
    """Input [B, C, H, W], weight [O, C, 3, 3] -> [B, O, H', W'], all channels-last in memory."""

    @staticmethod
    def forward(ctx: Any, input: Tensor, weight: Tensor, stride: int) -> Tensor:
        num, _, height, width = input.shape
        down, across = (height - 1) // stride + 1, (width - 1) // stride + 1
        pixels = input.permute(0, 2, 3, 1).reshape(num, height * width, -1)
        kernel = weight.permute(0, 2, 3, 1).contiguous()
        ctx.save_for_backward(pixels, kernel)
        ctx.shape = height, width, stride
        result = pixels.new_zeros(num, down * across, len(kernel))
        for out, row, columns, under in _rows(height, width, stride):
            result[:, out].addmm_(pixels[:, under].flatten(1), kernel[:, row, columns].flatten(1).mT)
        return result.view(num, down, across, -1).permute(0, 3, 1, 2)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        pixels, kernel = ctx.saved_tensors
        height, width, stride = ctx.shape
        gradient = gradients[0].permute(0, 2, 3, 1).reshape(len(pixels), -1, len(kernel))
        of_pixels = torch.zeros_like(pixels) if ctx.needs_input_grad[0] else None
        of_kernel = torch.zeros_like(kernel) if ctx.needs_input_grad[1] else None
        for out, row, columns, under in _rows(height, width, stride):
            if of_kernel is not None:
                of_kernel[:, row, columns].flatten(1).addmm_(gradient[:, out].mT, pixels[:, under].flatten(1))
            if of_pixels is not None:
                of_pixels[:, under].flatten(1).addmm_(gradient[:, out], kernel[:, row, columns].flatten(1))
        of_input = None if of_pixels is None else of_pixels.unflatten(1, (height, width)).permute(0, 3, 1, 2)
        return of_input, None if of_kernel is None else of_kernel.permute(0, 3, 1, 2), None
