"""References to images: a file, a frame of a video, a cell of a parquet table, an array.

References with the same container (a video, a row group) are read together in one pass. Another format is one more
class here: its ``container``, how it is ``opened``, and what is ``stored`` there.
"""

import io
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from mvitac.data import video
from mvitac.data.images import MAX_PIXELS, decode, to_gray
from mvitac.system.files import brief, check_ordinary

ARRAYS = (".h5", ".hdf5", ".zarr", ".zarr.zip")

Damage = dict["ImageRef", str]  # reference of a damaged image -> what is wrong with it
Refs = dict[str, list["ImageRef | None"]]  # column -> each row's image


@dataclass(frozen=True, slots=True, order=True)
class ImageRef:
    """One image of a dataset, here a file of its own; sorted and hashed by its location."""

    path: str
    crop: tuple[int, ...] = field(default=(), kw_only=True)
    """Left, top, width and height of the part that is used; () = all of it."""
    span: tuple[float, ...] = field(default=(), kw_only=True)
    """The numbers that become black and white, of images of more than 8 bits; () = 0 and 65535, or 0 and 1 of floats."""
    bgr: bool = field(default=False, kw_only=True)
    """Whether blue is stored first."""

    def __str__(self) -> str:
        return self.path

    def container(self) -> Hashable | None:
        """Return what is opened once to read many images from it; None if the image is read by itself."""
        return None

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Open the container; ValueError or OSError if that fails."""
        yield None

    def stored(self, container: Any) -> str | bytes | np.ndarray:
        """Read from the opened container the path or the bytes of an image file, or numbers [H, W] or [H, W, 1 to 3].

        References of one container are asked for in ascending order. ValueError or OSError if it is damaged.
        """
        if not self.path.lower().endswith(".npy"):
            return self.path
        try:  # memory-mapped: a header may claim any shape
            return np.load(self.path, mmap_mode="r", allow_pickle=False)
        except (ValueError, TypeError, OverflowError) as error:
            raise ValueError(f"{self} cannot be read as an array ({brief(error)})") from None

    @staticmethod
    def read(refs: "Sequence[ImageRef]", lost: Damage) -> "Iterator[tuple[ImageRef, Image.Image]]":
        """Yield the references, ascending and of one container, with their images; damaged ones go to ``lost`` instead."""
        with refs[0].opened() as container:
            for ref in refs:
                try:
                    found = picture(ref.stored(container), ref)
                except (ValueError, OSError) as error:
                    lost[ref] = str(error)
                else:
                    yield ref, found


@dataclass(frozen=True, slots=True, order=True)
class Frame(ImageRef):
    """Frame ``index`` (from 0) of a video."""

    index: int

    def __str__(self) -> str:
        return f"{self.path} frame {self.index}"

    def container(self) -> Hashable:
        return self.path

    @staticmethod
    def read(refs: Sequence[Any], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        path, at = refs[0].path, {ref.index: ref for ref in refs}
        why: dict[int, str] = {}
        for index, image in video.frames(path, list(at), lost=why):
            yield at[index], Image.fromarray(image)
        lost.update({at[index]: f"{path}: frame {index} {reason}" for index, reason in why.items()})


@dataclass(frozen=True, slots=True, order=True)
class ParquetCell(ImageRef):
    """Row ``row`` of row group ``group``, column ``column``: encoded bytes, or Hugging Face's struct<bytes, path>."""

    group: int
    column: str
    row: int

    def __str__(self) -> str:
        return f"{self.path} row group {self.group} row {self.row} {self.column}"

    def container(self) -> Hashable:
        return (self.path, self.group)

    @contextmanager
    def opened(self) -> Iterator[pa.ChunkedArray]:
        try:
            file = pq.ParquetFile(Path(self.path).absolute())
            values = file.read_row_group(self.group, columns=[self.column]).column(0)
        except (pa.ArrowException, OSError) as error:
            raise ValueError(f"{self.path} cannot be read ({brief(error)})") from None
        yield values

    def stored(self, container: pa.ChunkedArray) -> bytes:
        value = container[self.row].as_py()
        if isinstance(value, dict):
            folder = Path(self.path).resolve().parent
            beside = (folder / (value.get("path") or "")).resolve()
            inside = beside.is_relative_to(folder) and beside.is_file()  # a stranger's table shows no other folders
            value = value.get("bytes") or (beside.read_bytes() if inside else None)
        if not value:
            raise ValueError(f"{self} holds no image")
        return value


def _usual(kind: np.dtype) -> tuple[float, float]:
    """Return what is black and white in numbers of more than 8 bits, or in 8 bits that are stored as longer numbers."""
    return (0.0, 1.0) if kind.kind == "f" else (0, 65535) if kind.kind == "u" and kind.itemsize == 2 else (0, 255)


