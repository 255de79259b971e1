"""A frozen network with its owner's preprocessing, as one module from raw images to features.

Shapes: B images, S sensors, F frames, D features, P places.
"""

import copy
import hashlib
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mvitac.bench.external.preprocessing import Preprocessing
from mvitac.nn.encoders import num_features
from mvitac.system.files import brief


@dataclass(frozen=True)
class Layout:
    """How a dataset lays out the images of one modality: [B, F S 3, H, W], newest frame first."""

    sensors: int = 1
    frames: int = 1
    gain: float = 0.0  # 2 for difference images, (image - background) / 2 + 128; 0 for plain ones


class Plain(nn.Module):
    """Any module, with the interface of timm's models: ``forward`` gives features, ``forward_features`` what it gives.

    Its output is features [B, D], tokens [B, P, D] of which the first ``prefix`` are no places, or a map [B, D, H, W].
    """

    def __init__(self, network: nn.Module, prefix: int = 0) -> None:
        super().__init__()
        self.network, self.num_prefix_tokens, self.num_features = network, prefix, 0

    def forward_features(self, images: Tensor) -> Tensor:
        found = self.network(images)
        if not isinstance(found, Tensor) or found.ndim not in (2, 3, 4):
            shown = f"shape {list(found.shape)}" if isinstance(found, Tensor) else type(found).__name__
            raise ValueError(
                f"the network returned {shown}: return features [B, D], tokens [B, P, D] or maps [B, D, H, W]"
            )
        return found[:, None] if found.ndim == 2 else found

    def forward(self, images: Tensor) -> Tensor:
        found = self.forward_features(images)
        if found.ndim == 4:
            return found.mean((2, 3))
        return found[:, min(self.num_prefix_tokens, found.shape[1] - 1) :].mean(1)


class ExternalEncoder(nn.Module):
    """Features [B, S D] of raw images [B, C, H, W], uint8 or float in [0, 1]. Several sensors are encoded one by one.

    Args:
        network: With the interface of timm's models: ``forward`` gives features [B, D], ``forward_features`` tokens
            [B, P, D] (with ``num_prefix_tokens``) or a map [B, D, H, W].
        preprocessing: Of its owner.
        pool: mean: features are the mean of the places. cls: the first token. "": those of ``forward``.
        about: What else decides the features, for their digest.

    Raises:
        ValueError: If the network does not take such images.
    """

    def __init__(self, network: nn.Module, preprocessing: Preprocessing, pool: str = "", about: str = "") -> None:
        super().__init__()
        self.network, self.preprocessing, self.pool = network.eval().requires_grad_(False), preprocessing, pool
        self.layout = Layout()
        known = hashlib.sha256(f"{preprocessing} {pool} {about}".encode()).digest()
        # A parameter, so that digests of the weights cover it and networks without weights have a device.
        self.identity = nn.Parameter(torch.frombuffer(bytearray(known), dtype=torch.uint8), requires_grad=False)
        shape = preprocessing.input_shape()
        try:
            with torch.no_grad():
                found = self._pooled(torch.zeros(2, *shape))
        except Exception as error:  # whatever the network raises
            raise ValueError(
                f"the network does not take images {list(shape)} ({brief(error)}): give its size and frames"
            ) from None
        if found.ndim != 2 or len(found) != 2 or not found.shape[1]:
            raise ValueError(f"the network returned {list(found.shape)} for two images: expected features [2, D]")
        self.num_features = self.width = found.shape[1]

    def bound(self, layout: Layout) -> "ExternalEncoder":
        """The same encoder, with the same weights, for images of ``layout``."""
        made = copy.copy(self)
        made.layout, made.num_features = layout, self.width * layout.sensors
        return made

    def forward(self, images: Tensor) -> Tensor:
        return self._pooled(self._prepared(images)).unflatten(0, (-1, self.layout.sensors)).flatten(1)

    def _prepared(self, images: Tensor) -> Tensor:
        shape = (self.layout.frames, self.layout.sensors, 3)
        each = images.unflatten(1, shape).transpose(1, 2).flatten(0, 1)  # [B S, F, 3, H, W]
        return self.preprocessing(each, self.layout.gain)

    def _pooled(self, x: Tensor) -> Tensor:
        if not self.pool:
            return self.network(x).float()
        found = self.network.forward_features(x)  # type: ignore[operator]
        if found.ndim == 4:
            if self.pool == "cls":
                raise ValueError("pool=cls needs a network with tokens: give pool=mean")
            return found.mean((2, 3) if found.shape[1] == num_features(self.network) else (1, 2)).float()
        front = int(self.network.num_prefix_tokens)  # type: ignore[arg-type]
        return (found[:, 0] if self.pool == "cls" else found[:, front:].mean(1)).float()
