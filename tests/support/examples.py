"""The scripts in examples/ and benchmarks/, imported from their files."""

import importlib.util
from pathlib import Path
from typing import Any


def load_example(name: str, folder: str = "examples") -> Any:
    path = Path(__file__).parents[2] / folder / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
