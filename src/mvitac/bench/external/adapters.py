"""From a text to an encoder of other people: a trunk of timm, or whatever a Python function returns.

    external:timm/resnet18.a1_in1k,size=112        any model of timm: DINOv2, CLIP, ImageNet trunks, random weights
    external:python:package.module:function        the door for all others

Licences and preprocessing of timm's models are those of their ``pretrained_cfg`` (huggingface/pytorch-image-models
@aa4b585). The Python function takes no arguments and returns a torch module and a dict:

    def function():
        return network, {"size": (224, 224), "mean": (0.5, 0.5, 0.5), "std": (0.5, 0.5, 0.5), "licence": "MIT"}

The module maps normalised images to features [B, D], tokens [B, P, D] or maps [B, D, H, W]; of the last two the mean is
taken. The dict has fields of ``Preprocessing``, and "title", "licence", "source" and "trained_on".
"""

import importlib
import math
import re
import sys
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from timm.data.config import resolve_data_config
from timm.data.constants import IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD
from torch import Tensor, nn

from mvitac.nn import imagenet
from mvitac.nn.encoders import IMAGENET, SCRATCH, EncoderConfig, build_trunk, within
from mvitac.nn.weights import said_trained_on
from mvitac.registry import check_known, from_json, to_json, unknown
from mvitac.system.files import brief

START = "external:"
UNKNOWN, NOTHING, RANDOM = "unknown", "nothing", "none (random weights)"
ABOUT = ("title", "licence", "source", "trained_on")
WEB = re.compile(r"in\d+k|dino|mae|openai|laion\w+|datacomp1b|webli|lvd\d+m")
"""Parts of timm's tags for weights that name images of the web, which no tactile set is from."""


@dataclass(frozen=True, kw_only=True)
class Preprocessing:
    """From frames to a network's input. All values are RGB in [0, 1] until ``mean`` and ``std``."""

    size: tuple[int, int] = (224, 224)
    """Height and width of the input."""
    mean: tuple[float, float, float] = IMAGENET_DEFAULT_MEAN
    std: tuple[float, float, float] = IMAGENET_DEFAULT_STD
    frames: int = 1
    """Frames that the network sees at once, stacked on channels: [N, 3 F, H, W]."""
    stride: float = 1.0
    """Distance of two frames, in units of the data's order column."""

    def __post_init__(self) -> None:
        if min(*self.size, self.frames) < 1 or not 0 < min(self.stride, *self.std) < math.inf:
            raise ValueError(f"size {self.size}, frames {self.frames}, stride {self.stride}, std {self.std}: 0 or less")
        if not all(0 <= level <= 1 for level in self.mean):
            raise ValueError(f"mean {self.mean}: images are in 0 to 1")

    def __call__(self, images: Tensor) -> Tensor:
        """Prepare images [N, F, 3, H, W], uint8 or float in [0, 1], newest first.

        Missing older frames are the oldest there is; further ones are left out.
        """
        images = images[:, [min(f, images.shape[1] - 1) for f in range(self.frames)]]
        x = images.float() / 255 if images.dtype == torch.uint8 else images.float()
        x = F.interpolate(x.flatten(0, 1), self.size, mode="bilinear", antialias=True).unflatten(0, images.shape[:2])
        mean, std = (x.new_tensor(values).view(3, 1, 1) for values in (self.mean, self.std))
        return ((x - mean) / std).flatten(1, 2)


@dataclass(frozen=True)
class Loaded:
    network: nn.Module  # images -> features [B, D]
    preprocessing: Preprocessing
    title: str  # its name in tables
    files: tuple[Path, ...] = ()  # files with its weights, or its code
    licence: str = UNKNOWN  # licence of the weights
    source: str = UNKNOWN  # where they are from
    trained_on: str = UNKNOWN  # the data it was trained on; ``NOTHING`` for random weights
    code: str = ""  # tells features of code that may change from those in the cache


@dataclass(frozen=True, kw_only=True)
class Adapter(ABC):
    """Base of both adapters. The fields are the options that every encoder has; "" and None keep the adapter's value."""

    place: str
    """What to open."""
    reads: Literal["touch", "vision", "both"] = "both"
    """The images that it encodes."""
    size: int | None = None
    """Side of the input."""
    title: str = ""
    """Name in tables."""
    licence: str = ""
    """Licence of the weights, if the adapter does not know it."""
    trained_on: str = ""
    """What it was trained on, if the adapter does not know it; no leak is then assumed."""
    seed: int = 0
    """Seed of random weights and of the probes."""

    @abstractmethod
    def load(self) -> Loaded:
        """Open the encoder; ValueError in one line if ``place`` is something else."""


