"""Image files of any kind as RGB, in Pillow's hands: what is only wanted small need not become a large array."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image, ImageOps

IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm", ".gif")


def decode(path: str | Path | BinaryIO, name: str = "") -> Image.Image:
    """An image file as RGB: upright (EXIF), 16 bits scaled to 8, transparent parts black.

    ``name`` is what to call an open file in errors.
    """
    name = name or str(path)
    try:
        with Image.open(path) as image:
            # A camera's MPO hides a second picture behind the first; a GIF or TIFF stack is no photo.
            if getattr(image, "n_frames", 1) > 1 and image.format != "MPO":
                raise ValueError(f"it holds {getattr(image, 'n_frames', 0)} frames, not one: store one image per row")
            image.load()
            ImageOps.exif_transpose(image, in_place=True)
            return _to_rgb(image)
    except FileNotFoundError:
        raise ValueError(f"{name} does not exist any more: it was there when packing began") from None
    # What PIL raises for damaged files is not one family.
    except (OSError, ValueError, SyntaxError, TypeError, IndexError, EOFError, struct.error) as error:
        raise ValueError(f"{name} cannot be read as an image ({' '.join(str(error).split())})") from None
    except Image.DecompressionBombError as error:
        raise ValueError(f"{name} is too large ({error})") from None


def _to_rgb(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):
        values = np.asarray(image).astype(np.int64)
        if values.min() < 0 or values.max() > 65535:
            raise ValueError(f"its values lie in {values.min()} to {values.max()}, not in 16 bits: scale it first")
        gray = ((values + 128) // 257).astype(np.uint8)  # 65535 -> 255; PIL's own conversion clips instead
        return Image.fromarray(gray).convert("RGB")
    if image.mode == "F":
        raise ValueError("it holds floating-point values of unknown range: store it with 8 or 16 bits")
    if image.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in image.info:
        image = image.convert("RGBA")
        black = Image.new("RGBA", image.size, (0, 0, 0, 255))
        image = Image.alpha_composite(black, image)
    return image if image.mode == "RGB" else image.convert("RGB")
