"""The rows of ``servo-v1``: who estimates the pose, and how far from its target each episode then stays."""

import copy
import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import nn

from mvitac.bench.external import open_model
from mvitac.control.servo import STEP_MS, TASKS, Episode, presses, touch_at
from mvitac.control.suite import ServoSuite
from mvitac.evaluation.regressors import fit_ridge
from mvitac.model import Model
from mvitac.sim.gel import area_resize
from mvitac.system.progress import tick

Encode = Callable[[np.ndarray], np.ndarray]  # images uint8 [N, S, S, 3] -> features [N, D]
SUMS = ("mm", "deg", "lost")  # of the scored steps of one shape
TRUE, NONE, SHUFFLED = "true pose", "no touch", "touch shuffled"


@dataclass(frozen=True)
class Row:
    """One row of a suite, and the function that scores it."""

    source: str  # "" is the encoder
    seed: int | None
    score: Callable[[], list[dict[str, Any]]]


def encoding(model: Model) -> Encode:
    """The frozen features of touch of ``model``; ValueError if it does not read single images of one gel."""
    if "touch" not in model.encoders or model.spec.channels("touch") != 3 or model.spec.difference:
        raise ValueError(f"{model!r} does not read plain images of one gel, which closed-loop suites give")

    def encode(images: np.ndarray) -> np.ndarray:
        chunks = torch.from_numpy(images).permute(0, 3, 1, 2).split(256)
        return torch.cat([model.features("touch", chunk) for chunk in chunks]).numpy()

    return encode


def pixels(images: np.ndarray) -> np.ndarray:
    """8 x 8 pixels of each image, [N, 192]."""
    return np.stack([area_resize(image.astype(np.float32), 8, 8).ravel() for image in images])


