"""Convolutions over maps of a few pixels, faster than oneDNN's: for training at small images on a CPU.

The last stages of a ResNet at 48 px have maps of 3x3 and 2x2 pixels. oneDNN takes up to six times as long for them as
the arithmetic needs, and up to 56 % of that is with the zeros of the padding (docs/speed.md). Here each output pixel is a
sum of matrix products, one for each row of the kernel, over those places of the kernel that lie on the map. Operands are
slices of the tensors as they lie in memory; nothing is copied.

The weight gradient of a depthwise convolution takes oneDNN up to sixty times as long as its forward pass. Here it is one
sum of products for each place of the kernel. Both equal the convolution to rounding (tests/nn/test_layers.py).
"""

from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from timm.layers.conv2d_same import Conv2dSame
from timm.layers.padding import pad_same
from torch import Tensor, nn

MAX_PIXELS = 9  # of the output map, up to which products are faster than the convolution
MAX_PIXELS_DEPTHWISE = {3: 4, 5: 64}  # the same for the weight gradient of a depthwise convolution, by kernel side


class SmallMapConv2d(nn.Conv2d):
    """``Conv2d`` that takes the product where it pays: in training, on a CPU, up to ``MAX_PIXELS`` pixels out."""

    def forward(self, input: Tensor) -> Tensor:
        height, width = input.shape[-2:]
        stride = self.stride[0]
        pixels = ((height - 1) // stride + 1) * ((width - 1) // stride + 1)
        # Exports and compiled graphs keep the convolution as such.
        large = pixels > MAX_PIXELS or input.device.type != "cpu"
        if large or not self.training or self.bias is not None or torch.compiler.is_compiling():
            return super().forward(input)
        weight = self.weight
        if torch.is_autocast_enabled("cpu"):
            dtype = torch.get_autocast_dtype("cpu")
            input, weight = input.to(dtype), weight.to(dtype)
        return _Product.apply(input, weight, stride)  # type: ignore[return-value]


class DepthwiseConv2d(nn.Conv2d):
    """Depthwise ``Conv2d`` with a weight gradient of its own where that pays: in fp32 training on a CPU."""

    def forward(self, input: Tensor) -> Tensor:
        if not _pays(self, input):
            return super().forward(input)
        return _Depthwise.apply(input, self.weight, self.stride[0], self.padding[0])  # type: ignore[return-value]


class DepthwiseConv2dSame(Conv2dSame):
    """The same for timm's convolution that pads as TensorFlow does."""

    def forward(self, input: Tensor) -> Tensor:
        conv: Any = self
        if _pays(self, input):
            return _Depthwise.apply(pad_same(input, conv.kernel_size, conv.stride), conv.weight, conv.stride[0], 0)
        if torch.compiler.is_compiling() or conv.stride != (2, 2) or any(side % 2 for side in input.shape[-2:]):
            return super().forward(input)
        # One more pixel right and below: a kernel with a row and a column of zeros needs no copy of the map.
        kernel = F.pad(conv.weight, (1, 0, 1, 0))
        return torch.conv2d(input, kernel, conv.bias, 2, conv.kernel_size[0] // 2, 1, conv.groups)


def _pays(conv: Any, input: Tensor) -> bool:
    pixels = -(-input.shape[2] // conv.stride[0]) * -(-input.shape[3] // conv.stride[0])
    small = pixels <= MAX_PIXELS_DEPTHWISE[conv.kernel_size[0]]
    plain = input.dtype == torch.float32 and not torch.is_autocast_enabled("cpu") and not torch.compiler.is_compiling()
    return small and plain and conv.training and conv.bias is None and input.device.type == "cpu"


PLAIN = {SmallMapConv2d: nn.Conv2d, DepthwiseConv2d: nn.Conv2d, DepthwiseConv2dSame: Conv2dSame}
"""Convolution of ours -> what it replaces."""


def use_products(trunk: nn.Module) -> nn.Module:
    """``trunk``, its plain 3x3 and its depthwise convolutions made ours; parameters and their names stay as they are."""
    for conv in trunk.modules():
        if isinstance(conv, nn.Conv2d):
            conv.__class__ = _ours(conv)  # type: ignore[assignment]
    return trunk


def use_convolutions(trunk: nn.Module) -> nn.Module:
    """``trunk``, the work of ``use_products`` undone."""
    for conv in trunk.modules():
        if type(conv) in PLAIN:
            conv.__class__ = PLAIN[type(conv)]  # type: ignore[index]
    return trunk


def _ours(conv: nn.Conv2d) -> type[nn.Module]:
    kind, side, same = type(conv), conv.kernel_size[0], type(conv) is Conv2dSame
    shape = ((side, side), (0 if same else side // 2,) * 2, (1, 1), "zeros", None, (conv.stride[0],) * 2)
    given = (conv.kernel_size, conv.padding, conv.dilation, conv.padding_mode, conv.bias, conv.stride)
    if kind not in (nn.Conv2d, Conv2dSame) or given != shape:
        return kind
    if 1 < conv.groups == conv.in_channels == conv.out_channels and side in MAX_PIXELS_DEPTHWISE:
        return DepthwiseConv2dSame if same else DepthwiseConv2d
    return SmallMapConv2d if side == 3 and conv.groups == 1 and not same else kind


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
    """Input [B, C, H, W], weight [O, C, 3, 3] -> [B, O, H', W'], channels-last in memory; fast if both are, too."""

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
        of_pixels = pixels.new_zeros(pixels.shape) if ctx.needs_input_grad[0] else None  # or ``flatten`` copies
        of_kernel = torch.zeros_like(kernel) if ctx.needs_input_grad[1] else None
        for out, row, columns, under in _rows(height, width, stride):
            if of_kernel is not None:
                of_kernel[:, row, columns].flatten(1).addmm_(gradient[:, out].mT, pixels[:, under].flatten(1))
            if of_pixels is not None:
                of_pixels[:, under].flatten(1).addmm_(gradient[:, out], kernel[:, row, columns].flatten(1))
        of_input = None if of_pixels is None else of_pixels.unflatten(1, (height, width)).permute(0, 3, 1, 2)
        return of_input, None if of_kernel is None else of_kernel.permute(0, 3, 1, 2), None


class _Depthwise(torch.autograd.Function):
    """Input [B, C, H, W], weight [C, 1, K, K] -> [B, C, H', W']: torch's convolution with another weight gradient."""

    @staticmethod
    def forward(ctx: Any, input: Tensor, weight: Tensor, stride: int, padding: int) -> Tensor:
        ctx.save_for_backward(input, weight)
        ctx.shape = stride, padding
        return torch.conv2d(input, weight, None, stride, padding, 1, len(weight))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        (input, weight), (stride, padding), gradient = ctx.saved_tensors, ctx.shape, gradients[0]
        of_input = of_weight = None
        if ctx.needs_input_grad[0]:
            sizes = [stride] * 2, [padding] * 2, [1, 1], False, [0, 0], len(weight), [True, False, False]
            of_input = torch.ops.aten.convolution_backward(gradient, input, weight, None, *sizes)[0]
        if ctx.needs_input_grad[1]:
            of_weight = torch.zeros_like(weight)
            pixels, towards, side = input.permute(0, 2, 3, 1), gradient.permute(0, 2, 3, 1), weight.shape[-1]
            rows = [_under(place - padding, stride, input.shape[2], towards.shape[1]) for place in range(side)]
            columns = [_under(place - padding, stride, input.shape[3], towards.shape[2]) for place in range(side)]
            for row, (down, above) in enumerate(rows):
                for column, (across, left) in enumerate(columns):
                    of_weight[:, 0, row, column] = (pixels[:, down, across] * towards[:, above, left]).sum((0, 1, 2))
        return of_input, of_weight, None, None


def _under(offset: int, stride: int, num_in: int, num_out: int) -> tuple[slice, slice]:
    """(pixels in, pixels out) along one side that a place of the kernel, ``offset`` from the pixel out, joins."""
    first, last = max(0, -(offset // stride)), min(num_out - 1, (num_in - 1 - offset) // stride)
    start = first * stride + offset
    return slice(start, max(start, last * stride + offset + 1), stride), slice(first, max(first, last + 1))
