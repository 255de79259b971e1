"""A MoCo step for two modalities built from lightly's components (`pip install --no-deps lightly lightly-utils`).

It uses lightly's projection heads, NT-Xent loss and momentum update, combined as in lightly's documentation for one
modality, with the four losses of the paper. Each image passes each network once. fp32, default memory layout, torch's
default Adam.
"""

from __future__ import annotations

import copy
import importlib.util

import timm
import torch
from torch import Tensor, nn

INSTALLED = importlib.util.find_spec("lightly") is not None


class LightlyStep:
    """One training step. Call it with two views [B, 3, S, S] of vision and two of touch; it returns the loss."""

    def __init__(self, trunk: str, device: torch.device) -> None:
        from lightly.loss import NTXentLoss  # pyright: ignore[reportMissingImports]
        from lightly.models.modules import MoCoProjectionHead  # pyright: ignore[reportMissingImports]
        from lightly.models.utils import (  # pyright: ignore[reportMissingImports]
            deactivate_requires_grad,
            update_momentum,
        )

        def tower() -> nn.ModuleDict:
            body = timm.create_model(trunk, num_classes=0)
            width = body.num_features
            heads = {name: MoCoProjectionHead(width, 512, 128) for name in ("intra", "inter")}
            return nn.ModuleDict({"body": body, **heads})

        self.query = nn.ModuleDict({m: tower() for m in ("vision", "touch")}).to(device).train()
        self.key = copy.deepcopy(self.query)
        deactivate_requires_grad(self.key)
        self.follow = lambda: update_momentum(self.query, self.key, m=0.99)
        self.loss = NTXentLoss(temperature=0.07)
        self.optimiser = torch.optim.Adam(self.query.parameters(), 1e-3)

    def __call__(self, vision: tuple[Tensor, Tensor], touch: tuple[Tensor, Tensor]) -> float:
        self.follow()
        z: dict[tuple[str, str, str], Tensor] = {}
        for modality, (first, second) in (("vision", vision), ("touch", touch)):
            query, key = self.query[modality], self.key[modality]
            features = query["body"](first)  # type: ignore[index, operator]
            with torch.no_grad():
                others = key["body"](second)  # type: ignore[index, operator]
            for head in ("intra", "inter"):
                z["query", modality, head] = query[head](features)  # type: ignore[index, operator]
                with torch.no_grad():
                    z["key", modality, head] = key[head](others)  # type: ignore[index, operator]
        pairs = (("vision", "vision"), ("touch", "touch"), ("vision", "touch"), ("touch", "vision"))
        losses = [
            self.loss(z["query", a, head], z["key", b, head])
            for a, b in pairs
            for head in ("intra" if a == b else "inter",)
        ]
        loss = torch.stack(losses).sum()
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return loss.item()
