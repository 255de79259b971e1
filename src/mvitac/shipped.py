"""The model that the package brings: commands and ``mvitac.load`` know it by the name ``base``."""

from pathlib import Path
from typing import TypeVar

Place = TypeVar("Place", str, Path)
BASE = Path(__file__).parent / "weights" / "base"


def named(place: Place) -> Place:
    """The folder of the shipped model if ``place`` is "base" and nothing here has that name, else ``place``."""
    return type(place)(BASE) if str(place) == "base" and BASE.exists() and not Path(place).exists() else place
