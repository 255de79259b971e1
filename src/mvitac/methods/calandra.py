"""Supervised fusion of Calandra et al. (2017): a trunk per stream (vision, left gel, right gel) and an MLP on all of them.

The architecture is that of TACTO's grasp-stability experiment, which MViTac ran for its Table II: a ResNet-18 per stream,
concatenated pooled features, and linear layers 512 - 256 - classes with ReLU between (arXiv:1710.05512 and
https://github.com/facebookresearch/tacto, experiments/grasp_stability). Streams share no weights.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from mvitac.data.spec import DataSpec
from mvitac.methods.supervised import LabelledConfig, Supervised
from mvitac.nn.encoders import EncoderConfig, Encoders, build_trunk, num_features


@dataclass(frozen=True, kw_only=True)
class CalandraConfig(LabelledConfig):
    """Supervised grasp prediction with a trunk per camera and per gel, trained end to end."""

    name: ClassVar[str] = "calandra"

    def build(self, spec: DataSpec, encoder: Encoders) -> Supervised:
        names = self.modalities_of(spec)
        streams: dict[str, nn.Module] = {m: Streams(encoder[m], spec.channels(m) // 3) for m in names}
        width = sum(num_features(stream) for stream in streams.values())

        def layers(num: int) -> nn.Module:
            return nn.Sequential(nn.Linear(width, 512), nn.ReLU(), nn.Linear(512, 256), nn.ReLU(), nn.Linear(256, num))

        return Supervised(streams, self.heads(spec, layers))


class Streams(nn.Module):
    """One trunk per three channels of a stacked image, features concatenated: [B, 3 S, H, W] to [B, S D]."""

    def __init__(self, encoder: EncoderConfig, num: int) -> None:
        super().__init__()
        self.trunks = nn.ModuleList(build_trunk(encoder, 3) for _ in range(num))
        self.num_features = sum(num_features(trunk) for trunk in self.trunks)

    def forward(self, images: Tensor) -> Tensor:
        return torch.cat([trunk(x) for trunk, x in zip(self.trunks, images.split(3, dim=1), strict=True)], dim=1)
