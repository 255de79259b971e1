"""Several packs as one: other datasets, sensors, image sizes and missing modalities. Images are not copied."""

import copy
import functools
import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from mvitac.data.lazy import Pieces
from mvitac.data.mixed_table import MixedTasks, mixed_spec, mixed_table, renamed_columns
from mvitac.data.pack import Images, Pack
from mvitac.data.row_hashes import image_sums, known_images, number_hint, row_hashes
from mvitac.data.spec import MODALITIES
from mvitac.system.files import digest


class MixedPack(Pack):
    """The rows of all ``parts``, one part after another.

    A row has the split, labels, values and groups that it has in its part (``mixed_table``). A part without a modality has
    no image of it.

    Attributes:
        weights: How often each part is drawn in training, relative to the others; () = by its number of rows.
        temperature: Without weights, parts are drawn in proportion to (number of rows)^temperature.
        one_part: Whether all rows of a batch are of one part.

    Args:
        parts: Name -> pack, at least two.
        size: Side of the images in pixels; images of another side are resized when they are read. 0: the largest side.
        allow_leak: Accept groups, rows and images that one part has in train and another in test.

    Raises:
        ValueError: If a part has no rows to train on, the parts differ in channels or in what touch images show, or are
            the same data, or train of one part and test of another share groups, rows or images.

    Examples:
        >>> pack = MixedPack({"tag": Pack("packs/tag"), "mine": Pack("packs/mine")})  # doctest: +SKIP
        >>> pack.column("part")[pack.rows("train")]  # doctest: +SKIP
    """

    weights: tuple[float, ...] = ()
    temperature: float = 1.0
    one_part: bool = False

    def __init__(self, parts: Mapping[str, Pack], *, size: int = 0, allow_leak: bool = False) -> None:
        self.parts = dict(parts)
        packs = list(self.parts.values())
        channels = _check(self.parts)
        self.path, self.meta, self.store = Path(" + ".join(str(pack.path) for pack in packs)), {}, "raw"
        self.num, self.size = sum(pack.num for pack in packs), size or max(pack.size for pack in packs)
        self.digests = {name: pack.digest for name, pack in self.parts.items()} | {"size": digest(self.size)}
        columns = renamed_columns(self.parts)
        tasks = MixedTasks(self.parts, columns)
        self.table: pa.Table = mixed_table(self.parts, columns, tasks)
        notes = [
            f"{name}: images of {pack.size} px are resized to {self.size} px when they are read"
            for name, pack in self.parts.items()
            if pack.size != self.size
        ]
        if found := _shared(self.parts):
            if not allow_leak:
                raise ValueError(f"{found}: pack them with splits that agree, leave a part out, or give allow_leak")
            notes.append(found)
        self.spec = mixed_spec(self.parts, tasks, channels, notes)
        starts = np.cumsum([0, *(pack.num for pack in packs)])
        pieces = {m: [pack.images.get(m) for pack in packs].__getitem__ for m in self.spec.modalities}
        self.images: dict[str, Images] = {m: Pieces(self._shape(m, self.num), starts, pieces[m]) for m in pieces}

    def has(self, modality: str) -> np.ndarray:
        return self._has[modality]

    @functools.cached_property
    def _has(self) -> dict[str, np.ndarray]:
        return {modality: self.column(f"has_{modality}") for modality in self.spec.modalities}

    @functools.cached_property
    def whole(self) -> np.ndarray:
        return np.concatenate([pack.whole for pack in self.parts.values()])

    @functools.cached_property
    def hidden(self) -> np.ndarray:
        return np.concatenate([pack.hidden for pack in self.parts.values()])

    @functools.cached_property
    def phased(self) -> bool:
        return any(pack.phased for pack in self.parts.values())

    @property
    def own_ids(self) -> np.ndarray:
        return np.concatenate([pack.own_ids for pack in self.parts.values()])

    @functools.cached_property
    def part_of(self) -> np.ndarray:
        """int64 [N], number of each row's part."""
        return np.repeat(np.arange(len(self.parts)), [pack.num for pack in self.parts.values()])

    def shares(self, rows: np.ndarray) -> np.ndarray:
        """Share [parts] of each part in the rows that training draws from ``rows``."""
        sizes = np.bincount(self.part_of[rows], minlength=len(self.parts))
        drawn = np.array(self.weights) if self.weights else sizes**self.temperature * (sizes > 0)
        return drawn / drawn.sum()

    @property
    def weighted(self) -> bool:
        """Whether training draws from the parts otherwise than from one pack of all rows."""
        return bool(self.weights) or self.temperature != 1 or self.one_part

    def alone(self, part: str) -> Pack:
        """This pack with the rows of all other parts hidden, and the modalities of ``part``."""
        made, own = copy.copy(self), self.parts[part].spec
        made.__dict__.pop("_answers", None)  # labels by split, of all parts
        inside = self.part_of == list(self.parts).index(part)
        splits = pa.array(np.where(inside, self.column("split").astype(str), "hidden"))
        made.table = self.table.set_column(self.table.schema.get_field_index("split"), "split", splits)
        lacking = {f"{m}_channels": 0 for m in self.spec.modalities if m not in own.modalities}
        made.spec = replace(self.spec, **lacking)
        return made


