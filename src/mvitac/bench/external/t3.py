"""T3: one encoder per sensor and a trunk that all share. MIT.

Names, shapes and preprocessing were read from alanzjl/t3 @341177f and huggingface.co/datasets/alanz-mit/FoundationTactile.
No owner's weights were at hand; no owner's code is used.
"""

import re
from dataclasses import dataclass
from typing import ClassVar

from torch import nn

from mvitac.bench.external.base import Adapter, Loaded
from mvitac.bench.external.preprocessing import IMAGENET, Preprocessing, Three
from mvitac.bench.external.tower import depth, read_tensors, tower, under

NAMES = {"cls_token": "front", "pos_embed": "positions", "patch_embed.proj": "embed"}
STATISTICS: dict[str, tuple[Three, Three]] = {
    "digit": ((0.42094, 0.44041, 0.44151), (0.14661, 0.08972, 0.09041)),
    "gs_tag": ((0.51808, 0.50300, 0.51457), (0.13893, 0.11343, 0.13497)),
}
"""sensor -> mean and standard deviation. The owner's loader takes ImageNet's where a dataset has none."""


@dataclass(frozen=True, kw_only=True)
class T3(Adapter):
    """T3 (alanzjl/t3)."""

    name: ClassVar[str] = "t3"
    expects: ClassVar[str] = (
        "a folder such as models/t3_medium with trunk.pth and encoders/<sensor>.pth, and sensor=NAME"
    )
    sensor: str = "digit"
    """File in the folder encoders: digit, mini, gs_black, gs_tag, wedge, finray, densetact or svelte."""

    def load(self) -> Loaded:
        files = (self.path() / "encoders" / f"{self.sensor}.pth", self.path() / "trunk.pth")
        if missing := [file for file in files if not file.is_file()]:
            raise self.refuse(f"{missing[0]} does not exist")
        tensors = under(read_tensors(files[0]), "", NAMES)
        own = depth(tensors)
        for name, value in read_tensors(files[1]).items():
            number = re.match(r"blocks\.(\d+)\.", name)
            tensors[name.replace(number[0], f"blocks.{own + int(number[1])}.") if number else name] = value
        network = tower(self, tensors)
        for norm in (m for part in (*network.blocks[own:], network.norm) for m in part.modules()):
            if isinstance(norm, nn.LayerNorm):
                norm.eps = 1e-5
        mean, std = STATISTICS.get(self.sensor, IMAGENET)
        return Loaded(
            network=network,
            preprocessing=Preprocessing(mean=mean, std=std, shorter=256),
            title=f"T3 {self.path().name.removeprefix('t3_')} {self.sensor}",
            files=files,
            licence="MIT",
            source="https://huggingface.co/datasets/alanz-mit/FoundationTactile",
        )
