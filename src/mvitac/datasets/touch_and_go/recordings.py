"""Touch and Go's recordings on disk: find them, report what is missing, read frames.

Each modality of a recording is an mp4 file or a folder of JPEGs named by frame number (the layout is in ``reader.py``).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvitac.data.images import decode, shrink
from mvitac.data.source import Stamp, stamp_of
from mvitac.data.spec import listed
from mvitac.data.video import frames

HOMEPAGE = "https://touch-and-go.github.io"
STEMS = {"vision": "video", "touch": "gelsight"}


@dataclass(frozen=True)
class Recording:
    """A recording; ``places`` maps each modality to an mp4 file or a folder of JPEGs."""

    name: str
    places: dict[str, Path]

    def stamps(self, numbers: Sequence[int]) -> Iterator[Stamp]:
        """Yield the stamps of the files with frames ``numbers``."""
        for place in self.places.values():
            files = [str(place)] if place.suffix else [f"{place}/{number:010d}.jpg" for number in numbers]
            yield from map(stamp_of, files)


def find_recordings(
    root: Path, names: Iterable[str], modalities: Sequence[str]
) -> tuple[list[Recording], dict[str, str]]:
    """Return the recordings in ``names`` with all ``modalities``, and why each of the others cannot be used."""
    base = root / "dataset" if (root / "dataset").is_dir() else root
    if not base.is_dir():
        raise ValueError(f"{base} is not a folder: give the download as --data.root; get it from {HOMEPAGE}")
    # Some mirrors append the material, as in 20220319_002026_rock.
    folders = {path.name[:15]: path for path in sorted(base.iterdir()) if path.is_dir()}
    found, missing = [], {}
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
            found.append(Recording(name, places))
    return found, missing


def missing_report(missing: dict[str, str], num: int) -> str:
    """Return e.g. '3 of 126 listed recordings cannot be packed: c (no video.mp4), a (no folder), b (no folder)'."""
    named = [f"{name} ({why})" for name, why in sorted(missing.items(), key=lambda one: one[1], reverse=True)]
    return f"{len(missing)} of {num} listed recordings cannot be packed: {listed(named)}"


def read_frames(place: Path, numbers: list[int], size: int, lost: dict[int, str]) -> dict[int, np.ndarray]:
    """Return frame number -> image [size, size, 3] of one modality.

    Frames that cannot be read are put in ``lost`` with the reason.
    """
    if place.suffix:
        why: dict[int, str] = {}
        found = dict(frames(place, numbers, size, lost=why))
        lost.update({number: f"{place.name}: frame {reason}" for number, reason in why.items()})
        return found
    found = {}
    for number in numbers:
        try:
            found[number] = shrink(decode(place / f"{number:010d}.jpg"), size)
        except (ValueError, OSError) as error:
            lost[number] = str(error)
    return found
