"""Small checkpoints with the names and shapes of other people's encoders, and their networks written out.

The networks are written from the owners' names and shapes, with loops and without the code under test.
"""

import math
from collections.abc import Callable
from itertools import product
from pathlib import Path

import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor

Weights = dict[str, Tensor]
D, HEADS, GRID = 128, 2, 3


def drawn(shapes: dict[str, tuple[int, ...]]) -> Weights:
    """Random weights; scales are near 1, so that no part of a network vanishes."""
    generator = torch.Generator().manual_seed(0)
    return {n: torch.randn(shape, generator=generator) * 0.1 + ("norm" in n) for n, shape in shapes.items()}


def pair(name: str, *shape: int) -> dict[str, tuple[int, ...]]:
    """Shapes of a weight and its bias."""
    return {f"{name}.weight": shape, f"{name}.bias": shape[:1]}


def block(prefix: str, names: dict[str, str]) -> dict[str, tuple[int, ...]]:
    """Shapes of one block under the owner's names."""
    shapes = {"n1": (D,), "qkv": (3 * D, D), "out": (D, D), "n2": (D,), "fc1": (4 * D, D), "fc2": (D, 4 * D)}
    made = {}
    for part, name in names.items():
        made |= {prefix + name: (D,)} if part in ("ls1", "ls2") else pair(prefix + name, *shapes[part])
    return made


TIMM = {"n1": "norm1", "qkv": "attn.qkv", "out": "attn.proj", "n2": "norm2", "fc1": "mlp.fc1", "fc2": "mlp.fc2"}
SCALED = {**TIMM, "ls1": "ls1.gamma", "ls2": "ls2.gamma"}


def through(x: Tensor, w: Weights, prefix: str, names: dict[str, str], eps: float) -> Tensor:
    """One block, head by head."""

    def linear(z: Tensor, part: str) -> Tensor:
        weight, bias = (w[name] for name in pair(prefix + names[part]))
        return z @ weight.T + bias

    z = norm(x, w, prefix + names["n1"], eps)
    q, k, v = linear(z, "qkv").chunk(3, dim=2)
    each = []
    for h in range(HEADS):
        part = slice(h * D // HEADS, (h + 1) * D // HEADS)
        weights = (q[:, :, part] @ k[:, :, part].mT / math.sqrt(D // HEADS)).softmax(dim=2)
        each.append(weights @ v[:, :, part])
    scale = (lambda n: w[prefix + names[n]]) if "ls1" in names else (lambda n: 1.0)
    x = x + scale("ls1") * linear(torch.cat(each, dim=2), "out")
    return x + scale("ls2") * linear(F.gelu(linear(norm(x, w, prefix + names["n2"], eps), "fc1")), "fc2")


def patches(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Tokens [B, places, D] of images [B, C, H, W], one product per patch."""
    p = weight.shape[-1]
    starts = product(range(0, x.shape[2], p), range(0, x.shape[3], p))
    pieces = [x[:, :, i : i + p, j : j + p].flatten(1) for i, j in starts]
    return torch.stack([piece @ weight.flatten(1).T + bias for piece in pieces], dim=1)


def norm(x: Tensor, w: Weights, name: str, eps: float) -> Tensor:
    return F.layer_norm(x, (D,), w[f"{name}.weight"], w[f"{name}.bias"], eps)


def before(z: Tensor, token: Tensor) -> Tensor:
    """``z`` [B, N, D] behind ``token`` [1, 1, D], the same for each image."""
    return torch.cat([token.expand(len(z), -1, -1), z], dim=1)


def sparsh(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    shapes = {"register_tokens": (1, 1, D)} | pair("patch_embed.proj", D, 6, 16, 16) | pair("norm", D)
    w = drawn(shapes | block("blocks.0.", SCALED) | block("blocks.1.", SCALED))
    bands = D // 4
    w["pos_embed.frequency_bands"] = (10000.0 ** (-torch.arange(bands) / bands)).repeat(2, 1)
    file = folder / "dino_vitbase.safetensors"
    safetensors.torch.save_file(w, file)

    def slow(x: Tensor) -> Tensor:
        z = patches(x, w["patch_embed.proj.weight"], w["patch_embed.proj.bias"])
        for n, place in enumerate(product(range(4), range(3))):
            waves = [f(at / 10000 ** (i / bands)) for at in place for f in (math.sin, math.cos) for i in range(bands)]
            z[:, n] += torch.tensor(waves)
        z = before(z, w["register_tokens"])
        for b in range(2):
            z = through(z, w, f"blocks.{b}.", SCALED, 1e-6)
        return norm(z, w, "norm", 1e-6)[:, 1:].mean(1)

    return f"external:sparsh:{file},size=64x48", slow


def t3(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    first = {"cls_token": (1, 1, D), "pos_embed": (1, 1 + GRID**2, D)} | pair("patch_embed.proj", D, 3, 16, 16)
    own = drawn(first | block("blocks.0.", TIMM))
    trunk = drawn(block("blocks.0.", TIMM) | block("blocks.1.", TIMM) | pair("norm", D))
    (folder / "t3_tiny/encoders").mkdir(parents=True)
    torch.save(own, folder / "t3_tiny/encoders/gs_tag.pth")
    torch.save(trunk, folder / "t3_tiny/trunk.pth")

    def slow(x: Tensor) -> Tensor:
        z = patches(x, own["patch_embed.proj.weight"], own["patch_embed.proj.bias"])
        z = through(before(z, own["cls_token"]) + own["pos_embed"], own, "blocks.0.", TIMM, 1e-6)
        for b in range(2):
            z = through(z, trunk, f"blocks.{b}.", TIMM, 1e-5)
        return norm(z, trunk, "norm", 1e-5)[:, 0]

    return f"external:t3:{folder / 't3_tiny'},sensor=gs_tag,size=48", slow


def tvl(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    shapes = {"cls_token": (1, 1, D), "pos_embed": (1, 1 + GRID**2, D)} | pair("patch_embed.proj", D, 3, 16, 16)
    w = drawn(shapes | pair("fc_norm", D) | pair("head", 32, D) | block("blocks.0.", TIMM))
    found = {f"tactile_encoder.{name}": value for name, value in w.items()} | {"logit_scale": torch.ones(())}
    torch.save({"model": found, "epoch": 3}, folder / "tvl_enc_vits.pth")

    def slow(x: Tensor) -> Tensor:
        z = patches(x, w["patch_embed.proj.weight"], w["patch_embed.proj.bias"])
        z = through(before(z, w["cls_token"]) + w["pos_embed"], w, "blocks.0.", TIMM, 1e-6)
        z = norm(z[:, 1:].mean(1), w, "fc_norm", 1e-6) @ w["head.weight"].T + w["head.bias"]
        return z / z.norm(dim=1, keepdim=True)

    return f"external:tvl:{folder / 'tvl_enc_vits.pth'}", slow


OWNERS = (sparsh, t3, tvl)
