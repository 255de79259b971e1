"""Functions on images: decode, resize to a square, subtract a background."""

import re
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import simplejpeg
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError


def fit(image: np.ndarray, size: int) -> np.ndarray:
    """Resize uint8 [H, W, C] to [size, size, C], ignoring the aspect ratio as the paper does (appendix B)."""
    if image.shape[:2] == (size, size):
        return image
    # One element of three bytes per pixel and sensor: copies ten times as fast as single bytes.
    pixels = np.ascontiguousarray(image).view("V3")
    sensors = [np.ascontiguousarray(pixels[:, :, i]).view(np.uint8) for i in range(pixels.shape[2])]
    return np.concatenate([shrink(Image.fromarray(s.reshape(*image.shape[:2], 3)), size) for s in sensors], axis=2)


def shrink(image: Image.Image, size: int) -> np.ndarray:
    """Resize an RGB image to uint8 [size, size, 3]: the same pixels as ``fit``, without an array in full size."""
    if image.size != (size, size):
        image = image.resize((size, size), Image.Resampling.BILINEAR)
    return np.asarray(image)


IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm", ".gif")
MAX_PIXELS = 80_000_000  # of one image; 240 MB as RGB
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)  # ``decode`` refuses such images itself
FORMATS = ("JPEG", "PNG", "BMP", "TIFF", "WEBP", "PPM", "GIF")
"""What a file is read as, whatever its name (JPEG: a camera's MPO, too). Pillow would start Ghostscript for an EPS."""


def decode(path: str | Path | BinaryIO, name: str = "", span: Sequence[float] | None = None) -> Image.Image:
    """Read an image file as RGB: rotated by EXIF, transparent parts black.

    Packs, ``find`` and ``live FOLDER`` read files with it; ``Model.embed`` treats PIL images alike.

    ``name`` is the name of an open file in error messages. ``span``, for packs, are the numbers of 16 bits or floats that
    become black and white, () for 0 and 65535; without it such files are a ValueError, as no model knows its pack's.
    """
    name = name or str(path)
    try:
        if isinstance(path, str | Path) and Path(path).exists() and not Path(path).is_file():  # a pipe never ends
            raise ValueError("it is no file")
        with Image.open(path, formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"it has {image.width} x {image.height} pixels: at most {MAX_PIXELS:,} are read")
            many = (tile[0][:3] == "ppm" and int(tile[3][1]) > 255 for tile in image.tile)  # type: ignore[index, arg-type]
            deep = any(many) or any(";16" in str(tile[3]) for tile in image.tile)
            if deep and not image.mode.startswith("I"):
                raise ValueError("it has 16 bits a colour, of which half would be lost: convert it to 8 bits")
            # A camera's MPO has a second image after the photo; GIF and TIFF stacks are refused.
            if getattr(image, "n_frames", 1) > 1 and image.format != "MPO":
                raise ValueError(f"it holds {getattr(image, 'n_frames', 0)} frames, not one: store one image per row")
            if image.format in ("JPEG", "MPO"):
                return to_rgb(_jpeg(image))
            image.load()
            return to_rgb(image, span)
    except UnidentifiedImageError:
        raise ValueError(f"{name} cannot be read as an image (its content is none of {', '.join(FORMATS)})") from None
    except DAMAGED as error:
        raise ValueError(f"{name} cannot be read as an image ({' '.join(str(error).split())})") from None


DAMAGED = (OSError, ValueError, SyntaxError, TypeError, IndexError, struct.error, Image.DecompressionBombError)
"""Errors of damaged files: PIL has no common base class for them."""
DAMAGE = re.compile("Corrupt JPEG data|Premature end|Inconsistent progression")
PADDING = re.compile(r" 1?\d extraneous bytes before marker 0xd9")
"""Of libjpeg's warnings: those of damage, and of the few bytes that USB cameras write before the end marker."""


def _jpeg(image: Image.Image) -> Image.Image:
    """An opened JPEG with its pixels, which are Pillow's; ValueError where libjpeg warns of damage, as Pillow does not."""
    file: BinaryIO = image.fp  # type: ignore[attr-defined]
    file.seek(0)
    try:
        pixels = simplejpeg.decode_jpeg(file.read())
    except ValueError as error:
        if DAMAGE.search(str(error)) and not PADDING.search(str(error)):
            raise
        pixels = None  # rare subsampling, which Pillow knows
    if pixels is None or image.mode == "CMYK":
        image.load()
        return image
    found = Image.fromarray(pixels)
    found.info = image.info  # EXIF
    return found


