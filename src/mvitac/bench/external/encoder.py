"""A frozen network with its owner's preprocessing, as one module from raw images to features.

Shapes: B images, S sensors, F frames, D features, P places.
"""

import copy
import hashlib
from dataclasses import replace

import torch
from torch import Tensor, nn

from mvitac.bench.external.adapters import NOTHING, RANDOM, UNKNOWN, Adapter, Loaded, parse
from mvitac.system.files import brief, digest_file


class ExternalEncoder(nn.Module):
    """Features [B, S D] of raw images [B, C, H, W], uint8 or float in [0, 1]. Several sensors are encoded one by one.

    Args:
        adapter: Its options.
        loaded: What it opened.

    Raises:
        ValueError: If the network does not take such images.
    """

    def __init__(self, adapter: Adapter, loaded: Loaded) -> None:
        super().__init__()
        self.adapter, self.loaded, self.sensors, self.frames = adapter, loaded, 1, 1
        self.network = loaded.network.eval().requires_grad_(False)
        self.preprocessing = adapter.changed(loaded.preprocessing)
        digests = [digest_file(file) for file in loaded.files]
        known = hashlib.sha256(f"{self.preprocessing} {digests}".encode()).digest()
        # A parameter, so that digests of the weights cover it and networks without weights have a device.
        self.identity = nn.Parameter(torch.frombuffer(bytearray(known), dtype=torch.uint8), requires_grad=False)
        shape = self.preprocessing.input_shape()
        try:
            with torch.no_grad():
                found = self.network(torch.zeros(2, *shape))
            if found.ndim != 2 or len(found) != 2 or not found.shape[1]:
                raise ValueError(f"it returns {list(found.shape)} for two images, not [2, D]")
        except Exception as error:  # whatever the network raises
            why = f"the network does not take images {list(shape)} ({brief(error)})"
            raise ValueError(f"{adapter.place}: {why}: give its size and frames") from None
        self.num_features = self.width = found.shape[1]

    def bound(self, sensors: int, frames: int) -> "ExternalEncoder":
        """The same encoder, with the same weights, for images [B, frames x sensors x 3, H, W], newest frame first."""
        made = copy.copy(self)
        made.sensors, made.frames, made.num_features = sensors, frames, self.width * sensors
        return made

    def untrained(self) -> "ExternalEncoder | None":
        """The same network with random weights; None if it has no weights here, or random ones already."""
        if self.loaded.trained_on == NOTHING or not any(p.is_floating_point() for p in self.network.parameters()):
            return None
        network = randomised(self.network, self.adapter.seed)
        random = replace(self.loaded, network=network, files=(), licence=RANDOM, trained_on=NOTHING)
        return ExternalEncoder(self.adapter, random)

    def forward(self, images: Tensor) -> Tensor:
        each = images.unflatten(1, (self.frames, self.sensors, 3)).transpose(1, 2).flatten(0, 1)  # [B S, F, 3, H, W]
        return self.network(self.preprocessing(each)).float().unflatten(0, (-1, self.sensors)).flatten(1)


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
