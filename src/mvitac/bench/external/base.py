"""The interface of adapters to other people's encoders, and the text that names an encoder.

    external:timm/resnet18.a1_in1k,size=112        adapter, what it opens, options
    external:sparsh:sparsh_dino_base.safetensors   one adapter per owner
    external:model.onnx,mean=clip,std=clip         any TorchScript or ONNX file

An adapter is a subclass of ``Adapter`` whose fields are its options.
"""

import typing
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import nn

from mvitac.bench.external.preprocessing import CLIP, IMAGENET, PLAIN, Preprocessing
from mvitac.registry import Registered, find, from_json, unknown
from mvitac.system.files import parse_json

START = "external:"
FILES = (".pt", ".ts", ".pth", ".onnx", ".safetensors")
UNKNOWN, NOTHING, RANDOM = "unknown", "nothing", "none (random weights)"
STATISTICS = {"imagenet": IMAGENET, "clip": CLIP, "none": PLAIN}


@dataclass(frozen=True)
class Loaded:
    """What an adapter opened."""

    network: nn.Module  # as ``ExternalEncoder`` takes it
    preprocessing: Preprocessing
    title: str  # its name in tables
    files: tuple[Path, ...] = ()  # files with its weights
    licence: str = UNKNOWN  # licence of the weights
    source: str = UNKNOWN  # where they are from
    trained_on: str = UNKNOWN  # the data it was trained on; ``NOTHING`` for random weights


@dataclass(frozen=True, kw_only=True)
class Adapter(Registered, ABC):
    """Base of all adapters. The fields are the options that every encoder has; "" and None keep the adapter's value."""

    expects: ClassVar[str]
    """What ``place`` must be, in words."""
    place: str
    """A file, a folder or a name."""
    reads: Literal["touch", "vision", "both"] = "touch"
    """The images that it encodes."""
    size: str = ""
    """Input size, e.g. 224 or 320x240 (height x width)."""
    mean: str = ""
    """imagenet, clip, none, or three numbers: 0.5/0.5/0.5."""
    std: str = ""
    """Likewise."""
    frames: int | None = None
    """Frames that the network sees at once, stacked on channels unless the adapter says otherwise."""
    stride: float | None = None
    """Distance of the frames."""
    offset: float | None = None
    """0 to 1: difference images become image - background + offset. Default: images as they are, or the owner's."""
    pool: Literal["", "mean", "cls"] = ""
    """Features: the mean of the places, or the first token."""
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

    def path(self) -> Path:
        """``place`` as a file or folder that exists."""
        if not (path := Path(self.place).expanduser()).exists():
            raise ValueError(f"{START}{self.name}: {path} does not exist: give {self.expects}")
        return path

    def changed(self, made: Preprocessing) -> Preprocessing:
        """``made`` with the values that options give."""
        options = ("frames", "stride", "offset")
        changes: dict[str, Any] = {n: getattr(self, n) for n in options if getattr(self, n) is not None}
        for name, at in (("mean", 0), ("std", 1)):
            if text := getattr(self, name):
                changes[name] = STATISTICS[text][at] if text in STATISTICS else _numbers(text, name, float, "/", 3)
        made = replace(made, **changes)
        return made.resized_to(self.sides(made.size)) if self.size else made

    def sides(self, usual: tuple[int, int]) -> tuple[int, int]:
        """Height and width that ``size`` asks for, by default ``usual``."""
        if not self.size:
            return usual
        text = self.size if "x" in self.size else f"{self.size}x{self.size}"
        return typing.cast(tuple[int, int], _numbers(text, "size", int, "x", 2))


def _numbers(text: str, name: str, kind: Callable[[str], Any], between: str, num: int) -> tuple[Any, ...]:
    try:
        found = tuple(kind(part) for part in text.split(between))
    except ValueError:
        found = ()
    if len(found) != num:
        raise ValueError(f"{name} {text!r}: give {num} numbers with {between!r} between them")
    return found


def seeded(build: Callable[[], nn.Module], seed: int) -> nn.Module:
    """A network from ``build``, with random weights of ``seed``; the caller's random state stays as it is."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build()


def parse(text: str) -> Adapter:
    """The adapter, with its options, that ``text`` names."""
    head, *pairs = text.removeprefix(START).split(",")
    while pairs and "=" not in pairs[0]:  # a comma in a file's name
        head += f",{pairs.pop(0)}"
    name, _, place = head.partition("/" if head.startswith("timm/") else ":")
    if name not in Adapter.choices and Path(head).suffix in FILES and (":" not in head or Path(head).exists()):
        name, place = "file", head
    if name not in Adapter.choices or not place:
        known = [f"{START}{choice}{'/' if choice == 'timm' else ':'}..." for choice in Adapter.choices]
        raise unknown("encoder", text, [*known, f"{START}FILE ({', '.join(FILES)})"])
    hints = typing.get_type_hints(find(Adapter, name))
    given: dict[str, Any] = {}
    for key, _, value in (pair.partition("=") for pair in pairs):
        key = key.replace("-", "_")
        words = hints.get(key, str) is str or typing.get_origin(hints[key]) is Literal
        given[key] = value if words else _number(value)
    return from_json(Adapter, {**given, "name": name, "place": place}, START + name)


def _number(text: str) -> Any:
    try:
        return parse_json(text)
    except ValueError:
        return text
