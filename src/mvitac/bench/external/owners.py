"""Touch encoders whose owners publish them under a stated licence, from their checkpoints, as timm's vision transformers.

No owner's weights were at hand: the adapters are tested on small weights with the owners' names and shapes, which were
read, as the preprocessing, from

    Sparsh    facebookresearch/sparsh @fee6a05, huggingface.co/facebook/sparsh-*
    T3        alanzjl/t3 @341177f, huggingface.co/datasets/alanz-mit/FoundationTactile
    TVL       Max-Fu/tvl @f489503, huggingface.co/mlfu7/Touch-Vision-Language-Models
"""

import math
import re
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from timm.models.vision_transformer import VisionTransformer
from torch import Tensor, nn

from mvitac.bench.external.base import START, Adapter, Loaded
from mvitac.bench.external.preprocessing import IMAGENET, PLAIN, Preprocessing, Three
from mvitac.nn.weights import State, misfit, read_tensors
from mvitac.system.files import brief

Built = tuple[
    VisionTransformer, Preprocessing, str
]  # network, its preprocessing, what follows the owner's name in tables


@dataclass(frozen=True, kw_only=True)
class Owner(Adapter):
    """Base of the adapters below: what is known of an owner's files, and the network that their tensors make."""

    about: ClassVar[tuple[str, str, str]]  # name in tables, where the weights are, their licence

    @abstractmethod
    def build(self, *tensors: State) -> Built:
        """The network of the ``tensors`` of each file; any error if they are of another one."""

    def files(self) -> tuple[Path, ...]:
        return (self.path(),)

    def load(self) -> Loaded:
        files = self.files()
        read = [read_tensors(file) for file in files]
        try:
            network, made, variant = self.build(*read)
        except (LookupError, RuntimeError, ValueError) as error:
            why = f"no {brief(error)}" if isinstance(error, KeyError) else brief(error)
            raise ValueError(f"{self.place} is not for {START}{self.name} ({why}): give {self.expects}") from None
        owner, source, licence = self.about
        return Loaded(network, made, f"{owner} {variant}", files=files, licence=licence, source=source)

    def square(self, tensors: State, **options: Any) -> VisionTransformer:
        """The transformer of ``tensors`` with learned positions over a square grid, at the size that is asked for."""
        grid = math.isqrt(tensors["pos_embed"].shape[1])
        side = grid * tensors["patch_embed.proj.weight"].shape[-1]
        network = transformer(tensors, img_size=side, **options)
        network.set_input_size(self.sides((side, side)))
        return network