def picture(found: str | bytes | np.ndarray, ref: ImageRef) -> Image.Image:
    """Return what is ``stored`` of ``ref`` as RGB."""
    if not isinstance(found, np.ndarray):
        return decode(found if isinstance(found, str) else io.BytesIO(found), str(ref), ref.span)
    pixels = found
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (1,), (2,), (3,)) or pixels.dtype.kind not in "iuf":
        raise ValueError(f"{ref} is {pixels.dtype} {list(pixels.shape)}: give numbers [height, width, 1 to 3 channels]")
    if not 0 < (num := pixels.shape[0] * pixels.shape[1]) <= MAX_PIXELS:
        raise ValueError(f"{ref} has {num:,} pixels: 1 to {MAX_PIXELS:,} are read")
    if pixels.dtype != np.uint8 or ref.span:
        try:
            pixels = to_gray(pixels, ref.span or _usual(pixels.dtype), bool(ref.span))
        except ValueError as error:
            raise ValueError(f"{ref}: {error}") from None
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    if pixels.shape[2] == 2:  # such as a field of motion
        pixels = np.concatenate([pixels, np.zeros_like(pixels[:, :, :1])], axis=2)
    return Image.fromarray(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels).convert("RGB")


CHUNK_BYTES = 64 << 20
"""Cache for chunks of an HDF5 dataset. h5py's 1 MB is less than a chunk of several images, which each image would read."""


@contextmanager
def open_arrays(path: str | Path) -> Iterator[Any]:
    """Open an HDF5 file (h5py.File) or a zarr group for reading; ValueError if it, or something in it, is damaged."""
    hdf5 = str(path).lower().endswith(ARRAYS[:2])
    try:
        check_ordinary(Path(path))  # a pipe never ends
        if hdf5:
            import h5py

            with h5py.File(path, rdcc_nbytes=CHUNK_BYTES) as file:
                yield file
        else:
            import zarr.storage

            zipped = str(path).lower().endswith(".zip")
            with zarr.storage.ZipStore(path, mode="r") if zipped else zarr.storage.LocalStore(path) as store:
                yield zarr.open_group(store, mode="r")
    except ModuleNotFoundError:
        raise ValueError(f"{path} needs zarr: pip install 'mvitac[zarr]'") from None
    except Exception as error:  # zarr and its codecs raise any type for metadata that somebody wrote by hand
        if isinstance(error, ValueError) and str(path) in str(error):
            raise
        what = "HDF5" if hdf5 else "zarr"
        raise ValueError(f"{path} cannot be read as {what} ({brief(error)}): is it complete, and closed?") from None


@dataclass(frozen=True, slots=True, order=True)
class ArrayRow(ImageRef):
    """Row ``index`` (from 0) of a ``dataset`` of an HDF5 or zarr file: an image as numbers, or the bytes of a file."""

    dataset: str
    index: int

    def __str__(self) -> str:
        return f"{self.path} {self.dataset} row {self.index}"

    def container(self) -> Hashable:
        return (self.path, self.dataset)

    @contextmanager
    def opened(self) -> Iterator[Any]:
        with open_arrays(self.path) as file:
            yield file[self.dataset]

    def stored(self, container: Any) -> bytes | np.ndarray:
        try:
            return entry(container, self.index)
        except (ArithmeticError, OSError, RuntimeError, IndexError, TypeError, ValueError) as error:
            raise ValueError(f"{self} cannot be read ({brief(error)})") from None


def entry(data: Any, index: int) -> Any:
    """Return a row of a dataset: numbers [H, W, ...], or bytes where it is a file (text, opaque, or numbers [B])."""
    array = np.asarray(data[index])
    return array if array.ndim > 1 else array.tobytes() if array.ndim else array.tolist()


def span_of(ref: ImageRef) -> tuple[float, ...]:
    """Return the numbers that become black and white of an image of more than 8 bits; () of others, and of damaged ones."""
    with suppress(ValueError, OSError, Image.DecompressionBombError), ref.opened() as container:
        found = ref.stored(container)
        if isinstance(found, np.ndarray):
            return () if found.dtype == np.uint8 else ref.span or _usual(found.dtype)
        with Image.open(found if isinstance(found, str) else io.BytesIO(found)) as image:
            return () if image.mode[0] not in "IF" else ref.span or ((0, 1) if image.mode == "F" else (0, 65535))
    return ()


def read_all(refs: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
    """Yield each distinct reference, all of one container, with its image (RGB); damaged ones are put in ``lost``."""
    if distinct := sorted(set(refs)):
        for ref, image in distinct[0].read(distinct, lost):
            yield ref, _prepared(ref, image)


def _prepared(ref: ImageRef, image: Image.Image) -> Image.Image:
    if ref.crop:
        left, top, width, height = ref.crop
        if left + width > image.width or top + height > image.height:
            raise ValueError(f"{ref} is {image.width} x {image.height}: crop {':'.join(map(str, ref.crop))} is larger")
        image = image.crop((left, top, left + width, top + height))
    return Image.merge("RGB", image.split()[::-1]) if ref.bgr else image


@lru_cache(maxsize=64)
def mean_image(refs: tuple[ImageRef, ...]) -> np.ndarray:
    """Return the mean of images of one size, uint8 [H, W, 3]: the sensor's background."""
    images: list[np.ndarray] = []
    for ref in refs:
        lost: Damage = {}
        images += [np.asarray(image) for _, image in read_all([ref], lost)]
        if lost:
            raise ValueError(lost[ref])
        if images[-1].shape != images[0].shape:
            raise ValueError(f"{ref} has another size than {refs[0]}: backgrounds must be of one size")
    return np.rint(np.mean(images, axis=0, dtype=np.float64)).astype(np.uint8)
