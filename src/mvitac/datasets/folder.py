"""``--data folder``: anybody's images, named by a manifest or laid out in class folders.

A **manifest** (.csv, .parquet or .jsonl) has one row per sample; its paths are relative to its own folder, or absolute:

    vision,touch,material,object,split
    vision/0001.jpg,touch/0001.jpg,wood,table_3,train

A path may name a **video**: column ``frame`` (or ``touch_frame``, ``vision_frame``, ...) then holds the frame's number,
counted from 0; every video is decoded once, and is one group unless a column says the groups.

**Class folders** need no manifest. Files are paired by their path below the modality's folder, without the suffix:

    <root>/vision/<class>/<name>.jpg            <root>/touch/<class>/<name>.png          every file its own group
    <root>/vision/<class>/<group>/<name>.jpg    ...                                      or grouped by a folder
    <root>/train/vision/<class>/...             <root>/test/vision/<class>/...           or split by a folder above
    <root>/left/<class>/...                     <root>/right/<class>/...                 two sensors instead of touch
    <root>/<class>/<name>.jpg                   one modality (see ``pictures``)

They read as the manifest that they amount to, with columns vision, touch (or left, right), label, group and, where the
folders split, split. Everything that can be wrong with a manifest is said before the first image is decoded; rows are
counted from 1, the header not counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from mvitac.datasets.table.manifest import Manifest, find_manifest, list_class_folders, read_manifest
from mvitac.datasets.table.table import RowsConfig


@dataclass(frozen=True, kw_only=True)
class FolderConfig(RowsConfig):
    """An image folder, or a manifest naming vision path, touch path, labels, group and split."""

    name: ClassVar[str] = "folder"

    path: Path = Path("data")
    """A manifest (.csv, .parquet, .jsonl), a folder with a manifest.* in it, or a folder of class folders."""
    pictures: Literal["touch", "vision"] = "touch"
    """What plain class folders (<root>/<class>/*.jpg) show."""

    def manifest(self) -> Manifest:
        file = find_manifest(self.path)
        if file:
            return read_manifest(file)
        return list_class_folders(self.path, pictures=self.pictures, allow_missing=self.allow_missing)
