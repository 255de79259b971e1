"""The model that the package brings: commands and ``mvitac.load`` know it by the name ``base``."""

from pathlib import Path

BASE = Path(__file__).parent / "weights" / "base"


def named(place: str) -> str:
    """The folder of the shipped model if ``place`` is "base" and nothing here has that name, else ``place``."""
    return str(BASE) if place == "base" and BASE.exists() and not Path(place).exists() else place


def with_names(words: list[str]) -> list[str]:
    """The words of a command with the shipped model's folder for its name. Values of options, but --model's, stay."""
    before = ["", *words]
    return [named(w) if b == "--model" or not b.startswith("--") else w for b, w in zip(before, words, strict=False)]
