"""TVL's tactile encoders: timm's ViT with a head into the space of CLIP. Weights Apache-2.0, their code CC-BY-NC 4.0.

Names, shapes and preprocessing were read from Max-Fu/tvl @f489503 and huggingface.co/mlfu7/Touch-Vision-Language-Models.
No owner's weights were at hand; no owner's code is used.
"""

from dataclasses import dataclass
from typing import ClassVar

from mvitac.bench.external.base import Adapter, Loaded
from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.bench.external.tower import projection, read_tensors, tower, under

NAMES = {
    "cls_token": "front",
    "pos_embed": "positions",
    "patch_embed.proj": "embed",
    "head": "head.1",
    "fc_norm": "head.0",
}


@dataclass(frozen=True, kw_only=True)
class TVL(Adapter):
    """TVL (Max-Fu/tvl)."""

    name: ClassVar[str] = "tvl"
    expects: ClassVar[str] = "tvl_enc_{vittiny,vits,vitb}.pth of huggingface.co/mlfu7/Touch-Vision-Language-Models"

    def load(self) -> Loaded:
        file = self.path()
        if "bgs" in file.stem and not (self.mean and self.std):
            raise ValueError(
                f"{file} was trained minus a background, with its own mean and std: give mean=..., std=..."
            )
        tensors = under(read_tensors(file), "tactile_encoder.", NAMES)
        network = tower(self, tensors, mean=True, head=projection(tensors, 1e-6), scale=1.0)
        mean, std = (0.2917, 0.2971, 0.2910), (0.1876, 0.1947, 0.2187)
        return Loaded(
            network=network,
            preprocessing=Preprocessing(size=network.size, mean=mean, std=std, pad=True),
            title=f"TVL {file.stem.removeprefix('tvl_enc_')}",
            files=(file,),
            licence="Apache-2.0 (owner's code: CC-BY-NC-4.0)",
            source="https://huggingface.co/mlfu7/Touch-Vision-Language-Models",
        )
