"""Random views of images: crop, flip, grayscale, colour jitter, normalisation (paper, appendix B).

``draw`` draws the parameters from an explicit generator, ``apply`` applies them. A view is therefore a function of
(seed, step), the two gels of a stacked image get the same crop, and CPU and GPU can apply the same parameters.

Shapes: B images of C channels and H x W pixels, stacked from N = C / 3 sensors; views of S x S pixels.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor
from tyro.conf import Fixed

from mvitac.registry import check_range

MeanStd = tuple[tuple[float, ...], tuple[float, ...]]
"""Mean and standard deviation of R, G, B, by which levels in [0, 1] are normalised."""
IMAGENET: MeanStd = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))

NUM_TRIES = 10  # to draw a crop that fits, then the largest possible one, as in torchvision's RandomResizedCrop


@dataclass(frozen=True, kw_only=True)
class ViewAugment:
    """Random views of one modality."""

    scale: tuple[float, float] = (0.2, 1.0)
    """Range of the crop area, as a fraction of the image (paper: .2 to 1)."""
    flip: float = 0.5
    """Probability of a horizontal flip (paper: .5)."""
    grayscale: float = 0.2
    """Probability of grayscale (paper: .2 for materials, none for grasping)."""
    jitter: Fixed[float] = 0.0
    """Strength of brightness, contrast and per-channel gain jitter; each factor is 1 +- jitter (paper: none)."""
    size: int | None = None
    """Side in pixels of the crops of this modality. Default: that of both."""
    whole: Fixed[int | None] = None
    """Side in pixels of whole images of this modality. Default: its own size, else that of both."""

    @property
    def fixed(self) -> bool:
        """Whether every view is the whole image as it is."""
        return self.scale == (1.0, 1.0) and not (self.flip or self.grayscale or self.jitter)

    def __post_init__(self) -> None:
        if not 0 < self.scale[0] <= self.scale[1] <= 1:
            raise ValueError(f"augment scale {self.scale}: give two fractions of the area, 0 < low <= high <= 1")
        check_range(self, 0, 1, "flip", "grayscale")
        check_range(self, 0, 0.99, "jitter")


@dataclass(frozen=True, kw_only=True)
class Augment:
    """Views of both modalities, and the image sizes that the encoders see."""

    size: int = 224
    """Side in pixels of the crops that enter the encoders (paper: 224)."""
    whole: int | None = None
    """Side in pixels at which frozen encoders see whole images. Default: size. Random crops show objects larger than a whole
    image resized to the same side does, so features of whole images improve with a larger side (arXiv:1906.06423). Heads
    trained with the encoders (shared space, own classifiers) do not, and always use ``size`` (docs/simulator.md)."""
    vision: ViewAugment = ViewAugment()
    touch: ViewAugment = ViewAugment()

    def __post_init__(self) -> None:
        given = (self.size, self.whole, *(side for own in (self.vision, self.touch) for side in (own.size, own.whole)))
        for side in given:
            if side is not None and not 8 <= side <= 1024:
                raise ValueError(f"augment size or whole {side}: give a side of 8 to 1024 pixels")

    def of(self, modality: str) -> ViewAugment:
        return self.vision if modality == "vision" else self.touch

    def size_of(self, modality: str) -> int:
        """Side in pixels of the crops of ``modality``."""
        return self.of(modality).size or self.size

    def whole_of(self, modality: str) -> int:
        """Side in pixels of the whole images of ``modality`` that probes and predictions see."""
        own = self.of(modality)
        return own.whole or own.size or self.whole or self.size


@dataclass(frozen=True)
class Drawn:
    """Parameters of one view of B images."""

    boxes: Tensor  # [B, 4] int64: top, left, height, width of the crop
    flip: Tensor  # [B] bool
    grayscale: Tensor  # [B] bool
    gains: Tensor  # [B, 5] float: brightness, contrast, and gains of R, G, B


def draw(config: ViewAugment, num: int, size: int, generator: torch.Generator) -> Drawn:
    """Draw the parameters of one random view of ``num`` images of ``size`` x ``size`` pixels."""

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    area = size * size * uniform(num, NUM_TRIES, low=config.scale[0], high=config.scale[1])
    ratio = torch.exp(uniform(num, NUM_TRIES, low=-0.28768207, high=0.28768207))  # log(3/4) to log(4/3)
    width, height = (area * ratio).sqrt().round().long(), (area / ratio).sqrt().round().long()
    fits = (width <= size) & (height <= size) & (width > 0) & (height > 0)
    first, none = fits.float().argmax(dim=1, keepdim=True), ~fits.any(dim=1)
    height, width = height.gather(1, first).squeeze(1), width.gather(1, first).squeeze(1)
    height[none] = width[none] = size
    top = (uniform(num) * (size - height + 1)).long()
    boxes = torch.stack([top, (uniform(num) * (size - width + 1)).long(), height, width], dim=1)
    flip, grayscale = uniform(num) < config.flip, uniform(num) < config.grayscale
    return Drawn(boxes, flip, grayscale, uniform(num, 5, low=1 - config.jitter, high=1 + config.jitter))


def apply(
    images: UInt8[Tensor, "B C H W"], drawn: Drawn, size: int, dtype: torch.dtype, mean_std: MeanStd = IMAGENET
) -> Float[Tensor, "B C S S"]:
    """Apply the parameters ``drawn``: crop to [size, size], flip, colour, normalise. Returns channels-last on their device.

    Computed in fp32 and rounded to ``dtype`` once, as autocast would round it before the first convolution.
    """
    return (_one_by_one if images.device.type == "cpu" else _batched)(images, drawn, size, dtype, mean_std)


def _one_by_one(images: Tensor, drawn: Drawn, size: int, dtype: torch.dtype, mean_std: MeanStd) -> Tensor:
    """The implementation for CPUs. One image at a time stays in the cache, as uint8 until the last step."""
    num, channels = images.shape[:2]
    out = torch.empty(num, size, size * channels, dtype=dtype)  # lines of pixels with their channels: long inner loops
    factors, offsets = (t.repeat(size * channels // 3) for t in _normalisation(images.device, mean_std))
    luma = _luma(images.device).flatten()
    jittered = (drawn.gains != 1).any(1)
    for i, line in enumerate(out):
        pixels = _crop(images[i], drawn.boxes[i].tolist(), bool(drawn.flip[i]), size)
        tones = pixels.reshape(size, -1).float()
        if jittered[i]:
            sensors = pixels.permute(2, 0, 1).unflatten(0, (-1, 3))[None].float().div_(255)
            one = Drawn(*(values[i : i + 1] for values in vars(drawn).values()))
            tones = _colour(sensors, one)[0].mul_(255).permute(2, 3, 0, 1).reshape(size, -1)
        elif drawn.grayscale[i]:
            tones = (tones.view(-1, 3) @ luma)[:, None].expand(-1, 3).reshape(size, -1)
        torch.addcmul(offsets, tones, factors, out=line)
    return out.view(num, size, size, channels).permute(0, 3, 1, 2)


def _crop(image: UInt8[Tensor, "C H W"], box: list[int], flip: bool, size: int) -> UInt8[Tensor, "S S C"]:
    """Crop, resize (bilinear, antialiased when shrinking) and flip one image."""
    top, left, height, width = box
    crop = image[:, top : top + height, left : left + width].unflatten(0, (-1, 3))  # [sensors, 3, h, w]
    if (height, width) != (size, size):  # torch's uint8 kernel is vectorised for channels-last images
        crop = crop.contiguous(memory_format=torch.channels_last)
        crop = F.interpolate(crop, (size, size), mode="bilinear", antialias=True)
    if flip:
        crop = crop.flip(-1)
    return crop.permute(2, 3, 0, 1).reshape(size, size, -1)


def _batched(images: Tensor, drawn: Drawn, size: int, dtype: torch.dtype, mean_std: MeanStd = IMAGENET) -> Tensor:
    """The implementation for GPUs: crop, resize and flip the whole batch by two matrix products, Y @ image @ X'. The
    antialiased filter is the same as on the CPU. On a GPU it uses fp16, whose weights err by less than 0.1 level."""
    device = images.device
    top, left, height, width = drawn.boxes.to(device, torch.float32, non_blocking=True).unbind(1)
    exact = torch.float16 if device.type == "cuda" else torch.float32
    rows = _resampling(top, height, images.shape[-2], size).to(exact)[:, None]
    columns = _resampling(left, width, images.shape[-1], size)
    flip = drawn.flip.to(device, non_blocking=True)[:, None, None]
    columns = torch.where(flip, columns.flip(1), columns).to(exact)[:, None]
    with torch.autocast(device.type, enabled=False):
        cropped = rows @ images.to(exact) @ columns.mT
    sensors = cropped.float().round_().div_(255).unflatten(1, (-1, 3))
    scale, shift = (t.view(3, 1, 1) for t in _normalisation(device, mean_std))
    view = torch.addcmul(shift, _colour(sensors, drawn), scale * 255)
    return view.flatten(1, 2).to(dtype, memory_format=torch.channels_last)


def _resampling(start: Tensor, length: Tensor, side: int, size: int) -> Float[Tensor, "B S H"]:
    """Weights of the H source pixels in each of the S pixels of crops [start, start + length): a triangle filter."""
    step = length[:, None, None] / size
    target = torch.arange(size, device=start.device, dtype=torch.float32)[None, :, None] + 0.5
    source = torch.arange(side, device=start.device, dtype=torch.float32)[None, None, :] + 0.5
    begin = start[:, None, None]
    weights = (1 - (source - begin - target * step).abs() / step.clamp(min=1)).clamp_(min=0)
    weights = weights * ((source > begin) & (source < begin + length[:, None, None]))
    return weights / weights.sum(2, keepdim=True)


@lru_cache
def _normalisation(device: torch.device, mean_std: MeanStd) -> tuple[Tensor, Tensor]:
    """Factor and offset [3] that normalise levels 0-255 by mean and standard deviation."""
    mean, std = (torch.tensor(v, dtype=torch.float64) for v in mean_std)
    return (1 / (255 * std)).float().to(device), (-mean / std).float().to(device)


@lru_cache
def _luma(device: torch.device) -> Tensor:
    return torch.tensor((0.299, 0.587, 0.114), device=device).view(3, 1, 1)  # ITU-R BT.601, as of PIL and torchvision


def _colour(sensors: Float[Tensor, "B N 3 S S"], drawn: Drawn) -> Float[Tensor, "B N 3 S S"]:
    """Apply jitter, then grayscale, to levels in [0, 1]; the same for all sensors of an image."""
    luma = _luma(sensors.device)
    if bool((drawn.gains != 1).any()):  # the parameters are on the CPU, so this does not wait for a GPU
        gains = drawn.gains.to(sensors.device, non_blocking=True)
        brightness, contrast = gains[:, 0].view(-1, 1, 1, 1, 1), gains[:, 1].view(-1, 1, 1, 1, 1)
        sensors = sensors * (brightness * gains[:, 2:].view(-1, 1, 3, 1, 1))
        level = (sensors * luma).sum(2, keepdim=True).mean((3, 4), keepdim=True)
        sensors = (level + contrast * (sensors - level)).clamp_(0, 1)
    if bool(drawn.grayscale.any()):
        gray = drawn.grayscale.to(sensors.device, non_blocking=True).view(-1, 1, 1, 1, 1)
        sensors = torch.where(gray, (sensors * luma).sum(2, keepdim=True), sensors)
    return sensors


def plain_view(images: UInt8[Tensor, "B C H W"], size: int, mean_std: MeanStd = IMAGENET) -> Float[Tensor, "B C S S"]:
    """Whole images resized to ``size`` and normalised, without randomness, for probes and predictions."""
    num, _, height, width = images.shape
    whole = torch.tensor([[0, 0, height, width]]).expand(num, 4)
    never = torch.zeros(num, dtype=torch.bool)
    return apply(images, Drawn(whole, never, never, torch.ones(num, 5)), size, torch.float32, mean_std)


def normalise(images: Float[Tensor, "B C H W"], mean_std: MeanStd = IMAGENET) -> Float[Tensor, "B C H W"]:
    """Normalise images with levels in [0, 1]. Returns channels-last."""
    scale, shift = (t.repeat(images.shape[1] // 3).view(-1, 1, 1) for t in _normalisation(images.device, mean_std))
    return torch.addcmul(shift, images, scale * 255).contiguous(memory_format=torch.channels_last)
