"""From raw images of any kind to the input of an encoder, without randomness.

An image is first resized to ``stored``, the side of the training pack's images, and then to the side that the encoder
sees. Shapes: B images, C channels, H x W pixels, S the side that the encoder sees.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from mvitac.data.images import decode, difference, fit, to_rgb
from mvitac.system.files import brief
from mvitac.transforms.random_views import IMAGENET, MeanStd, plain_view

ImageInput = str | Path | np.ndarray | Tensor | Image.Image | Sequence[Any]
"""One image or several, as ``Model.embed`` accepts them."""
TOLERANCE = 1e-3  # by which floats may lie outside [0, 1], as rounding and resizing leave them


@dataclass(frozen=True)
class Preprocess:
    """The preprocessing of ``Model.embed`` for one image, made by ``Model.transform``. It can be pickled."""

    modality: str
    channels: int
    stored: int  # side in pixels of the images in the training pack
    size: int | None = None
    """Side of normalised images for the trunk. None: uint8 at ``stored`` pixels, for ``Model.forward``."""
    background: np.ndarray | None = None  # the touch sensor without contact, uint8 [H, W, C], to subtract
    frames: int = 1  # frames of a window; ``channels`` are those of all of them, the newest first
    mean_std: MeanStd = IMAGENET  # by which images for the trunk are normalised

    def __call__(self, image: ImageInput) -> Tensor:
        """One image (a path, PIL image, array or tensor) to uint8 [C, stored, stored], or fp32 [C, size, size].

        With several ``frames``: one clip, as for ``Model.embed``.
        """
        pixels = torch.from_numpy(self._stored(image, self.background)).permute(2, 0, 1).contiguous()
        return pixels if self.size is None else plain_view(pixels[None], self.size, self.mean_std)[0].contiguous()

    def batches(self, images: ImageInput, background: ImageInput | None, num: int) -> Iterator[Tensor]:
        """Batches uint8 [<= num, C, stored, stored] of one image or several, read as they are needed.

        ``background`` is one image, or one for each of ``images``. With several ``frames``, images are clips.
        """
        given, free = single_images(images, self.modality, clips=self.channels if self.frames > 1 else 0), [None]
        if background is not None:
            each = self.channels // self.frames
            free = [to_array(x, each, "background") for x in single_images(background, "background")]
        if len(free) not in (1, len(given)):
            raise ValueError(f"background: got {len(free)} images for {len(given)} of touch: give one, or one for each")
        for start in range(0, len(given), num):
            rows = range(start, min(start + num, len(given)))
            batch = np.stack([self._stored(given[i], free[i % len(free)]) for i in rows])
            yield torch.from_numpy(batch).permute(0, 3, 1, 2)

    def _stored(self, image: Any, background: np.ndarray | None) -> np.ndarray:
        """One image of any kind, or one clip, as a new uint8 array [stored, stored, channels], as a pack would store it."""
        frames, each = [], self.channels // self.frames
        for frame in self._clip(image) if self.frames > 1 else [image]:
            array = fit(to_array(frame, each, self.modality), self.stored)
            frames.append(np.array(array if background is None else difference(array, fit(background, self.stored))))
        return np.concatenate(frames[::-1], axis=2)

    def _clip(self, value: Any) -> list[Any]:
        """The frames of one clip, oldest first; a window as a pack stores it, [H, W, C] of all frames, is taken apart."""
        each = self.channels // self.frames
        if isinstance(value, np.ndarray) and value.ndim == 3 and value.shape[2] == self.channels:
            return [value[:, :, f * each : (f + 1) * each] for f in reversed(range(self.frames))]
        frames = [value] if _is_image(value) else list(value)
        if len(frames) != self.frames:
            how = f"give clips [{self.frames}, H, W, {each}], oldest first"
            raise ValueError(f"{self.modality}: this model looks at {self.frames} frames, got {len(frames)}: {how}")
        return frames


def single_images(value: ImageInput, what: str, *, clips: int = 0) -> list[Any]:
    """The images in any input of ``Model.embed``, as they are. ``what`` names it in errors.

    ``clips``: channels of a window, if they are clips [F, H, W, C], or [H, W, F C] as a pack stores windows; 0 for images.
    """
    windows = isinstance(value, np.ndarray) and value.ndim == 4 and value.shape[3] == clips
    listed = isinstance(value, (list, tuple)) and bool(value) and _is_image(value[0])
    if _is_image(value) or (clips and not windows and (listed or getattr(value, "ndim", 0) == 4)):
        return [value]
    if isinstance(value, (bytes, dict)) or not isinstance(value, Iterable):
        raise ValueError(f"{what}: expected one image or several, got {type(value).__name__}")
    if not (images := list(value)):
        raise ValueError(f"{what}: no images given")
    return images


def _is_image(value: Any) -> bool:
    """Whether ``value`` is one image, and so a list that it is in may be one clip."""
    pixels = isinstance(value, (np.ndarray, Tensor)) and value.ndim in (0, 2, 3)
    return pixels or isinstance(value, (str, os.PathLike, Image.Image))


def to_array(image: Any, channels: int, what: str) -> np.ndarray:
    """One image of any kind as uint8 [H, W, channels]; if it is none, ValueError with its name, ``what``."""
    first = isinstance(image, Tensor)  # channels are first in tensors and last in arrays, where both would fit
    if isinstance(image, (str, os.PathLike)):
        image = decode(Path(image))
    if isinstance(image, Image.Image):
        try:
            image = np.asarray(to_rgb(image))
        except (ValueError, OSError) as error:
            raise ValueError(f"{what}: this image cannot be used ({brief(error)})") from None
    if isinstance(image, Tensor):
        image = (image.float() if image.is_floating_point() else image).detach().cpu().numpy()
    known = isinstance(image, np.ndarray) and (image.dtype == np.uint8 or np.issubdtype(image.dtype, np.floating))
    if not known or image.ndim != 3:
        shown = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"{what}: expected uint8 images, or floats in [0, 1], with {channels} channels, got {shown}")
    if 0 in image.shape or channels not in (image.shape[0], image.shape[2]):
        raise ValueError(f"{what}: this model takes {channels} channels, got an image of shape {image.shape}")
    if image.shape[0] == channels and (first or image.shape[2] != channels):
        image = image.transpose(1, 2, 0)
    if image.dtype == np.uint8:
        return image
    check_range(float(image.min()), float(image.max()), image.dtype, what)
    return (image.clip(0, 1) * 255).round().astype(np.uint8)


def check_range(low: float, high: float, dtype: Any, what: str) -> None:
    """Raise ValueError if floats from ``low`` to ``high`` are no levels in [0, 1]."""
    if not (low >= -TOLERANCE and high <= 1 + TOLERANCE):
        got = f"got {dtype} from {low:.3g} to {high:.3g}"
        raise ValueError(f"{what}: expected floats in [0, 1] or uint8, {got}: the model normalises images itself")


def check_images(images: Tensor, channels: int, what: str, *, values: bool = True) -> Tensor:
    """Return ``images`` [B, channels, H, W] as `embed` sees them: uint8, but floats in [0, 1] that need gradients.

    ValueError if they are others. Without ``values`` their range is not checked: that makes a GPU wait.
    """
    known = isinstance(images, Tensor) and (images.dtype == torch.uint8 or images.is_floating_point())
    if not known or images.ndim != 4 or images.shape[1] != channels or not images.numel():
        shown = f"{images.dtype} {list(images.shape)}" if isinstance(images, Tensor) else type(images).__name__
        asked = f"expected a tensor [B, {channels}, H, W], uint8 or float in [0, 1]"
        raise ValueError(f"{what}: {asked}, got {shown} (`embed` takes any image)")
    if images.dtype == torch.uint8:
        return images
    if values:
        low, high = images.detach().aminmax()
        check_range(float(low), float(high), images.dtype, what)
    return images if images.requires_grad else (images.float().clip(0, 1) * 255).round().to(torch.uint8)


def resized(images: Tensor, side: int) -> Tensor:
    """Resize [B, C, H, W] to [B, C, side, side], ignoring the aspect ratio; uint8 stays uint8."""
    if images.shape[-2:] == (side, side):
        return images
    whole = images.dtype == torch.uint8
    # torch's uint8 kernel, for CPUs only, gives Pillow's pixels (0.3 % differ by one level).
    levels = images.contiguous(memory_format=torch.channels_last) if whole and images.is_cpu else images.float()
    levels = F.interpolate(levels, (side, side), mode="bilinear", antialias=True)
    return levels.round().to(torch.uint8) if whole and not images.is_cpu else levels
