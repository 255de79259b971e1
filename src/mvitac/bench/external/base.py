"""The interface of adapters to other people's encoders, and the text that names an encoder.

    external:timm/resnet18.a1_in1k,size=112        adapter, what it opens, options
    external:sparsh:sparsh_dino_base.safetensors   one file per owner
    external:model.onnx,mean=clip,std=clip         any TorchScript or ONNX file

An adapter is one file: a subclass of ``Adapter`` whose fields are its options. No owner's code is used, and no owner's
weights were at hand when the adapters were written: they are tested on small weights with the owners' names and shapes.
"""

import copy
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import nn

from mvitac.bench.external.encoder import ExternalEncoder
from mvitac.bench.external.preprocessing import CLIP, IMAGENET, PLAIN, Preprocessing
from mvitac.registry import Registered, find, from_json, unknown
from mvitac.system.files import digest_file, parse_json

START = "external:"
FILES = (".pt", ".ts", ".pth", ".onnx", ".safetensors")
UNKNOWN, NOTHING, RANDOM = "unknown", "nothing", "none (random weights)"
STATISTICS = {"imagenet": IMAGENET, "clip": CLIP, "none": PLAIN}


@dataclass(frozen=True, kw_only=True)
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
    background: Literal["", "minus", "none"] = ""
    """minus: of difference images, image - background + offset. none: images as they are."""
    offset: float | None = None
    """0 to 1, with background=minus."""
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

    def refuse(self, why: str) -> ValueError:
        """The error for a file of another kind."""
        return ValueError(f"{self.place} is not for {START}{self.name} ({why}): give {self.expects}")

    def changed(self, made: Preprocessing) -> Preprocessing:
        """``made`` with the values that options give."""
        options = ("frames", "stride", "offset")
        changes: dict[str, Any] = {n: getattr(self, n) for n in options if getattr(self, n) is not None}
        for name, at in (("mean", 0), ("std", 1)):
            if text := getattr(self, name):
                changes[name] = STATISTICS[text][at] if text in STATISTICS else _numbers(text, name, float, "/")
        if self.background == "minus":
            changes.setdefault("offset", 0.5 if made.offset is None else made.offset)
        elif self.background == "none":
            changes["offset"] = None
        made = replace(made, **changes)
        return made.resized_to(self.sides(made.size)) if self.size else made

    def sides(self, usual: tuple[int, int]) -> tuple[int, int]:
        """Height and width that ``size`` asks for, by default ``usual``."""
        if not self.size:
            return usual
        found: list[int] = list(_numbers(self.size, "size", int, "x"))
        if len(found) > 2:
            raise ValueError(f"size {self.size}: give one side or height x width, e.g. 224 or 320x240")
        return found[0], found[-1]


def _numbers(text: str, name: str, kind: Callable[[str], Any], between: str) -> tuple[Any, ...]:
    try:
        return tuple(kind(part) for part in text.split(between))
    except ValueError:
        raise ValueError(f"{name} {text!r}: give numbers with {between!r} between them") from None


@dataclass(frozen=True)
class OpenEncoder:
    """An encoder that was named by text."""

    text: str
    adapter: Adapter
    loaded: Loaded
    encoder: ExternalEncoder

    def untrained(self) -> "OpenEncoder | None":
        """The same network with random weights; None if it has no weights here, or random ones already."""
        network = self.loaded.network
        if self.loaded.trained_on == NOTHING or not any(p.is_floating_point() for p in network.parameters()):
            return None
        network = randomised(network, self.adapter.seed)
        loaded = replace(self.loaded, network=network, files=(), licence=RANDOM, trained_on=NOTHING)
        encoder = ExternalEncoder(network, self.encoder.preprocessing, self.adapter.pool)
        return OpenEncoder(self.text, self.adapter, loaded, encoder)


def randomised(network: nn.Module, seed: int) -> nn.Module:
    """A copy of ``network`` with random weights: matrices truncated normal (.02), convolutions He, scales 1, biases 0."""
    network, generator = copy.deepcopy(network), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if weight.ndim > 3:
                nn.init.kaiming_normal_(weight, generator=generator)
            elif weight.ndim > 1:
                nn.init.trunc_normal_(weight, std=0.02, generator=generator)
            else:
                weight.fill_(not name.endswith("bias"))
        for name, value in network.named_buffers():
            if name.endswith(("running_mean", "running_var")):
                value.fill_(name.endswith("var"))
    return network


def seeded(build: Callable[[], nn.Module], seed: int) -> nn.Module:
    """A network from ``build``, with random weights of ``seed``; the caller's random state stays as it is."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build()


def open_encoder(text: str) -> OpenEncoder:
    """Open the encoder that ``text`` names (module docstring); ValueError if that is not possible."""
    adapter = parse(text)
    loaded = adapter.load()
    given = {name: getattr(adapter, name) for name in ("licence", "trained_on") if getattr(loaded, name) == UNKNOWN}
    given["title"] = adapter.title
    loaded = replace(loaded, **{name: value for name, value in given.items() if value})
    digests = [digest_file(file) for file in loaded.files]
    try:
        encoder = ExternalEncoder(loaded.network, adapter.changed(loaded.preprocessing), adapter.pool, f"{digests}")
    except ValueError as error:
        raise ValueError(f"{text}: {error}") from None
    return OpenEncoder(text, adapter, loaded, encoder)


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
    kind: Any = find(Adapter, name)
    hints = typing.get_type_hints(kind)
    known = [field.name.replace("_", "-") for field in fields(kind) if field.name != "place"]
    given: dict[str, Any] = {}
    for pair in pairs:
        key, _, value = pair.partition("=")
        if key not in known:
            raise unknown(f"option of {START}{name}", key, known)
        given[key.replace("-", "_")] = _value(hints[key.replace("-", "_")], value, key)
    return kind(place=place, **given)


def _value(annotation: Any, text: str, name: str) -> Any:
    if annotation is str or typing.get_origin(annotation) is Literal:
        return from_json(annotation, text, name)
    try:
        value = parse_json(text)
    except ValueError:
        raise ValueError(f"{name}={text}: give a number") from None
    return from_json(annotation, value, name)
