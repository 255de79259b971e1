"""Every method on a tiny trunk with narrow heads, a batch of noise for it, its losses, and InfoNCE written out."""

import math
from dataclasses import replace

import torch

from mvitac.data.spec import DataSpec
from mvitac.methods.base import Method, MethodConfig, Views
from mvitac.nn.encoders import SCRATCH, Encoders
from mvitac.registry import default
from support.toy import Toy

TINY = Encoders().changed(trunk="mvitac_tiny", weights=SCRATCH)
TINY_VIT = Encoders().changed(trunk="mvitac_tiny_vit", weights=SCRATCH)
ROWS = torch.arange(3, 83)
PAIRED = ("cmc", "mct", "ssvtp")


def small(name: str) -> MethodConfig:
    config = default(MethodConfig, name)
    narrow = {"hidden": 24, "out": 12, "queue": 20, "num_negatives": 9}
    return replace(config, **{key: value for key, value in narrow.items() if hasattr(config, key)})


def build(name: str, spec: DataSpec | None = None, config: MethodConfig | None = None) -> Method:
    torch.manual_seed(0)
    config = config or small(name)
    method = config.build(spec or Toy().spec(), TINY_VIT if config.needs_vit else TINY)
    method.prepare(ROWS)
    return method


def views(method: Method, num: int = 8, seed: int = 5, vision: int = 3, touch: int = 3) -> Views:
    rng = torch.Generator().manual_seed(seed)
    channels = {m: c for m, c in (("vision", vision), ("touch", touch)) if c}
    images = {m: [torch.randn(num, c, 32, 32, generator=rng) for _ in range(method.views)] for m, c in channels.items()}
    labels = {"pattern": torch.arange(num) % 3, "bright": torch.arange(num) % 2}
    return Views(images=images, labels=labels, rows=ROWS[torch.randperm(len(ROWS), generator=rng)[:num]])


def outcome(method: Method, batch: Views) -> dict[str, torch.Tensor]:
    torch.manual_seed(9)  # dropout, drawn negatives
    return method(batch)


def slow_info_nce(query: torch.Tensor, key: torch.Tensor, tau: float) -> float:
    """Eq. 8 word by word, in float64, one query at a time."""
    query, key, total = query.detach(), key.detach(), 0.0
    for i in range(len(query)):
        q = query[i].double() / query[i].double().norm()
        ks = [k.double() / k.double().norm() for k in key]
        numerator = math.exp(float(q @ ks[i]) / tau)
        total += -math.log(numerator / sum(math.exp(float(q @ k) / tau) for k in ks))
    return total / len(query)
