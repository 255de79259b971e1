"""Random views, per image and batched: crop, flips, grayscale, colour jitter, normalisation (paper, appendix B).

Parameters are drawn first (``draw``), from an explicit generator, then applied (``apply``): so a view is a function of
(seed, step), the two gels of a stacked pair get the same crop, and CPU and GPU can replay the same parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from mvitac.encoders import IMAGENET_MEAN, IMAGENET_STD

LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601, as PIL and torchvision use it
NUM_TRIES = 10  # of a crop that fits, then the largest centred one; as torchvision's RandomResizedCrop


@dataclass(frozen=True, kw_only=True)
class ViewAugment:
    """What one modality's random views are made of."""

    scale: tuple[float, float] = (0.2, 1.0)
    """Crop area as a share of the image (paper: .2 to 1)."""
    flip: float = 0.5
    """Probability of a horizontal flip (paper: .5). On touch it also mirrors the LEDs, which no real press does."""
    grayscale: float = 0.2
    """Probability of grayscale (paper: .2 for materials, none for grasping)."""
    jitter: float = 0.0
    """Strength of brightness, contrast and per-channel gain jitter, each factor 1 +- jitter (paper: none)."""
    independent_sensors: bool = False
    """Draw the two sensors of a stacked touch image apart (as the authors' code does) instead of alike."""

    def __post_init__(self) -> None:
        if not 0 < self.scale[0] <= self.scale[1] <= 1:
            raise ValueError(f"augment scale {self.scale}: give two shares of the area, 0 < low <= high <= 1")
        for name in ("flip", "grayscale"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"augment {name} {getattr(self, name)} is not a probability: give 0 to 1")
        if not 0 <= self.jitter < 1:
            raise ValueError(f"augment jitter {self.jitter}: give a strength in [0, 1)")


@dataclass(frozen=True, kw_only=True)
class Augment:
    """Both modalities' views and the side in pixels of what the encoders see."""

    size: int = 224
    """Side of the crop that enters the encoders (paper: 224)."""
    whole: int | None = None
    """Side at which the frozen encoders see whole images; none = size. A random crop shows things larger than the whole
    image squeezed into the same side does, so features of whole images gain from a larger side (arXiv:1906.06423)."""
    vision: ViewAugment = ViewAugment()
    touch: ViewAugment = ViewAugment()

    def __post_init__(self) -> None:
        for name, side in (("size", self.size), ("whole", self.seen)):
            if not 8 <= side <= 1024:
                raise ValueError(f"augment {name} {side}: give a side of 8 to 1024 pixels")

    @property
    def seen(self) -> int:
        """Side of the whole image that probes and predictions see."""
        return self.size if self.whole is None else self.whole


@dataclass(frozen=True)
class Drawn:
    """The drawn parameters of one view of B images."""

    boxes: Tensor
    """[B, 4] int64: top, left, height, width of the crop."""
    flip: Tensor
    """[B] bool."""
    grayscale: Tensor
    """[B] bool."""
    gains: Tensor
    """[B, 5] float: brightness, contrast, and a gain for each of R, G, B."""


def draw(config: ViewAugment, num: int, size: int, generator: torch.Generator) -> Drawn:
    """Parameters of one random view of ``num`` images of side ``size``."""

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    area = size * size * uniform(num, NUM_TRIES, low=config.scale[0], high=config.scale[1])
    ratio = torch.exp(uniform(num, NUM_TRIES, low=-0.28768207, high=0.28768207))  # log(3/4) to log(4/3)
    width, height = (area * ratio).sqrt().round().long(), (area / ratio).sqrt().round().long()
    fits = (width <= size) & (height <= size) & (width > 0) & (height > 0)
    first = fits.float().argmax(dim=1, keepdim=True)
    none = ~fits.any(dim=1)
    height, width = height.gather(1, first).squeeze(1), width.gather(1, first).squeeze(1)
    height[none] = width[none] = size
    top = (uniform(num) * (size - height + 1)).long()
    left = (uniform(num) * (size - width + 1)).long()
    return Drawn(
        boxes=torch.stack([top, left, height, width], dim=1),
        flip=uniform(num) < config.flip,
        grayscale=uniform(num) < config.grayscale,
        gains=uniform(num, 5, low=1 - config.jitter, high=1 + config.jitter),
    )


