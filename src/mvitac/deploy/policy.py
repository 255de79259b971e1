"""Trained encoders as the observation encoder of a robot policy: from a dict of images to one feature vector.

    encoder = ObservationEncoder(mvitac.load("runs/demo/seed0"), {"observation.images.wrist": "vision",
                                                                  "observation.images.gel": "touch"})
    policy = nn.Sequential(encoder, nn.Linear(encoder.out_features, num_actions))

Follows LeRobot's convention: images are [B, 3, H, W] (or [B, T, 3, H, W]), float in [0, 1] or uint8, RGB.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mvitac.model import Model
from mvitac.transforms.preprocess import check_range, resized

STATE = "observation.state"


class ObservationEncoder(nn.Module):
    """Features [B, D] (or [B, T, D]) of an observation, in the order of ``keys``, with the robot's state at the end.

    A model of difference images (``model.spec.difference``) takes touch as (touch - background) / 2 + one half.
    """

    def __init__(self, model: Model, keys: Mapping[str, str], *, state: int = 0, tune: bool = False) -> None:
        """Encode with ``model``; ValueError if a modality or the number of its keys does not fit it.

        Args:
            keys: modality of each observation key. Two gels of one gripper are two keys of "touch", left first.
            state: length of "observation.state" to append; 0 = none.
            tune: let the policy's loss train the encoders (BatchNorm keeps its statistics); otherwise they are frozen.
        """
        super().__init__()
        self.keys: dict[str, list[str]] = {}
        for key, modality in keys.items():
            if modality not in model.encoders:
                raise ValueError(f"{key}: this model has no {modality} encoder, it has {', '.join(model.encoders)}")
            self.keys.setdefault(modality, []).append(key)
        for modality, names in self.keys.items():
            if 3 * len(names) != model.spec.channels(modality):
                wanted = model.spec.channels(modality) // 3
                raise ValueError(f"the {modality} encoder takes {wanted} image(s), given: {', '.join(names)}")
        self.encoders = nn.ModuleDict({m: model.encoders[m] for m in self.keys})
        self.stored, self.state, self.tune, self._input = model.stored, state, tune, model.input
        self._checked: set[str] = set()
        self.encoders.requires_grad_(tune)
        self.encoders.eval()
        features = (int(e.num_features) for e in self.encoders.values())  # type: ignore[arg-type]
        self.out_features = sum(features) + state

    def train(self, mode: bool = True) -> "ObservationEncoder":
        """As for any module, but the encoders stay in eval mode: small batches of a policy would spoil their BatchNorm."""
        super().train(mode)
        self.encoders.eval()
        return self

    def forward(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Features of a batch of observations; ValueError names a key that is missing or has another shape."""
        found, lead = [], ()
        for modality, names in self.keys.items():
            views = []
            for name in names:
                image = self._get(observation, name)
                if image.ndim not in (4, 5) or image.shape[-3] != 3:
                    shape = tuple(image.shape)
                    raise ValueError(f"{name}: expected images [B, 3, H, W] or [B, T, 3, H, W], got {shape}")
                self._check_range(name, image)
                lead = image.shape[:-3]
                views.append(self._input(modality, resized(image.flatten(0, -4), self.stored)))
            with torch.set_grad_enabled(self.tune and torch.is_grad_enabled()):
                found.append(self.encoders[modality](torch.cat(views, dim=1)).float())
        features = torch.cat(found, dim=1).unflatten(0, lead)
        if not self.state:
            return features
        state = self._get(observation, STATE)
        if state.shape != (*lead, self.state):
            raise ValueError(f"{STATE}: expected {(*lead, self.state)}, got {tuple(state.shape)}")
        return torch.cat([features, state.float()], dim=-1)

    def _get(self, observation: Mapping[str, Tensor], name: str) -> Tensor:
        if name not in observation:
            raise ValueError(f"the observation has no {name!r}: it has {', '.join(observation)}")
        return observation[name]

    def _check_range(self, name: str, image: Tensor) -> None:
        """Check the first images of a key only: each check makes a GPU wait."""
        if name in self._checked:
            return
        if image.dtype != torch.uint8:
            low, high = image.aminmax()
            check_range(float(low), float(high), image.dtype, name)
        self._checked.add(name)
