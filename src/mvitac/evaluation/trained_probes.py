"""Probes that are small networks: an MLP on pooled features, and attention over the trunk's last feature map.

The attentive probe is the pooler of V-JEPA (arXiv:2404.08471) and Sparsh (arXiv:2410.24090): one learned query attends to
all places of the map, then one MLP block and a linear layer. Here each channel is standardised over the fitted rows
instead of normalised within each image, because force is also in a feature's size. Places have a learned position.

Shapes: N or B rows, P places, D features, H heads, K classes or targets.
"""

import copy
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mvitac.methods.supervised import ValueHead

TRAINED = ("mlp", "attentive")
STEPS = (100, 300, 1000)  # candidate lengths of training. One is chosen on held-out groups of train.
BATCH, RATE, DECAY, MEMORY = 128, 1e-3, 0.01, 0.99
"""AdamW: rows per step, learning rate, weight decay. What is used is a running mean of the weights, with this memory."""
HIDDEN = 512  # hidden units of the MLP


def fit_network(
    kind: str, x: np.ndarray, y: np.ndarray, num_val: int, num_out: int, seed: int
) -> tuple[Callable[[np.ndarray], np.ndarray], int]:
    """Train a probe of ``kind`` (``TRAINED``): AdamW at a fixed rate, cross-entropy or smooth L1 on standardised values.

    The number of steps is the one of ``STEPS`` with the lowest loss on the last ``num_val`` rows, which hold groups of
    their own. The final network is trained for as many steps on all rows.

    Args:
        x: Features [N, D] for mlp, maps [N, P, D] for attentive.
        y: Labels [N], or values [N, K] with NaN = not measured; ``num_out`` is the number of classes or targets K.

    Returns:
        A function from features or maps to logits [M, K], or values [M, K] in their units; and the number of steps.
    """
    build = partial(_network, kind, x, y, num_out, seed)
    answers, num = torch.from_numpy(y), len(x) - num_val
    networks = _trained(build(), x[:num], answers[:num], STEPS, seed)
    held = [_loss_on(network, x[num:], answers[num:]) for network in networks]
    steps = STEPS[int(np.argmin(held))]
    (network,) = _trained(build(), x, answers, (steps,), seed)
    return partial(_outputs, network), steps


