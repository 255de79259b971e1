"""Baseline for comparison: a training step and input pipeline as in typical research code of this field.

It follows the released code of several papers. Images are JPEG files. PIL decodes and augments them one by one in a
DataLoader. The intra- and inter-modal losses use separate forward passes. The momentum update is a Python loop over
parameters. Everything is fp32 in the default memory layout.
"""

from __future__ import annotations

import copy
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import timm
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, RandomSampler
from torchvision.transforms import v2

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class TypicalStep:
    """A step on two modalities. Query and key networks have two heads each. Call it with four views [B, 3, S, S]."""

    def __init__(self, trunk: str, device: torch.device) -> None:
        def tower() -> nn.ModuleDict:
            body = timm.create_model(trunk, num_classes=0)

            def head() -> nn.Sequential:
                return nn.Sequential(nn.Linear(body.num_features, 512), nn.ReLU(), nn.Linear(512, 128))

            return nn.ModuleDict({"body": body, "intra": head(), "inter": head()})

        self.query = nn.ModuleDict({m: tower() for m in ("vision", "touch")}).to(device).train()
        self.key = copy.deepcopy(self.query)
        for p in self.key.parameters():
            p.requires_grad = False
        self.optimiser = torch.optim.Adam(self.query.parameters(), 1e-3, foreach=False)

    def embed(self, towers: nn.ModuleDict, modality: str, head: str, images: Tensor) -> Tensor:
        tower = towers[modality]
        return F.normalize(tower[head](tower["body"](images)), dim=1)

    def __call__(self, vision: tuple[Tensor, Tensor], touch: tuple[Tensor, Tensor]) -> float:
        views = {"vision": vision, "touch": touch}
        loss = torch.zeros((), device=vision[0].device)
        pairs = (
            ("vision", "vision", "intra"),
            ("touch", "touch", "intra"),
            ("vision", "touch", "inter"),
            ("touch", "vision", "inter"),
        )
        for a, b, head in pairs:
            query = self.embed(self.query, a, head, views[a][0])
            with torch.no_grad():
                key = self.embed(self.key, b, head, views[b][1])
            logits = query @ key.T / 0.07
            loss = loss + F.cross_entropy(logits, torch.arange(len(logits), device=logits.device))
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        for q, k in zip(self.query.parameters(), self.key.parameters(), strict=True):
            k.data = k.data * 0.99 + q.data * 0.01
        return loss.item()


class TypicalDataset(Dataset):
    """Pairs of 640x480 JPEG files. An item is four PIL views: two of vision, two of touch."""

    def __init__(self, folder: Path, size: int) -> None:
        self.paths = sorted(folder.glob("vision-*.jpg"))
        self.transform = v2.Compose(
            [
                v2.Resize((256, 256)),
                v2.RandomResizedCrop(size, scale=(0.2, 1.0)),
                v2.RandomHorizontalFlip(),
                v2.RandomGrayscale(0.2),
                v2.PILToTensor(),
                v2.ToDtype(torch.float32, scale=True),
                v2.Normalize(MEAN, STD),
            ]
        )

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        path = self.paths[index]
        vision = Image.open(path).convert("RGB")
        touch = Image.open(path.with_name(path.name.replace("vision", "touch"))).convert("RGB")
        return self.transform(vision), self.transform(vision), self.transform(touch), self.transform(touch)


def write_jpegs(folder: Path, num: int) -> None:
    """Write ``num`` pairs of 640x480 JPEG files with photograph-like content."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    grains = rng.normal(0, 4, (8, 480, 640, 3))
    for i in range(num):
        for name in ("vision", "touch"):
            coarse = Image.fromarray(rng.integers(0, 255, (30, 40, 3), dtype=np.uint8)).resize((640, 480))
            picture = np.clip(np.asarray(coarse) + grains[i % 8], 0, 255).astype(np.uint8)
            Image.fromarray(picture).save(folder / f"{name}-{i:05d}.jpg", quality=90)


def typical_batches(folder: Path, size: int, batch: int, workers: int) -> Iterator[list[Tensor]]:
    """Yield shuffled batches of four views [B, 3, S, S], without end."""
    random.seed(0)
    dataset = TypicalDataset(folder, size)
    # One long epoch: between short ones, most workers would wait, and all would start again.
    order = RandomSampler(dataset, replacement=True, num_samples=1_000_000 * batch)
    yield from DataLoader(dataset, batch, sampler=order, num_workers=workers)