def _check(parts: Mapping[str, Pack]) -> dict[str, int]:
    """Check that the parts fit together; return the channels of each modality."""
    digests: dict[str, str] = {}
    for name, pack in parts.items():
        if twin := digests.get(pack.digest):
            raise ValueError(f"parts {twin} and {name} are the same data: give each pack once, with a weight")
        digests[pack.digest] = name
        if not len(pack.rows("train", "unlabelled")):
            raise ValueError(
                f"part {name} ({pack.path}) has no rows in split train or unlabelled: leave it out, and score it with"
                " `mvitac probe --on`"
            )
    channels = {}
    for modality in MODALITIES:
        given = {name: num for name, pack in parts.items() if (num := pack.spec.channels(modality))}
        if len(set(given.values())) > 1:
            counts = ", ".join(f"{num} in {name}" for name, num in given.items())
            raise ValueError(f"{modality} channels differ: {counts}; pack them with the same number of sensors")
        channels[modality] = next(iter(given.values()), 0)
    minus = {name: pack.spec.difference for name, pack in parts.items() if pack.spec.touch_channels}
    if len(set(minus.values())) > 1:
        with_, without = (next(name for name, given in minus.items() if given == wanted) for wanted in (True, False))
        raise ValueError(
            f"touch is stored minus its background in {with_} and as it is in {without}: pack both alike"
            " (--subtract-background)"
        )
    return channels


def _shared(parts: Mapping[str, Pack]) -> str:
    """Say what train (or val) of one part and test of another have in common; "" if nothing."""
    learn = {name: pack.rows("train", "val", "unlabelled") for name, pack in parts.items()}
    tests = {name: [p.column(c) == "test" for c in p.spec.split_columns] for name, p in parts.items()}
    for (a, one), (b, other) in itertools.permutations(parts.items(), 2):
        learned, scored = learn[a], np.flatnonzero(np.any(tests[b], axis=0))
        hashes = list(zip(("id", "group"), row_hashes(one), row_hashes(other), strict=True))
        for column, ours, theirs in hashes[::-1]:
            both = scored[np.isin(theirs[scored], ours[learned])]
            if len(both):
                what, num = other.column(column)[both[0]], len(np.unique(theirs[both]))
                by = other.spec.group_by if column == "group" else "row"
                hint = number_hint(one.spec.name, other) if column == "id" else ""
                return f"{by} {str(what)!r} is in train of part {a} and in test of part {b}, one of {num}{hint}"
        same = known_images(other, scored, image_sums(one)[learned])
        for rows, modality in zip(same.T, MODALITIES, strict=True):
            if rows.any():
                row = f"{other.column('id')[scored[rows][0]]!r} ({other.column('group')[scored[rows][0]]})"
                return f"the {modality} image of row {row} in test of part {b} is in train of part {a}, one of {rows.sum()}"
    return ""
