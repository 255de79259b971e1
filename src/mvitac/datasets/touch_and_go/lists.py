"""Touch and Go's list files: the labels of frames, the touches they form, and the splits of recordings.

train.txt  test.txt               category of 20          rows "<rec>/<10 digits>.jpg,<label>", -1 = inconclusive
train_rough.txt  test_rough.txt   1 rough, 0 smooth
"""

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvitac.datasets.table.splits import stratify

CLASSES = (
    *("concrete", "plastic", "glass", "wood", "metal", "brick", "tile", "leather", "synthetic fabric"),
    *("natural fabric", "rubber", "paper", "tree", "grass", "soil", "rock", "gravel", "sand", "plants", "others"),
)
SOFT = (7, 8, 9, 11, 13)  # categories that the owners call soft; the others are hard
AT = "https://github.com/fredfyyang/Touch-and-Go, folder 'Visuo-tactile contrastive learning/dataset'"
LIST_FILES = ("train.txt", "test.txt", "train_rough.txt", "test_rough.txt")
ROW = re.compile(r"^[ \t]*([^/,\s]+)/(\d{10})\.jpg,(-?\d{1,9})[ \t]*$", re.MULTILINE)


@dataclass(slots=True)
class Frame:
    """One pair, its labels and its split."""

    recording: str
    number: int
    category: int = -1
    rough: int = -1
    listed: str = ""  # train or test: the category list that it is in
    listed_rough: str = ""
    split: str = "unlabelled"
    split_rough: str = "unlabelled"
    touch: int = 0  # number of the first frame of its run


def read_list(file: Path, num_classes: int) -> list[tuple[str, int, int]]:
    """Return (recording, frame, label) per row, -1 = inconclusive; ValueError names an invalid line."""
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{file} is not text: give the owners' list file") from None
    found = ROW.findall(text)
    if len(found) < len(lines := [line for line in text.splitlines() if line.strip()]):
        number, line = next((n, line) for n, line in enumerate(lines, 1) if not ROW.fullmatch(line))
        raise ValueError(f"{file} line {number} is {line[:60]!r}: expected <recording>/<10 digits>.jpg,<label>")
    if not found:
        raise ValueError(f"{file} is empty: fetch it again")
    rows = [(recording, int(frame), int(label)) for recording, frame, label in found]
    for number, (_, _, label) in enumerate(rows, 1):
        if not -1 <= label < num_classes:
            raise ValueError(f"{file} line {number}: label {label} is not in -1 to {num_classes - 1}")
    return rows


def read_lists(folder: Path) -> list[Frame]:
    """Return every labelled frame in the lists of ``folder``, sorted by recording and number."""
    known: dict[tuple[str, int], Frame] = {}
    for name in LIST_FILES:
        if not (folder / name).is_file():
            raise ValueError(f"{folder} has no {name}: the lists are in {AT} (--data.lists)")
        split, rough = name.split(".")[0].removesuffix("_rough"), "rough" in name
        for recording, number, label in read_list(folder / name, 2 if rough else len(CLASSES)):
            frame = known.setdefault((recording, number), Frame(recording, number))
            if frame.listed_rough if rough else frame.listed:
                where = f"{folder / name}: {recording}/{number:010d}.jpg"
                raise ValueError(f"{where} is listed twice: fetch the lists again")
            if rough:
                frame.listed_rough, frame.rough = split, label
            else:
                frame.listed, frame.category = split, label
    labelled = [frame for frame in known.values() if frame.category >= 0 or frame.rough >= 0]
    return sorted(labelled, key=lambda frame: (frame.recording, frame.number))


def find_touches(listed: Sequence[Frame]) -> None:
    """Set ``touch`` of each frame: the first frame of its run of consecutive frames of one recording and category."""
    last = Frame("", -2)
    for frame in listed:
        other = frame.category != last.category and min(frame.category, last.category) >= 0
        goes_on = frame.recording == last.recording and frame.number == last.number + 1 and not other
        frame.touch = last.touch if goes_on else frame.number
        last = frame


def leaks(listed: Iterable[Frame]) -> list[str]:
    """Return notes on what train and test of the owners' lists share."""
    by_side: dict[str, set[str]] = defaultdict(set)
    rough_test = seen = 0
    for frame in listed:
        by_side[frame.listed].add(frame.recording)
        rough_test += frame.listed_rough == "test"
        seen += frame.listed_rough == "test" and frame.listed == "train"
    shared, test = len(by_side["train"] & by_side["test"]), len(by_side["test"])
    notes = [f"official split: {shared} of {test} test recordings are also in train (other touches)"] if shared else []
    if seen:
        notes.append(f"official split: {seen} of {rough_test} rough/smooth test frames are in the pre-training list")
    return notes


def by_recording(listed: Sequence[Frame], shares: tuple[float, ...], seed: int) -> dict[str, int]:
    """Return the split number of each recording, stratified by category and rough/smooth together."""
    names = sorted({frame.recording for frame in listed})
    place = {name: i for i, name in enumerate(names)}
    counts = np.zeros((len(names), len(CLASSES) + 2), np.int64)
    for frame in listed:
        if frame.category >= 0:
            counts[place[frame.recording], frame.category] += 1
        if frame.rough >= 0:
            counts[place[frame.recording], len(CLASSES) + frame.rough] += 1
    return dict(zip(names, stratify(counts, shares, seed).tolist(), strict=True))


def assign_by_recording(listed: Sequence[Frame], test_share: float, val_share: float, seed: int) -> None:
    splits = by_recording(listed, (1 - test_share - val_share, val_share, test_share), seed)
    for frame in listed:
        frame.split = frame.split_rough = ("train", "val", "test")[splits[frame.recording]]


def assign_official(listed: Sequence[Frame], val_share: float, seed: int) -> None:
    """Set the split of each frame to that of the owners' lists, with ``val_share`` of train's recordings in val."""
    learnt = [frame for frame in listed if "train" in (frame.listed, frame.listed_rough)]
    held = by_recording(learnt, (1 - val_share, val_share), seed) if val_share else {}
    for frame in listed:
        learn = "val" if held.get(frame.recording) else "train"
        # Frames that only the rough lists name are not in the owners' pre-training, so they are "test" here.
        frame.split = learn if frame.listed == "train" else "test"
        frame.split_rough = learn if frame.listed_rough == "train" else "test"
