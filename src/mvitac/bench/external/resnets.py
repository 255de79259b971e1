"""ResNets of MViTac's notebooks and of Touch and Go's CMC.

Names, shapes and preprocessing were read from ligerfotis/mvitac @a5b572d (MIT by its README) and
fredfyyang/Touch-and-Go @d62e871 (BSD-2). Neither owner publishes weights: these are for files of one's own runs of their
code. No owner's code is used. MViTac's notebooks number the stages of torchvision's ResNet (``4.0.conv1.weight``), with
or without a name in front; with strict=False they would load nothing.
"""

import re
from dataclasses import dataclass
from typing import ClassVar

from mvitac.bench.external.base import UNKNOWN, Adapter, Loaded
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.bench.external.tower import Tensors, read_tensors, resnet, under

NUMBERS = {"0": "conv1", "1": "bn1", "4": "layer1", "5": "layer2", "6": "layer3", "7": "layer4"}
TOWERS = {"touch": "encoder.module.touch_to_image.", "vision": "encoder.module.image_to_touch."}


@dataclass(frozen=True, kw_only=True)
class Notebooks(Adapter):
    """The released MViTac notebooks (ligerfotis/mvitac)."""

    name: ClassVar[str] = "mvitac-notebooks"
    expects: ClassVar[str] = "state_dict_tac or state_dict_vis (with reads=vision) of its notebooks"

    def load(self) -> Loaded:
        tensors = read_tensors(self.path())
        if not any(name == "0.weight" for name in tensors):
            tensors = {re.sub(r"^[a-z]\w*\.", "", name): value for name, value in tensors.items()}
        made = under(tensors, "", NUMBERS)
        return _loaded(self, made, 256, "MViTac notebooks", "https://github.com/ligerfotis/mvitac")


@dataclass(frozen=True, kw_only=True)
class TouchAndGoCMC(Adapter):
    """CMC of Touch and Go (fredfyyang/Touch-and-Go). Its random crops and flips at test time are left out."""

    name: ClassVar[str] = "touch-and-go-cmc"
    expects: ClassVar[str] = "a checkpoint of its CMC code, with reads=touch or reads=vision"

    def load(self) -> Loaded:
        if self.reads == "both":
            raise ValueError(f"{self.name} has an encoder for each sense: give reads=touch or reads=vision")
        tensors = under(read_tensors(self.path()), TOWERS[self.reads])
        kept = {name: value for name, value in tensors.items() if not name.startswith("fc.")}
        return _loaded(self, kept, 224, "Touch and Go CMC", "https://github.com/fredfyyang/Touch-and-Go")


def _loaded(adapter: Adapter, tensors: Tensors, side: int, title: str, source: str) -> Loaded:
    network = resnet(adapter, tensors)
    frames = tensors["conv1.weight"].shape[1] // 3
    made = Preprocessing(size=(side, side), frames=frames)
    return Loaded(
        network=network, preprocessing=made, title=title, files=(adapter.path(),), licence=UNKNOWN, source=source
    )