def to_gray(values: np.ndarray, span: Sequence[float], clip: bool) -> np.ndarray:
    """Scale numbers to uint8, so that ``span`` becomes 0 to 255; without ``clip``, others are a ValueError."""
    low, high = span
    least, most = float(values.min()), float(values.max())
    if not np.isfinite(values).all():
        raise ValueError("it has values that are NaN or infinite")
    if not clip and (least < low or most > high):
        raise ValueError(f"its values lie in {least:g} to {most:g}, not {low:g} to {high:g}: --data.range")
    return np.rint(np.clip((values - np.float64(low)) / (high - low), 0, 1) * 255).astype(np.uint8)


def to_rgb(image: Image.Image, span: Sequence[float] | None = None) -> Image.Image:
    """An opened image as RGB, by the rules of ``decode``; ``image`` itself is not changed. Raises as ``decode``."""
    if image.getexif().get(ExifTags.Base.Orientation, 1) != 1:
        image = ImageOps.exif_transpose(image)
    if image.mode.startswith("I") or image.mode == "F":  # PIL's own conversion clips instead
        if span is None:
            raise ValueError("it has more than 8 bits, and the model does not know how they were scaled: pack it, too")
        levels = span or ((0, 1) if image.mode == "F" else (0, 65535))
        return Image.fromarray(to_gray(np.asarray(image), levels, bool(span))).convert("RGB")
    if span:
        raise ValueError(f"it is read as {image.mode} of 8 bits: --data.range is for gray images of more")
    if image.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in image.info:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, (0, 0, 0, 255)), image)
    return image if image.mode == "RGB" else image.convert("RGB")


def side_by_side(image: np.ndarray) -> np.ndarray:
    """Sensors stacked on channels, uint8 [H, W, 3 n], next to each other: [H, n W, 3]."""
    return np.concatenate([image[..., c : c + 3] for c in range(0, image.shape[2], 3)], axis=1)


def difference(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Return (image - background) / 2 + 128 as uint8, so that no contact is 128."""
    if image.shape != background.shape:
        (h, w), (h2, w2) = image.shape[:2], background.shape[:2]
        raise ValueError(f"image is {w} x {h}, its background {w2} x {h2}: a difference needs one size")
    return ((image.astype(np.int16) - background + 256) >> 1).astype(np.uint8)


ROS_CHANNELS = {"mono": 1, "8UC1": 1, "16UC1": 1, "32FC1": 1, "bgr": 3, "rgb": 3, "8UC3": 3, "bgra": 4, "rgba": 4}


def ros_pixels(message: Any, name: str) -> bytes | np.ndarray:
    """The file in a sensor_msgs CompressedImage, or the numbers [H, W, 1 or 3] of an Image, red first.

    ValueError says that ``name`` has an encoding that is not read, or a wrong length.
    """
    if not hasattr(message, "encoding"):
        return bytes(message.data)
    code = message.encoding
    channels = ROS_CHANNELS.get(code) or ROS_CHANNELS.get(code.rstrip("168"), 0)
    kind = np.dtype(np.float32 if "32F" in code else np.uint16 if "16" in code else np.uint8)
    if not channels:
        raise ValueError(f"{name} has the encoding {code}: {', '.join(ROS_CHANNELS)} are read")
    kind = kind.newbyteorder(">" if message.is_bigendian else "<")
    least = message.height * message.width * channels * kind.itemsize
    if not 0 < least <= len(message.data) or len(message.data) % message.height:
        size = f"{message.width} x {message.height} pixels of {code}"
        raise ValueError(f"{name} has {len(message.data)} bytes for {size}: it is damaged")
    lines = np.frombuffer(message.data, kind).reshape(message.height, -1)[:, : message.width * channels]  # padded
    pixels = lines.reshape(message.height, message.width, channels)[:, :, :3]
    return pixels[:, :, ::-1] if code.startswith("bgr") else pixels
