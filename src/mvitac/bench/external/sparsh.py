"""Sparsh: MAE, DINO, DINOv2, I-JEPA (two frames on 6 channels) and V-JEPA (four frames). CC-BY-NC 4.0: non-commercial.

Names, shapes and preprocessing were read from facebookresearch/sparsh @fee6a05 and the pages of
huggingface.co/facebook/sparsh-*. No owner's weights were at hand; no owner's code is used.
The configs of I-JEPA and V-JEPA set no register, but the files have one: the file decides.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from mvitac.bench.external.base import Adapter, Loaded
from mvitac.bench.external.preprocessing import PLAIN, Preprocessing
from mvitac.bench.external.tower import Tower, fill, patches, read_tensors, under

TWO = Preprocessing(
    size=(320, 240), mean=PLAIN[0], std=PLAIN[1], frames=2, stride=5, offset=0.5, whole_levels=True, portrait=True
)
"""A frame and the one five before it; the encoders of force fields take 224x224."""
NAMES = {"patch_embed.proj": "embed", "register_tokens": "front"}


@dataclass(frozen=True, kw_only=True)
class Sparsh(Adapter):
    """Sparsh (facebookresearch/sparsh)."""

    name: ClassVar[str] = "sparsh"
    expects: ClassVar[str] = "a {method}_vit{small,base}.safetensors of huggingface.co/facebook/sparsh-*, not the .ckpt"

    def load(self) -> Loaded:
        file = self.path()
        tensors = under(read_tensors(file), "", NAMES)
        bands = tensors.pop("pos_embed.frequency_bands", None)
        if bands is None or "embed.weight" not in tensors:
            raise self.refuse("it has no 'pos_embed.frequency_bands' or no 'patch_embed.proj.weight'")
        width, channels, *kernel = tensors["embed.weight"].shape
        video = len(kernel) == 3
        made = replace(TWO, frames=4, stride=2, layout="video") if video else replace(TWO, frames=channels // 3)
        grid = (made.frames // kernel[0] if video else 1, *patches(self.sides(made.size), kernel[-1]))
        fixed = sines(bands, grid if video else grid[1:], width)
        return Loaded(
            network=fill(self, Tower(tensors, grid, placed=0, fixed=fixed, mean=True), tensors),
            preprocessing=made,
            title=f"Sparsh {file.stem.removeprefix('sparsh_')}",
            files=(file,),
            licence="CC-BY-NC-4.0",
            source="https://github.com/facebookresearch/sparsh",
        )


def sines(bands: Tensor, grid: tuple[int, ...], width: int) -> Tensor:
    """Positions [1, places, width]: for each axis the sines, then the cosines, of place x ``bands`` [axes, bands]."""
    axes = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in grid), indexing="ij")
    phases = torch.stack(axes, -1).flatten(0, -2)[:, :, None] * bands.float()
    return torch.cat([phases.sin(), phases.cos()], dim=2).flatten(1)[None, :, :width]
