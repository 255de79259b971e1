"""mvitac: learn representations of paired camera and optical-tactile images without labels, and evaluate them.

    model = mvitac.load("runs/demo/seed0")                      # a run, an artifact, or owner/name on the Hub
    features = model.embed(vision=photos, touch=presses)        # {"vision": [N, 1280], "touch": [N, 512]}

Names are imported on first use, so that ``import mvitac`` is fast.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mvitac.data.pack import Pack
    from mvitac.deploy.artifact import load
    from mvitac.evaluation.evaluate import probe
    from mvitac.model import Model
    from mvitac.nn.initial import Init
    from mvitac.recipes import recipe
    from mvitac.run import Run
    from mvitac.training.loop import train

__version__ = "0.1.0"
__all__ = ["Init", "Model", "Pack", "Run", "load", "probe", "recipe", "train"]

_HOME = {"Model": "model", "Pack": "data.pack", "Run": "run", "recipe": "recipes", "train": "training.loop"}
_HOME |= {"Init": "nn.initial", "probe": "evaluation.evaluate", "load": "deploy.artifact"}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"mvitac.{_HOME[name]}"), name)
    raise AttributeError(f"module 'mvitac' has no attribute {name!r}")
