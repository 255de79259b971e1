"""Masked Vision Transformers: random numbers of each row, encoding a part of the patches, predicting the others.

Shapes: B images, F prefix tokens (class, registers), N patches in rows and columns, K visible, T predicted, D features.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from timm.layers import PatchEmbed  # pyright: ignore[reportPrivateImportUsage]
from timm.models.vision_transformer import Block, VisionTransformer
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.nn.encoders import SCRATCH, EncoderConfig, Encoders, build_trunk, sin_cos_positions

_GOLDEN, _MULTIPLIERS = -0x61C8864680B583EB, (-0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15)
"""The constants of SplitMix64 (Steele et al., OOPSLA 2014) as signed numbers."""


def row_uniform(seed: Tensor, rows: Int[Tensor, " B"], num: int, stream: int) -> Float[Tensor, "B {num}"]:
    """Uniform numbers in [0, 1) that are a function of (seed, row, stream), on the device of ``rows``.

    They are the same in whatever chunk, process or order a row is read. SplitMix64 hashes the numbers. ``seed`` is
    ``Views.seed``; each use has a ``stream`` of its own.
    """
    row_key = _hash(_hash(_hash(seed) + stream) + rows)
    key = _hash(row_key[:, None] + torch.arange(num, device=rows.device) * _GOLDEN)
    return ((key >> 40) & 0xFFFFFF).float() / (1 << 24)


def _hash(x: Tensor) -> Tensor:
    """SplitMix64's finaliser; products wrap around, and shifts bring in zeros."""
    x = x + _GOLDEN
    for shift, multiplier in zip((30, 27), _MULTIPLIERS, strict=True):
        x = (x ^ ((x >> shift) & ((1 << (64 - shift)) - 1))) * multiplier
    return x ^ ((x >> 31) & ((1 << 33) - 1))


def check_vit(config: EncoderConfig, method: str, size: int) -> None:
    """Raise ValueError unless ``config`` names a plain ViT that cuts views of ``size`` px into 2 x 2 patches or more."""
    with torch.device("meta"):
        vit = _plain(build_trunk(EncoderConfig(trunk=config.trunk, weights=SCRATCH), 3), config.trunk, method)
    if size <= vit.patch_embed.patch_size[0]:
        one = f"views of {size} px are a single patch of trunk {config.trunk}, and {method!r} hides patches from others"
        raise ValueError(f"{one}: give --augment.size {size * 2} or more")


def _plain(trunk: nn.Module, name: str, method: str) -> VisionTransformer:
    if not (isinstance(trunk, VisionTransformer) and isinstance(trunk.patch_embed, PatchEmbed)):
        given = f"method {method!r} needs a plain ViT, and trunk {name} is a {type(trunk).__name__}"
        raise ValueError(f"{given}: give --encoder.trunk mvitac_vit --encoder.weights scratch")
    return trunk


def build_vits(config: Encoders, spec: DataSpec, method: str) -> nn.ModuleDict:
    """A ViT per modality of ``spec``, whose features are the mean over its patches, as no class token is trained here.

    ValueError if the trunk is no plain ViT, or does not read the frames of a window together.
    """
    trunks = nn.ModuleDict()
    for modality in spec.modalities:
        own = config[modality]
        if spec.frames(modality) > 1 and own.temporal == "mean":
            raise ValueError(f"method {method!r} reads the frames of a window together: give --encoder.temporal stack")
        trunks[modality] = _plain(build_trunk(own, spec.channels(modality)), own.trunk, method)
        vit_of(trunks[modality]).reset_classifier(0, "avg")
    return trunks


def vit_of(trunk: nn.Module) -> VisionTransformer:
    return trunk  # type: ignore[return-value]


