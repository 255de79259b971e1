"""``--data touch-and-go``: Touch and Go (Yang et al., NeurIPS 2022), read as published.

    <root>/dataset/<rec>/video.mp4              camera, 640 x 480
                         gelsight.mp4           touch; frame i pairs with frame i of the camera, from 0
                         video_frame/<10 digits>.jpg   gelsight_frame/<10 digits>.jpg    as extracted by the owners' script

Images are read from the two videos or from extracted JPEGs. The lists are in the owners' repository (see ``lists.py``).
One pack has all three tasks; a frame that is not in a task's lists has label -1.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from mvitac.data import video
from mvitac.data.images import decode, shrink
from mvitac.data.source import Lost, Sample, Source, Stamp, one_stamp, stamp_of
from mvitac.data.spec import MODALITIES, DataSpec, Task, listed
from mvitac.datasets.base import KEEPING, DatasetConfig
from mvitac.datasets.touch_and_go import lists
from mvitac.datasets.touch_and_go.lists import Frame
from mvitac.registry import check_range, to_json
from mvitac.system.files import digest, digest_file

VERSION = 1  # version of this reader. Increase it when the same files would give another pack.
HOMEPAGE = "https://touch-and-go.github.io"
STEMS = {"vision": "video", "touch": "gelsight"}
CHUNK = 256  # frames of one recording that a worker holds at a time (100 MB of pairs at 256 px)


@dataclass(frozen=True, kw_only=True)
class TouchAndGoConfig(DatasetConfig):
    """Touch and Go: a person touches objects with a GelSight, filmed by a camera. Labels are 20 materials, hard/soft and
    rough/smooth. Download the recordings from touch-and-go.github.io and the four list files from the owners' repository.
    To pack everything:

    mvitac data pack --data touch-and-go --root DOWNLOAD --lists LISTS --out packs/tag
    """

    name: ClassVar[str] = "touch-and-go"
    phased: ClassVar[bool | None] = False

    root: Path = Path("touch_and_go")
    """Folder of the download: with dataset/<recording>/ in it, or with the recordings themselves."""
    lists: Path | None = None
    """Folder with train.txt, test.txt, train_rough.txt and test_rough.txt; default: root."""
    split: Literal["by-recording", "official"] = "by-recording"
    """by-recording: each recording is in one split, so scores are for unseen places. official: the owners' lists, as in
    the paper; 100 of their 106 test recordings are also in train, which results note."""
    modalities: Literal["both", "vision", "touch"] = "both"
    """Which images to pack, e.g. touch if only the GelSight videos were downloaded."""
    partial: bool = False
    """Pack the available recordings and list the missing ones, instead of stopping."""
    test_share: float = 0.25
    """Fraction of recordings in the test split (by-recording)."""
    val_share: float | None = None
    """Fraction of recordings in the validation split, taken from train; default: 0.15 (by-recording) or 0 (official,
    where the probe sets aside a fifth of train's recordings)."""
    split_seed: int = 0
    """Random seed for assigning recordings to splits."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, 0, math.inf, "split_seed")
        if not 0 < self.test_share < 1:
            raise ValueError(f"test_share {self.test_share}: give a share of the recordings in (0, 1)")
        if not 0 <= self.val_part < 1:
            raise ValueError(f"val_share {self.val_share}: give a share of the recordings in [0, 1)")
        if self.split == "by-recording" and self.test_share + self.val_part >= 1:
            raise ValueError(f"test_share {self.test_share} and val_share {self.val_part} leave nothing to train on")

    @property
    def val_part(self) -> float:
        return self.val_share if self.val_share is not None else 0.15 if self.split == "by-recording" else 0.0

    def source(self) -> Source:
        return TouchAndGo(self)


class TouchAndGo(Source):
    """One item is up to ``CHUNK`` frames of one recording, ascending, read in one forward pass of each video."""

    def __init__(self, config: TouchAndGoConfig) -> None:
        self._config, self._lists = config, config.lists or config.root
        if not self._lists.is_dir():
            raise ValueError(f"{self._lists} is not a folder: give the one with the lists; get them from {lists.AT}")
        listed = lists.read_lists(self._lists)
        names = sorted({frame.recording for frame in listed})
        modalities = MODALITIES if config.modalities == "both" else (config.modalities,)
        found, missing = find_recordings(config.root, names, modalities)
        lacking = missing_report(missing, len(names)) if missing else ""
        if not found or (missing and not config.partial):
            hint = "; modalities=touch needs only gelsight" * (config.modalities == "both")
            raise ValueError(f"{config.root}: {lacking}; fetch them from {HOMEPAGE}, or give partial{hint}")
        listed = [frame for frame in listed if frame.recording not in missing]
        lists.find_touches(listed)
        if config.split == "official":
            lists.assign_official(listed, config.val_part, config.split_seed)
        else:
            lists.assign_by_recording(listed, config.test_share, config.val_part, config.split_seed)
        self._recordings = found
        self._chunks: list[list[Frame]] = []
        for _, own in itertools.groupby(listed, key=lambda frame: frame.recording):
            recording = list(own)
            self._chunks += [recording[i : i + CHUNK] for i in range(0, len(recording), CHUNK)]
        self._stamps = [one_stamp(stamps(found[chunk[0].recording], chunk)) for chunk in self._chunks]
        notes = [*(lists.leaks(listed) if config.split == "official" else ()), *[lacking] * bool(missing)]
        # A part of the recordings may have no frame of the rough lists.
        self._spec = _spec(config, any(frame.rough >= 0 for frame in listed), tuple(notes), bool(missing))
        self._fingerprint = {
            "reader": f"touch-and-go {VERSION}",
            "lists": {name: digest_file(self._lists / name) for name in sorted(lists.LIST_FILES)},
            "options": {k: v for k, v in to_json(config).items() if k not in ("root", "lists", *KEEPING)},
            "recordings": digest([[name, *(p.name for p in places.values())] for name, places in found.items()]),
            "missing": dict(sorted(missing.items())),
        }

    def spec(self) -> DataSpec:
        return self._spec

    def items(self) -> list[str]:
        return [f"{c[0].recording} frames {c[0].number} to {c[-1].number}" for c in self._chunks]

    def samples_per_item(self) -> list[int]:
        return [len(chunk) for chunk in self._chunks]

    def fingerprint(self) -> dict[str, Any]:
        return self._fingerprint

    def stamps(self) -> list[int]:
        return self._stamps

    def read(self, item: int) -> list[Sample | Lost]:
        chunk, lost = self._chunks[item], {}
        numbers, places = [frame.number for frame in chunk], self._recordings[chunk[0].recording]
        images = {m: read_frames(at, numbers, self._config.size, lost) for m, at in places.items()}
        samples: list[Sample | Lost] = []
        for frame in chunk:
            if frame.number in lost:
                samples.append(Lost(f"{frame.recording}/{frame.number:010d}", lost[frame.number]))
            else:
                vision, touch = (images[m][frame.number] if m in images else None for m in MODALITIES)
                samples.append(Sample(vision=vision, touch=touch, columns=_columns(frame, self._spec)))
        return samples


def _columns(frame: Frame, spec: DataSpec) -> dict[str, Any]:
    group, number = frame.recording, frame.number
    known = {"id": f"{group}/{number:010d}", "group": group, "touch_group": f"{group}/{frame.touch:010d}"}
    soft = -1 if frame.category < 0 else int(frame.category in lists.SOFT)
    columns = {**known, "split": frame.split, "frame": number, "label_category": frame.category, "label_soft": soft}
    for task in spec.tasks[2:]:
        columns |= {"label_rough": frame.rough, **({task.split: frame.split_rough} if task.split != "split" else {})}
    return columns


def _spec(config: TouchAndGoConfig, rough: bool, notes: tuple[str, ...], missing: bool) -> DataSpec:
    # The rough/smooth lists have another split than the category lists.
    own = "split_rough" if config.split == "official" else "split"
    tasks = [Task(name="category", classes=lists.CLASSES), Task(name="soft", classes=("hard", "soft"))]
    tasks += [Task(name="rough", classes=("smooth", "rough"), split=own)] * rough
    return DataSpec(
        name=f"touch-and-go ({config.split}{', partial' if missing else ''})",
        vision_channels=3 * (config.modalities != "touch"),
        touch_channels=3 * (config.modalities != "vision"),
        tasks=tuple(tasks),
        group_by="recording",
        licence="CC BY 4.0 (says its homepage)",
        source=f"Touch and Go, Yang et al., NeurIPS 2022, {HOMEPAGE}",
        notes=notes,
    )


Places = dict[str, Path]
"""Modality -> mp4 file or folder of JPEGs of one recording."""


def stamps(places: Places, frames: Sequence[Frame]) -> Iterator[Stamp]:
    for place in places.values():
        files = [str(place)] if place.suffix else [f"{place}/{frame.number:010d}.jpg" for frame in frames]
        yield from map(stamp_of, files)


def find_recordings(
    root: Path, names: Iterable[str], modalities: Sequence[str]
) -> tuple[dict[str, Places], dict[str, str]]:
    """Return the places of recordings in ``names`` with all ``modalities``, and why each of the others cannot be used."""
    base = root / "dataset" if (root / "dataset").is_dir() else root
    if not base.is_dir():
        raise ValueError(f"{base} is not a folder: give the download as --data.root; get it from {HOMEPAGE}")
    # Some mirrors append the material, as in 20220319_002026_rock.
    folders = {path.name[:15]: path for path in sorted(base.iterdir()) if path.is_dir()}
    found, missing = {}, {}
    for name in names:
        folder = folders.get(name, base / name)
        places, lacking = {}, []
        for modality in modalities:
            movie, images = folder / f"{STEMS[modality]}.mp4", folder / f"{STEMS[modality]}_frame"
            if movie.is_file() and movie.stat().st_size:
                places[modality] = movie
            elif images.is_dir():
                places[modality] = images
            else:
                lacking.append(movie.name)
        if lacking:
            missing[name] = f"no {' and '.join(lacking)}" if folder.is_dir() else "no folder"
        else:
            found[name] = places
    return found, missing


def missing_report(missing: dict[str, str], num: int) -> str:
    """Return e.g. '3 of 126 listed recordings cannot be packed: c (no video.mp4), a (no folder), b (no folder)'."""
    named = [f"{name} ({why})" for name, why in sorted(missing.items(), key=lambda one: one[1], reverse=True)]
    return f"{len(missing)} of {num} listed recordings cannot be packed: {listed(named)}"


def read_frames(place: Path, numbers: list[int], size: int, lost: dict[int, str]) -> dict[int, np.ndarray]:
    """Return frame number -> image [size, size, 3] of one modality; ``lost`` gets the reason for each damaged frame."""
    if place.suffix:
        why: dict[int, str] = {}
        found = dict(video.frames(place, numbers, size, lost=why))
        lost.update({number: f"{place.name}: frame {number} {reason}" for number, reason in why.items()})
        return found
    found = {}
    for number in numbers:
        try:
            found[number] = shrink(decode(place / f"{number:010d}.jpg"), size)
        except (ValueError, OSError) as error:
            lost[number] = str(error)
    return found
