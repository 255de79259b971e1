"""AnyTouch and AnyTouch 2: transformers of CLIP with tokens that name the sensor. Code MIT; licence of the weights unknown.

Names, shapes and preprocessing were read from GeWu-Lab/AnyTouch @9c43a1a and GeWu-Lab/AnyTouch2 @d8a1147. No owner's
weights were at hand; no owner's code is used. AnyTouch's convolution in three dimensions takes [B, frame, colour, H, W]:
its channels are frames and its depth is colour. The 2-D ``embeddings.patch_embedding`` of that file is not used.
"""

import re
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from mvitac.bench.external.base import Adapter, Loaded
from mvitac.bench.external.preprocessing import CLIP, Preprocessing
from mvitac.bench.external.tower import Tensors, Tower, from_clip, projection, read_tensors, shape, tower, under

START = "touch_mae_model."
NAMES = {
    "embeddings.position_embedding.weight": "positions",
    "pre_layrnorm": "pre_norm",  # the owner's spelling
    "post_layernorm": "head.0",
}
CLS = "embeddings.class_embedding"
UNUSED = r"embeddings\.(patch_embedding\.weight|position_ids|new_position_ids|class_embedding)"


@dataclass(frozen=True, kw_only=True)
class AnyTouch(Adapter):
    """AnyTouch (GeWu-Lab/AnyTouch)."""

    name: ClassVar[str] = "anytouch"
    expects: ClassVar[str] = "checkpoint.pth of AnyTouch"
    sensor: int = -1
    """0 GelSight, 1 DIGIT, 2 GelSlim, 3 GelSight Mini, 4 DuraGel, 5 ObjectFolder 2, -1 any sensor."""

    def load(self) -> Loaded:
        tensors = under(read_tensors(self.path()), START)
        kernel = shape(self, tensors, "video_patch_embedding.weight", 5)
        network = _tower(self, tensors, "video_patch_embedding.weight", 1, self.sensor)
        made = Preprocessing(size=network.size, frames=kernel[1], still=True, layout="frames")
        source = "https://github.com/GeWu-Lab/AnyTouch"
        return Loaded(network=network, preprocessing=made, title="AnyTouch", files=(self.path(),), source=source)


@dataclass(frozen=True, kw_only=True)
class AnyTouch2(Adapter):
    """AnyTouch 2 (GeWu-Lab/AnyTouch2)."""

    name: ClassVar[str] = "anytouch2"
    expects: ClassVar[str] = "checkpoint-4frames.pth of AnyTouch 2, or checkpoint-2frames.pth with frames=2"
    sensor: int = -1
    """As for AnyTouch. Distance of frames (stride): Touch and Go 1, force of DIGIT 2."""

    def load(self) -> Loaded:
        tensors, frames = under(read_tensors(self.path()), START), self.frames or 4
        name = "touch_model.embeddings.patch_embedding.weight"
        network = _tower(self, tensors, name, max(1, frames // shape(self, tensors, name, 5)[2]), self.sensor)
        made = Preprocessing(
            mean=CLIP[0], std=CLIP[1], frames=frames, oldest_first=True, layout="video", offset=130 / 255
        )
        source = "https://github.com/GeWu-Lab/AnyTouch2"
        made = replace(made, size=network.size)
        return Loaded(network=network, preprocessing=made, title="AnyTouch 2", files=(self.path(),), source=source)


def _tower(adapter: Adapter, tensors: Tensors, embed: str, time: int, sensor: int) -> Tower:
    """The transformer of ``tensors``, with patch embedding ``embed`` over ``time`` steps."""
    num = shape(adapter, tensors, "sensor_token", 3)[0]
    if not -num <= sensor < num:
        raise ValueError(f"sensor {sensor}: give -1 (any sensor) or 0 to {num - 1}")
    own = from_clip(under(tensors, "touch_model.", NAMES))
    width = shape(adapter, own, CLS, 1)[0]
    shape(adapter, own, "positions", 2)
    shape(adapter, tensors, "touch_projection.weight", 2)
    tokens = [own[CLS].reshape(1, width), tensors["sensor_token"][sensor].reshape(-1, width)]
    kept = {name: value for name, value in own.items() if not re.fullmatch(UNUSED, name)}
    kept |= {"front": torch.cat(tokens)[None], "positions": own["positions"][None], "embed.weight": tensors[embed]}
    kept["head.1.weight"] = tensors["touch_projection.weight"]
    return tower(adapter, kept, time=time, eps=1e-5, head=projection(kept, 1e-5))
