"""Encoders of owners who publish touch encoders or the code that trains them, from their checkpoints.

No owner's code is used, and no owner's weights were at hand: the adapters are tested on small weights with the owners'
names and shapes, which were read, as the preprocessing, from

    Sparsh            facebookresearch/sparsh @fee6a05, huggingface.co/facebook/sparsh-*
    T3                alanzjl/t3 @341177f, huggingface.co/datasets/alanz-mit/FoundationTactile
    AnyTouch, 2       GeWu-Lab/AnyTouch @9c43a1a, GeWu-Lab/AnyTouch2 @d8a1147
    UniTouch          cfeng16/UniTouch @00d1bdc
    TVL               Max-Fu/tvl @f489503, huggingface.co/mlfu7/Touch-Vision-Language-Models
"""

import re
from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch
from timm.layers.mlp import Mlp
from torch import Tensor, nn

from mvitac.bench.external.base import START, UNKNOWN, Adapter, Loaded
from mvitac.bench.external.preprocessing import CLIP, IMAGENET, PLAIN, Preprocessing, Three
from mvitac.bench.external.tower import HEAD, Tower, depth, fill, from_clip, patches, read_tensors, tower, under
from mvitac.nn.weights import State
from mvitac.system.files import brief

VIT = {"cls_token": "front", "pos_embed": "positions", "patch_embed.proj": "embed"}
"""Names of timm's ViT -> those of ``Tower``."""
Built = tuple[nn.Module, Preprocessing, str]  # network, its preprocessing, what follows the owner's name in tables


@dataclass(frozen=True, kw_only=True)
class Owner(Adapter):
    """Base of the adapters below: what is known of an owner's files, and the network that their tensors make."""

    about: ClassVar[tuple[str, str, str]]  # name in tables, where the weights or the code are, licence of the weights

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
        title = f"{owner} {variant}".strip()
        return Loaded(network, made, title, files=files, licence=licence, source=source)


class Sparsh(Owner):
    """MAE, DINO, DINOv2, I-JEPA (a frame and the one five before it) and V-JEPA (four frames). Non-commercial.

    The configs of I-JEPA and V-JEPA set no register, but the files have one: the file decides.
    """

    name: ClassVar[str] = "sparsh"
    expects: ClassVar[str] = "a {method}_vit{small,base}.safetensors of huggingface.co/facebook/sparsh-*, not the .ckpt"
    about: ClassVar = ("Sparsh", "https://github.com/facebookresearch/sparsh", "CC-BY-NC-4.0")

    def build(self, *tensors: State) -> Built:
        own = under(tensors[0], "", {"patch_embed.proj": "embed", "register_tokens": "front"})
        bands = own.pop("pos_embed.frequency_bands")
        width, channels, *kernel = own["embed.weight"].shape
        video = len(kernel) == 3
        made = Preprocessing(  # the encoders of force fields take 224x224
            size=(320, 240), mean=PLAIN[0], std=PLAIN[1], offset=0.5, whole_levels=True, portrait=True
        )
        if video:
            made = replace(made, frames=4, stride=2, layout="video")
        else:
            made = replace(made, frames=channels // 3, stride=5)
        grid = (made.frames // kernel[0] if video else 1, *patches(self.sides(made.size), kernel[-1]))
        fixed = sines(bands, grid if video else grid[1:], width)
        network = fill(Tower(own, grid, placed=0, fixed=fixed, mean=True), own)
        return network, made, self.path().stem.removeprefix("sparsh_")


def sines(bands: Tensor, grid: tuple[int, ...], width: int) -> Tensor:
    """Positions [1, places, width]: for each axis the sines, then the cosines, of place x ``bands`` [axes, bands]."""
    axes = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in grid), indexing="ij")
    phases = torch.stack(axes, -1).flatten(0, -2)[:, :, None] * bands.float()
    return torch.cat([phases.sin(), phases.cos()], dim=2).flatten(1)[None, :, :width]


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
        own = under(tensors[0], "", VIT)
        first = depth(own)
        for name, value in tensors[1].items():
            number = re.match(r"blocks\.(\d+)\.", name)
            own[name.replace(number[0], f"blocks.{first + int(number[1])}.") if number else name] = value
        network = tower(own, self.sides)
        for norm in (m for part in (*network.blocks[first:], network.norm) for m in part.modules()):
            if isinstance(norm, nn.LayerNorm):
                norm.eps = 1e-5
        mean, std = self.statistics.get(self.sensor, IMAGENET)
        made = Preprocessing(mean=mean, std=std, shorter=256)
        return network, made, f"{self.path().name.removeprefix('t3_')} {self.sensor}"


