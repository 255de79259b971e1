"""A Python function that returns a network and its preprocessing: the door for all other encoders.

The function of external:python:package.module:function takes no arguments and returns a torch module and a dict:

    def function():
        return network, {"size": (224, 224), "mean": (0.5, 0.5, 0.5), "std": (0.5, 0.5, 0.5), "licence": "MIT"}

The module maps normalised images to features [B, D], tokens [B, P, D] or maps [B, D, H, W]; of the last two the mean is
taken. The dict has fields of ``Preprocessing``, and "title", "licence", "source" and "trained_on".
"""

import importlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor, nn

from mvitac.bench.external.base import Adapter, Loaded, seeded
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.registry import from_json, to_json
from mvitac.system.files import brief

ABOUT = ("title", "licence", "source", "trained_on")


@dataclass(frozen=True, kw_only=True)
class Python(Adapter):
    """A function that returns a module and its preprocessing."""

    name: ClassVar[str] = "python"

    def load(self) -> Loaded:
        module, _, name = self.place.partition(":")
        sys.path.insert(0, str(Path.cwd()))  # as python -m does
        try:
            made: Any = seeded(getattr(importlib.import_module(module), name), self.seed)
            network, given = made[0], dict(made[1])
        except Exception as error:  # whatever the module raises, or returns
            why = f"{type(error).__name__}: {brief(error)}"
            raise ValueError(
                f"{self.place}() returns no torch module and dict ({why}): give package.module:function"
            ) from None
        finally:
            sys.path.remove(str(Path.cwd()))
        about: dict[str, Any] = {"title": self.place, "source": self.place}
        about |= {name: str(given.pop(name)) for name in ABOUT if name in given}
        if isinstance(size := given.get("size"), int):
            given["size"] = (size, size)
        preprocessing = from_json(Preprocessing, to_json(given), f"{self.place}()")
        return Loaded(Mean(network), preprocessing, **about)


class Mean(nn.Module):
    """Features [B, D] of a network that gives features, tokens [B, P, D] or a map [B, D, H, W]."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        found = self.network(images)
        return found.mean((2, 3)) if found.ndim == 4 else found.mean(1) if found.ndim == 3 else found
