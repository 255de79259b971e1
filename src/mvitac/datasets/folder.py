"""``--data folder``: your own images, in a table, parquet, HDF5 or zarr files, videos or folders (docs/datasets.md).

A **manifest** (.csv, .parquet or .jsonl) has one row per sample; its paths are relative to its own folder, or absolute.
A path may be a **video**; column ``frame`` (or ``touch_frame``, ``vision_frame``, ...) then holds the frame number, from 0.
Without a table, files are paired by their path inside the modality's folder, without the suffix:

    <root>/vision/<class>/<name>.jpg            <root>/touch/<class>/<name>.png          each file is its own group
    <root>/vision/<class>/<group>/<name>.jpg    ...                                      grouped by folder
    <root>/train/vision/<class>/...             <root>/test/vision/<class>/...           split by folder
    <root>/<class>/<name>.jpg                   one modality (see ``pictures``)

The cameras of a **recording** are paired by time; both layouts are in docs/datasets.md.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from mvitac.data.video import VIDEOS
from mvitac.datasets.table.arrays import read_arrays
from mvitac.datasets.table.folders import list_images, list_videos, to_train
from mvitac.datasets.table.image_refs import ARRAYS
from mvitac.datasets.table.manifest import READERS, Manifest, read_manifest
from mvitac.datasets.table.parquet import read_parquet
from mvitac.datasets.table.table import RecordedConfig
from mvitac.system.files import walk


@dataclass(frozen=True, kw_only=True)
class FolderConfig(RecordedConfig):
    """A folder of images, a manifest with vision path, touch path, labels, group and split, or HDF5 files."""

    name: ClassVar[str] = "folder"

    path: Path = Path("data")
    """A manifest (.csv, .parquet, .jsonl), a parquet file with images, an HDF5 or zarr file, a video; or a folder with
    manifest.*, of files of these kinds, of class folders or of images."""
    pictures: Literal["touch", "vision"] = "touch"
    """Modality of images and videos that nothing names (<root>/<class>/*.jpg, <root>/*.mp4)."""

    def manifest(self) -> Manifest:
        if not self.path.exists():
            raise ValueError(f"{self.path} does not exist: give a manifest, an HDF5 file or a folder as --data.path")
        alone = not self.path.is_dir() or self.path.name.lower().endswith(ARRAYS)
        files = [self.path] if alone else sorted(self.path.iterdir())
        tables = [f for f in files if f.suffix.lower() in READERS and (f == self.path or f.stem == "manifest")]
        if len(tables) > 1:
            raise ValueError(f"{self.path} holds {' and '.join(f.name for f in tables)}: give the path of one of them")
        parquet = tables if tables or alone else sorted(walk(self.path))
        parquet = [file for file in parquet if file.suffix.lower() == ".parquet"]
        shown = read_parquet(self.path, parquet, self.vectors()) if parquet else None
        arrays = [file for file in files if file.name.lower().endswith(ARRAYS)]
        if (self.every or 1) > 1 and (listed := parquet * bool(shown) or tables or arrays):
            raise ValueError(f"{listed[0]}: --data.every is not for tables, HDF5 and zarr, whose rows are all used")
        if shown:
            return shown
        if tables:
            return read_manifest(tables[0])
        if arrays:
            images = [name for name in (self.vision, *self.touch, *self.background) if name]
            return read_arrays(self.path, arrays, images, self.vectors())
        cameras = [name for name in (*self.touch, self.vision) if name]
        found = list_videos(self.path, cameras, self.pictures, self.every, self.tolerance)
        if not found and not self.path.is_dir():
            raise ValueError(f"{self.path} is no table: its name must end in {', '.join((*READERS, *ARRAYS, *VIDEOS))}")
        found = found or list_images(self.path, self.pictures, self.every)
        return found if self.labels or self.values else to_train(found)
