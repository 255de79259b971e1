"""References to images: in a file, a video, a tar, a cell of a parquet table or a dataset of an HDF5 file.

References with the same container (a video, a row group) are read together in one pass.
"""

import functools
import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from mvitac.data import video
from mvitac.data.images import decode
from mvitac.system.files import brief

HDF5 = (".h5", ".hdf5")

Damage = dict["ImageRef", str]  # reference of a damaged image -> what is wrong with it


@dataclass(frozen=True, slots=True)
class ImageRef(ABC):
    """One image of a dataset; sorted and hashed by its location."""

    path: str

    def container(self) -> Hashable | None:
        """Return what is opened once to read many images from it; None if the image is read by itself."""
        return None

    def within(self) -> tuple[int, ...]:
        """Return the bytes of the file that hold the image, if the table of rows does not determine them."""
        return ()

    @staticmethod
    @abstractmethod
    def read(refs: "Sequence[ImageRef]", lost: Damage) -> "Iterator[tuple[ImageRef, Image.Image]]":
        """Yield each reference with its image as RGB; damaged images go to ``lost`` instead.

        ``refs`` are in ascending order, all of one class and with one container. ValueError or OSError if that cannot
        be opened.
        """


@dataclass(frozen=True, slots=True, order=True)
class File(ImageRef):
    """An image file."""

    def __str__(self) -> str:
        return self.path

    @staticmethod
    def read(refs: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        return _each(refs, lambda ref: decode(ref.path), lost)


@dataclass(frozen=True, slots=True, order=True)
class Frame(ImageRef):
    """Frame ``index`` (from 0) of a video."""

    index: int

    def __str__(self) -> str:
        return f"{self.path} frame {self.index}"

    def container(self) -> Hashable:
        return self.path

    @staticmethod
    def read(refs: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        path, at = refs[0].path, {ref.index: ref for ref in refs}  # type: ignore[attr-defined]
        why: dict[int, str] = {}
        for index, image in video.frames(path, list(at), lost=why):
            yield at[index], Image.fromarray(image)
        lost.update({at[index]: f"{path}: frame {index} {reason}" for index, reason in why.items()})


@dataclass(frozen=True, slots=True, order=True)
class TarMember(ImageRef):
    """An image file inside an uncompressed tar: ``size`` bytes from ``offset``."""

    offset: int
    size: int

    def __str__(self) -> str:
        return f"{self.path} byte {self.offset}"

    def within(self) -> tuple[int, ...]:
        return self.offset, self.size

    @staticmethod
    def read(refs: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        def image(ref: Any) -> Image.Image:
            with open(ref.path, "rb") as file:
                file.seek(ref.offset)
                return decode(io.BytesIO(file.read(ref.size)), str(ref))

        return _each(refs, image, lost)


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

    @staticmethod
    def read(refs: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        first: ParquetCell = refs[0]  # type: ignore[assignment]
        try:
            values = pq.ParquetFile(first.path).read_row_group(first.group, columns=[first.column]).column(0)
        except (pa.ArrowException, OSError) as error:
            raise ValueError(f"{first.path} cannot be read ({brief(error)})") from None

        def image(ref: Any) -> Image.Image:
            value = values[ref.row].as_py()
            if isinstance(value, dict):
                folder = Path(first.path).resolve().parent
                beside = (
                    folder / (value.get("path") or "")
                ).resolve()  # of other folders, a stranger's table shows nothing
                inside = beside.is_relative_to(folder) and beside.is_file()
                value = value.get("bytes") or (beside.read_bytes() if inside else None)
            if not value:
                raise ValueError(f"{ref} holds no image")
            return decode(io.BytesIO(value), str(ref))

        yield from _each(refs, image, lost)


CHUNK_BYTES = 64 << 20
"""Cache for chunks of an HDF5 dataset. h5py's 1 MB is less than a chunk of several images, which each image would read."""


@contextmanager
def open_hdf5(path: str | Path) -> Iterator[Any]:
    """Open an HDF5 file (h5py.File) for reading; ValueError if it, or something in it, is damaged."""
    import h5py

    try:
        with h5py.File(path, rdcc_nbytes=CHUNK_BYTES) as file:
            yield file
    except (OSError, KeyError, RuntimeError, TypeError, UnicodeDecodeError) as error:  # h5py raises these
        raise ValueError(
            f"{path} cannot be read as HDF5 ({brief(error)}): is it complete, and closed by the program that wrote it?"
        ) from None


@dataclass(frozen=True, slots=True, order=True)
class Hdf5Row(ImageRef):
    """Row ``index`` (from 0) of a ``dataset`` of an HDF5 file: uint8 [rows, height, width, 1 or 3]."""

    dataset: str
    index: int

    def __str__(self) -> str:
        return f"{self.path} {self.dataset} row {self.index}"

    def container(self) -> Hashable:
        return (self.path, self.dataset)

    @staticmethod
    def read(refs: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
        first: Hdf5Row = refs[0]  # type: ignore[assignment]
        with open_hdf5(first.path) as file:
            images = file[first.dataset]

            def image(ref: Any) -> Image.Image:
                try:
                    pixels = images[ref.index]
                except (OSError, RuntimeError, IndexError) as error:
                    raise ValueError(f"{ref} cannot be read ({brief(error)})") from None
                return Image.fromarray(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels).convert("RGB")

            yield from _each(refs, image, lost)


def _each(
    refs: Sequence[ImageRef], image: Callable[[Any], Image.Image], lost: Damage
) -> Iterator[tuple[ImageRef, Image.Image]]:
    """Yield each reference with its ``image``; damaged ones are put in ``lost``."""
    for ref in refs:
        try:
            found = image(ref)
        except (ValueError, OSError) as error:
            lost[ref] = str(error)
        else:
            yield ref, found


def read_all(refs: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
    """Yield each distinct reference, all of one container, with its image (RGB); damaged ones are put in ``lost``."""
    distinct = sorted(set(refs))  # type: ignore[type-var]
    if distinct:
        yield from type(distinct[0]).read(distinct, lost)


@functools.lru_cache(maxsize=64)
def mean_image(refs: tuple[ImageRef, ...]) -> np.ndarray:
    """Return the mean of images of one size, uint8 [H, W, 3]: the sensor's background."""
    total, num = None, 0
    for ref in refs:
        lost: Damage = {}
        for _, read in read_all([ref], lost):
            image = np.asarray(read)
            if total is not None and image.shape != total.shape:
                raise ValueError(f"{ref} is {image.shape[1]} x {image.shape[0]}: backgrounds must be of one size")
            total = image.astype(np.float64) if total is None else total + image
            num += 1
        if lost:
            raise ValueError(lost[ref])
    assert total is not None
    return np.rint(total / num).astype(np.uint8)
