"""References to images: a file, a frame of a video, a member of a tar, a cell of a parquet table, a row of an HDF5 dataset.

References with the same container (a video, a row group) are read together in one pass. Another format is one more
class here: its ``container``, how it is ``opened``, and one ``image`` of it.
"""

import io
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
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


@dataclass(frozen=True, slots=True, order=True)
class ImageRef:
    """One image of a dataset, here a file of its own; sorted and hashed by its location."""

    path: str

    def __str__(self) -> str:
        return self.path

    def container(self) -> Hashable | None:
        """Return what is opened once to read many images from it; None if the image is read by itself."""
        return None

    def within(self) -> tuple[int, ...]:
        """Return the bytes of the file that hold the image, if the table of rows does not determine them."""
        return ()

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Open the container; ValueError or OSError if that fails."""
        yield None

    def image(self, container: Any) -> Image.Image:
        """Read the image from the opened container as RGB; ValueError or OSError if it is damaged."""
        return decode(self.path)

    @staticmethod
    def read(refs: "Sequence[ImageRef]", lost: Damage) -> "Iterator[tuple[ImageRef, Image.Image]]":
        """Yield the references, ascending and of one container, with their images; damaged ones go to ``lost`` instead."""
        with refs[0].opened() as container:
            for ref in refs:
                try:
                    found = ref.image(container)
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
class TarMember(ImageRef):
    """An image file inside an uncompressed tar: ``size`` bytes from ``offset``."""

    offset: int
    size: int

    def __str__(self) -> str:
        return f"{self.path} byte {self.offset}"

    def within(self) -> tuple[int, ...]:
        return self.offset, self.size

    def image(self, container: Any) -> Image.Image:
        with open(self.path, "rb") as file:
            file.seek(self.offset)
            return decode(io.BytesIO(file.read(self.size)), str(self))


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
            values = pq.ParquetFile(self.path).read_row_group(self.group, columns=[self.column]).column(0)
        except (pa.ArrowException, OSError) as error:
            raise ValueError(f"{self.path} cannot be read ({brief(error)})") from None
        yield values

    def image(self, container: pa.ChunkedArray) -> Image.Image:
        value = container[self.row].as_py()
        if isinstance(value, dict):
            folder = Path(self.path).resolve().parent
            beside = (folder / (value.get("path") or "")).resolve()
            inside = beside.is_relative_to(folder) and beside.is_file()  # a stranger's table shows no other folders
            value = value.get("bytes") or (beside.read_bytes() if inside else None)
        if not value:
            raise ValueError(f"{self} holds no image")
        return decode(io.BytesIO(value), str(self))


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

    @contextmanager
    def opened(self) -> Iterator[Any]:
        with open_hdf5(self.path) as file:
            yield file[self.dataset]

    def image(self, container: Any) -> Image.Image:
        try:
            pixels = container[self.index]
        except (OSError, RuntimeError, IndexError) as error:
            raise ValueError(f"{self} cannot be read ({brief(error)})") from None
        return Image.fromarray(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels).convert("RGB")


def read_all(refs: Sequence[ImageRef], lost: Damage) -> Iterator[tuple[ImageRef, Image.Image]]:
    """Yield each distinct reference, all of one container, with its image (RGB); damaged ones are put in ``lost``."""
    if distinct := sorted(set(refs)):
        yield from distinct[0].read(distinct, lost)


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