class Servo:
    """A suite with its presses, which are rendered once for all rows."""

    def __init__(self, suite: ServoSuite, mapped: Callable[..., Iterable[Any]] = map) -> None:
        self.suite, self.map = suite, mapped  # ``map``, or that of a pool of processes

    @cached_property
    def presses(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        found, suite = {}, self.suite
        for name in TASKS:
            made = list(self.map(partial(presses, name, suite.seed, suite.fit_presses), range(suite.fit_shapes)))
            images, poses = (np.concatenate(parts) for parts in zip(*made, strict=True))
            found[name] = images, poses
        return found

    def data(self) -> dict[str, str]:
        """Digests of the presses."""
        return {name: hashlib.sha256(images.tobytes()).hexdigest() for name, (images, _) in self.presses.items()}

    def rows(self, models: Sequence[Model]) -> list[Row]:
        """The encoder's seeds, then the controls."""
        own = [Row("", model.seed, lambda m=model: self._probed(encoding(m))) for model in models]
        suite, shuffled = self.suite, encoding(models[0])
        random = [open_model(text) for text in suite.untrained]
        found = [*own, Row(SHUFFLED, models[0].seed, lambda: self._probed(shuffled, shuffle=True))]
        found += [Row(TRUE, None, lambda: self.run(None)), Row(NONE, None, self._blind)]
        found += [Row("pixels", None, lambda: self._probed(pixels))]
        found += [Row("untrained", model.seed, lambda m=model: self._probed(encoding(m))) for model in random]
        found.append(Row("end to end", None, lambda: self._trained(random[0])))
        try:
            known = open_model(suite.imagenet)
        except ValueError:  # its weights cannot be had here
            return found
        return [*found, Row("imagenet", None, lambda: self._probed(encoding(known)))]

    def _probed(self, encode: Encode, *, shuffle: bool = False) -> list[dict[str, Any]]:
        fitted = {}
        for name, (images, poses) in self.presses.items():
            held = self.suite.fit_val * self.suite.fit_presses
            fitted[name] = fit_ridge(encode(images), poses, held)[0]
        return self.run(lambda name, images: fitted[name](encode(images)), shuffle=shuffle)

    def _blind(self) -> list[dict[str, Any]]:
        """The mean of the presses' poses, whatever is touched."""
        return self.run(lambda name, images: np.tile(self.presses[name][1].mean(0), (len(images), 1)), see=False)

    def _trained(self, model: Model) -> list[dict[str, Any]]:
        known = {name: train(model, *data, epochs=self.suite.epochs) for name, data in self.presses.items()}
        return self.run(lambda name, images: known[name](images))

    def run(
        self,
        estimate: Callable[[str, np.ndarray], np.ndarray] | None,
        *,
        shuffle: bool = False,
        see: bool = True,
    ) -> list[dict[str, Any]]:
        """Sums of every kind and condition, by shape; ``estimate`` gives poses from a task's images, None: the true ones.

        With ``shuffle`` each episode gets the image of the next shape; without ``see`` no image is rendered.
        """
        cells = []
        for name, task in TASKS.items():
            for kind in task.kinds:
                cells += self._follow(name, kind, estimate, shuffle, see)
                tick("kinds")
        return cells

    def _follow(self, name: str, kind: str, estimate: Any, shuffle: bool, see: bool) -> list[dict[str, Any]]:
        """All episodes of one kind, in step, so that their images are rendered and encoded together."""
        suite, num = self.suite, self.suite.shapes
        asked = [{"new": one.new_sensor, "noise": one.noise} for one in suite.conditions for _ in range(num)]
        episodes = [Episode.begin(suite.seed, kind, i % num, **each) for i, each in enumerate(asked)]
        late = np.repeat([one.latency_ms // STEP_MS for one in suite.conditions], num)
        order = np.arange(len(episodes))
        other = order - order % num + (order + 1) % num  # the next shape under the same condition
        sums = np.zeros((len(episodes), len(SUMS)))
        known: list[np.ndarray] = []
        for step in range(suite.steps):
            if estimate is None:
                known.append(np.stack([episode.pose for episode in episodes]))
            else:
                images = self._touches(kind, asked, episodes) if see else np.zeros((len(episodes), 1, 1, 3), np.uint8)
                known.append(estimate(name, images[other] if shuffle else images))
            for i, episode in enumerate(episodes):
                away = known[max(0, step - late[i])][i] - episode.task.target
                bound = suite.most * episode.task.limit
                episode.move(np.clip(-suite.gain * away, -bound, bound))
                if step >= suite.settle:
                    sums[i] += (*episode.error(), episode.lost)
        found, n = [], [float(suite.steps - suite.settle)] * num
        for one, lines in zip(suite.conditions, sums.reshape(-1, num, len(SUMS)), strict=True):
            each = {key: [float(f"{x:.10g}") for x in line] for key, line in zip(SUMS, lines.T, strict=True)}
            found.append({"task": kind, "condition": one.name, "n": n, **each})
        return found

    def _touches(self, kind: str, asked: Sequence[dict[str, Any]], episodes: Sequence[Episode]) -> np.ndarray:
        """The pictures of this moment."""
        seed, num = self.suite.seed, self.suite.shapes
        wanted = [
            (seed, kind, i % num, each, e.state, e.step)
            for i, (each, e) in enumerate(zip(asked, episodes, strict=True))
        ]
        return np.stack(list(self.map(touch_at, wanted)))


def train(model: Model, images: np.ndarray, poses: np.ndarray, *, epochs: int, seed: int = 0) -> Encode:
    """The network of an external ``model`` with a linear head, both trained: smooth L1 on standardised poses."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        trunk = copy.deepcopy(model.encoders["touch"]).train()
        trunk.network.requires_grad_(True)  # type: ignore[union-attr]
        head = nn.Linear(trunk.num_features, poses.shape[1])  # type: ignore[arg-type]
        network = nn.Sequential(trunk, head)
        x = torch.from_numpy(images).permute(0, 3, 1, 2)
        mean, std = poses.mean(0), poses.std(0)
        y = torch.from_numpy((poses - mean) / std).float()
        weights = [p for p in network.parameters() if p.requires_grad]
        optimiser = torch.optim.AdamW(weights, lr=1e-3, weight_decay=0.05)
        steps = epochs * -(-len(x) // 64)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=steps)
        for _ in range(epochs):
            for rows in torch.randperm(len(x)).split(64):
                loss = nn.functional.smooth_l1_loss(network(x[rows]), y[rows])
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                schedule.step()
    network.eval()

    @torch.no_grad()
    def estimate(images: np.ndarray) -> np.ndarray:
        return network(torch.from_numpy(images).permute(0, 3, 1, 2)).numpy() * std + mean

    return estimate
