"""The scripts in examples/ and ros/, run from their files."""

from pathlib import Path
from runpy import run_path
from types import SimpleNamespace


def load_example(name: str, folder: str = "examples") -> SimpleNamespace:
    return SimpleNamespace(**run_path(str(Path(__file__).parents[2] / folder / f"{name}.py"), run_name=name))
