"""Fine-tuning of a part of a trunk: which parameters are trained, low-rank updates (LoRA), and learned pooling.

Shapes: B images, P places of a feature map, D features, O outputs of a layer and I inputs of each.
"""

import copy
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from mvitac.nn.encoders import last_map, num_features

Part = Literal["all", "last-stage", "lora", "attentive", "head"]


class Lora(nn.Module):
    """A weight [O, ...] plus a trained product of rank r: W + U V, U [O, r], V [r, I] (arXiv:2106.09685, alpha = r).

    U starts at zero, so the layer starts as it was. A convolution's kernel [O, C, h, w] is read as [O, C h w].
    """

    def __init__(self, weight: Tensor, rank: int) -> None:
        super().__init__()
        outputs, inputs = weight.shape[0], weight[0].numel()
        rank = min(rank, outputs, inputs)
        self.up = nn.Parameter(weight.new_zeros(outputs, rank))
        self.down = nn.Parameter(torch.randn(rank, inputs) * inputs**-0.5)

    def forward(self, weight: Tensor) -> Tensor:
        return weight + (self.up @ self.down).view(weight.shape)


class AttentivePool(nn.Module):
    """A trunk whose pooled features [B, D] gain an attention over its last feature map: one query, as V-JEPA's probe.

    The attention's output layer starts at zero, so that training starts from the trunk's own features.
    """

    def __init__(self, trunk: nn.Module) -> None:
        super().__init__()
        self.trunk, self.num_features = trunk, (width := num_features(trunk))
        self.norm = nn.BatchNorm1d(width, affine=False)
        self.query = nn.Parameter(torch.randn(1, 1, width) * width**-0.5)
        heads = max((h for h in range(1, 13) if width % h == 0 and width // h >= 32), default=1)
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)
        nn.init.zeros_(self.attention.out_proj.weight)

    def forward(self, images: Tensor) -> Tensor:
        places = self.norm(self.last_map(images).mT).mT
        found, _ = self.attention(self.query.expand(len(places), -1, -1), places, places, need_weights=False)
        return self.trunk(images) + found.squeeze(1)

    def last_map(self, images: Tensor) -> Tensor:
        """The trunk's map [B, P, D]."""
        return last_map(self.trunk, images)


def train_part(trunk: nn.Module, part: Part, rank: int) -> None:
    """Freeze all parameters of ``trunk`` but those of ``part``; ValueError if it does not name its stages.

    all: nothing is frozen. last-stage: the last stage of a timm model (layer4 of a ResNet, the last block of a ViT) and
    what follows it. lora: low-rank updates of every convolution and linear layer, and the affine parameters of
    normalisation layers. attentive: the pooling of an ``AttentivePool``. head: nothing of the trunk.
    """
    if part == "all":
        return
    trunk.requires_grad_(False)
    if part == "last-stage":
        names = [name for name, _ in trunk.named_parameters()]
        first = next((i for i, name in enumerate(names) if f".{_last_stage(trunk)}." in f".{name}"), len(names))
        for name in names[first:]:
            trunk.get_parameter(name).requires_grad_()
    elif part == "attentive":
        assert isinstance(trunk, AttentivePool)
        trunk.query.requires_grad_()
        trunk.attention.requires_grad_()
    elif part == "lora":
        for module in list(trunk.modules()):
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                parametrize.register_parametrization(module, "weight", Lora(module.weight, rank))
            elif not list(module.children()):  # normalisation
                module.requires_grad_()


def _last_stage(trunk: nn.Module) -> str:
    for module in trunk.modules():  # the timm model may be inside PerFrame
        if stages := getattr(module, "feature_info", None):
            return stages[-1]["module"]
    raise ValueError("this trunk does not name its stages: give --train head, attentive, lora or all")


def freeze_statistics(trunk: nn.Module) -> None:
    """Put the frozen layers of ``trunk`` in eval mode: their BatchNorm keeps its statistics. Called after ``train()``."""
    if not any(p.requires_grad for p in trunk.parameters()):
        trunk.eval()
    for module in trunk.modules():
        own = list(module.parameters(recurse=False))
        if own and not any(p.requires_grad for p in own):
            module.eval()


def merged(trunk: nn.Module) -> nn.Module:
    """``trunk`` itself, or, if it has low-rank updates, a copy with them added to its weights."""
    if not any(parametrize.is_parametrized(module) for module in trunk.modules()):
        return trunk
    trunk = copy.deepcopy(trunk)
    for module in list(trunk.modules()):
        if parametrize.is_parametrized(module, "weight"):
            weight = torch.as_tensor(module.weight).detach().clone()
            # remove_parametrizations would also change the class, which the copy shares with the original.
            module.__class__ = type(module).__bases__[0]  # type: ignore[assignment]
            del module.parametrizations
            module.weight = nn.Parameter(weight)
    return trunk
