"""A dataset made of stripes, small and fast: the class decides the pattern both modalities see, the instance its phase.

The three patterns (columns, rows, checks) stay themselves under a horizontal flip.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from PIL import Image
from threadpoolctl import threadpool_info

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Target, Task, ValueTask

NUM_CLASSES = 3
LIGHT = (
    ValueTask(name="light", targets=(Target(name="level", unit="levels"),)),
    ValueTask(name="both", targets=(Target(name="level", unit="levels"), Target(name="weight", unit="N"))),
)


@dataclass
class Toy(Source):
    num: int = 120
    vision_channels: int = 3
    touch_channels: int = 3
    damaged: tuple[int, ...] = ()
    values: bool = False
    """Also two numbers: the image's brightness in levels, and a weight in N that every third row lacks."""
    extra: dict[str, Any] = field(default_factory=dict)

    def spec(self) -> DataSpec:
        return DataSpec(
            name="toy",
            vision_channels=self.vision_channels,
            touch_channels=self.touch_channels,
            tasks=(
                Task(name="pattern", classes=("columns", "rows", "checks")),
                Task(name="bright", classes=("dark", "light")),
            ),
            values=LIGHT if self.values else (),
            group_by="instance",
            controls={"noise only": ("noise",)},
            licence="none",
            source="tests/support/toy.py",
        )

    def items(self) -> list[str]:
        return [f"item {i}" for i in range(self.num)]

    def fingerprint(self) -> dict[str, Any]:
        return {"toy": self.num, **self.extra}

    def read(self, item: int) -> list[Sample]:
        if item in self.damaged:
            raise ValueError(f"item {item} is damaged on purpose")
        rng = np.random.default_rng([7, item])
        category, instance = item % NUM_CLASSES, item // NUM_CLASSES // 2
        bright = instance % 2

        def image(channels: int) -> np.ndarray | None:
            if not channels:
                return None
            y, x = np.mgrid[0:32, 0:32]
            columns, rows = np.sin(0.8 * x + instance), np.sin(0.8 * y + instance)
            wave = (columns, rows, columns * rows)[category] * 60 + 90 + 60 * bright
            return np.clip(wave[:, :, None] + rng.normal(0, 8, (32, 32, channels)), 0, 255).astype(np.uint8)

        columns = {
            "id": f"{item:04d}",
            "group": f"{category}-{instance}",
            "touch_group": f"{category}-{instance}",
            "split": ("train", "train", "val", "test")[instance // 2 % 4],
            "label_pattern": category,
            "label_bright": bright,
            "noise": float(rng.normal()),
        }
        if self.values:
            columns["frame"] = item // NUM_CLASSES % 2  # the two of an instance
            columns["level"] = float(90 + 60 * bright + rng.normal())
            columns["weight"] = float("nan") if item % 3 == 0 else category + 0.1 * float(rng.normal())
        return [Sample(vision=image(self.vision_channels), touch=image(self.touch_channels), columns=columns)]


@dataclass
class Counting(Toy):
    """The toy, which keeps what was read of it."""

    seen: list[int] = field(default_factory=list)

    def read(self, item: int) -> list[Sample]:
        self.seen.append(item)
        return super().read(item)


def altered(source: Source, change: Callable[[Sample, int], dict[str, Any]] = lambda *_: {}, **about: Any) -> Any:
    """``source`` with other images and columns (None: without it), which ``change`` makes of a sample and the number of its
    item, and with other fields of its spec."""
    made, spec, read = copy.copy(source), replace(source.spec(), **about), source.read

    def changed(sample: Sample, item: int) -> Sample:
        new = {**sample.columns, "vision": sample.vision, "touch": sample.touch, **change(sample, item)}
        images = {m: new.pop(m) for m in ("vision", "touch")}
        return Sample(**images, columns={name: value for name, value in new.items() if value is not None})

    made.spec, made.read = lambda: spec, lambda item: [changed(sample, item) for sample in read(item)]  # type: ignore
    return made


def swapped(source: Source) -> Any:
    """The same samples with train and test the other way round."""
    other = {"train": "test", "test": "train", "val": "val"}
    return altered(source, lambda sample, _: {"split": other[sample.columns["split"]]})


def with_columns(pack: Pack, *, spec: DataSpec | None = None, **columns: Any) -> Pack:
    made, cached = copy.copy(pack), {name for name, kind in vars(Pack).items() if isinstance(kind, cached_property)}
    made.__dict__ = {name: value for name, value in vars(pack).items() if name not in cached}
    made.spec = spec or pack.spec
    made.table = pack.table.drop_columns([name for name in columns if name in pack.table.column_names])
    for name, values in columns.items():
        made.table = made.table.append_column(name, pa.array(values))
    return made


def renumbered(pack: Pack, *classes: str) -> Pack:
    """``pack``, its patterns listed as ``classes``; rows of any other have no label."""
    first, *rest = pack.spec.tasks
    numbers = np.array([classes.index(name) if name in classes else -1 for name in first.classes])
    spec = replace(pack.spec, tasks=(replace(first, classes=classes), *rest))
    return with_columns(pack, spec=spec, label_pattern=numbers[pack.column("label_pattern")])


def toy_pack(path: Path, size: int = 32, **kwargs: Any) -> Pack:
    return build(Toy(**kwargs), path, size=size, quiet=True)


class Holes(Toy):
    """Every fifth item without touch, every seventh without vision."""

    def read(self, item: int) -> list[Sample]:
        (sample,) = super().read(item)
        has = {"vision": item % 7 != 3, "touch": item % 5 != 1}
        columns = {**sample.columns, **{f"has_{m}": present for m, present in has.items()}}
        return [Sample(columns=columns, **{m: getattr(sample, m) if has[m] else None for m in has})]


def film(pack: Pack, folder: Path, *, rest: int, num: int, fps: int) -> list[str]:
    """Write folders of ``num`` frames, of which the first ``rest`` show no contact; returns the words of a command."""
    for m in ("vision", "touch"):
        (folder / m).mkdir()
        for i in range(num):
            image = pack.images[m][0] if i < rest else 255 - pack.images[m][0]
            Image.fromarray(image ^ np.uint8(i % 2)).save(folder / m / f"{i:03d}.png")
    return [word for m in ("vision", "touch") for word in (f"--{m}", f"{folder / m}@{fps}")]


def threads_of(first: int, end: int) -> Any:
    return [library["num_threads"] for library in threadpool_info()]