@dataclass(frozen=True, kw_only=True)
class Timm(Adapter):
    weights: str = "pretrained"
    """pretrained (timm downloads them), random, or a file."""
    pool: Literal["last", "stages"] = "last"
    """Features: those of the model, or the means of the maps of all its stages (``EncoderConfig.pool``)."""

    def load(self) -> Loaded:
        if self.place.endswith(".openai") and "quickgelu" not in self.place:
            quick = self.place.replace("_clip_", "_clip_quickgelu_")
            raise ValueError(f"{self.place}: OpenAI's weights need QuickGELU: {quick}")
        known = {"pretrained": IMAGENET, "random": SCRATCH}
        network = seeded(partial(self._built, known.get(self.weights, self.weights)), self.seed)
        cfg: dict[str, Any] = getattr(within(network), "pretrained_cfg", None) or {}
        usual = resolve_data_config(pretrained_cfg={"name": self.place, **cfg})
        random, named, file = self.weights == "random", self.weights in known, Path(self.weights)
        page = f"https://huggingface.co/{cfg.get('hf_hub_id')}"
        return Loaded(
            network,
            Preprocessing(size=usual["input_size"][1:], mean=usual["mean"], std=usual["std"]),
            f"{self.place}, {self.weights if named else file.name}" + ", all stages" * (self.pool == "stages"),
            files=() if named else (file,),
            licence=RANDOM if random else (named and cfg.get("license")) or UNKNOWN,
            source=imagenet.source(self.place) or page if self.weights == "pretrained" else self.weights,
            trained_on=NOTHING if random else said(cfg.get("tag") or "") if named else said_trained_on(file) or UNKNOWN,
        )

    def _built(self, weights: str) -> nn.Module:
        trunk = build_trunk(EncoderConfig(trunk=self.place, weights=weights, pool=self.pool), 3)
        if self.size and hasattr(model := within(trunk), "set_input_size"):
            try:
                model.set_input_size(img_size=(self.size, self.size))  # type: ignore[operator]
            except Exception as error:  # each model has its own rules
                raise ValueError(f"{self.place} cannot take size {self.size} ({brief(error)})") from None
        return trunk


def said(tag: str) -> str:
    """What timm's tag of pretrained weights says of their data."""
    return f"timm's {tag}" if any(map(WEB.fullmatch, tag.split("_"))) else UNKNOWN


@dataclass(frozen=True, kw_only=True)
class Python(Adapter):
    def load(self) -> Loaded:
        module, _, name = self.place.partition(":")
        sys.path.insert(0, str(Path.cwd()))  # as python -m does
        try:
            made: Any = seeded(getattr(importlib.import_module(module), name), self.seed)
            network, given = made[0], dict(made[1])
        except (Exception, SystemExit) as error:  # whatever the module raises, or returns
            why = f"{type(error).__name__}: {brief(error)}"
            raise ValueError(f"{self.place}() returns no torch module and dict ({why}): give module:function") from None
        finally:
            sys.path.remove(str(Path.cwd()))
        about: dict[str, Any] = {"title": self.place, "source": self.place}
        about |= {name: str(given.pop(name)) for name in ABOUT if name in given}
        if isinstance(size := given.get("size"), int):
            given["size"] = (size, size)
        about |= {"files": (Path(str(sys.modules[module].__file__)),), "code": uuid.uuid4().hex}
        return Loaded(Mean(network), from_json(Preprocessing, to_json(given), f"{self.place}()"), **about)


class Mean(nn.Module):
    """Features [B, D] of a network that gives features, tokens [B, P, D] or a map [B, D, H, W]."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        found = self.network(images)
        return found.mean((2, 3)) if found.ndim == 4 else found.mean(1) if found.ndim == 3 else found


def seeded(build: Callable[[], nn.Module], seed: int) -> nn.Module:
    """A network from ``build``, with random weights of ``seed``; the caller's random state stays as it is."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build()


def parse(text: str) -> Adapter:
    """The adapter, with its options, that ``text`` names."""
    head, *pairs = text.removeprefix(START).split(",")
    name, _, place = head.partition("/" if head.startswith("timm/") else ":")
    kind = {"timm": Timm, "python": Python}.get(name)
    if not kind or not place:
        raise unknown("encoder", text, [f"{START}timm/NAME", f"{START}python:MODULE:FUNCTION"])
    options = [field.name.replace("_", "-") for field in fields(kind) if field.name != "place"]
    check_known(f"option of {START}{name}", [pair.partition("=")[0] for pair in pairs], options)
    given: dict[str, Any] = {key.replace("-", "_"): value for key, _, value in (pair.partition("=") for pair in pairs)}
    if len(given) < len(pairs):
        raise ValueError(f"{text}: an option is given twice")
    numbers = {key: int(given[key]) for key in ("size", "seed") if given.get(key, "").isdecimal()}
    return from_json(kind, {**given, **numbers, "place": place}, START + name)
