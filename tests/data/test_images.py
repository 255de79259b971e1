"""One decoder: a picture has the same pixels in a pack, in ``find``, in ``live FOLDER`` and in ``Model.embed``."""

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image

from mvitac.cli.search import _picture
from mvitac.data.build import build
from mvitac.data.images import decode, fit
from mvitac.data.video import frame_times
from mvitac.datasets.folder import FolderConfig
from mvitac.live.cameras import Folder
from mvitac.transforms.preprocess import to_array
from support.forged_packs import refuse_pipe

SIDE = 16


def written(kind: str, folder: Path) -> Path:
    rgb = (rng := np.random.default_rng(5)).integers(0, 256, (20, 24, 3), dtype=np.uint8)
    path = folder / "touch.png"
    if kind == "jpeg rotated by EXIF":
        path, exif = folder / "touch.jpg", Image.Exif()
        exif[ExifTags.Base.Orientation] = 6
        Image.fromarray(rgb).save(path, quality=95, exif=exif)
    elif kind == "RGBA":
        Image.fromarray(np.dstack([rgb, rng.integers(0, 256, (20, 24), dtype=np.uint8)])).save(path)
    elif kind == "palette with a transparent colour":
        Image.fromarray(rgb).quantize(32).save(path, transparency=3)
    else:
        assert kind == "gray"
        Image.fromarray(rgb[..., 0]).save(path)
    return path


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n"


def test_a_file_of_another_format_starts_no_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow would run Ghostscript on an EPS, whatever the file is called."""
    ran, program = tmp_path / "ran", tmp_path / "gs"
    program.write_text(f"#!/bin/sh\ntouch {ran}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("PIL.EpsImagePlugin.gs_binary", None)
    (tmp_path / "x.png").write_bytes(EPS)
    live = Folder(tmp_path)
    live.open()
    for read in (lambda: decode(tmp_path / "x.png"), lambda: _picture([tmp_path / "x.png"]), live.read):
        with pytest.raises(ValueError, match=r"x\.png cannot be read as an image"):
            read()
    assert not ran.exists()


def test_a_pipe_is_no_image(tmp_path: Path) -> None:
    picture, video = tmp_path / "a.png", tmp_path / "a.mp4"
    refuse_pipe(picture, lambda: decode(picture), r"a\.png cannot be read as an image \(it is no file\)")
    refuse_pipe(video, lambda: frame_times(video), r"a\.mp4 is no file")


@pytest.mark.parametrize("side", [9_000, 60_000])
def test_a_huge_image_is_refused_before_it_is_decoded(tmp_path: Path, side: int) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4) + kind + data + zlib.crc32(kind + data).to_bytes(4)

    head = side.to_bytes(4) + side.to_bytes(4) + bytes([8, 2, 0, 0, 0])
    (tmp_path / "x.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")))
    with pytest.raises(ValueError, match=r"x\.png cannot be read as an image \((it has 9000|Image size)"):
        decode(tmp_path / "x.png")


@pytest.mark.parametrize("kind", ["jpeg rotated by EXIF", "RGBA", "palette with a transparent colour", "gray"])
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


def smooth(size: tuple[int, int]) -> Image.Image:
    return Image.fromarray(np.random.default_rng(5).integers(0, 256, (16, 16, 3), dtype=np.uint8)).resize(size)


@pytest.mark.parametrize("progressive", [False, True])
def test_a_damaged_jpeg_is_refused(tmp_path: Path, progressive: bool) -> None:
    """Where libjpeg warns, Pillow shows gray or smeared pixels. An end marker in a comment is none."""
    path, end = tmp_path / "touch.jpg", b"\xff\xd9"
    smooth((320, 240)).save(path, comment=end, quality=90, progressive=progressive)
    middle = len(whole := path.read_bytes()) // 2
    damaged = {
        "cut off": whole[:middle],
        "zeros to the end": whole[:middle] + bytes(len(whole) - middle),
        "cut off, with an end marker": whole[:middle] + end,
        "zeros before the end marker": whole[:middle] + bytes(len(whole) - middle - 2) + end,
        "a block of zeros": whole[:middle] + bytes(512) + whole[middle + 512 :],
    }
    for what, data in damaged.items():
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"touch.jpg cannot be read as an image \((Corrupt|Premature)"):
            print(what, decode(path).size)


def test_bytes_after_a_jpeg_and_padding_of_usb_cameras_are_allowed(tmp_path: Path) -> None:
    path, end = tmp_path / "touch.jpg", b"\xff\xd9"
    smooth((64, 48)).save(path)
    whole, pixels = path.read_bytes(), np.asarray(decode(path))
    for allowed in (whole + b"trailer", whole[:-2] + bytes(2) + end):
        path.write_bytes(allowed)
        assert np.array_equal(np.asarray(decode(path)), pixels)
    path.write_bytes(whole[:-2] + bytes(200) + end)
    with pytest.raises(ValueError, match=r"19\d extraneous bytes"):
        decode(path)


@pytest.mark.parametrize("mode", ["RGB", "L", "CMYK"])
@pytest.mark.parametrize("options", [{}, {"subsampling": 0}, {"subsampling": 1}, {"progressive": True}], ids=str)
def test_jpegs_have_the_pixels_of_pillow(tmp_path: Path, mode: str, options: dict[str, Any]) -> None:
    path = tmp_path / "touch.jpg"
    smooth((61, 47)).convert(mode).save(path, **options)
    with Image.open(path) as opened:
        assert np.array_equal(np.asarray(decode(path)), np.asarray(opened.convert("RGB")))
