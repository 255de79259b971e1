"""Several packs as one: the rows of one pack after another, images read where they are.

The parts that ``mixed_pack`` (training) and ``joined_pack`` (probes) share.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa

from mvitac.data.lazy import Pieces
from mvitac.data.pack import Pack
from mvitac.data.row_hashes import known_images
from mvitac.data.spec import MODALITIES, AnyTask, Task
from mvitac.registry import unknown


class Several(Pack):
    """Rows of packs one after another; a subclass sets ``path``, ``table``, ``spec``, ``size`` and ``digests``."""

    def _open(self, packs: Sequence[Pack]) -> None:
        """Show the images of ``packs``, one pack after another; spec and size are set."""
        self._packs, self.store, self.num = packs, "raw", sum(pack.num for pack in packs)
        starts = np.cumsum([0, *(pack.num for pack in packs)])
        pieces = {m: [pack.images.get(m) for pack in packs].__getitem__ for m in self.spec.modalities}
        self.images = {m: Pieces(self._shape(m, self.num), starts, piece) for m, piece in pieces.items()}

    @property
    def own_ids(self) -> np.ndarray:
        return np.concatenate([pack.own_ids for pack in self._packs])


Columns = dict[str, pa.Array | pa.ChunkedArray]


def columns_of_part(
    part: str, pack: Pack, taken: Mapping[str, str], prefixed: Mapping[str, str], tasks: Mapping[str, AnyTask]
) -> Columns:
    """The columns of one part of several.

    Args:
        part: Name of the part.
        pack: The part.
        taken: Its columns that are taken over -> their new names.
        prefixed: New columns whose cells get the prefix ``<part>/`` -> those of the part.
        tasks: Its tasks by name -> tasks of all parts, by whose classes labels are numbered.
    """
    table: Columns = {new: pack.table.column(own) for own, new in taken.items()}
    table |= {new: text(f"{part}/{cell}" for cell in pack.column(own).astype(str)) for new, own in prefixed.items()}
    table["sensor"] = text(np.array(pack.sensor_names)[pack.sensors])
    for modality in MODALITIES:
        there = pack.has(modality) if modality in pack.spec.modalities else np.zeros(pack.num, bool)
        table[f"has_{modality}"] = pa.array(there)
    for own in pack.spec.tasks:
        if isinstance(task := tasks.get(own.name), Task):
            numbers = [task.classes.index(name) if name in task.classes else -2 for name in own.classes]
            labels = np.array([*numbers, -1])[pack.column(f"label_{own.name}").astype(int)]  # -1 (no label) is the last
            if (labels == -2).any():
                new = next(name for name in own.classes if name not in task.classes)
                raise unknown(f"class of {task.name}", f"{new} ({pack.path})", task.classes)
            table[f"label_{task.name}"] = pa.array(labels)
    return table


def text(cells: Iterable[str]) -> pa.Array:
    return pa.array(list(cells), pa.string())


def known_image(pack: Pack, rows: np.ndarray, sums: np.ndarray) -> tuple[str, int] | None:
    """The first image of ``rows`` that is among ``sums``, and how many there are of its modality."""
    for same, modality in zip(known_images(pack, rows, sums).T, MODALITIES, strict=True):
        if same.any():
            return f"the {modality} image of row {str(pack.own_ids[rows[same][0]])!r}", int(same.sum())
    return None
