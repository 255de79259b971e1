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
    """Shapes of a weight and its bias; ``*`` is where the owner's names tell them apart."""
    pattern = name if "*" in name else f"{name}.*"
    return {pattern.replace("*", "weight"): shape, pattern.replace("*", "bias"): shape[:1]}


def block(prefix: str, names: dict[str, str]) -> dict[str, tuple[int, ...]]:
    """Shapes of one block under the owner's names."""
    shapes = {"n1": (D,), "qkv": (3 * D, D), "q": (D, D), "k": (D, D), "v": (D, D), "out": (D, D), "n2": (D,)}
    shapes |= {"fc1": (4 * D, D), "fc2": (D, 4 * D)}
    alone = {"ls1": (D,), "ls2": (D,), "bias_k": (1, 1, D), "bias_v": (1, 1, D)}
    made = {}
    for part, name in names.items():
        made |= {prefix + name: alone[part]} if part in alone else pair(prefix + name, *shapes[part])
    return made


TIMM = {"n1": "norm1", "qkv": "attn.qkv", "out": "attn.proj", "n2": "norm2", "fc1": "mlp.fc1", "fc2": "mlp.fc2"}
SCALED = {**TIMM, "ls1": "ls1.gamma", "ls2": "ls2.gamma"}
CLIP = {"n1": "layer_norm1", "n2": "layer_norm2", "fc1": "mlp.fc1", "fc2": "mlp.fc2"}
CLIP |= {part: f"self_attn.{part}_proj" for part in ("q", "k", "v", "out")}
BIND = {"n1": "norm_1", "n2": "norm_2", "fc1": "mlp.fc1", "fc2": "mlp.fc2", "qkv": "attn.in_proj_*"}
BIND |= {"out": "attn.out_proj", "bias_k": "attn.bias_k", "bias_v": "attn.bias_v"}


