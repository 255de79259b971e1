"""Trunks (any timm model), their initial weights, and projection heads."""

import copy
import difflib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import timm
import torch
from timm.data.constants import IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD
from timm.models import PretrainedCfg, register_model
from timm.models.resnet import BasicBlock, ResNet
from timm.models.vision_transformer import VisionTransformer
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from tyro.conf import Fixed

from mvitac.data.spec import DataSpec
from mvitac.nn import imagenet
from mvitac.nn.small_conv import use_convolutions, use_products
from mvitac.nn.weights import load_weights, read_tensors, stem_names
from mvitac.system.files import brief

IMAGENET, SCRATCH = "imagenet", "scratch"
_VITS = ("timm.models.vision_transformer", "timm.models.deit", "timm.models.eva")
"""timm's files of ViTs that take images of any size ..."""
_ANY_SIZE = {"dynamic_img_size": True, "dynamic_img_pad": True}
"""... with these arguments: positions are interpolated, and the last patches padded."""


@register_model
def mvitac_tiny(pretrained: bool = False, **kwargs: Any) -> ResNet:
    """A ResNet with one narrow block per stage (64 features, 78 k parameters), for tests and the smoke recipe."""
    _from_scratch("mvitac_tiny", pretrained, kwargs)
    shape: dict[str, Any] = {"block": BasicBlock, "layers": (1, 1, 1, 1), "channels": (8, 16, 32, 64)}
    return ResNet(**shape, stem_width=8, stem_type="deep", **kwargs)


@register_model
def mvitac_resnet8(pretrained: bool = False, **kwargs: Any) -> ResNet:
    """timm's ResNet-10-T without its last stage, for images of some 48 px (256 features, 1.2 M parameters)."""
    _from_scratch("mvitac_resnet8", pretrained, kwargs)
    shape: dict[str, Any] = {"block": BasicBlock, "layers": (1, 1, 1, 1), "stem_width": 32, "stem_type": "deep_tiered"}
    trunk = ResNet(**shape, avg_down=True, **kwargs)
    trunk.layer4, trunk.num_features, trunk.head_hidden_size = nn.Identity(), 256, 256  # type: ignore[assignment]
    del trunk.feature_info[-1]
    return trunk


@register_model
def mvitac_vit(pretrained: bool = False, **kwargs: Any) -> VisionTransformer:
    """A ViT for CPUs and small images: 192 features, 6 blocks, patches of 8 px (2.7 M parameters)."""
    return _small_vit("mvitac_vit", pretrained, {"embed_dim": 192, "depth": 6, "num_heads": 3}, kwargs)


@register_model
def mvitac_tiny_vit(pretrained: bool = False, **kwargs: Any) -> VisionTransformer:
    """A ViT with 64 features and 2 blocks, patches of 8 px (116 k parameters), for tests."""
    return _small_vit("mvitac_tiny_vit", pretrained, {"embed_dim": 64, "depth": 2, "num_heads": 2}, kwargs)


def _from_scratch(name: str, pretrained: bool, kwargs: dict[str, Any]) -> None:
    if pretrained:
        raise ValueError(f"{name} has no ImageNet weights: use --encoder.weights scratch")
    for key in ("pretrained_cfg", "pretrained_cfg_overlay", "cache_dir"):
        kwargs.pop(key, None)


def _small_vit(name: str, pretrained: bool, shape: dict[str, Any], kwargs: dict[str, Any]) -> VisionTransformer:
    """A ViT for 64 px without a class token; its learned positions start as sines and cosines."""
    _from_scratch(name, pretrained, kwargs)
    usual: dict[str, Any] = {"class_token": False, "global_pool": "avg", "fc_norm": False} | _ANY_SIZE
    vit = VisionTransformer(**{"img_size": 64, "patch_size": 8, **usual, **shape, **kwargs})
    assert vit.pos_embed is not None
    with torch.no_grad():
        vit.pos_embed.copy_(sin_cos_positions(*vit.patch_embed.grid_size, vit.embed_dim))  # type: ignore[call-arg]
    return vit


