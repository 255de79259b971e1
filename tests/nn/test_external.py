"""Adapters to other people's encoders: small weights with their names give what their networks are by definition.

The networks are written out here from the owners' names and shapes, with loops and without the code under test.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchvision.models.resnet import BasicBlock, ResNet

from mvitac.nn.external import open_encoder
from mvitac.nn.external.base import OpenEncoder, parse, randomised
from mvitac.nn.external.preprocessing import Preprocessing
from mvitac.nn.external.tower import Tower

D, HEADS, GRID = 128, 2, 3
Weights = dict[str, Tensor]


def drawn(**shapes: tuple[int, ...]) -> Weights:
    """Random weights; scales are near 1, so that no part of a network vanishes."""
    generator = torch.Generator().manual_seed(0)
    return {
        name.replace("__", "."): torch.randn(shape, generator=generator) * 0.1 + ("norm" in name)
        for name, shape in shapes.items()
    }


def block(prefix: str, names: dict[str, str]) -> dict[str, tuple[int, ...]]:
    """Shapes of one block under the owner's names."""
    shapes = {"n1": (D,), "qkv": (3 * D, D), "q": (D, D), "k": (D, D), "v": (D, D), "out": (D, D), "n2": (D,)}
    shapes |= {"fc1": (4 * D, D), "fc2": (D, 4 * D)}
    made = {}
    for part, name in names.items():
        if part in ("ls1", "ls2"):
            made[prefix + name] = (D,)
        elif part.startswith("bias"):
            made[prefix + name] = (1, 1, D)
        elif "*" in name:  # weight and bias have names of their own
            made |= {
                prefix + name.replace("*", "weight"): shapes[part],
                prefix + name.replace("*", "bias"): shapes[part][:1],
            }
        else:
            made |= {f"{prefix}{name}.weight": shapes[part], f"{prefix}{name}.bias": shapes[part][:1]}
    return made


TIMM = {"n1": "norm1", "qkv": "attn.qkv", "out": "attn.proj", "n2": "norm2", "fc1": "mlp.fc1", "fc2": "mlp.fc2"}
SCALED = {**TIMM, "ls1": "ls1.gamma", "ls2": "ls2.gamma"}
CLIP = {"n1": "layer_norm1", "n2": "layer_norm2", "fc1": "mlp.fc1", "fc2": "mlp.fc2"}
CLIP |= {part: f"self_attn.{part}_proj" for part in ("q", "k", "v", "out")}
BIND = {
    "n1": "norm_1",
    "n2": "norm_2",
    "fc1": "mlp.fc1",
    "fc2": "mlp.fc2",
    "qkv": "attn.in_proj_*",
    "out": "attn.out_proj",
}
BIND |= {"bias_k": "attn.bias_k", "bias_v": "attn.bias_v"}


