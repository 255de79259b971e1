"""The preprocessing that an encoder's owner used, as data: from frames of a sensor to the input of the network.

Shapes: N images, F frames (newest first), H x W pixels.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from timm.data.constants import IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD
from torch import Tensor

Three = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Preprocessing:
    """From frames to a network's input. All values are RGB in [0, 1] until ``mean`` and ``std``."""

    size: tuple[int, int] = (224, 224)
    """Height and width of the input."""
    mean: Three = IMAGENET_DEFAULT_MEAN
    std: Three = IMAGENET_DEFAULT_STD
    frames: int = 1
    """Frames that the network sees at once, stacked on channels: [N, 3 F, H, W]."""
    stride: float = 1.0
    """Distance of two frames, in units of the data's order column."""

    def __post_init__(self) -> None:
        if min(*self.size, self.frames) < 1 or not 0 < min(self.stride, *self.std) < math.inf:
            raise ValueError(f"size {self.size}, frames {self.frames}, stride {self.stride}, std {self.std}: 0 or less")

    def input_shape(self) -> tuple[int, ...]:
        """Shape of the network's input, for one image."""
        return (3 * self.frames, *self.size)

    def __call__(self, images: Tensor) -> Tensor:
        """Prepare images [N, F, 3, H, W], uint8 or float in [0, 1], newest first.

        Missing older frames are the oldest there is; further ones are left out.
        """
        images = images[:, [min(f, images.shape[1] - 1) for f in range(self.frames)]]
        x = images.float() / 255 if images.dtype == torch.uint8 else images.float()
        x = F.interpolate(x.flatten(0, 1), self.size, mode="bilinear", antialias=True).unflatten(0, images.shape[:2])
        mean, std = (x.new_tensor(values).view(3, 1, 1) for values in (self.mean, self.std))
        return ((x - mean) / std).flatten(1, 2)
