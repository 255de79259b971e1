"""``--data webdataset``: tar files of samples (https://github.com/webdataset/webdataset).

Members with the same name up to the first dot are one sample:

    shard-000.tar:  0001.vision.jpg  0001.touch.png  0001.json        two images and their metadata
    shard-001.tar:  0002.jpg  0002.cls  ...                           one image (see ``pictures``) and its class

Images are read from inside the tar. A .json gives a column per scalar, .cls and .txt one column each.
"""

import tarfile
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from mvitac.data.images import IMAGES
from mvitac.datasets.table.image_refs import ImageRef, TarMember
from mvitac.datasets.table.manifest import Manifest, text_of
from mvitac.datasets.table.table import RowsConfig
from mvitac.system.files import brief, parse_json


@dataclass(frozen=True, kw_only=True)
class WebDatasetConfig(RowsConfig):
    """Tar files of images and JSON, as WebDataset writes them."""

    name: ClassVar[str] = "webdataset"

    path: Path = Path("data.tar")
    """A .tar, or a folder of them."""
    pictures: Literal["touch", "vision"] = "touch"
    """Modality of images without a name of their own (0001.jpg, not 0001.touch.jpg)."""

    @classmethod
    def reads(cls, path: Path) -> bool:
        return path.suffix == ".tar"

    def manifest(self) -> Manifest:
        shards = sorted(self.path.glob("*.tar")) if self.path.is_dir() else [self.path]
        if not shards or not shards[0].is_file():
            raise ValueError(f"{self.path} is no .tar and holds none: give a tar file, or a folder of them")
        samples: dict[str, dict[str, str]] = {}
        places: dict[str, dict[str, ImageRef]] = {}
        for shard in shards:
            self._index(shard, samples, places)
        columns = list(dict.fromkeys(c for found in places.values() for c in found))
        if not columns:
            raise ValueError(f"{self.path} holds no images ({', '.join(IMAGES)}): is it a WebDataset?")
        found = {c: [places[key].get(c) for key in samples if key in places] for c in columns}
        return Manifest.of(self.path, [row for key, row in samples.items() if key in places], found)

    def _index(self, shard: Path, samples: dict[str, dict[str, str]], places: dict[str, dict[str, ImageRef]]) -> None:
        """Add the members of ``shard``, which must not be compressed."""
        try:
            with tarfile.open(shard, "r:") as tar:
                for member in tar:
                    folder, _, base = member.name.rpartition("/")
                    key, dot, kind = base.partition(".")
                    if not member.isfile() or not key or not dot:
                        continue
                    key = f"{folder}/{key}" if folder else key
                    row = samples.setdefault(key, {"id": key, "shard": shard.name})
                    name, _, last = kind.lower().rpartition(".")
                    if f".{last}" in IMAGES:
                        column = name or self.pictures
                        if column in places.setdefault(key, {}):
                            raise ValueError(f"{shard} has two {column} images of {key}: names must differ")
                        places[key][column] = TarMember(str(shard), member.offset_data, member.size)
                    elif last in ("json", "cls", "txt"):
                        file = tar.extractfile(member)
                        text = file.read().decode() if file else ""
                        row.update(_known(text, self.vectors()) if last == "json" else {last: text.strip()})
        except (tarfile.TarError, OSError, ValueError) as error:
            raise ValueError(f"{shard} cannot be read as an uncompressed tar ({brief(error)})") from None


def _known(text: str, vectors: Collection[str]) -> dict[str, str]:
    """Return the scalars of a JSON object, and its lists ``vectors``, as text."""
    value = parse_json(text)
    if not isinstance(value, dict):
        return {}
    plain = (str, int, float, bool, type(None))
    return {name: text_of(v) for name, v in value.items() if isinstance(v, plain) or name in vectors}
