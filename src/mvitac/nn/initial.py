"""Start weights from another model: what to take (``Init``). ``training/start.py`` loads them."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Fixed, arg

from mvitac.nn.weights import read_safetensors, safetensors_digest
from mvitac.shipped import named

MODEL = "model.safetensors"  # the file with the weights in the folder of a run or an artifact


@dataclass(frozen=True, kw_only=True)
class Init:
    """Start weights from another model. Heads and modalities that are not taken start as the other settings say."""

    path: Annotated[Path | None, arg(name="init")] = None
    """Folder of a finished run or of an artifact, its model.safetensors, or `base` (the model that the package brings).
    Adapted where the number of channels differs. Weights of others: --encoder.weights FILE."""
    modalities: Fixed[tuple[Literal["vision", "touch"], ...]] = ()
    """Encoders to take. Default: all that fit, and at least one."""
    heads: Fixed[bool] = True
    """Also take the heads into the space shared by both modalities, where they fit."""
    digest: Fixed[str] = ""
    """sha256 of the weights. Training records it."""

    def __bool__(self) -> bool:
        return self.path is not None

    @property
    def file(self) -> Path:
        """The file with the weights; ValueError if there is none."""
        assert self.path is not None
        place = named(self.path)
        file = place / MODEL if place.is_dir() else place
        if not file.is_file():
            unfinished = "; its run is not finished, continue it with --resume" * (place / "checkpoint.pt").exists()
            raise ValueError(f"init {file} does not exist{unfinished}: give a finished run or an artifact")
        return file

    def resolved(self) -> "Init":
        """The same with ``digest``; ValueError if there are no such weights, or they are others than those of it."""
        if not self:
            return self
        found = _digest(self.file, self.file.stat().st_mtime_ns)
        if self.digest not in ("", found):
            raise ValueError(f"init {self.path} now holds other weights than this run was recorded with: restore them")
        return replace(self, digest=found)


@cache
def _digest(file: Path, changed: int) -> str:
    return safetensors_digest(read_safetensors(file)[1])
