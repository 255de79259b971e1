"""A network from a Python function: external:python:package.module:factory.

The function takes no arguments and returns a torch module and a dict:

    def factory():
        return network, {"size": (224, 224), "mean": (0.5, 0.5, 0.5), "std": (0.5, 0.5, 0.5), "licence": "MIT"}

The module maps normalised images to features [B, D], tokens [B, P, D] or maps [B, D, H, W]; one with timm's interface
(``forward_features``, ``num_features``) is used as it is. The dict has fields of ``Preprocessing``, and "title",
"licence", "source", "trained_on" and "prefix" (tokens in front that are no places).
"""

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from torch import nn

from mvitac.bench.external.base import Adapter, Loaded, seeded
from mvitac.bench.external.encoder import Plain
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.registry import from_json, to_json
from mvitac.system.files import brief

ABOUT = ("title", "licence", "source", "trained_on")


@dataclass(frozen=True, kw_only=True)
class Python(Adapter):
    """A function that returns a module and its preprocessing."""

    name: ClassVar[str] = "python"
    expects: ClassVar[str] = "package.module:function"
    reads: Literal["touch", "vision", "both"] = "both"

    def load(self) -> Loaded:
        factory = self._factory()
        try:
            made: Any = seeded(factory, self.seed)  # type: ignore[arg-type]
        except Exception as error:  # whatever the function raises
            raise ValueError(f"{self.place}() failed ({type(error).__name__}: {brief(error)})") from None
        if not (
            isinstance(made, tuple) and len(made) == 2 and isinstance(made[0], nn.Module) and isinstance(made[1], dict)
        ):
            raise ValueError(f"{self.place}() returned a {type(made).__name__}: return a torch module and a dict")
        network, given = made[0], dict(made[1])
        about = {name: str(given.pop(name)) for name in ABOUT if name in given}
        prefix = int(given.pop("prefix", 0))
        if isinstance(size := given.get("size"), int):
            given["size"] = (size, size)
        made = from_json(Preprocessing, to_json(given), f"{self.place}()")
        if not (hasattr(network, "forward_features") and hasattr(network, "num_features")):
            network = Plain(network, prefix)
        about = {"title": self.place, "source": self.place, **about}
        return replace(Loaded(network=network, preprocessing=made, title=""), **about)

    def _factory(self) -> Callable[[], Any]:
        module, _, name = self.place.partition(":")
        if not module or not name:
            raise ValueError(f"{self.place}: give {self.expects}")
        sys.path.insert(0, str(Path.cwd()))  # as python -m does
        try:
            return getattr(importlib.import_module(module), name)
        except Exception as error:  # whatever the module raises
            raise ValueError(f"{self.place} cannot be imported ({brief(error)}): give {self.expects}") from None
        finally:
            sys.path.remove(str(Path.cwd()))
