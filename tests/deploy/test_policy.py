"""The encoders inside a policy."""

from pathlib import Path

import pytest
import torch

import mvitac
from mvitac.data.pack import Pack
from mvitac.deploy.policy import ObservationEncoder
from mvitac.model import Model

KEYS = {"observation.images.wrist": "vision", "observation.images.gel": "touch"}


@pytest.fixture
def model(artifact: Path) -> Model:
    return mvitac.load(artifact)


def observe(pack: Pack, rows: list[int]) -> dict[str, torch.Tensor]:
    return {k: torch.from_numpy(pack.images[m][rows]).permute(0, 3, 1, 2) for k, m in KEYS.items()}


def test_features_are_the_models(model: Model, pack: Pack) -> None:
    """uint8 or float, single steps or a history: what embed() gives."""
    encoder, seen = ObservationEncoder(model, KEYS), observe(pack, [3, 50])
    expected = model.embed(vision=pack.images["vision"][[3, 50]], touch=pack.images["touch"][[3, 50]])
    wanted = torch.cat([expected["vision"], expected["touch"]], dim=1)
    torch.testing.assert_close(encoder(seen), wanted, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(encoder({k: v / 255 for k, v in seen.items()}), wanted, atol=1e-4, rtol=1e-4)
    history = {k: v[None].expand(4, -1, -1, -1, -1) for k, v in seen.items()}
    torch.testing.assert_close(encoder(history), wanted[None].expand(4, -1, -1), atol=1e-4, rtol=1e-4)
    assert encoder.out_features == wanted.shape[1]
    maps = encoder.maps(history)["touch"]  # this trunk's features are the mean over places
    assert maps.ndim == 5 and not maps.requires_grad
    torch.testing.assert_close(maps.mean((-2, -1))[0], expected["touch"], atol=1e-4, rtol=1e-4)


def test_a_policy_trains_its_head_and_leaves_the_encoders_alone(model: Model, pack: Pack) -> None:
    encoder = ObservationEncoder(model, KEYS, state=2)
    policy = torch.nn.Sequential(encoder, torch.nn.Linear(encoder.out_features, 3))
    before = {k: v.clone() for k, v in encoder.state_dict().items()}
    policy.train()
    optimiser = torch.optim.Adam([p for p in policy.parameters() if p.requires_grad], lr=0.01)
    seen = {**observe(pack, list(range(12))), "observation.state": torch.zeros(12, 2)}
    target = torch.from_numpy(pack.column("label_pattern")[:12].astype(int))
    losses = []
    for _ in range(30):
        loss = torch.nn.functional.cross_entropy(policy(seen), target)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.5 * losses[0]
    assert all(torch.equal(before[k], v) for k, v in encoder.state_dict().items())


def test_tuned_encoders_get_gradients_but_keep_their_batchnorm(model: Model, pack: Pack) -> None:
    encoder = ObservationEncoder(model, KEYS, tune=True).train()
    before = {k: v.clone() for k, v in encoder.named_buffers()}
    encoder(observe(pack, [0, 1])).sum().backward()
    assert all(p.grad is not None for p in encoder.encoders.parameters())
    assert encoder.maps(observe(pack, [0]))["vision"].requires_grad
    assert all(torch.equal(before[k], v) for k, v in encoder.named_buffers())


def test_what_does_not_fit_is_named(model: Model, pack: Pack) -> None:
    with pytest.raises(ValueError, match=r"takes 1 image\(s\), given: left, right"):
        ObservationEncoder(model, {"left": "touch", "right": "touch"})
    encoder, seen = ObservationEncoder(model, KEYS), observe(pack, [0])
    not_divided = {k: v.float() for k, v in seen.items()}
    normalised_already = {k: (v / 255 - 0.45) / 0.22 for k, v in seen.items()}
    for wrong in (not_divided, normalised_already):
        with pytest.raises(ValueError, match=r"expected floats in \[0, 1\] or uint8"):
            encoder(wrong)
