"""The preprocessing that an encoder's owner used, as data: from frames of a sensor to the input of the network.

Shapes: N images, F frames (newest first), H x W pixels.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

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
    """Frames that the network sees at once."""
    stride: float = 1.0
    """Distance of two frames, in units of the data's order column."""
    still: bool = False
    """Whether all frames are the current one."""
    oldest_first: bool = False
    layout: Literal["channels", "video", "frames"] = "channels"
    """Input of several frames. channels: [N, 3 F, H, W]. video: [N, 3, F, H, W]. frames: [N, F, 3, H, W]."""
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
    bicubic: bool = False

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
        return self._laid_out(torch.zeros(1, self.frames, 3, 1, 1)).shape[1:-2] + self.size

    def __call__(self, images: Tensor, gain: float = 0.0) -> Tensor:
        """Prepare images [N, F, 3, H, W], uint8 or float in [0, 1], newest first.

        Missing older frames are the oldest there is; further ones are left out. For difference images ``gain`` undoes
        their scale; it is 0 for plain images.
        """
        last = 0 if self.still else images.shape[1] - 1
        images = images[:, [min(f, last) for f in range(self.frames)]]
        x = images.float() / 255 if images.dtype == torch.uint8 else images.float()
        if gain and self.offset is not None:
            x = ((x - NO_CONTACT) * gain + self.offset).clamp(0, 1)
            x = (x * 255 + 1e-4).floor() / 255 if self.whole_levels else x
        x = self._fitted(x.flatten(0, 1)).unflatten(0, images.shape[:2])
        mean, std = (x.new_tensor(values).view(3, 1, 1) for values in (self.mean, self.std))
        return self._laid_out((x - mean) / std)

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
            return self._resized(x, self.size)
        scale = self.shorter / min(x.shape[-2:])
        x = self._resized(x, (max(self.size[0], int(x.shape[2] * scale)), max(self.size[1], int(x.shape[3] * scale))))
        top, left = (round((have - want) / 2) for have, want in zip(x.shape[-2:], self.size, strict=True))
        return x[:, :, top : top + self.size[0], left : left + self.size[1]]

    def _resized(self, x: Tensor, size: tuple[int, int]) -> Tensor:
        if x.shape[-2:] == size:
            return x
        return F.interpolate(x, size, mode="bicubic" if self.bicubic else "bilinear", antialias=True)

    def _laid_out(self, x: Tensor) -> Tensor:
        """[N, F, 3, H, W], newest first, in ``layout``."""
        x = x.flip(1) if self.oldest_first else x
        if self.layout == "channels":
            return x.flatten(1, 2)
        return x.transpose(1, 2) if self.layout == "video" else x
