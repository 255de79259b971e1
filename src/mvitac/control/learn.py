"""What learns from images in a closed loop: frozen features, pixels, and trunks trained along; heads are linear."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mvitac.bench.external import open_model
from mvitac.model import Model
from mvitac.sim.gel import area_resize

Encode = Callable[[str, np.ndarray], np.ndarray]  # modality, images uint8 [N, S, S, 3] -> features [N, D]
Cells = list[dict[str, Any]]


@dataclass(frozen=True)
class Row:
    """One row of a suite, and the function that scores it."""

    source: str  # "" is the encoder
    seed: int | None
    score: Callable[[], Cells]


def encoding(model: Model) -> Encode:
    """The frozen features of ``model``; ValueError if it does not read single images of one gel."""
    if "touch" not in model.encoders or model.spec.channels("touch") != 3 or model.spec.difference:
        raise ValueError(f"{model!r} does not read plain images of one gel, which closed-loop suites give")

    def encode(modality: str, images: np.ndarray) -> np.ndarray:
        model.check_modality(modality)
        chunks = torch.from_numpy(images).permute(0, 3, 1, 2).split(256)
        return torch.cat([model.features(modality, chunk) for chunk in chunks]).numpy()

    return encode


def pixels(modality: str, images: np.ndarray) -> np.ndarray:
    """8 x 8 pixels of each image, [N, 192]."""
    return np.stack([area_resize(image.astype(np.float32), 8, 8).ravel() for image in images])


def frozen_rows(
    models: Sequence[Model], untrained: Sequence[str], imagenet: str
) -> list[tuple[str, int | None, Encode]]:
    """Source, seed and features of each frozen row: the encoder's seeds, pixels, untrained trunks, ImageNet if here."""
    found: list[tuple[str, int | None, Encode]] = [("", model.seed, encoding(model)) for model in models]
    found.append(("pixels", None, pixels))
    found += [("untrained", model.seed, encoding(model)) for model in map(open_model, untrained)]
    try:
        return [*found, ("imagenet", None, encoding(open_model(imagenet)))]
    except ValueError:  # its weights cannot be had here
        return found


class _Network(nn.Module):
    """A copy of a trunk for each image of a row, and one linear head on their features."""

    def __init__(self, text: str, images: int, num: int) -> None:
        super().__init__()
        trunk: Any = open_model(text).encoders["touch"]
        self.trunks = nn.ModuleList(copy.deepcopy(trunk) for _ in range(images))
        for each in self.trunks:
            each.network.requires_grad_(True)  # type: ignore[union-attr]
        self.head = nn.Linear(images * trunk.num_features, num)

    def forward(self, images: Sequence[Tensor]) -> Tensor:
        return self.head(torch.cat([trunk(x) for trunk, x in zip(self.trunks, images, strict=True)], 1))


def train(
    text: str, images: Sequence[np.ndarray], targets: np.ndarray, *, steps: int
) -> Callable[[Sequence[np.ndarray]], np.ndarray]:
    """Train the network that ``text`` names, with a linear head, from images uint8 [N, S, S, 3] to ``targets`` [N, T].

    Smooth L1 on standardised targets. Returns the function from images to targets.
    """
    mean, std = targets.mean(0), targets.std(0) + 1e-9

    def tensors(images: Sequence[np.ndarray]) -> list[Tensor]:
        return [torch.from_numpy(x).permute(0, 3, 1, 2) for x in images]

    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = _Network(text, len(images), targets.shape[1]).train()
        x, y = tensors(images), torch.from_numpy((targets - mean) / std).float()
        optimiser = torch.optim.AdamW([p for p in network.parameters() if p.requires_grad], weight_decay=0.05)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=steps)
        for _ in range(steps):
            rows = torch.randint(len(y), (64,))
            loss = nn.functional.smooth_l1_loss(network([each[rows] for each in x]), y[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    network.eval()

    @torch.no_grad()
    def estimate(images: Sequence[np.ndarray]) -> np.ndarray:
        return network(tensors(images)).numpy() * std + mean

    return estimate
