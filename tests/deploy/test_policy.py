"""The encoders inside a policy."""

import pytest
import torch

from mvitac.data.pack import Pack
from mvitac.deploy.policy import ObservationEncoder
from mvitac.model import Model

KEYS = {"observation.images.wrist": "vision", "observation.images.gel": "touch"}


def observe(pack: Pack, rows: list[int]) -> dict[str, torch.Tensor]:
    return {k: torch.from_numpy(pack.images[m][rows]).permute(0, 3, 1, 2) for k, m in KEYS.items()}


def test_features_are_the_models(model: Model, pack: Pack) -> None:
    """uint8 or float, single steps or a history: what embed() gives."""
    encoder, seen = ObservationEncoder(model, KEYS), observe(pack, [3, 50])
    expected = model.embed(vision=pack.images["vision"][[3, 50]], touch=pack.images["touch"][[3, 50]])
    wanted = torch.cat([expected["vision"], expected["touch"]], dim=1)
    torch.testing.assert_close(encoder(seen), wanted, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(encoder({k: v / 255 for k, v in seen.items()}), wanted, atol=1e-4, rtol=1e-4)
    large = {k: v.repeat_interleave(3, 2).repeat_interleave(2, 3).roll(5, 3) for k, v in seen.items()}
    alike = encoder({k: v / 255 for k, v in large.items()}), model(vision=large[next(iter(KEYS))] / 255)["vision"]
    embedded = model.embed(vision=large["observation.images.wrist"], touch=large["observation.images.gel"])
    both = torch.cat([embedded["vision"], embedded["touch"]], dim=1)
    torch.testing.assert_close(alike, (both, embedded["vision"]), atol=1e-6, rtol=1e-5)
    history = {k: v[None].expand(4, -1, -1, -1, -1) for k, v in seen.items()}
    torch.testing.assert_close(encoder(history), wanted[None].expand(4, -1, -1), atol=1e-4, rtol=1e-4)
    assert encoder.out_features == wanted.shape[1]
    maps = encoder.maps(history)["touch"]  # this trunk's features are the mean over places
    assert maps.ndim == 5 and not maps.requires_grad
    torch.testing.assert_close(maps.mean((-2, -1))[0], expected["touch"], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("tune", [False, True])
def test_only_tuned_encoders_get_gradients_and_their_batchnorm_stays(model: Model, pack: Pack, tune: bool) -> None:
    encoder = ObservationEncoder(model, KEYS, state=2, tune=tune)
    policy = torch.nn.Sequential(encoder, torch.nn.Linear(encoder.out_features, 3)).train()
    before = {k: v.clone() for k, v in encoder.named_buffers()}
    policy({**observe(pack, [0, 1]), "observation.state": torch.zeros(2, 2)}).sum().backward()
    assert {p.grad is not None for p in encoder.encoders.parameters()} == {tune}
    assert all(p.grad is not None for p in policy[1].parameters())
    assert encoder.maps(observe(pack, [0]))["vision"].requires_grad == tune
    assert all(torch.equal(before[k], v) for k, v in encoder.named_buffers())
    assert {p.requires_grad and p.grad is None for p in model.encoders.parameters()} == {True}  # they are copied


def test_what_does_not_fit_is_named(model: Model, pack: Pack) -> None:
    with pytest.raises(ValueError, match=r"takes 1 image\(s\), given: left, right"):
        ObservationEncoder(model, {"left": "touch", "right": "touch"})
    encoder, seen = ObservationEncoder(model, KEYS), observe(pack, [0])
    not_divided = {k: v.float() for k, v in seen.items()}
    normalised_already = {k: (v / 255 - 0.45) / 0.22 for k, v in seen.items()}
    nan, last = ({k: f(v) for k, v in seen.items()} for f in (lambda v: v * torch.nan, lambda v: v.movedim(1, -1)))
    for _ in range(2):  # also after a batch that was right
        for wrong in (not_divided, normalised_already, nan, last):
            with pytest.raises(ValueError, match=r"expected .*float"):
                encoder(wrong)
        with pytest.raises(ValueError, match=r"wrist: \[3, \d+, \d+\] has no axis for the batch"):
            encoder({k: v[0] for k, v in seen.items()})
        with pytest.raises(ValueError, match=r"gel: .* does not fit images of \[1, 3, "):
            encoder({**seen, "observation.images.gel": seen["observation.images.gel"].repeat(2, 1, 1, 1)})
        encoder(seen)
