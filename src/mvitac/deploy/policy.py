"""Trained encoders as the observation encoder of a robot policy: from a dict of images to one feature vector.

    encoder = ObservationEncoder(mvitac.load("runs/demo/seed0"), {"observation.images.wrist": "vision",
                                                                  "observation.images.gel": "touch"})
    policy = nn.Sequential(encoder, nn.Linear(encoder.out_features, num_actions))

Follows LeRobot's convention: images are [B, 3, H, W] (or [B, T, 3, H, W]), float in [0, 1] or uint8, RGB.
"""

import copy
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from mvitac.model import Model
from mvitac.nn.encoders import num_features
from mvitac.transforms.preprocess import check_images, resized

STATE = "observation.state"


class ObservationEncoder(nn.Module):
    """Features [B, D] (or [B, T, D]) of an observation, in the order of ``keys``, with the robot's state at the end.

    A model of difference images (``model.spec.difference``) takes touch as (touch - background) / 2 + one half. Images of
    another kind are refused; on a GPU, those of other values only in the first batch of a key.
    """

    def __init__(self, model: Model, keys: Mapping[str, str], *, state: int = 0, tune: bool = False) -> None:
        """Encode with ``model``; ValueError if a modality or the number of its keys does not fit it.

        Args:
            keys: modality of each observation key. Two gels of one gripper are two keys of "touch", left first.
                A model of windows takes a key for each frame, the newest first.
            state: length of "observation.state" to append; 0 = none.
            tune: let the policy's loss train the encoders (BatchNorm keeps its statistics); otherwise they are frozen.
        """
        super().__init__()
        self.keys: dict[str, list[str]] = {}
        for key, modality in keys.items():
            model.check_modality(modality)
            self.keys.setdefault(modality, []).append(key)
        for modality, names in self.keys.items():
            if len(names) != (wanted := model.spec.channels(modality) // 3):
                raise ValueError(f"the {modality} encoder takes {wanted} image(s), given: {', '.join(names)}")
        # Copies: a policy that tunes its encoders changes neither ``model`` nor another policy.
        self.encoders = nn.ModuleDict({m: copy.deepcopy(model.encoders[m]) for m in self.keys})
        self.stored, self.state, self.tune, self._input = model.stored, state, tune, model.input
        self._checked: set[str] = set()
        self.encoders.requires_grad_(tune).eval()
        self.out_features = sum(map(num_features, self.encoders.values())) + state

    def train(self, mode: bool = True) -> "ObservationEncoder":
        """As for any module, but the encoders stay in eval mode: small batches of a policy would spoil their BatchNorm."""
        super().train(mode)
        self.encoders.eval()
        return self

    def forward(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Features of a batch of observations; KeyError or ValueError names a key that is missing or of another shape."""
        features = torch.cat(list(self._each(observation, lambda trunk, images: trunk(images)).values()), dim=-1)
        lead = features.shape[:-1]
        if not self.state:
            return features
        if (state := observation[STATE]).shape != (*lead, self.state):
            raise ValueError(f"{STATE}: expected {(*lead, self.state)}, got {tuple(state.shape)}")
        return torch.cat([features, state.float()], dim=-1)

    def maps(self, observation: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The last feature map [B, D, h, w] of each trunk. Images are normalised in here, as for ``forward``."""
        last: Any = {"indices": 1, "intermediates_only": True}
        return self._each(observation, lambda trunk, images: trunk.forward_intermediates(images, **last)[0])

    def _each(self, observation: Mapping[str, Tensor], network: Callable[[Any, Tensor], Tensor]) -> dict[str, Tensor]:
        """What ``network`` makes of each modality's trunk and normalised images, [B, ...] or [B, T, ...]."""
        found, first = {}, observation[next(iter(self.keys.values()))[0]]
        lead = first.shape[:-3]
        for modality, names in self.keys.items():
            views = []
            for name in names:
                image = observation[name]
                if image.ndim < 4 or image.shape[:-3] != lead:
                    others = f"does not fit images of {list(first.shape)}"
                    how = others if first.ndim > 3 else "has no axis for the batch"
                    raise ValueError(f"{name}: {list(image.shape)} {how}")
                check = image.is_cpu or name not in self._checked  # on a GPU, the values of the first only
                images = check_images(image.flatten(0, -4), 3, name, values=check)
                self._checked.add(name)
                views.append(self._input(modality, resized(images, self.stored)))
            with torch.set_grad_enabled(self.tune and torch.is_grad_enabled()):
                found[modality] = network(self.encoders[modality], torch.cat(views, dim=1)).float().unflatten(0, lead)
        return found
