"""What learns from images in a closed loop: ridge on frozen features or pixels, and a trunk trained along with its head."""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mvitac.bench.external import open_model
from mvitac.evaluation.regressors import fit_ridge
from mvitac.model import Model
from mvitac.sim.gel import area_resize

Encode = Callable[[str, np.ndarray], np.ndarray]  # modality, images uint8 [N, S, S, 3] -> features [N, D]
Look = Callable[[str], np.ndarray]  # modality -> what all episodes show now, uint8 [E, S, S, 3]
Estimate = Callable[[Look], np.ndarray]  # -> [E, T] or [T]
Learn = Callable[[dict[str, np.ndarray], np.ndarray, int], Estimate]
"""Images by modality, targets [N, T] of the first N of them, how many of the last of these choose a strength."""


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


def ridge(encode: Encode) -> Learn:
    """Ridge regression on features; those of the images that are learned from are computed once."""
    known: dict[int, np.ndarray] = {}

    def learn(images: dict[str, np.ndarray], targets: np.ndarray, num_val: int) -> Estimate:
        for modality, each in images.items():
            if id(each) not in known:
                known[id(each)] = encode(modality, each)
        features = np.concatenate([known[id(each)][: len(targets)] for each in images.values()], axis=1)
        fitted, _ = fit_ridge(features, targets, num_val)
        return lambda look: fitted(np.concatenate([encode(each, look(each)) for each in images], axis=1))

    return learn


def blind(images: dict[str, np.ndarray], targets: np.ndarray, num_val: int) -> Estimate:
    """The mean of the targets, whatever is seen."""
    return lambda look: targets.mean(0)


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


def end_to_end(text: str, steps: int) -> Learn:
    """Train the network that ``text`` names with a linear head, by smooth L1 on standardised targets."""

    def tensors(images: Sequence[np.ndarray]) -> list[Tensor]:
        return [torch.from_numpy(x).permute(0, 3, 1, 2) for x in images]

    def learn(images: dict[str, np.ndarray], targets: np.ndarray, num_val: int) -> Estimate:
        mean, std = targets.mean(0), targets.std(0) + 1e-9
        with torch.random.fork_rng():
            torch.manual_seed(0)
            network = _Network(text, len(images), targets.shape[1]).train()
            x, y = tensors(list(images.values())), torch.from_numpy((targets - mean) / std).float()
            optimiser = torch.optim.AdamW([p for p in network.parameters() if p.requires_grad], weight_decay=0.05)
            schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=steps)
            for _ in range(steps):
                rows = torch.randint(len(y), (64,))
                loss = nn.functional.smooth_l1_loss(network([each[rows] for each in x]), y[rows])
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                schedule.step()
        network.eval().requires_grad_(False)
        return lambda look: network(tensors([look(each) for each in images])).numpy() * std + mean

    return learn
