"""The interface of adapters to other people's encoders, and the text that names an encoder.

    external:timm/resnet18.a1_in1k,size=112        a model of timm, with options
    external:python:package.module:function        whatever a Python function returns

An adapter is a subclass of ``Adapter`` whose fields are its options.
"""

import typing
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.registry import Registered, from_json, unknown

START = "external:"
UNKNOWN, NOTHING, RANDOM = "unknown", "nothing", "none (random weights)"


@dataclass(frozen=True)
class Loaded:
    """What an adapter opened."""

    network: nn.Module  # images -> features [B, D]
    preprocessing: Preprocessing
    title: str  # its name in tables
    files: tuple[Path, ...] = ()  # files with its weights
    licence: str = UNKNOWN  # licence of the weights
    source: str = UNKNOWN  # where they are from
    trained_on: str = UNKNOWN  # the data it was trained on; ``NOTHING`` for random weights


@dataclass(frozen=True, kw_only=True)
class Adapter(Registered, ABC):
    """Base of all adapters. The fields are the options that every encoder has; "" keeps the adapter's value."""

    place: str
    """What to open."""
    reads: Literal["touch", "vision", "both"] = "both"
    """The images that it encodes."""
    size: str = ""
    """Input size, e.g. 224 or 320x240 (height x width)."""
    mean: str = ""
    """Three numbers: 0.5/0.5/0.5."""
    std: str = ""
    """Likewise."""
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

    def changed(self, made: Preprocessing) -> Preprocessing:
        """``made`` with the values that options give."""
        given = {name: text for name in ("mean", "std") if (text := getattr(self, name))}
        levels: dict[str, Any] = {name: _numbers(text, name, float, "/", 3) for name, text in given.items()}
        return replace(made, size=self.sides(made.size), **levels)

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
    name, _, place = head.partition("/" if head.startswith("timm/") else ":")
    if name not in Adapter.choices or not place:
        raise unknown("encoder", text, [f"{START}timm/NAME", f"{START}python:MODULE:FUNCTION"])
    given: dict[str, Any] = {key.replace("-", "_"): value for key, _, value in (pair.partition("=") for pair in pairs)}
    if given.get("seed", "").isdecimal():
        given["seed"] = int(given["seed"])
    return from_json(Adapter, {**given, "name": name, "place": place}, START + name)
