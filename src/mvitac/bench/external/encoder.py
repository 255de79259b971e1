"""A frozen network with its owner's preprocessing, as one module from raw images to features.

Shapes: B images, S sensors, F frames, D features, P places.
"""

import copy
import hashlib
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from mvitac.bench.external.base import NOTHING, RANDOM, UNKNOWN, Adapter, Loaded, parse
from mvitac.nn.encoders import num_features
from mvitac.system.files import brief, digest_file


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
        return found[:, None] if found.ndim == 2 else found

    def forward(self, images: Tensor) -> Tensor:
        found = self.forward_features(images)
        if found.ndim == 4:
            return found.mean((2, 3))
        return found[:, min(self.num_prefix_tokens, found.shape[1] - 1) :].mean(1)


class ExternalEncoder(nn.Module):
    """Features [B, S D] of raw images [B, C, H, W], uint8 or float in [0, 1]. Several sensors are encoded one by one.

    Args:
        adapter: Its options.
        loaded: What it opened. The network has the interface of timm's models: ``forward`` gives features [B, D],
            ``forward_features`` tokens [B, P, D] (with ``num_prefix_tokens``) or a map [B, D, H, W].

    Raises:
        ValueError: If the network does not take such images.
    """

    def __init__(self, adapter: Adapter, loaded: Loaded) -> None:
        super().__init__()
        self.adapter, self.loaded, self.layout = adapter, loaded, Layout()
        self.network = loaded.network.eval().requires_grad_(False)
        self.preprocessing = adapter.changed(loaded.preprocessing)
        digests = [digest_file(file) for file in loaded.files]
        known = hashlib.sha256(f"{self.preprocessing} {adapter.pool} {digests}".encode()).digest()
        # A parameter, so that digests of the weights cover it and networks without weights have a device.
        self.identity = nn.Parameter(torch.frombuffer(bytearray(known), dtype=torch.uint8), requires_grad=False)
        shape = self.preprocessing.input_shape()
        try:
            with torch.no_grad():
                found = self._pooled(torch.zeros(2, *shape))
            if found.ndim != 2 or len(found) != 2 or not found.shape[1]:
                raise ValueError(f"it returns {list(found.shape)} for two images, not [2, D]")
        except Exception as error:  # whatever the network raises
            why = f"the network does not take images {list(shape)} ({brief(error)})"
            raise ValueError(f"{adapter.place}: {why}: give its size and frames") from None
        self.num_features = self.width = found.shape[1]

    def bound(self, layout: Layout) -> "ExternalEncoder":
        """The same encoder, with the same weights, for images of ``layout``."""
        made = copy.copy(self)
        made.layout, made.num_features = layout, self.width * layout.sensors
        return made

    def untrained(self) -> "ExternalEncoder | None":
        """The same network with random weights; None if it has no weights here, or random ones already."""
        if self.loaded.trained_on == NOTHING or not any(p.is_floating_point() for p in self.network.parameters()):
            return None
        network = randomised(self.network, self.adapter.seed)
        random = replace(self.loaded, network=network, files=(), licence=RANDOM, trained_on=NOTHING)
        return ExternalEncoder(self.adapter, random)

    def forward(self, images: Tensor) -> Tensor:
        return self._pooled(self._prepared(images)).unflatten(0, (-1, self.layout.sensors)).flatten(1)

    def _prepared(self, images: Tensor) -> Tensor:
        shape = (self.layout.frames, self.layout.sensors, 3)
        each = images.unflatten(1, shape).transpose(1, 2).flatten(0, 1)  # [B S, F, 3, H, W]
        return self.preprocessing(each, self.layout.gain)

    def _pooled(self, x: Tensor) -> Tensor:
        if not self.adapter.pool:
            return self.network(x).float()
        found = self.network.forward_features(x)  # type: ignore[operator]
        if found.ndim == 4:
            if self.adapter.pool == "cls":
                raise ValueError("pool=cls needs a network with tokens: give pool=mean")
            return found.mean((2, 3) if found.shape[1] == num_features(self.network) else (1, 2)).float()
        front = int(self.network.num_prefix_tokens)  # type: ignore[arg-type]
        return (found[:, 0] if self.adapter.pool == "cls" else found[:, front:].mean(1)).float()


def randomised(network: nn.Module, seed: int) -> nn.Module:
    """A copy of ``network`` with random weights: matrices truncated normal (.02), convolutions He, scales 1, biases 0."""
    network, generator = copy.deepcopy(network), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if weight.ndim > 3:
                nn.init.kaiming_normal_(weight, generator=generator)
            elif weight.ndim > 1:
                nn.init.trunc_normal_(weight, std=0.02, generator=generator)
            else:
                weight.fill_(not name.endswith("bias"))
        for name, value in network.named_buffers():
            if name.endswith(("running_mean", "running_var")):
                value.fill_(name.endswith("var"))
    return network


def open_encoder(text: str) -> ExternalEncoder:
    """Open the encoder that ``text`` names (``base``); ValueError if that is not possible."""
    adapter = parse(text)
    loaded = adapter.load()
    given = {name: getattr(adapter, name) for name in ("licence", "trained_on") if getattr(loaded, name) == UNKNOWN}
    given["title"] = adapter.title
    return ExternalEncoder(adapter, replace(loaded, **{name: value for name, value in given.items() if value}))
