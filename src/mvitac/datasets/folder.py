"""``--data folder``: your own images, listed in a manifest, stored in HDF5 files or arranged in class folders.

A **manifest** (.csv, .parquet or .jsonl) has one row per sample; its paths are relative to its own folder, or absolute:

    vision,touch,material,object,split
    vision/0001.jpg,touch/0001.jpg,wood,table_3,train

A path may be a **video**; column ``frame`` (or ``touch_frame``, ``vision_frame``, ...) then holds the frame number, from
0. Each video is decoded once, and is one group unless a column gives the groups.

**Class folders** need no manifest. Files are paired by their path inside the modality's folder, without the suffix:

    <root>/vision/<class>/<name>.jpg            <root>/touch/<class>/<name>.png          each file is its own group
    <root>/vision/<class>/<group>/<name>.jpg    ...                                      grouped by folder
    <root>/train/vision/<class>/...             <root>/test/vision/<class>/...           split by folder
    <root>/left/<class>/...                     <root>/right/<class>/...                 two sensors instead of touch
    <root>/<class>/<name>.jpg                   one modality (see ``pictures``)

An **HDF5 file** (.h5, .hdf5), or a folder of them, holds images and numbers as datasets with one row per frame
(``mvitac.datasets.table.hdf5``); ``vision`` and ``touch`` name image datasets:

    grips.h5     camera uint8 [N, H, W, 3]    gel uint8 [N, H, W, 3]    force_n [N]    pose [N, 6]    object [N]
    demos.h5     data/demo_0/obs/camera       data/demo_0/obs/gel       data/demo_0/force             one group each

Class folders are equivalent to a manifest with columns vision, touch (or left, right), label, group and, if there are
split folders, split. A manifest is checked completely before the first image is decoded. Rows are counted from 1, without
the header.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from mvitac.datasets.table.hdf5 import read_hdf5
from mvitac.datasets.table.image_refs import HDF5
from mvitac.datasets.table.manifest import READERS, Manifest, list_class_folders, read_manifest
from mvitac.datasets.table.table import RowsConfig


@dataclass(frozen=True, kw_only=True)
class FolderConfig(RowsConfig):
    """A folder of images, a manifest with vision path, touch path, labels, group and split, or HDF5 files."""

    name: ClassVar[str] = "folder"

    path: Path = Path("data")
    """A manifest (.csv, .parquet, .jsonl), a folder with a manifest.*, an HDF5 file (.h5, .hdf5) or a folder of them, or
    a folder of class folders."""
    pictures: Literal["touch", "vision"] = "touch"
    """Modality of plain class folders (<root>/<class>/*.jpg)."""

    def manifest(self) -> Manifest:
        files = sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]
        if not self.path.exists():
            raise ValueError(f"{self.path} does not exist: give a manifest, an HDF5 file or a folder as --data.path")
        tables = [f for f in files if f.suffix.lower() in READERS and (f == self.path or f.stem == "manifest")]
        if len(tables) > 1:
            raise ValueError(f"{self.path} holds {' and '.join(f.name for f in tables)}: give the path of one of them")
        if tables:
            return read_manifest(tables[0])
        if arrays := [file for file in files if file.suffix.lower() in HDF5 and file.is_file()]:
            images = [name for name in (self.vision, *self.touch, *self.background) if name]
            return read_hdf5(self.path, arrays, images, self.vectors())
        if not self.path.is_dir():
            raise ValueError(f"{self.path} is no table: its name must end in {', '.join((*READERS, *HDF5))}")
        return list_class_folders(self.path, self.pictures)
