"""The preprocessing that an encoder's owner used, as data: from frames of a sensor to the input of the network.

Shapes: N images, F frames (newest first), H x W pixels.
"""

import math
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from timm.data.constants import IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD, OPENAI_CLIP_MEAN, OPENAI_CLIP_STD
from torch import Tensor

from mvitac.registry import check_range

Three = tuple[float, float, float]
PLAIN: tuple[Three, Three] = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
IMAGENET: tuple[Three, Three] = (IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD)
CLIP: tuple[Three, Three] = (OPENAI_CLIP_MEAN, OPENAI_CLIP_STD)
NO_CONTACT = 128 / 255  # the value of no contact in difference images, (image - background) / 2 + 128


@dataclass(frozen=True, kw_only=True)
class Preprocessing:
    """From frames to a network's input. All values are RGB in [0, 1] until ``mean`` and ``std``."""

    size: tuple[int, int] = (224, 224)
    """Height and width of the input."""
    mean: Three = IMAGENET[0]
    std: Three = IMAGENET[1]
    frames: int = 1
    """Frames that the network sees at once, stacked on channels: [N, 3 F, H, W]."""
    stride: float = 1.0
    """Distance of two frames, in units of the data's order column."""
    offset: float | None = None
    """If given, difference images become clip(image - background + offset, 0, 1). Other images stay as they are."""
    whole_levels: bool = False
    """Round difference images down to whole levels of 255."""
    portrait: bool = False
    """First rotate images that are wider than high by 90 degrees clockwise, and cut the height of those that are then not
    4:3 to three quarters of itself. Square images are taken as squashed 4:3 images and only resized."""
    pad: bool = False
    """First pad images with zeros to a square and rotate them by 90 degrees anticlockwise."""
    shorter: int | None = None
    """Resize the shorter side to this, then cut out the centre. None: resize to ``size``, ignoring the aspect ratio."""

    def __post_init__(self) -> None:
        check_range(self, 0, 1, *["offset"] * (self.offset is not None))
        if min(*self.size, self.frames) < 1 or not 0 < min(self.stride, *self.std) < math.inf:
            raise ValueError(f"size {self.size}, frames {self.frames}, stride {self.stride}, std {self.std}: 0 or less")

    def resized_to(self, size: tuple[int, int]) -> "Preprocessing":
        """The same for another input size; the margin of a centre crop grows with it."""
        shorter = None if self.shorter is None else round(self.shorter * min(size) / min(self.size))
        return replace(self, size=size, shorter=shorter)

    def input_shape(self) -> tuple[int, ...]:
        """Shape of the network's input, for one image."""
        return (3 * self.frames, *self.size)

    def __call__(self, images: Tensor, gain: float = 0.0) -> Tensor:
        """Prepare images [N, F, 3, H, W], uint8 or float in [0, 1], newest first.

        Missing older frames are the oldest there is; further ones are left out. For difference images ``gain`` undoes
        their scale; it is 0 for plain images.
        """
        images = images[:, [min(f, images.shape[1] - 1) for f in range(self.frames)]]
        x = images.float() / 255 if images.dtype == torch.uint8 else images.float()
        if gain and self.offset is not None:
            x = ((x - NO_CONTACT) * gain + self.offset).clamp(0, 1)
            x = (x * 255 + 1e-4).floor() / 255 if self.whole_levels else x
        x = self._fitted(x.flatten(0, 1)).unflatten(0, images.shape[:2])
        mean, std = (x.new_tensor(values).view(3, 1, 1) for values in (self.mean, self.std))
        return ((x - mean) / std).flatten(1, 2)

    def _fitted(self, x: Tensor) -> Tensor:
        """Rotate, cut and resize [N, 3, H, W] to ``size``."""
        height, width = x.shape[-2:]
        if self.portrait and height != width:
            x = x.rot90(-1, (2, 3)) if height < width else x
            height = x.shape[2]
            if 3 * height != 4 * x.shape[3]:
                x = x[:, :, height // 8 : height // 8 + height * 3 // 4]
        if self.pad:
            side = max(height, width)
            top, left = (side - height) // 2, (side - width) // 2
            x = F.pad(x, (left, side - width - left, top, side - height - top)).rot90(1, (2, 3))
        if self.shorter is None:
            return F.interpolate(x, self.size, mode="bilinear", antialias=True)
        scale = self.shorter / min(x.shape[-2:])
        large = (max(want, int(have * scale)) for want, have in zip(self.size, x.shape[-2:], strict=True))
        x = F.interpolate(x, tuple(large), mode="bilinear", antialias=True)
        top, left = (round((have - want) / 2) for have, want in zip(x.shape[-2:], self.size, strict=True))
        return x[:, :, top : top + self.size[0], left : left + self.size[1]]