class Attentive(nn.Module):
    """Logits or values [B, K] from maps [B, P, D].

    The query's projections to keys are kept multiplied out, so that a step costs P H D products and not P D D.
    """

    def __init__(self, places: int, width: int, num_out: int) -> None:
        super().__init__()
        heads = max((h for h in range(1, 13) if width % h == 0 and width // h >= 32), default=1)
        depth = width // heads
        self.position = nn.Parameter(torch.empty(places, width))
        self.query = nn.Parameter(torch.empty(heads, depth))
        self.key, self.value = (nn.Parameter(torch.empty(heads, depth, width)) for _ in range(2))
        self.start, self.norm = nn.Parameter(torch.zeros(width)), nn.LayerNorm(width)
        self.joined, self.out = _linear(width, width), _linear(width, num_out)
        self.block = nn.Sequential(_linear(width, 4 * width), nn.GELU(), _linear(4 * width, width))

    def forward(self, maps: Tensor) -> Tensor:
        x = maps + self.position
        asked = torch.einsum("hd,hdw->hw", self.query, self.key) * self.query.shape[1] ** -0.5
        weights = torch.einsum("bpw,hw->bhp", x, asked).softmax(dim=2)
        seen = torch.einsum("bhw,hdw->bhd", weights @ x, self.value).flatten(1)
        z = self.start + self.joined(seen)
        return self.out(z + self.block(self.norm(z)))


class Standardised(nn.Module):
    """``network`` on inputs whose channels are standardised over the fitted rows."""

    mean: Tensor
    std: Tensor

    def __init__(self, network: nn.Module, x: np.ndarray) -> None:
        super().__init__()
        self.network = network
        places = x.reshape(-1, x.shape[-1])
        parts = np.array_split(places, -(-len(places) // 4096))  # all rows' maps as floats may not fit
        mean = sum(part.sum(0, dtype=float) for part in parts) / len(places)
        std = np.sqrt(sum(((part - mean) ** 2).sum(0) for part in parts) / len(places))
        self.register_buffer("mean", torch.from_numpy(mean).float())
        self.register_buffer("std", torch.from_numpy(std).float() + 1e-6)

    def forward(self, x: Tensor) -> Tensor:
        return self.network((x - self.mean) / self.std)


def _linear(width: int, num: int) -> nn.Linear:
    """A linear layer without weights yet: drawing them here would use the random generator that threads share."""
    return nn.utils.skip_init(nn.Linear, width, num)  # type: ignore[return-value]


def _network(kind: str, x: np.ndarray, y: np.ndarray, num_out: int, seed: int) -> nn.Module:
    """A fresh probe, as a ``ValueHead`` if ``y`` has values."""
    if kind == "attentive":
        network: nn.Module = Attentive(x.shape[1], x.shape[2], num_out)
    else:
        network = nn.Sequential(_linear(x.shape[1], HIDDEN), nn.GELU(), _linear(HIDDEN, num_out))
    generator = torch.Generator().manual_seed(seed)
    for name, weight in network.named_parameters():
        if weight.ndim > 1:  # positions are drawn as large as the standardised channels
            std = 1.0 if name == "position" else weight.shape[-1] ** -0.5
            nn.init.normal_(weight, std=std, generator=generator)
        elif name.endswith("bias"):
            nn.init.zeros_(weight)
    network = Standardised(network, x)
    if y.ndim == 2:
        network = ValueHead(network, num_out)
        network.learn_scale(torch.from_numpy(y))
    return network.to("cuda" if torch.cuda.is_available() else "cpu")


def _trained(network: nn.Module, x: np.ndarray, y: Tensor, lengths: tuple[int, ...], seed: int) -> Iterator[nn.Module]:
    """Train ``network``; yield the running mean of its weights after each number of steps in ``lengths``."""
    generator, device = torch.Generator().manual_seed(seed), next(network.parameters()).device
    averaged = copy.deepcopy(network).requires_grad_(False)
    pairs = list(zip(averaged.parameters(), network.parameters(), strict=True))
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    order = torch.zeros(0, dtype=torch.int64)
    for step in range(1, lengths[-1] + 1):
        if len(order) < min(BATCH, len(x)):
            order = torch.cat([order, torch.randperm(len(x), generator=generator)])
        batch, order = order[:BATCH], order[BATCH:]
        optimiser.zero_grad()
        _loss(network, torch.from_numpy(x[batch.numpy()]).float().to(device), y[batch].to(device)).backward()
        optimiser.step()
        for mean, weight in pairs:
            mean.lerp_(weight.detach(), 1 - min(MEMORY, step / (step + 9)))
        if step in lengths:
            yield averaged


def _loss(network: nn.Module, x: Tensor, y: Tensor) -> Tensor:
    if isinstance(network, ValueHead):
        return network.loss(x, y.float())
    return F.cross_entropy(network(x), y)


@torch.no_grad()
def _loss_on(network: nn.Module, x: np.ndarray, y: Tensor) -> float:
    """Mean loss of all rows, 256 at a time."""
    device, total = next(network.parameters()).device, 0.0
    for rows in np.array_split(np.arange(len(x)), -(-len(x) // 256)):
        part = torch.from_numpy(x[rows]).float().to(device)
        total += _loss(network, part, y[rows].to(device)).item() * len(rows) / len(x)
    return total


@torch.no_grad()
def _outputs(network: nn.Module, x: np.ndarray) -> np.ndarray:
    """Outputs [M, K] of all rows, 256 at a time."""
    device = next(network.parameters()).device
    parts = [torch.from_numpy(part).float().to(device) for part in np.array_split(x, -(-len(x) // 256))]
    return torch.cat([network(part).cpu() for part in parts]).numpy()
