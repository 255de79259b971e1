"""A vision transformer as checkpoint files describe it, and the reading of such files.

Widths and depths are taken from the file. A head has 64 channels in every transformer here, as in ViT-Ti, S, B and L.
"""

import math
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from timm.models.vision_transformer import Block
from torch import Tensor, nn

from mvitac.nn import weights
from mvitac.nn.weights import State, misfit

HEAD = 64  # channels of an attention head


def read_tensors(file: Path) -> State:
    """The tensors of a checkpoint, those below "state_dict" or "model" if it has such an entry (``nn.weights``)."""
    tensors = weights.read_tensors(file)
    for entry in ("state_dict.", "model."):
        tensors = under(tensors, entry) or tensors
    return tensors


def under(tensors: State, start: str, names: Mapping[str, str] = {}) -> State:
    """State whose name begins with ``start``, without it; leading parts of names are exchanged as in ``names``."""
    found = {name.removeprefix(start): value for name, value in tensors.items() if name.startswith(start)}
    for old, new in names.items():
        found = {re.sub(rf"^{re.escape(old)}(?=\.|$)", new, name): value for name, value in found.items()}
    return found


def depth(tensors: State) -> int:
    """Number of blocks."""
    return 1 + max((int(name.split(".")[1]) for name in tensors if name.startswith("blocks.")), default=-1)


def fill(network: nn.Module, tensors: State) -> Any:
    """``network`` with exactly ``tensors`` as its weights; ValueError if names or shapes differ."""
    if why := misfit(network.state_dict(), tensors):
        raise ValueError(why)
    network.load_state_dict(tensors)
    return network


def from_clip(tensors: State) -> State:
    """Layers of Hugging Face's CLIP (``encoder.layers.N.self_attn.q_proj``) under the names of timm's blocks."""
    found: State = {}
    for name, value in tensors.items():
        name = re.sub(r"^encoder\.layers\.", "blocks.", name)
        name = re.sub(r"\.layer_norm([12])\.", r".norm\1.", name).replace(".self_attn.out_proj.", ".attn.proj.")
        found[name.replace(".self_attn.", ".attn.")] = value
    for name in [name for name in found if ".attn.q_proj." in name]:
        parts = [found.pop(name.replace("q_proj", f"{part}_proj")) for part in "qkv"]
        found[name.replace("q_proj", "qkv")] = torch.cat(parts)
    return found


class Tower(nn.Module):
    """A vision transformer with the interface of timm's: a patch embedding, tokens in front, blocks, a head.

    Its tensors are ``embed``, ``front`` (class, registers, sensor), ``positions``, ``pre_norm``, ``blocks`` (timm's),
    ``norm`` and ``head``. All sizes are those of given tensors.

    Args:
        tensors: Weights under these names.
        grid: Steps of time, rows and columns of the patches.
        placed: The first tokens in front that have a position.
        fixed: Positions [1, places, D] that are computed. None: learned.
        eps: Of every normalisation.
        mean: Features are the mean of the places, not the first token.
        head: Whether a normalisation and a linear layer follow the features.
        scale: If given, features have this length.
        block: Makes a block; default: timm's.
    """

    def __init__(
        self,
        tensors: State,
        grid: tuple[int, int, int],
        *,
        placed: int = 1,
        fixed: Tensor | None = None,
        eps: float = 1e-6,
        mean: bool = False,
        head: bool = False,
        scale: float | None = None,
        block: Any = None,
    ) -> None:
        super().__init__()
        width, channels, *kernel = tensors["embed.weight"].shape
        conv = nn.Conv3d if len(kernel) == 3 else nn.Conv2d
        self.embed = conv(channels, width, tuple(kernel), tuple(kernel), bias="embed.bias" in tensors)  # type: ignore[arg-type]
        self.grid, self.patch, self.placed, self.mean, self.scale = grid, kernel[-1], placed, mean, scale
        self.num_features = width
        self.num_prefix_tokens = tensors["front"].shape[1] if "front" in tensors else 0
        if self.num_prefix_tokens:
            self.front = nn.Parameter(torch.zeros(1, self.num_prefix_tokens, width))
        if fixed is None:
            self.positions = nn.Parameter(torch.zeros(1, placed + math.prod(grid), width))
        else:
            self.register_buffer("positions", fixed, persistent=False)
        norm: Any = partial(nn.LayerNorm, eps=eps)
        start = 1.0 if "blocks.0.ls1.gamma" in tensors else None
        usual = partial(Block, width, max(1, width // HEAD), qkv_bias=True, init_values=start, norm_layer=norm)
        self.pre_norm = norm(width) if "pre_norm.weight" in tensors else nn.Identity()
        self.blocks = nn.ModuleList((block or usual)() for _ in range(depth(tensors)))
        self.norm = norm(width) if "norm.weight" in tensors else nn.Identity()
        self.head = nn.Identity()
        if head:
            out, width = tensors["head.1.weight"].shape
            self.head = nn.Sequential(norm(width), nn.Linear(width, out, bias="head.1.bias" in tensors))

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of its images."""
        return self.patch * self.grid[1], self.patch * self.grid[2]

    def forward_features(self, images: Tensor) -> Tensor:
        """Tokens [B, front + places, D]."""
        x = self.embed(images).flatten(2).mT + self.positions[:, self.placed :]
        if self.num_prefix_tokens:
            placed = F.pad(self.positions[:, : self.placed], (0, 0, 0, self.num_prefix_tokens - self.placed))
            x = torch.cat([(self.front + placed).expand(len(x), -1, -1), x], dim=1)
        x = self.pre_norm(x)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)

    def forward(self, images: Tensor) -> Tensor:
        """Features [B, D]."""
        tokens = self.forward_features(images)
        z = self.head(tokens[:, self.num_prefix_tokens :].mean(1) if self.mean else tokens[:, 0])
        return z if self.scale is None else self.scale * F.normalize(z, dim=1)

    def resize(self, size: tuple[int, int]) -> "Tower":
        """This tower for images of another size: learned positions are interpolated."""
        places = self.positions[0, self.placed :].unflatten(0, self.grid).permute(0, 3, 1, 2)
        grid = patches(size, self.patch)
        places = F.interpolate(places, grid, mode="bicubic", antialias=True).permute(0, 2, 3, 1).flatten(0, 2)
        self.positions = nn.Parameter(torch.cat([self.positions[:, : self.placed], places[None]], dim=1).detach())
        self.grid = (self.grid[0], *grid)
        return self


def patches(size: tuple[int, int], patch: int) -> tuple[int, int]:
    """Rows and columns of patches in an image."""
    if size[0] % patch or size[1] % patch:
        raise ValueError(f"size {size[0]}x{size[1]}: give multiples of {patch}, the side of a patch")
    return size[0] // patch, size[1] // patch


def tower(
    tensors: State, sides: Callable[[tuple[int, int]], tuple[int, int]], *, time: int = 1, **options: Any
) -> Tower:
    """The ``Tower`` of ``tensors`` with learned positions over a square grid, at the size that ``sides`` says."""
    num = tensors["positions"].shape[1] - 1
    side = math.isqrt(num // time)
    if num < 1 or side * side * time != num:
        raise ValueError(f"positions for {num} places are no square grid at {time} steps of time")
    made: Tower = fill(Tower(tensors, (time, side, side), **options), tensors)
    return made if (size := sides(made.size)) == made.size else made.resize(size)