def through(x: Tensor, w: Weights, prefix: str, names: dict[str, str], eps: float) -> Tensor:
    """One block, head by head."""

    def linear(z: Tensor, part: str) -> Tensor:
        name = names[part] if "*" in names[part] else f"{names[part]}.*"
        return z @ w[prefix + name.replace("*", "weight")].T + w[prefix + name.replace("*", "bias")]

    def normed(z: Tensor, part: str) -> Tensor:
        return F.layer_norm(z, (D,), w[f"{prefix}{names[part]}.weight"], w[f"{prefix}{names[part]}.bias"], eps)

    z = normed(x, "n1")
    q, k, v = linear(z, "qkv").chunk(3, dim=2) if "qkv" in names else (linear(z, part) for part in "qkv")
    if "bias_k" in names:
        k, v = (
            torch.cat([t, w[prefix + names[n]].expand(len(x), 1, D)], dim=1) for t, n in ((k, "bias_k"), (v, "bias_v"))
        )
    each = []
    for h in range(HEADS):
        part = slice(h * D // HEADS, (h + 1) * D // HEADS)
        weights = (q[:, :, part] @ k[:, :, part].mT / math.sqrt(D // HEADS)).softmax(dim=2)
        each.append(weights @ v[:, :, part])
    scale = (lambda n: w[prefix + names[n]]) if "ls1" in names else (lambda n: 1.0)
    x = x + scale("ls1") * linear(torch.cat(each, dim=2), "out")
    return x + scale("ls2") * linear(F.gelu(linear(normed(x, "n2"), "fc1")), "fc2")


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


def sparsh(folder: Path, video: bool = False) -> tuple[str, Callable[[Tensor], Tensor]]:
    """V-JEPA has three axes of positions, the others two."""
    axes, bands = (3, math.ceil(D / 6)) if video else (2, D // 4)
    kernel = (D, 3, 2, 16, 16) if video else (D, 6, 16, 16)
    shapes: dict[str, Any] = {
        "register_tokens": (1, 1, D),
        "patch_embed.proj.weight": kernel,
        "patch_embed.proj.bias": (D,),
    }
    shapes |= block("blocks.0.", SCALED) | block("blocks.1.", SCALED) | {"norm.weight": (D,), "norm.bias": (D,)}
    w = drawn(**shapes) | {"pos_embed.frequency_bands": (10000.0 ** (-torch.arange(bands) / bands)).repeat(axes, 1)}
    file = folder / ("vjepa_vitsmall.safetensors" if video else "dino_vitbase.safetensors")
    safetensors.torch.save_file(w, file)

    def slow(x: Tensor) -> Tensor:
        z = patches(x, w["patch_embed.proj.weight"], w["patch_embed.proj.bias"])
        places = (
            [(a, i, j) for a in range(2) for i in range(4) for j in range(3)]
            if video
            else [(i, j) for i in range(4) for j in range(3)]
        )
        for n, place in enumerate(places):
            waves = [f(at / 10000 ** (i / bands)) for at in place for f in (math.sin, math.cos) for i in range(bands)]
            z[:, n] += torch.tensor(waves[:D])
        z = torch.cat([w["register_tokens"].expand(len(x), 1, D), z], dim=1)
        for b in range(2):
            z = through(z, w, f"blocks.{b}.", SCALED, 1e-6)
        return norm(z, w, "norm", 1e-6)[:, 1:].mean(1)

    return f"external:sparsh:{file},size=64x48", slow


def vjepa(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    return sparsh(folder, video=True)


def t3(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    first = {"cls_token": (1, 1, D), "pos_embed": (1, 1 + GRID**2, D), "patch_embed.proj.weight": (D, 3, 16, 16)}
    own = drawn(**first, **{"patch_embed.proj.bias": (D,)}, **block("blocks.0.", TIMM))
    trunk = drawn(**block("blocks.0.", TIMM), **block("blocks.1.", TIMM), **{"norm.weight": (D,), "norm.bias": (D,)})
    (folder / "t3_tiny/encoders").mkdir(parents=True)
    torch.save(own, folder / "t3_tiny/encoders/gs_tag.pth")
    torch.save(trunk, folder / "t3_tiny/trunk.pth")

    def slow(x: Tensor) -> Tensor:
        z = patches(x, own["patch_embed.proj.weight"], own["patch_embed.proj.bias"])
        z = torch.cat([own["cls_token"].expand(len(x), 1, D), z], dim=1) + own["pos_embed"]
        z = through(z, own, "blocks.0.", TIMM, 1e-6)
        for b in range(2):
            z = through(z, trunk, f"blocks.{b}.", TIMM, 1e-5)
        return norm(z, trunk, "norm", 1e-5)[:, 0]

    return f"external:t3:{folder / 't3_tiny'},sensor=gs_tag,size=48", slow


def anytouch(folder: Path, version: int = 1) -> tuple[str, Callable[[Tensor], Tensor]]:
    places = GRID**2 * version  # version 2 has two steps of time
    embed = "video_patch_embedding.weight" if version == 1 else "touch_model.embeddings.patch_embedding.weight"
    kernel = (D, 3, 3, 14, 14) if version == 1 else (D, 3, 2, 16, 16)
    shapes: dict[str, Any] = {embed: kernel, "sensor_token": (10, 5, D), "touch_projection.weight": (32, D)}
    model = {"embeddings.class_embedding": (D,), "embeddings.position_embedding.weight": (1 + places, D)}
    for name in ("pre_layrnorm", "post_layernorm"):
        model |= {f"{name}.weight": (D,), f"{name}.bias": (D,)}
    model |= block("encoder.layers.0.", CLIP) | block("encoder.layers.1.", CLIP)
    shapes |= {f"touch_model.{name}": value for name, value in model.items()} | {
        "mask_token": (1, 1, D),
        "decoder.0.weight": (4, 4),
    }
    w = drawn(**shapes)
    found = {f"touch_mae_model.{name}": value for name, value in w.items()}
    if version == 1:
        found["touch_mae_model.touch_model.embeddings.patch_embedding.weight"] = torch.full(
            (D, 3, 14, 14), math.nan
        )  # not used
    torch.save({"model": found} if version == 1 else found, folder / "checkpoint.pth")

    def slow(x: Tensor) -> Tensor:
        at = w["touch_model.embeddings.position_embedding.weight"]
        z = patches(x, w[embed]) + at[1:]
        cls = (w["touch_model.embeddings.class_embedding"] + at[0]).expand(len(x), 1, D)
        z = torch.cat([cls, w["sensor_token"][3].expand(len(x), 5, D), z], dim=1)
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
    shapes: dict[str, Any] = {f"modality_preprocessors.touch.{name}": value for name, value in start.items()}
    shapes |= block("modality_trunks.touch.blocks.0.", BIND) | block("modality_trunks.touch.blocks.1.", BIND)
    shapes |= {
        "modality_heads.touch.0.weight": (D,),
        "modality_heads.touch.0.bias": (D,),
        "modality_heads.touch.2.weight": (32, D),
    }
    w = drawn(**shapes)
    others = {
        "modality_heads.vision.2.weight": torch.ones(2, 2),
        "modality_postprocessors.touch.1.log_logit_scale": torch.ones(()),
    }
    torch.save({"state_dict": {f"model.{n}": v for n, v in (w | others).items()}}, folder / "last_new.ckpt")

    def slow(x: Tensor) -> Tensor:
        z = patches(x, w["modality_preprocessors.touch.rgbt_stem.proj.1.weight"])
        z = torch.cat([w["modality_preprocessors.touch.cls_token"].expand(len(x), 1, D), z], dim=1)
        z = z + w["modality_preprocessors.touch.pos_embedding_helper.pos_embed"]
        for b in range(2):
            z = through(z, w, f"modality_trunks.touch.blocks.{b}.", BIND, 1e-6)
        z = norm(z, w, "modality_heads.touch.0", 1e-6)[:, 0] @ w["modality_heads.touch.2.weight"].T
        return 5 * z / z.norm(dim=1, keepdim=True)

    return f"external:unitouch:{folder / 'last_new.ckpt'}", slow


def tvl(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    shapes: dict[str, Any] = {
        "cls_token": (1, 1, D),
        "pos_embed": (1, 1 + GRID**2, D),
        "patch_embed.proj.weight": (D, 3, 16, 16),
    }
    shapes |= {
        "patch_embed.proj.bias": (D,),
        "fc_norm.weight": (D,),
        "fc_norm.bias": (D,),
        "head.weight": (32, D),
        "head.bias": (32,),
    }
    w = drawn(**shapes, **block("blocks.0.", TIMM))
    found = {f"tactile_encoder.{name}": value for name, value in w.items()} | {"logit_scale": torch.ones(())}
    torch.save({"model": found, "epoch": 3}, folder / "tvl_enc_vits.pth")

    def slow(x: Tensor) -> Tensor:
        z = patches(x, w["patch_embed.proj.weight"], w["patch_embed.proj.bias"])
        z = through(
            torch.cat([w["cls_token"].expand(len(x), 1, D), z], dim=1) + w["pos_embed"], w, "blocks.0.", TIMM, 1e-6
        )
        z = norm(z[:, 1:].mean(1), w, "fc_norm", 1e-6) @ w["head.weight"].T + w["head.bias"]
        return z / z.norm(dim=1, keepdim=True)

    return f"external:tvl:{folder / 'tvl_enc_vits.pth'}", slow


def small_resnet(channels: int) -> ResNet:
    """torchvision's, with one block per stage, and statistics that are not those of a new one."""
    torch.manual_seed(0)
    network = ResNet(BasicBlock, [1, 1, 1, 1])
    network.conv1 = nn.Conv2d(channels, 64, 7, 2, 3, bias=False)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.running_mean, std=0.1)  # type: ignore[arg-type]
            nn.init.uniform_(module.running_var, 0.5, 2)  # type: ignore[arg-type]
    network.fc = nn.Identity()  # type: ignore[assignment]
    return network.eval()


def notebooks(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    network = small_resnet(6)
    torch.save(nn.Sequential(*list(network.children())[:8]).state_dict(prefix="encoder."), folder / "state_dict_tac")
    return f"external:mvitac-notebooks:{folder / 'state_dict_tac'},size=64", network


def cmc(folder: Path) -> tuple[str, Callable[[Tensor], Tensor]]:
    touch, vision = small_resnet(3), small_resnet(3)
    nn.init.zeros_(vision.conv1.weight)
    found = {f"encoder.module.touch_to_image.{n}": v for n, v in touch.state_dict().items()}
    found |= {f"encoder.module.image_to_touch.{n}": v for n, v in vision.state_dict().items()}
    torch.save({"model": found | {"encoder.module.touch_to_image.fc.weight": torch.ones(128, 512)}}, folder / "cmc.pth")
    return f"external:touch-and-go-cmc:{folder / 'cmc.pth'},size=64", touch


OWNERS = (sparsh, vjepa, t3, anytouch, anytouch2, unitouch, tvl, notebooks, cmc)


@pytest.mark.parametrize("owner", OWNERS)
def test_features_are_those_of_the_network_written_out(owner: Callable[..., Any], tmp_path: Path) -> None:
    text, slow = owner(tmp_path)
    found = open_encoder(text)
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(2, *found.encoder.preprocessing.input_shape(), generator=generator)
    with torch.no_grad():
        expected = slow(x)
        assert expected.std() > 0.01
        torch.testing.assert_close(found.encoder.network(x), expected, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("owner", OWNERS)
def test_files_that_are_not_the_owners_are_refused_in_one_line(owner: Callable[..., Any], tmp_path: Path) -> None:
    text, _ = owner(tmp_path)
    adapter = parse(text)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    for file in files:
        whole = (
            safetensors.torch.load_file(file) if file.suffix == ".safetensors" else torch.load(file, weights_only=True)
        )
        tensors = next((whole[key] for key in ("model", "state_dict") if key in whole), whole)
        wrong = {n: v[: len(v) // 2].clone() if v.ndim >= 2 and len(v) > 8 else v for n, v in tensors.items()}
        for spoilt in (wrong, {"something.weight": torch.ones(3)}):
            safetensors.torch.save_file(spoilt, file) if file.suffix == ".safetensors" else torch.save(spoilt, file)
            with pytest.raises(ValueError, match=adapter.name) as caught:
                open_encoder(text)
            assert len(str(caught.value).splitlines()) == 1
            assert adapter.expects in str(caught.value)
        safetensors.torch.save_file(whole, file) if file.suffix == ".safetensors" else torch.save(whole, file)


def test_a_pickle_is_never_run(tmp_path: Path) -> None:
    torch.save({"model": nn.Linear(2, 2)}, tmp_path / "tvl.pth")
    with pytest.raises(ValueError, match="without running code"):
        open_encoder(f"external:tvl:{tmp_path / 'tvl.pth'}")


@pytest.mark.parametrize(
    ("width", "num_blocks", "kernel", "front", "places", "millions"),
    [
        (768, 12, (6, 16, 16), 1, 0, 86.24),  # Sparsh base; its file has 345 MB
        (384, 12, (6, 16, 16), 1, 0, 21.9),  # Sparsh small
        (768, 12, (3, 16, 16), 1, 197, 85.8),  # T3 medium: 22.0 + 63.8
        (1024, 24, (3, 3, 14, 14), 6, 257, 304),  # AnyTouch
    ],
)
def test_published_sizes_have_the_owners_number_of_weights(
    width: int, num_blocks: int, kernel: tuple[int, ...], front: int, places: int, millions: float
) -> None:
    with torch.device("meta"):
        given = {
            "embed.weight": torch.empty(width, *kernel),
            "front": torch.empty(1, front, width),
            "norm.weight": torch.ones(1),
        }
        given |= {"embed.bias": torch.ones(1)} if len(kernel) == 3 else {}
        given |= {f"blocks.{b}.norm1.weight": torch.ones(1) for b in range(num_blocks)}
        grid = (1, math.isqrt(places), math.isqrt(places)) if places else (1, 20, 15)
        tower = Tower(given, grid, fixed=None if places else torch.empty(1, 300, width), placed=1 if places else 0)
    assert sum(p.numel() for p in tower.parameters()) / 1e6 == pytest.approx(
        millions, abs=0.5 if millions > 100 else 0.06
    )


def test_positions_are_interpolated_to_another_size(tmp_path: Path) -> None:
    text, _ = tvl(tmp_path)
    plain, larger = open_encoder(text).loaded.network, open_encoder(f"{text},size=96x64").loaded.network
    assert isinstance(plain, Tower) and isinstance(larger, Tower)
    assert (plain.grid, larger.grid) == ((1, 3, 3), (1, 6, 4))
    assert torch.equal(larger.positions[:, 0], plain.positions[:, 0])  # that of the class token
    rows = plain.positions[0, 1:].unflatten(0, (3, 3)).mean(1)
    assert larger.positions[0, 1:].unflatten(0, (6, 4)).mean((0, 1)) == pytest.approx(rows.mean(0), abs=0.02)


def levels(*values: int) -> Tensor:
    """One image of 8 x 8 pixels per value, uint8 [1, F, 3, 8, 8]."""
    return torch.tensor(values, dtype=torch.uint8).view(1, -1, 1, 1, 1).expand(1, len(values), 3, 8, 8)


def test_frames_are_newest_first_or_oldest_first_and_the_oldest_is_repeated() -> None:
    plain = {"mean": (0, 0, 0), "std": (1, 1, 1), "size": (8, 8)}
    stacked = Preprocessing(frames=2, **plain)(levels(255, 0, 51))
    assert stacked.shape == (1, 6, 8, 8) and stacked[0, :, 0, 0].tolist() == [1, 1, 1, 0, 0, 0]
    film = Preprocessing(frames=3, oldest_first=True, layout="video", **plain)(levels(255, 0))
    assert film.shape == (1, 3, 3, 8, 8) and film[0, 0, :, 0, 0].tolist() == [0, 0, 1]
    still = Preprocessing(frames=3, still=True, layout="frames", **plain)(levels(255, 0))
    assert still.shape == (1, 3, 3, 8, 8) and still[0, :, 0, 0, 0].tolist() == [1, 1, 1]


def test_difference_images_get_the_owners_offset_and_scale() -> None:
    made = Preprocessing(mean=(0, 0, 0), std=(1, 1, 1), size=(8, 8), offset=0.5, whole_levels=True)
    for stored in (100, 128, 130, 250):  # (image - background) / 2 + 128
        minus = 2 * (stored - 128)
        expected = math.floor(255 * min(max(minus / 255 + 0.5, 0), 1)) / 255
        assert made(levels(stored), gain=2.0).flatten()[0].item() == pytest.approx(expected, abs=1e-6)
        assert made(levels(stored)).flatten()[0].item() == pytest.approx(
            stored / 255
        )  # of plain images none is subtracted
    shifted = Preprocessing(size=(8, 8), mean=(0.5,) * 3, std=(0.25,) * 3)(levels(255))  # type: ignore[arg-type]
    assert shifted.unique().tolist() == [2.0]


def test_landscape_images_are_rotated_and_cut_as_sparsh_does() -> None:
    made = Preprocessing(size=(32, 24), mean=(0, 0, 0), std=(1, 1, 1), portrait=True)
    image = torch.zeros(1, 1, 3, 24, 32)
    image[..., :12, :] = 1  # the upper half of a 4:3 landscape is the right half once rotated clockwise
    found = made(image)[0, 0]
    assert found[:, 12:].min() == 1 and found[:, :12].max() == 0
    tall = torch.zeros(1, 1, 3, 64, 24)
    tall[..., 8:56, :] = 1  # the middle three quarters
    assert made(tall).min() == 1


def test_tvl_pads_and_rotates_and_t3_cuts_the_centre() -> None:
    plain = {"mean": (0, 0, 0), "std": (1, 1, 1), "size": (16, 16)}
    image = torch.ones(1, 1, 3, 16, 8)
    image[..., :8, :] = 0.5
    padded = Preprocessing(pad=True, **plain)(image)[0, 0]
    assert padded[8].tolist() == [0.5] * 8 + [1.0] * 8 and padded[0].max() == padded[-1].max() == 0
    wide = torch.zeros(1, 1, 3, 32, 64)
    wide[..., 8:24, 24:40] = 1
    assert Preprocessing(shorter=32, **plain)(wide).min() == 1


def test_random_weights_for_the_control_leave_the_encoder_as_it_is(tmp_path: Path) -> None:
    found = open_encoder(tvl(tmp_path)[0])
    before = {name: value.clone() for name, value in found.loaded.network.state_dict().items()}
    untrained = found.untrained()
    assert untrained is not None and isinstance(untrained, OpenEncoder) and untrained.loaded.trained_on == "nothing"
    assert all(torch.equal(value, before[name]) for name, value in found.loaded.network.state_dict().items())
    again = randomised(found.loaded.network, 0).state_dict()
    for name, value in untrained.encoder.network.state_dict().items():
        assert torch.equal(value, again[name]) and (value.ndim < 2 or not torch.equal(value, before[name]))
    assert open_encoder("external:timm/mvitac_tiny,weights=random,size=32").untrained() is None


def test_maps_are_pooled_over_each_step_of_time(tmp_path: Path) -> None:
    text, _ = sparsh(tmp_path, video=True)
    encoder = open_encoder(f"{text.rsplit(',', 1)[0]},size=160x128").encoder
    images = torch.rand(2, 3, 160, 128)
    found = encoder.last_map(images)
    whole = encoder.network.forward_features(encoder._prepared(images))  # type: ignore[operator]
    assert whole.shape == (2, 1 + 2 * 10 * 8, D) and found.shape == (2, 1 + 2 * 7 * 7, D)
    assert torch.equal(found[:, 0], whole[:, 0])
    later = whole[:, 81:].mT.unflatten(2, (10, 8))
    expected = F.adaptive_avg_pool2d(later, 7).flatten(2).mT
    torch.testing.assert_close(found[:, 50:], expected)