def grid_of(trunk: nn.Module, images: Tensor) -> tuple[int, int]:
    """Rows and columns of the patches of ``images``."""
    side = vit_of(trunk).patch_embed.patch_size[0]
    return -(-images.shape[2] // side), -(-images.shape[3] // side)


def patches(trunk: nn.Module, images: Tensor) -> Float[Tensor, "B N P"]:
    """The pixels of each patch, P = C x side x side. Like timm's ViT, images are padded at the bottom and the right."""
    side = vit_of(trunk).patch_embed.patch_size[0]
    return F.unfold(F.pad(images, (0, -images.shape[3] % side, 0, -images.shape[2] % side)), side, stride=side).mT


def take(tokens: Float[Tensor, "B N D"], at: Int[Tensor, "B K"]) -> Float[Tensor, "B K D"]:
    return tokens.gather(1, at[:, :, None].expand(-1, -1, tokens.shape[2]))


@dataclass(frozen=True)
class Tokens:
    """Output tokens of a ViT that saw a part of the patches: its prefix tokens, then those patches."""

    values: Float[Tensor, "B F+K D"]
    at: Int[Tensor, "B K"]  # the patch of each token after the prefix
    grid: tuple[int, int]  # rows and columns of all patches
    live: Bool[Tensor, "B F+K"] | None = None  # which of them count. None = all.


def encode_visible(
    trunk: nn.Module, images: Tensor, at: Int[Tensor, "B K"], live: Bool[Tensor, "B K"] | None = None
) -> Tokens:
    """The normalised output tokens of a ViT that sees only the patches ``at``, each with its own position.

    ``live`` says which of ``at`` count; no token attends to the others.
    """
    vit = vit_of(trunk)
    tokens, front = vit.norm_pre(vit._pos_embed(vit.patch_embed(images))), vit.num_prefix_tokens
    tokens = torch.cat([tokens[:, :front], take(tokens[:, front:], at)], dim=1)
    live = None if live is None else F.pad(live, (front, 0), value=True)
    return Tokens(vit.norm(_pass(vit.blocks, tokens, live)), at, grid_of(trunk, images), live)


def _pass(blocks: nn.Sequential, tokens: Tensor, live: Tensor | None) -> Tensor:
    """``tokens`` [B, L, D] through transformer blocks, in which no token attends to one that is not ``live`` [B, L]."""
    mask = None if live is None else torch.where(live, 0.0, -torch.inf)[:, None, None]
    for block in blocks:
        tokens = block(tokens, attn_mask=mask)
    return tokens


class Predictor(nn.Module):
    """A narrow ViT that predicts something about hidden patches from visible ones (MAE's decoder, I-JEPA's predictor).

    A hidden patch is a learned mask token plus the fixed sine-cosine embedding of its position. ``out``: width of the
    predictions. Its width and number of blocks are ``share`` of the trunk's, in whole heads of 32, up to ``most``.
    """

    def __init__(self, trunk: nn.Module, out: int, share: float, most: tuple[int, int]) -> None:
        super().__init__()
        vit = vit_of(trunk)
        width = min(most[0], 32 * max(1, round(vit.embed_dim * share / 32)))
        depth = min(most[1], max(1, round(len(vit.blocks) * share)))
        self.embed = nn.Linear(vit.embed_dim, width)
        self.mask_token = nn.Parameter(torch.zeros(1, 1, 1, width))
        norm: Any = partial(nn.LayerNorm, eps=1e-6)
        self.blocks = nn.Sequential(*(Block(width, width // 32, qkv_bias=True, norm_layer=norm) for _ in range(depth)))
        self.norm = norm(width)
        self.out = nn.Linear(width, out)
        nn.init.normal_(self.mask_token, std=0.02)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.trunc_normal_(layer.weight, std=0.02)
                nn.init.zeros_(layer.bias)

    def forward(
        self, seen: Tokens, hidden: Int[Tensor, "B M T"], live: Bool[Tensor, "B M T"] | None = None
    ) -> Float[Tensor, "B M T O"]:
        """Predict each of M sets of ``hidden`` patches on its own, from the visible tokens ``seen``.

        ``live`` says which of ``hidden`` count, if ``seen`` says it of the visible ones. No token attends to others.
        """
        positions = sin_cos_positions(*seen.grid, self.mask_token.shape[3], hidden.device)
        front = seen.values.shape[1] - seen.at.shape[1]
        known = self.embed(seen.values) + F.pad(positions[seen.at], (0, 0, front, 0))
        num_sets, length = hidden.shape[1:]
        masked = (self.mask_token + positions[hidden]).to(known.dtype)
        tokens = torch.cat([known[:, None].expand(-1, num_sets, -1, -1), masked], dim=2).flatten(0, 1)
        shown = None
        if live is not None:
            assert seen.live is not None
            shown = torch.cat([seen.live[:, None].expand(-1, num_sets, -1), live], dim=2).flatten(0, 1)
        return self.out(self.norm(_pass(self.blocks, tokens, shown)[:, -length:])).unflatten(0, (-1, num_sets))
