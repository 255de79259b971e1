"""Parts of a trunk: what is trained, low-rank updates that merge exactly, statistics that are estimated anew."""

from __future__ import annotations

import pytest
import timm
import torch
from torch import Tensor, nn

from mvitac.nn.encoders import SCRATCH, EncoderConfig, PerFrame, build_trunk, last_map
from mvitac.nn.finetuning import AttentivePool, Lora, freeze_statistics, merged, train_part
from mvitac.nn.initial import load_trunk


def tiny(trunk: str = "mvitac_tiny") -> nn.Module:
    torch.manual_seed(0)
    return build_trunk(EncoderConfig(trunk=trunk, weights=SCRATCH), 3)


def moved(trunk: nn.Module, images: Tensor) -> set[str]:
    """Names of what two steps of training change: parameters and buffers."""
    before = {name: value.clone() for name, value in trunk.state_dict().items()}
    optimiser = torch.optim.SGD([p for p in trunk.parameters() if p.requires_grad], lr=0.1)
    for _ in range(2):  # after the first, U of a low-rank update is no longer zero, and V gets a gradient
        optimiser.zero_grad()
        trunk(images).square().sum().backward()
        optimiser.step()
    return {name for name, value in trunk.state_dict().items() if not torch.equal(value, before[name])}


def test_lora_is_the_sum_and_starts_at_zero() -> None:
    weight = torch.randn(6, 4, 3, 3)
    lora = Lora(weight, 2)
    assert torch.equal(lora(weight), weight)
    nn.init.normal_(lora.up)
    update = torch.einsum("or,rchw->ochw", lora.up, lora.down.view(2, 4, 3, 3))
    torch.testing.assert_close(lora(weight), weight + update)
    assert Lora(weight[:, :1, :1, :1], 8).up.shape == (6, 1)  # no more than the layer has


@pytest.mark.parametrize("trunk", ["mvitac_tiny", "test_vit"])
def test_lora_trains_few_numbers_and_merges_into_plain_weights(trunk: str) -> None:
    network, plain = tiny(trunk), tiny(trunk)
    images = torch.randn(4, 3, 160, 160) if "vit" in trunk else torch.randn(4, 3, 32, 32)
    start = network(images)
    train_part(network, "lora", 4)
    torch.testing.assert_close(network(images), start)
    changed = moved(network.train(), images)
    assert changed and not any(name.endswith("original") for name in changed)
    network.eval()
    whole = merged(network)
    assert whole is not network and merged(plain) is plain
    assert whole.state_dict().keys() == plain.state_dict().keys()
    torch.testing.assert_close(whole(images), network(images))
    assert not torch.allclose(whole(images), plain.eval()(images))
    assert {type(m) for m in whole.modules()} == {type(m) for m in plain.modules()}


@pytest.mark.parametrize(
    ("trunk", "stage"), [("mvitac_tiny", "layer4."), ("test_vit", "blocks.5."), ("test_vit", "norm.")]
)
def test_last_stage(trunk: str, stage: str) -> None:
    network = tiny(trunk)
    if stage == "norm.":  # what follows the last block is trained with it
        assert "norm.weight" in {name for name, _ in network.named_parameters()}
    train_part(network, "last-stage", 8)
    trained = {name for name, p in network.named_parameters() if p.requires_grad}
    assert any(name.startswith(stage) for name in trained)
    known = timm.create_model(trunk, num_classes=0)
    last = known.feature_info[-1]["module"]  # type: ignore[index, union-attr]
    before = {n for n, _ in network.named_parameters()} - trained
    assert all(n.startswith((f"{last}.", "norm", "fc_norm")) for n in trained) and not any(
        n.startswith(f"{last}.") for n in before
    )


def test_frozen_layers_keep_their_statistics() -> None:
    images = torch.randn(8, 3, 32, 32)
    for part, expected in (("head", set()), ("last-stage", {"layer4"}), ("all", {"conv1", "bn1", "layer1", "layer4"})):
        network = tiny()
        train_part(network, part, 8)  # type: ignore[arg-type]
        network.train()
        freeze_statistics(network)
        if part == "head":
            before = {k: v.clone() for k, v in network.state_dict().items()}
            network(images)
            assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
            continue
        assert expected <= (stages := {name.split(".")[0] for name in moved(network, images)})
        assert part == "all" or stages == expected


def test_a_trunk_of_windows_has_a_last_stage_too() -> None:
    network = PerFrame(tiny(), 2, attention=False)
    train_part(network, "last-stage", 8)
    assert {n.split(".")[1] for n, p in network.named_parameters() if p.requires_grad} == {"layer4"}


def test_attention_starts_from_the_features_of_the_trunk() -> None:
    trunk, images = tiny().eval(), torch.randn(4, 3, 64, 64)
    pooled = AttentivePool(trunk).eval()
    assert torch.equal(pooled(images), trunk(images)) and pooled.num_features == 64
    assert torch.equal(last_map(pooled, images), last_map(trunk, images))
    train_part(pooled, "attentive", 8)
    pooled.train()
    freeze_statistics(pooled)
    assert {name.split(".")[0] for name in moved(pooled, images)} == {"query", "attention", "norm"}
    assert not torch.allclose(pooled(images), trunk(images))


def test_a_learned_pooling_starts_from_plain_weights_and_gives_them() -> None:
    plain, images = tiny().eval(), torch.randn(2, 3, 64, 64)
    nn.init.constant_(plain.get_parameter("conv1.0.weight"), 0.3)
    pooled = AttentivePool(tiny()).eval()
    load_trunk(pooled, plain.state_dict())
    assert torch.equal(pooled(images), plain(images))
    nn.init.normal_(pooled.attention.out_proj.weight)
    other, again = tiny().eval(), AttentivePool(tiny()).eval()
    load_trunk(other, pooled.state_dict())
    load_trunk(again, pooled.state_dict())
    assert torch.equal(other(images), plain(images)) and torch.equal(again(images), plain(images))