def through(x: Tensor, w: Weights, prefix: str, names: dict[str, str], eps: float) -> Tensor:
    """One block, head by head."""

    def linear(z: Tensor, part: str) -> Tensor:
        weight, bias = (w[name] for name in pair(prefix + names[part]))
        return z @ weight.T + bias

    z = norm(x, w, prefix + names["n1"], eps)
    q, k, v = linear(z, "qkv").chunk(3, dim=2) if "qkv" in names else (linear(z, part) for part in "qkv")
    if "bias_k" in names:
        k, v = (after(t, w[prefix + names[n]]) for t, n in ((k, "bias_k"), (v, "bias_v")))
    each = []
    for h in range(HEADS):
        part = slice(h * D // HEADS, (h + 1) * D // HEADS)
        weights = (q[:, :, part] @ k[:, :, part].mT / math.sqrt(D // HEADS)).softmax(dim=2)
        each.append(weights @ v[:, :, part])
    scale = (lambda n: w[prefix + names[n]]) if "ls1" in names else (lambda n: 1.0)
    x = x + scale("ls1") * linear(torch.cat(each, dim=2), "out")
    return x + scale("ls2") * linear(F.gelu(linear(norm(x, w, prefix + names["n2"], eps), "fc1")), "fc2")


def patches(x: Tensor, weight: Tensor, bias: Tensor | float = 0.0) -> Tensor:
    """Tokens [B, places, D] of images or clips [B, C, (T,) H, W], one product per patch."""
    if x.ndim == 4:
        x, weight = x.unsqueeze(2), weight.unsqueeze(2)
    t, p = weight.shape[2], weight.shape[-1]
    tokens = []
    for a in range(0, x.shape[2], t):
        for i in range(0, x.shape[3], p):
            for j in range(0, x.shape[4], p):
                piece = x[:, :, a : a + t, i : i + p, j : j + p].flatten(1)
                tokens.append(piece @ weight.flatten(1).T + bias)
    return torch.stack(tokens, dim=1)


def norm(x: Tensor, w: Weights, name: str, eps: float) -> Tensor:
    return F.layer_norm(x, (D,), w[f"{name}.weight"], w[f"{name}.bias"], eps)


def after(z: Tensor, *tokens: Tensor) -> Tensor:
    """``z`` [B, N, D] and behind it ``tokens`` [..., D], the same for each image."""
    return torch.cat([z, *(t.reshape(1, -1, D).expand(len(z), -1, D) for t in tokens)], dim=1)


def before(z: Tensor, *tokens: Tensor) -> Tensor:
    return after(z, *tokens).roll(sum(t.numel() for t in tokens) // D, dims=1)


def sparsh(folder: Path, video: bool = False) -> tuple[str, Callable[[Tensor], Tensor]]:
    """V-JEPA has three axes of positions, the others two."""
    axes, bands = (3, math.ceil(D / 6)) if video else (2, D // 4)
    kernel = (3, 2, 16, 16) if video else (6, 16, 16)
    shapes = {"register_tokens": (1, 1, D)} | pair("patch_embed.proj", D, *kernel) | pair("norm", D)
    w = drawn(shapes | block("blocks.0.", SCALED) | block("blocks.1.", SCALED))
    w["pos_embed.frequency_bands"] = (10000.0 ** (-torch.arange(bands) / bands)).repeat(axes, 1)
    file = folder / ("vjepa_vitsmall.safetensors" if video else "dino_vitbase.safetensors")
    safetensors.torch.save_file(w, file)

    def slow(x: Tensor) -> Tensor:
        z = patches(x, w["patch_embed.proj.weight"], w["patch_embed.proj.bias"])
        for n, place in enumerate(product(*([range(2)] if video else []), range(4), range(3))):
            waves = [f(at / 10000 ** (i / bands)) for at in place for f in (math.sin, math.cos) for i in range(bands)]
            z[:, n] += torch.tensor(waves[:D])
        z = before(z, w["register_tokens"])
        for b in range(2):
            z = through(z, w, f"blocks.{b}.", SCALED, 1e-6)
        return norm(z, w, "norm", 1e-6)[:, 1:].mean(1)

    return f"external:sparsh:{file},size=64x48", slow


def vjepa(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    return sparsh(folder, video=True)


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


def anytouch(folder: Path, version: int = 1) -> tuple[str, Callable[[Tensor], Tensor]]:
    places = GRID**2 * version  # version 2 has two steps of time
    embed = "video_patch_embedding.weight" if version == 1 else "touch_model.embeddings.patch_embedding.weight"
    kernel = (D, 3, 3, 14, 14) if version == 1 else (D, 3, 2, 16, 16)
    model = {"embeddings.class_embedding": (D,), "embeddings.position_embedding.weight": (1 + places, D)}
    model |= pair("pre_layrnorm", D) | pair("post_layernorm", D)
    model |= block("encoder.layers.0.", CLIP) | block("encoder.layers.1.", CLIP)
    shapes = {embed: kernel, "sensor_token": (10, 5, D), "touch_projection.weight": (32, D), "mask_token": (1, 1, D)}
    w = drawn(shapes | {f"touch_model.{name}": value for name, value in model.items()} | {"decoder.0.weight": (4, 4)})
    found = {f"touch_mae_model.{name}": value for name, value in w.items()}
    if version == 1:  # not used
        found["touch_mae_model.touch_model.embeddings.patch_embedding.weight"] = torch.full((D, 3, 14, 14), math.nan)
    torch.save({"model": found} if version == 1 else found, folder / "checkpoint.pth")

    def slow(x: Tensor) -> Tensor:
        at = w["touch_model.embeddings.position_embedding.weight"]
        cls = w["touch_model.embeddings.class_embedding"] + at[0]
        z = before(patches(x, w[embed]) + at[1:], cls, w["sensor_token"][3])
        z = norm(z, w, "touch_model.pre_layrnorm", 1e-5)
        for b in range(2):
            z = through(z, w, f"touch_model.encoder.layers.{b}.", CLIP, 1e-5)
        return norm(z[:, 0], w, "touch_model.post_layernorm", 1e-5) @ w["touch_projection.weight"].T

    return f"external:anytouch{'' if version == 1 else 2}:{folder / 'checkpoint.pth'},sensor=3", slow


def anytouch2(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    return anytouch(folder, 2)


def unitouch(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    start = {"cls_token": (1, 1, D), "rgbt_stem.proj.1.weight": (D, 3, 2, 14, 14)}
    start |= {"pos_embedding_helper.pos_embed": (1, 1 + GRID**2, D)}
    shapes = {f"modality_preprocessors.touch.{name}": value for name, value in start.items()}
    shapes |= block("modality_trunks.touch.blocks.0.", BIND) | block("modality_trunks.touch.blocks.1.", BIND)
    w = drawn(shapes | pair("modality_heads.touch.0", D) | {"modality_heads.touch.2.weight": (32, D)})
    others = {"modality_heads.vision.2.weight": torch.ones(2, 2)}
    others |= {"modality_postprocessors.touch.1.log_logit_scale": torch.ones(())}
    torch.save({"state_dict": {f"model.{n}": v for n, v in (w | others).items()}}, folder / "last_new.ckpt")

    def slow(x: Tensor) -> Tensor:
        z = patches(x, w["modality_preprocessors.touch.rgbt_stem.proj.1.weight"])
        z = before(z, w["modality_preprocessors.touch.cls_token"])
        z = z + w["modality_preprocessors.touch.pos_embedding_helper.pos_embed"]
        for b in range(2):
            z = through(z, w, f"modality_trunks.touch.blocks.{b}.", BIND, 1e-6)
        z = norm(z, w, "modality_heads.touch.0", 1e-6)[:, 0] @ w["modality_heads.touch.2.weight"].T
        return 5 * z / z.norm(dim=1, keepdim=True)

    return f"external:unitouch:{folder / 'last_new.ckpt'}", slow


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


OWNERS = (sparsh, vjepa, t3, anytouch, anytouch2, unitouch, tvl)