def sin_cos_positions(height: int, width: int, features: int, device: torch.device | None = None) -> Tensor:
    """Fixed embeddings [height x width, ``features``] of the places of a grid, row by row (MoCo v3, arXiv:2104.02057).

    The four quarters of the features are sin(row w_i), cos(row w_i), sin(column w_i), cos(column w_i), with
    w_i = 10000^(-4 i / features).
    """
    assert features % 4 == 0, features
    rates = 10000.0 ** (-torch.arange(0, features, 4, device=device, dtype=torch.float32) / features)
    row, column = (torch.arange(side, device=device, dtype=torch.float32)[:, None] * rates for side in (height, width))
    across_rows = torch.cat([row.sin(), row.cos()], 1)[:, None].expand(-1, width, -1)
    across_columns = torch.cat([column.sin(), column.cos()], 1)[None].expand(height, -1, -1)
    return torch.cat([across_rows, across_columns], 2).flatten(0, 1)


@dataclass(frozen=True, kw_only=True)
class EncoderConfig:
    """The network that encodes one modality."""

    trunk: str = "resnet18.tv_in1k"
    """Name of a timm model. The paper uses ResNet-18; resnet18.tv_in1k is torchvision's."""
    weights: str = IMAGENET
    """Initial weights: `imagenet` (from timm's cache, an installed package, or the network), `scratch` (random), or a file
    with the trunk's state dict (.safetensors, .pth)."""
    stem: Fixed[Literal["repeat", "random"]] = "repeat"
    """Start of a pretrained trunk's first convolution for images that do not have three channels: timm repeats and rescales
    its filters, or random (the authors' code)."""
    temporal: Literal["stack", "mean"] = "stack"
    """How several frames of a window are read. stack: as channels of one image. mean: each by itself, features averaged."""
    pool: Literal["last", "stages"] = "last"
    """Features of the trunk. last: its own, pooled after the last layer. stages: the means of the maps of all its stages,
    side by side; early ones keep texture that the last layer of a network from ImageNet has lost."""
    locked: bool = False
    """Keep the trunk as it starts; its heads and the other trunk are trained (LiT, arXiv:2111.07991)."""
    keep_norms: bool = False
    """BatchNorm keeps the statistics that the trunk starts with, also for the images of training."""
    lr_scale: float = 1.0
    """Learning rate of the trunk relative to that of its heads, e.g. .1 to change pretrained weights slowly."""
    layer_decay: float = 1.0
    """Learning rate of each layer of the trunk relative to that of the next one, e.g. .65 to train a pretrained ViT further
    (BEiT, MAE). 1 = the same for all."""

    def __post_init__(self) -> None:
        for name in ("lr_scale", "layer_decay"):
            if not 0 < (factor := getattr(self, name)) <= 1:
                raise ValueError(f"{name} {factor}: give a factor above 0, at most 1")
        if not timm.is_model(self.trunk.split(".")[0]):
            near = difflib.get_close_matches(self.trunk.split(".")[0], timm.list_models(), n=3)
            hint = f"; did you mean {', '.join(near)}?" if near else ""
            raise ValueError(f"unknown trunk {self.trunk!r}: give the name of a timm model, e.g. resnet18{hint}")

    @property
    def mean_std(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Mean and standard deviation by which the trunk's images are normalised: those of timm's weights for it."""
        known = timm.get_pretrained_cfg(self.trunk)
        return (known.mean, known.std) if known else (IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD)


@dataclass(frozen=True, kw_only=True)
class Encoders:
    """The network of each modality. --encoder.NAME is short for --encoder.vision.NAME and --encoder.touch.NAME."""

    vision: EncoderConfig = EncoderConfig()
    touch: EncoderConfig = EncoderConfig()

    def __getitem__(self, modality: str) -> EncoderConfig:
        return self.vision if modality == "vision" else self.touch

    def changed(self, **fields: Any) -> "Encoders":
        return Encoders(vision=replace(self.vision, **fields), touch=replace(self.touch, **fields))

    def fresh(self) -> "Encoders":
        """These with random initial weights, all of which are trained at the full rate."""
        return self.changed(weights=SCRATCH, locked=False, keep_norms=False, lr_scale=1.0, layer_decay=1.0)

    def named(self, modalities: Iterable[str]) -> str:
        """The trunks of ``modalities``: ``resnet18``, or ``vision resnet18, touch resnet10t``."""
        found = {m: self[m].trunk for m in modalities}
        same = len(set(found.values())) == 1
        return next(iter(found.values())) if same else ", ".join(f"{m} {trunk}" for m, trunk in found.items())


def build_trunk(config: EncoderConfig, channels: int, frames: int = 1) -> nn.Module:
    """Create a trunk that maps images [B, ``channels``, H, W] to pooled features [B, D]; ``trunk.num_features`` is D.

    The channels are those of all ``frames`` of a window together. ValueError if the requested weights are missing:
    there is no silent fallback to random weights.
    """
    single = frames == 1 or config.temporal == "stack"
    channels = channels if single else channels // frames
    trunk = _from_timm(config, channels)
    if config.stem == "random" and channels != 3:
        for name in stem_names(trunk):
            trunk.get_submodule(name).reset_parameters()  # type: ignore[operator]
    trunk = use_products(trunk)
    trunk = trunk if config.pool == "last" else Stages(trunk)
    trunk = trunk if single else PerFrame(trunk, frames)
    trunk.locked, trunk.keep_norms = config.locked, config.keep_norms  # type: ignore[assignment]
    return trunk.requires_grad_(False) if config.locked else trunk


def is_locked(module: nn.Module) -> bool:
    """Whether ``module`` is a trunk that is not trained (``EncoderConfig.locked``)."""
    return getattr(module, "locked", False) is True


def keep_modes(network: nn.Module) -> None:
    """Put locked trunks in ``network``, and BatchNorm that is kept, in eval mode. Called after ``train()``."""
    for trunk in network.modules():
        if is_locked(trunk):
            trunk.eval()
        elif getattr(trunk, "keep_norms", False) is True:
            for layer in trunk.modules():
                if isinstance(layer, nn.modules.batchnorm._BatchNorm):
                    layer.eval()


class Stages(nn.Module):
    """A timm model whose features are the means of the maps of its stages, side by side: [B, C, H, W] to [B, D]."""

    def __init__(self, trunk: nn.Module) -> None:
        super().__init__()
        self.trunk = trunk
        self.num_features = sum(stage["num_chs"] for stage in trunk.feature_info)  # type: ignore[union-attr]

    def forward(self, images: Tensor) -> Tensor:
        each = [*range(len(self.trunk.feature_info))]  # type: ignore[arg-type]
        maps = self.trunk.forward_intermediates(images, each, intermediates_only=True)  # type: ignore[operator]
        # In the order in which they lie in memory: else their gradients have another one, and are copied.
        return torch.cat([each.permute(0, 2, 3, 1).flatten(1, 2).mean(1) for each in maps], 1)


def within(trunk: nn.Module) -> nn.Module:
    """The timm model in a trunk from ``build_trunk``."""
    while isinstance(trunk, PerFrame | Stages):
        trunk = trunk.trunk
    return trunk


class PerFrame(nn.Module):
    """A trunk that sees the F frames of a window one by one: [B, F C, H, W] to the mean of their features [B, D]."""

    def __init__(self, trunk: nn.Module, frames: int) -> None:
        super().__init__()
        self.trunk, self.frames = trunk, frames
        self.num_features = num_features(trunk)

    def forward(self, images: Tensor) -> Tensor:
        return self.trunk(images.unflatten(1, (self.frames, -1)).flatten(0, 1)).unflatten(0, (-1, self.frames)).mean(1)


def _from_timm(config: EncoderConfig, channels: int) -> nn.Module:
    arguments: dict[str, Any] = {"num_classes": 0, "in_chans": channels}
    if timm.models.model_entrypoint(config.trunk.split(".")[0]).__module__ in _VITS:
        arguments |= _ANY_SIZE
    if config.weights == SCRATCH:
        try:
            return timm.create_model(config.trunk, **arguments)
        except Exception as error:  # an unknown tag, or a trunk that does not support this number of channels
            raise ValueError(f"trunk {config.trunk} cannot be made for {channels} channels ({brief(error)})") from None
    if config.weights != IMAGENET:
        # Checked here, not in the config: a finished run must load after the file of its initial weights is gone.
        if not Path(config.weights).is_file():
            raise ValueError(f"weights {config.weights!r}: give imagenet, scratch, or a file that exists")
        trunk = _from_timm(replace(config, weights=SCRATCH), channels)
        load_weights(trunk, read_tensors(Path(config.weights)), config.weights)
        return trunk
    return imagenet.load(config.trunk, arguments)


def timm_trunk(
    encoder: nn.Module, name: str, input_size: tuple[int, int, int], mean: tuple[float, ...], std: tuple[float, ...]
) -> nn.Module:
    """A copy of an encoder from ``build_trunk`` as timm would have made it, with a ``pretrained_cfg`` of these values.

    ``input_size``: channels, height, width; ``mean``, ``std``: by channel. ValueError if it is no single timm model.
    """
    if not hasattr(encoder, "forward_features"):
        raise ValueError(f"this encoder is no single timm model but a {type(encoder).__name__}: use model.encoders")
    trunk = use_convolutions(copy.deepcopy(encoder))
    known: dict[str, Any] = getattr(encoder, "pretrained_cfg", None) or {}
    kept = {key: known[key] for key in ("first_conv", "classifier", "fixed_input_size") if key in known}
    # timm resizes as `Model.transform` does when images are stored at the size that the encoder sees.
    kept |= {"interpolation": "bilinear", "crop_pct": 1.0, "crop_mode": "squash", "num_classes": 0, "tag": "mvitac"}
    cfg = PretrainedCfg(architecture=name.split(".")[0], input_size=input_size, mean=mean, std=std, **kept).to_dict()
    trunk.pretrained_cfg = trunk.default_cfg = cfg  # type: ignore[assignment]
    return trunk


class Head(nn.Sequential):
    """Projection head g(.; phi): a 2-layer MLP with ReLU after the first layer only (paper, appendix A)."""

    def __init__(self, features: int, hidden: int, out: int, *, dropout: float = 0.0, norm: bool = False) -> None:
        norms, drops = [nn.BatchNorm1d(hidden)] * norm, [nn.Dropout(dropout)] * bool(dropout)
        super().__init__(nn.Linear(features, hidden, bias=not norm), *norms, nn.ReLU(), *drops, nn.Linear(hidden, out))


class Projected(nn.Module):
    """A trunk with one head: images [B, C, H, W] to embeddings [B, E]."""

    def __init__(self, trunk: nn.Module, head: nn.Module) -> None:
        super().__init__()
        self.trunk, self.head = trunk, head

    def forward(self, images: Tensor) -> Tensor:
        return self.head(features_of(self.trunk, images))


def features_of(trunk: nn.Module, images: Tensor) -> Tensor:
    """Features [B, D] of images [B, C, H, W]; what has two dimensions are features already (``Views.images``)."""
    return images if images.ndim == 2 else trunk(images)


def num_features(trunk: nn.Module) -> int:
    """Width D of the pooled features of a trunk."""
    return int(trunk.num_features)  # type: ignore[arg-type]


def draws_random_numbers(network: nn.Module) -> bool:
    """Whether ``network`` has any kind of dropout. Layers of torch and timm call its rate p, drop_prob or drop_rate."""
    rates = ("p", "drop_prob", "drop_rate")
    return any(isinstance(rate := getattr(m, name, 0), float) and rate > 0 for m in network.modules() for name in rates)


class Seeded(TorchDispatchMode):
    """Within it this thread draws what ``torch.manual_seed(seed)`` gives on a CPU, but not from what all threads share."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.drawn = {"generator": torch.Generator().manual_seed(seed)}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        device = (kwargs := kwargs or {}).get("device") or getattr(args[0] if args else None, "device", None)
        if torch.Tag.nondeterministic_seeded in func.tags and (device is None or device.type != "cuda"):
            name = "generator" if func._overloadname == "default" else f"{func._overloadname}_generator"
            func = getattr(func.overloadpacket, name, func)  # rand, randn, randint and randperm have a form of its own
            if any(argument.name == "generator" for argument in func._schema.arguments):
                kwargs = self.drawn | kwargs
        return func(*args, **kwargs)


def build_towers(config: Encoders, spec: DataSpec, head: Callable[[int], nn.Module]) -> nn.ModuleDict:
    """A ``Projected`` trunk and head per modality of ``spec``. ``head`` creates a head for D features."""
    towers = nn.ModuleDict()
    for modality in spec.modalities:
        trunk = build_trunk(config[modality], spec.channels(modality), spec.frames(modality))
        towers[modality] = Projected(trunk, head(num_features(trunk)))
    return towers