@dataclass(frozen=True, kw_only=True)
class AnyTouch(Owner):
    """A transformer of CLIP with tokens that name the sensor.

    Its convolution in three dimensions takes [B, frame, colour, H, W]: its channels are frames and its depth is colour.
    The 2-D ``embeddings.patch_embedding`` of that file is not used.
    """

    name: ClassVar[str] = "anytouch"
    expects: ClassVar[str] = "checkpoint.pth of AnyTouch"
    about: ClassVar = ("AnyTouch", "https://github.com/GeWu-Lab/AnyTouch", UNKNOWN)
    sensor: int = -1
    """0 GelSight, 1 DIGIT, 2 GelSlim, 3 GelSight Mini, 4 DuraGel, 5 ObjectFolder 2, -1 any sensor."""

    def build(self, *tensors: State) -> Built:
        own = under(tensors[0], "touch_mae_model.")
        embed = own["video_patch_embedding.weight"]
        network = self.tower(own, embed, 1)
        return network, Preprocessing(size=network.size, frames=embed.shape[1], still=True, layout="frames"), ""

    def tower(self, tensors: State, embed: Tensor, time: int) -> Tower:
        """The transformer of ``tensors``, with patch embedding ``embed`` over ``time`` steps."""
        names = {
            "embeddings.position_embedding.weight": "positions",
            "pre_layrnorm": "pre_norm",  # the owner's spelling
            "post_layernorm": "head.0",
        }
        own = from_clip(under(tensors, "touch_model.", names))
        cls = own["embeddings.class_embedding"][None]
        front, positions = torch.cat([cls, tensors["sensor_token"][self.sensor]])[None], own["positions"][None]
        own = {name: value for name, value in own.items() if not name.startswith("embeddings.")}
        own |= {"embed.weight": embed, "head.1.weight": tensors["touch_projection.weight"]}
        return tower(own | {"front": front, "positions": positions}, self.sides, time=time, eps=1e-5, head=True)


class AnyTouch2(AnyTouch):
    """Distance of frames (stride): Touch and Go 1, force of DIGIT 2."""

    name: ClassVar[str] = "anytouch2"
    expects: ClassVar[str] = "checkpoint-4frames.pth of AnyTouch 2, or checkpoint-2frames.pth with frames=2"
    about: ClassVar = ("AnyTouch 2", "https://github.com/GeWu-Lab/AnyTouch2", UNKNOWN)

    def build(self, *tensors: State) -> Built:
        own, frames = under(tensors[0], "touch_mae_model."), self.frames or 4
        embed = own["touch_model.embeddings.patch_embedding.weight"]
        network = self.tower(own, embed, max(1, frames // embed.shape[2]))
        made = Preprocessing(
            mean=CLIP[0], std=CLIP[1], frames=frames, oldest_first=True, layout="video", offset=130 / 255
        )
        return network, replace(made, size=network.size), ""


class UniTouch(Owner):
    """The touch tower of an ImageBind model, whose code's licence is named, as that of the weights was not found.

    Its attention has one learned key and value more than tokens, and tokens are not normalised before the first block.
    """

    name: ClassVar[str] = "unitouch"
    expects: ClassVar[str] = "last_new.ckpt of huggingface.co/chfeng/Touch-LLM"
    about: ClassVar = ("UniTouch", "https://github.com/cfeng16/UniTouch", "CC-BY-NC-SA-4.0")

    def build(self, *tensors: State) -> Built:
        names = {"cls_token": "front", "rgbt_stem.proj.1": "embed", "pos_embedding_helper.pos_embed": "positions"}
        own = under(tensors[0], "modality_preprocessors.touch.", names)
        own |= under(tensors[0], "modality_trunks.touch.")
        own |= under(tensors[0], "modality_heads.touch.", {"0": "head.0", "2": "head.1"})
        width, _, frames, *_ = own["embed.weight"].shape
        network = tower(own, self.sides, head=True, scale=5.0, block=partial(BiasedBlock, width))
        made = Preprocessing(mean=CLIP[0], std=CLIP[1], frames=frames, still=True, layout="video", bicubic=True)
        return network, replace(made, size=network.size, shorter=network.size[0]), ""


class BiasedBlock(nn.Module):
    """A transformer block whose attention has a learned key and value beside those of the tokens."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm_1, self.norm_2 = nn.LayerNorm(width, eps=1e-6), nn.LayerNorm(width, eps=1e-6)
        self.attn = nn.MultiheadAttention(width, max(1, width // HEAD), add_bias_kv=True, batch_first=True)
        self.mlp = Mlp(width, 4 * width)

    def forward(self, x: Tensor) -> Tensor:
        z = self.norm_1(x)
        x = x + self.attn(z, z, z, need_weights=False)[0]
        return x + self.mlp(self.norm_2(x))


class TVL(Owner):
    """timm's ViT with a head into the space of CLIP."""

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
        own = under(tensors[0], "tactile_encoder.", {**VIT, "head": "head.1", "fc_norm": "head.0"})
        network = tower(own, self.sides, mean=True, head=True, scale=1.0)
        mean, std = (0.2917, 0.2971, 0.2910), (0.1876, 0.1947, 0.2187)
        made = Preprocessing(size=network.size, mean=mean, std=std, pad=True)
        return network, made, file.stem.removeprefix("tvl_enc_")
