"""One decoder: a picture has the same pixels in a pack, in ``find``, in ``live FOLDER`` and in ``Model.embed``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from mvitac.cli.search import _picture
from mvitac.data.build import build
from mvitac.data.images import decode, fit
from mvitac.datasets.folder import FolderConfig
from mvitac.live.cameras import Folder
from mvitac.transforms.preprocess import to_array

SIDE = 16


def written(kind: str, folder: Path) -> Path:
    """A picture of 24 x 20 pixels, without symmetry, as a file of this kind."""
    rng = np.random.default_rng(5)
    rgb = rng.integers(0, 256, (20, 24, 3), dtype=np.uint8)
    path = folder / "touch.png"
    if kind == "jpeg rotated by EXIF":
        path = folder / "touch.jpg"
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 6
        Image.fromarray(rgb).save(path, quality=95, exif=exif)
    elif kind == "RGBA":
        Image.fromarray(np.dstack([rgb, rng.integers(0, 256, (20, 24), dtype=np.uint8)])).save(path)
    elif kind == "palette with a transparent colour":
        Image.fromarray(rgb).quantize(32).save(path, transparency=3)
    elif kind == "gray, 16 bits":
        Image.fromarray(rng.integers(0, 65536, (20, 24), dtype=np.uint16)).save(path)
    else:
        assert kind == "gray"
        Image.fromarray(rgb[..., 0]).save(path)
    return path


@pytest.mark.parametrize(
    "kind", ["jpeg rotated by EXIF", "RGBA", "palette with a transparent colour", "gray, 16 bits", "gray"]
)
def test_same_pixels_everywhere(kind: str, tmp_path: Path) -> None:
    path = written(kind, tmp_path)
    (tmp_path / "pairs.csv").write_text(f"touch\n{path.name}\n")
    source = FolderConfig(path=tmp_path / "pairs.csv", size=SIDE).source()
    packed = build(source, tmp_path / "pack", size=SIDE, quiet=True).images["touch"][0]
    live = Folder(tmp_path)
    live.open()
    with Image.open(path) as opened:
        before = opened.copy()
        embedded = to_array(opened, 3, "touch")
        assert opened.getexif() == before.getexif() and opened.mode == before.mode  # the caller's image is unchanged
    for found in (_picture([path]), live.read(), embedded):
        assert np.array_equal(fit(found, SIDE), packed)


def test_floating_point_images_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"touch: this image cannot be used .*floating-point"):
        to_array(Image.fromarray(np.ones((8, 8), np.float32)), 3, "touch")


def test_find_does_not_stack_sensors_of_two_sizes(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "left.png")
    Image.new("RGB", (8, 9)).save(tmp_path / "right.png")
    with pytest.raises(ValueError, match=r"left.png is 8 x 8, .*right.png is 8 x 9: stacked sensors need one size"):
        _picture([tmp_path / "left.png", tmp_path / "right.png"])


def test_a_jpeg_without_its_end_is_refused(tmp_path: Path) -> None:
    """Pillow shows zeros after half of the file as gray. An end marker inside a comment is none; a trailer is allowed."""
    path = tmp_path / "touch.jpg"
    rgb = np.random.default_rng(5).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(rgb).save(path, comment=b"\xff\xd9")
    whole = path.read_bytes()
    for kept in (len(whole) // 2, len(whole) - 2):
        path.write_bytes(whole[:kept] + bytes(len(whole) - kept))
        with pytest.raises(ValueError, match=r"touch.jpg cannot be read as an image .its end is missing"):
            decode(path)
    path.write_bytes(whole + b"trailer")
    assert decode(path).size == (64, 64)
