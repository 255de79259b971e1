"""Packs to mix: the stripes cut in two, and one with touch alone, at another size, with classes numbered otherwise."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample
from mvitac.data.spec import DataSpec
from mvitac.datasets.mix import MixConfig
from mvitac.recipes import recipe
from mvitac.run import Run
from support.toy import Toy


@dataclass
class Slice(Toy):
    """``num`` items of the stripes from item ``first`` on."""

    first: int = 0
    prefix: str = ""

    def fingerprint(self) -> dict[str, Any]:
        return {**super().fingerprint(), "slice": [self.first, self.prefix]}

    def read(self, item: int) -> list[Sample]:
        (sample,) = super().read(item + self.first)
        names = {name: f"{self.prefix}{sample.columns[name]}" for name in ("id", "group", "touch_group")}
        return [replace(sample, columns={**sample.columns, **names})]


@dataclass
class Gel(Slice):
    """Touch alone, of inverted colours, with a column sensor; the classes of bright differ from those of the stripes."""

    vision_channels: int = 0
    prefix: str = "gel "

    def spec(self) -> DataSpec:
        pattern, bright = (spec := super().spec()).tasks
        pattern = replace(pattern, classes=("checks", "columns", "rows"))
        return replace(spec, name="gel", tasks=(pattern, replace(bright, classes=("dim", "bright"))), controls={})

    def read(self, item: int) -> list[Sample]:
        (sample,) = super().read(item)
        assert sample.touch is not None
        columns = {**sample.columns, "label_pattern": (sample.columns["label_pattern"] + 1) % 3, "sensor": "mini"}
        return [replace(sample, touch=255 - sample.touch, columns=columns)]


def built(source: Toy, path: Path, size: int = 32) -> Pack:
    return build(source, path, size=size, quiet=True)


def mix_run(*parts: str, **changes: Any) -> Run:
    return replace(recipe("smoke", MixConfig(parts=parts, **changes.pop("data", {})), phased=False), **changes)
