"""The base class of dataset configs. A config gives a source of samples; all other code reads the pack made from it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from tyro.conf import Fixed

from mvitac.data.pack import Pack
from mvitac.data.source import Source
from mvitac.data.spec import QUALITY, Store, Window, check_request, stored_as
from mvitac.data.windows import windowed
from mvitac.registry import Registered, default
from mvitac.system.files import cache_dir, check_place, digest

WINDOW = ("num_frames", "stride", "frames_of", "order", "short", "minus_first")
"""Options that say which frames a row shows. A pack stores every frame once, whatever they are."""
KEEPING = ("size", "workers", "store", "quality", *WINDOW)
"""Options of every dataset that affect how images are stored or shown, not which images they are."""


@dataclass(frozen=True, kw_only=True)
class DatasetConfig(Registered):
    """Base class of dataset configs. A new dataset is one file with a ``Source`` and a config."""

    local: ClassVar[tuple[str, ...]] = ("workers",)
    """Options that do not affect the result."""
    names_a_place: ClassVar[bool] = True
    """Whether opening the data reads a path or a URL that the config names. That of an artifact is not believed."""
    phased: ClassVar[bool | None] = None
    """``Pack.phased`` where it is known before the data is opened. None: the opened pack decides."""

    size: int = 256
    """Side of the stored images in pixels; crops are taken from them (paper: 256)."""
    workers: int = 0
    """Number of processes for packing; 0 = one per core."""
    store: Store = "raw"
    """Store images as raw pixels, which are fast to read, or as jpeg, which needs less disk and is decoded in every step."""
    quality: Fixed[int] = QUALITY
    """JPEG quality, 1 to 100. At 95, pixels differ by 1 or 2 of 255 levels. Colours keep full resolution (4:4:4)."""

    num_frames: int = 1
    """Number of frames that a row shows: the current one and earlier ones of the same touch, stacked on channels."""
    stride: float = 1.0
    """Distance of these frames, in units of --data.order: frames, or seconds."""
    frames_of: Literal["touch", "vision", "both"] = "touch"
    """Images that show several frames; the others show the current one."""
    order: str | None = None
    """Column that orders the frames of a touch; default: frame, seq or time."""
    short: Fixed[Literal["repeat", "leave-out"]] = "repeat"
    """What is done with rows near the start of a touch: repeat its first frame, or leave the row out."""
    minus_first: bool = False
    """Show (frame - first frame of the touch) / 2 + 128 instead of the frame."""

    def __post_init__(self) -> None:
        for name in ("stride", "frames_of", *["order"] * (not self.minus_first)) * (self.num_frames == 1):
            if getattr(self, name) != getattr(DatasetConfig, name):
                option = f"--data.{name.replace('_', '-')} is for rows of several frames"
                raise ValueError(f"{option}: give --data.num-frames to what reads the pack, or leave it out")
        self.frame_window()
        check_request(self.store, size=self.size, workers=self.workers, quality=self.quality)

    @classmethod
    def reads(cls, path: Path) -> bool:
        """Whether ``path``, which exists, is this dataset's and no other's."""
        return False

    def frame_window(self) -> Window:
        of = ("vision", "touch") if self.frames_of == "both" else (self.frames_of,)
        same = {name: getattr(self, name) for name in ("stride", "order", "short", "minus_first")}
        return Window(frames=self.num_frames, of=of, **same)

    def build_options(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("size", "workers", "store", "quality")}

    def source(self) -> Source:
        """Return the source of samples; ValueError if the data does not exist, or is packed already."""
        raise ValueError(f"--data {self.name} reads packs: there is nothing to pack, use it to train and to probe")

    def place(self, source: Source | None = None) -> Path:
        """Return the folder in the cache where ``open`` builds the pack of ``source``, by default of this dataset."""
        source = source or self.source()
        kept = stored_as(self.store, self.quality)
        stamps = source.stamps()
        changed = {} if stamps is None else {"stamps": digest(stamps)}
        key = digest({"fingerprint": source.fingerprint(), "size": self.size, **kept, **changed})[:16]
        return cache_dir() / "packs" / f"{self.name}-{key}"

    def open(self, *, quiet: bool = False) -> Pack:
        """Return the pack of this dataset, with windows of frames if they are asked for.

        It is built in the cache (``files.cache_dir``) if it does not exist, and again if files of the dataset have changed.
        """
        pack = self._frames(quiet)
        try:
            made = windowed(pack, self.frame_window())
        except ValueError as error:  # nobody knows the cache's folder
            raise ValueError(str(error).replace(str(pack.path), str(getattr(self, "path", self.name)))) from None
        made.config = self
        return made

    def _frames(self, quiet: bool) -> Pack:
        source = self.source()
        path = self.place(source)
        if path.exists():
            return Pack(path)
        try:
            check_place(path)
        except ValueError as error:
            raise ValueError(f"the cache of packs: {error} with MVITAC_CACHE") from None
        from mvitac.data.build import build  # what is packed already needs no builder

        return build(source, path, quiet=quiet, exist_ok=True, **self.build_options())


def dataset(text: str) -> DatasetConfig:
    """The dataset of this name; or the pack, the table, the videos or the folder at this path. ValueError if it is neither.

    A path is ``--data folder``'s where no other dataset ``reads`` it.
    """
    if text in DatasetConfig.choices or not Path(text).exists():
        return default(DatasetConfig, text)
    name = next((name for name, kind in DatasetConfig.choices.items() if kind.reads(Path(text))), "folder")
    return replace(default(DatasetConfig, name), path=Path(text))  # type: ignore[call-arg]