def transformer(tensors: State, **options: Any) -> VisionTransformer:
    """timm's vision transformer with exactly ``tensors`` as its weights, from which its width and depth are taken."""
    width, channels, patch, _ = tensors["patch_embed.proj.weight"].shape
    depth = 1 + max((int(name.split(".")[1]) for name in tensors if name.startswith("blocks.")), default=-1)
    heads = max(1, width // 64)  # as in ViT-Ti, S, B and L
    about = {"patch_size": patch, "in_chans": channels, "embed_dim": width, "depth": depth, "num_heads": heads}
    network = VisionTransformer(**about, num_classes=options.pop("num_classes", 0), **options)
    if why := misfit(network.state_dict(), tensors):
        raise ValueError(why)
    network.load_state_dict(tensors)
    return network


class Sparsh(Owner):
    """MAE, DINO, DINOv2 and I-JEPA: a frame and the one five before it. Non-commercial.

    The configs of I-JEPA set no register, but the files have one: the file decides.
    """

    name: ClassVar[str] = "sparsh"
    expects: ClassVar[str] = "a {mae,dino,dinov2,ijepa}_vit{small,base}.safetensors of huggingface.co/facebook/sparsh-*"
    about: ClassVar = ("Sparsh", "https://github.com/facebookresearch/sparsh", "CC-BY-NC-4.0")

    def build(self, *tensors: State) -> Built:
        own = {name.replace("register_tokens", "reg_token"): value for name, value in tensors[0].items()}
        bands = own.pop("pos_embed.frequency_bands")
        _, channels, patch, _ = own["patch_embed.proj.weight"].shape
        made = Preprocessing(  # the encoders of force fields take 224x224
            size=(320, 240),
            mean=PLAIN[0],
            std=PLAIN[1],
            frames=channels // 3,
            stride=5,
            offset=0.5,
            whole_levels=True,
            portrait=True,
        )
        size = self.sides(made.size)
        own["pos_embed"] = sines(bands, (size[0] // patch, size[1] // patch))
        registers = own["reg_token"].shape[1] if "reg_token" in own else 0
        options = {"img_size": size, "class_token": False, "reg_tokens": registers, "no_embed_class": True}
        network = transformer(own, **options, global_pool="avg", fc_norm=False, init_values=1.0)
        del network.pos_embed  # computed: no weights
        network.register_buffer("pos_embed", own["pos_embed"])
        return network, made, self.path().stem.removeprefix("sparsh_")


def sines(bands: Tensor, grid: tuple[int, int]) -> Tensor:
    """Positions [1, places, D]: for row, then column, the sines, then the cosines, of place x ``bands`` [2, D / 4]."""
    axes = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in grid), indexing="ij")
    phases = torch.stack(axes, -1).flatten(0, -2)[:, :, None] * bands.float()
    return torch.cat([phases.sin(), phases.cos()], dim=2).flatten(1)[None]


@dataclass(frozen=True, kw_only=True)
class T3(Owner):
    """One encoder per sensor and a trunk that all share. Its loader takes ImageNet's statistics where it has none."""

    name: ClassVar[str] = "t3"
    expects: ClassVar[str] = (
        "a folder such as models/t3_medium with trunk.pth and encoders/<sensor>.pth, and sensor=NAME"
    )
    about: ClassVar = ("T3", "https://huggingface.co/datasets/alanz-mit/FoundationTactile", "MIT")
    statistics: ClassVar[dict[str, tuple[Three, Three]]] = {
        "digit": ((0.42094, 0.44041, 0.44151), (0.14661, 0.08972, 0.09041)),
        "gs_tag": ((0.51808, 0.50300, 0.51457), (0.13893, 0.11343, 0.13497)),
    }
    sensor: str = "digit"
    """File in the folder encoders: digit, mini, gs_black, gs_tag, wedge, finray, densetact or svelte."""

    def files(self) -> tuple[Path, ...]:
        return (self.path() / "encoders" / f"{self.sensor}.pth", self.path() / "trunk.pth")

    def build(self, *tensors: State) -> Built:
        own = dict(tensors[0])
        first = 1 + max(int(name.split(".")[1]) for name in own if name.startswith("blocks."))
        for name, value in tensors[1].items():
            number = re.match(r"blocks\.(\d+)\.", name)
            own[name.replace(number[0], f"blocks.{first + int(number[1])}.") if number else name] = value
        network = self.square(own)
        for norm in (m for part in (network.blocks[first:], network.norm) for m in part.modules()):
            if isinstance(norm, nn.LayerNorm):
                norm.eps = 1e-5
        mean, std = self.statistics.get(self.sensor, IMAGENET)
        made = Preprocessing(mean=mean, std=std, shorter=256)
        return network, made, f"{self.path().name.removeprefix('t3_')} {self.sensor}"


class TVL(Owner):
    """timm's ViT with a head into the space of CLIP, where features have unit length."""

    name: ClassVar[str] = "tvl"
    expects: ClassVar[str] = "tvl_enc_{vittiny,vits,vitb}.pth of huggingface.co/mlfu7/Touch-Vision-Language-Models"
    about: ClassVar = (
        "TVL",
        "https://huggingface.co/mlfu7/Touch-Vision-Language-Models",
        "Apache-2.0 (owner's code: CC-BY-NC-4.0)",
    )

    def build(self, *tensors: State) -> Built:
        file = self.path()
        if "bgs" in file.stem and not (self.mean and self.std):
            raise ValueError("it was trained minus a background, with its own statistics: give mean=..., std=...")
        start = "model.tactile_encoder."
        own = {name.removeprefix(start): value for name, value in tensors[0].items() if name.startswith(start)}
        network = self.square(own, global_pool="avg", num_classes=len(own["head.weight"]))
        network.head = nn.Sequential(network.head, Unit())  # type: ignore[assignment]
        mean, std = (0.2917, 0.2971, 0.2910), (0.1876, 0.1947, 0.2187)
        made = Preprocessing(size=network.patch_embed.img_size, mean=mean, std=std, pad=True)
        return network, made, file.stem.removeprefix("tvl_enc_")


class Unit(nn.Module):
    """Features of length 1."""

    def forward(self, x: Tensor) -> Tensor:
        return F.normalize(x, dim=1)
