"""What learns from images in a closed loop: ridge on frozen features or pixels, and a trunk trained along with its head."""

import copy
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from mvitac.evaluation.regressors import fit_ridge
from mvitac.model import Model
from mvitac.nn.encoders import num_features
from mvitac.sim.gel import area_resize

Encode = Callable[[str, np.ndarray], np.ndarray]  # modality, images uint8 [N, S, S, 3] -> features [N, D]
Look = Callable[[str], np.ndarray]  # modality -> what all episodes show now, uint8 [E, S, S, 3]
Estimate = Callable[[Look], np.ndarray]  # -> [E, T] or [T]
Learn = Callable[[dict[str, np.ndarray], np.ndarray, int], Estimate]
Lesson = tuple[dict[str, np.ndarray], np.ndarray, int]
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


def trained(model: Model, steps: int) -> Learn:
    """Train a copy of ``model`` for each sense and one linear head, by smooth L1 on standardised targets."""

    def learn(images: dict[str, np.ndarray], targets: np.ndarray, num_val: int) -> Estimate:
        mean, std = targets.mean(0), targets.std(0) + 1e-9
        trunks = nn.ModuleDict({sense: copy.deepcopy(model) for sense in images}).train()
        y = torch.from_numpy((targets - mean) / std).float()

        def features(look: Look) -> Tensor:
            seen = {m: torch.from_numpy(look(m)).permute(0, 3, 1, 2) for m in trunks}
            return torch.cat([trunk(**{m: seen[m]})[m] for m, trunk in trunks.items()], 1)

        with torch.random.fork_rng():
            torch.manual_seed(0)
            head = nn.Linear(sum(num_features(model.encoders[m]) for m in images), targets.shape[1])
            learned = [p.requires_grad_() for p in (*trunks.parameters(), *head.parameters()) if p.is_floating_point()]
            optimiser = torch.optim.AdamW(learned, weight_decay=0.05)
            schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=steps)
            for _ in range(steps):
                rows = torch.randint(len(y), (64,)).numpy()
                optimiser.zero_grad()
                nn.functional.smooth_l1_loss(head(features(lambda m, rows=rows: images[m][rows])), y[rows]).backward()
                optimiser.step()
                schedule.step()
        trunks.eval()

        @torch.no_grad()
        def estimate(look: Look) -> np.ndarray:
            return head(features(look)).numpy() * std + mean

        return estimate

    return learn