def apply(images: UInt8[Tensor, "B C H W"], drawn: Drawn, size: int) -> Float[Tensor, "B C S S"]:
    """The view ``drawn`` of uint8 ``images``: cropped to [size, size], normalised, channels-last, on their device."""
    cropped = _crop_cpu(images, drawn, size) if images.device.type == "cpu" else _crop_gpu(images, drawn, size)
    sensors = cropped.unflatten(1, (-1, 3))  # [B, sensors, 3, S, S]
    sensors = _colour(sensors, drawn)
    mean, std = (torch.tensor(v, device=images.device).view(3, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
    return ((sensors - mean) / std).flatten(1, 2).contiguous(memory_format=torch.channels_last)


def _crop_cpu(images: Tensor, drawn: Drawn, size: int) -> Tensor:
    """Crop, resize and flip one by one on uint8, where torch's antialiased kernel is vectorised; float in [0, 1]."""
    out = torch.empty(len(images), images.shape[1], size, size, dtype=torch.uint8)
    for i, ((top, left, height, width), flip) in enumerate(zip(drawn.boxes.tolist(), drawn.flip.tolist(), strict=True)):
        crop = images[i : i + 1, :, top : top + height, left : left + width]
        if (height, width) != (size, size):
            crop = F.interpolate(crop, (size, size), mode="bilinear", antialias=True)
        out[i] = crop[0].flip(-1) if flip else crop[0]
    return out.float().div_(255)


def _crop_gpu(images: Tensor, drawn: Drawn, size: int) -> Tensor:
    """The same crop for the whole batch in one grid sample (bilinear, not antialiased); float in [0, 1]."""
    side = images.shape[-1]
    boxes = drawn.boxes.to(images.device, torch.float32)
    top, left, height, width = boxes.unbind(1)
    scale_x = torch.where(drawn.flip.to(images.device), -width, width) / side
    theta = torch.zeros(len(images), 2, 3, device=images.device)
    theta[:, 0, 0], theta[:, 1, 1] = scale_x, height / side
    theta[:, 0, 2], theta[:, 1, 2] = (2 * left + width) / side - 1, (2 * top + height) / side - 1
    grid = F.affine_grid(theta, [len(images), images.shape[1], size, size], align_corners=False)
    sampled = F.grid_sample(images.float(), grid, padding_mode="border", align_corners=False)
    return sampled.round_().div_(255)


def _colour(sensors: Float[Tensor, "B N 3 S S"], drawn: Drawn) -> Float[Tensor, "B N 3 S S"]:
    """Jitter, then grayscale, for all N sensors of an image alike."""
    luma = torch.tensor(LUMA, device=sensors.device).view(3, 1, 1)
    gains = drawn.gains.to(sensors.device)
    if not bool((drawn.gains == 1).all()):
        brightness, contrast = gains[:, 0].view(-1, 1, 1, 1, 1), gains[:, 1].view(-1, 1, 1, 1, 1)
        sensors = sensors * (brightness * gains[:, 2:].view(-1, 1, 3, 1, 1))
        level = (sensors * luma).sum(2, keepdim=True).mean((3, 4), keepdim=True)
        sensors = (level + contrast * (sensors - level)).clamp_(0, 1)
    gray = drawn.grayscale.nonzero().flatten().to(sensors.device)
    if len(gray):
        sensors[gray] = (sensors[gray] * luma).sum(2, keepdim=True).expand(-1, -1, 3, -1, -1)
    return sensors


def random_view(
    images: UInt8[Tensor, "B C H W"], config: ViewAugment, size: int, generator: torch.Generator
) -> Float[Tensor, "B C S S"]:
    """One random view of every image; ``generator`` lives on the CPU and decides all of it."""
    num, channels, side, _ = images.shape
    if config.independent_sensors and channels > 3:
        apart = [apply(sensor, draw(config, num, side, generator), size) for sensor in images.split(3, dim=1)]
        return torch.cat(apart, dim=1).contiguous(memory_format=torch.channels_last)
    return apply(images, draw(config, num, side, generator), size)


def plain_view(images: UInt8[Tensor, "B C H W"], size: int) -> Float[Tensor, "B C S S"]:
    """The whole image at ``size``, normalised: what probes and predictions see (no randomness)."""
    num, _, side, _ = images.shape
    whole = torch.tensor([[0, 0, side, side]]).expand(num, 4)
    never = torch.zeros(num, dtype=torch.bool)
    return apply(images, Drawn(whole, never, never, torch.ones(num, 5)), size)
