"""The MLP probe and the attentive probe, and the feature maps that the latter reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import timm
import torch
import torch.nn.functional as F
from sklearn.metrics import r2_score

from mvitac.data.build import build
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation import trained_probes
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.regressors import fit_ridge
from mvitac.evaluation.trained_probes import Attentive, fit_network
from mvitac.methods.calandra import Streams
from mvitac.nn.encoders import Encoders, build_trunk, last_map
from mvitac.recipes import recipe
from mvitac.training.loop import train
from support.small_methods import TINY
from support.toy import Toy

# -- networks ---------------------------------------------------------------------------------------------------------


def test_attentive_probe_is_multi_head_attention_of_one_query() -> None:
    torch.manual_seed(0)
    probe = Attentive(places=5, width=64, num_out=3)
    for weight in probe.parameters():
        torch.nn.init.normal_(weight)
    maps = torch.randn(4, 5, 64)
    x = maps + probe.position
    keys, values = (torch.einsum("bpw,hdw->bhpd", x, weight) for weight in (probe.key, probe.value))
    assert keys.shape == (4, 2, 5, 32)
    query = probe.query[None, :, None].expand(4, -1, -1, -1)
    seen = F.scaled_dot_product_attention(query, keys, values)[:, :, 0].flatten(1)
    z = probe.start + probe.joined(seen)
    torch.testing.assert_close(probe(maps), probe.out(z + probe.block(probe.norm(z))), rtol=1e-4, atol=1e-2)


def bumps(num: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """Maps [N, 9, 32] of noise with a bump at one place, and its row and column in um; some unmeasured."""
    rng = np.random.default_rng(0)
    place = rng.integers(0, 9, num)
    maps = rng.normal(0, 0.3, (num, 9, 32))
    maps[np.arange(num), place, :16] += 3
    values = np.stack([place // 3, place % 3], axis=1) * 100.0 + 5000
    values[::7, 1] = np.nan
    return maps.astype(np.float16), values


def test_attentive_probe_reads_places_that_pooling_loses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trained_probes, "STEPS", (100, 200))
    maps, values = bumps()
    predict, steps = fit_network("attentive", maps[:500], values[:500], 100, 2, seed=0)
    have = ~np.isnan(values[500:, 1])
    found = predict(maps[500:])
    assert steps == 200
    assert r2_score(values[500:][have], found[have]) > 0.9
    pooled = maps.astype(float).mean(1)
    known = np.nan_to_num(values, nan=5100)
    assert r2_score(known[500:], fit_ridge(pooled[:500], known[:500], 100)[0](pooled[500:])) < 0.2
    again = fit_network("attentive", maps[:500], values[:500], 100, 2, seed=0)[0](maps[500:])
    assert np.array_equal(found, again)


def test_mlp_probe_finds_what_no_line_separates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trained_probes, "STEPS", (50, 200))
    rng = np.random.default_rng(0)
    x = rng.normal(size=(600, 4)).astype(np.float32) * (1, 100, 1, 1) + (0, 9, 0, 0)
    y = ((x[:, 0] > 0) ^ (x[:, 1] > 9)).astype(np.int64)
    logits, _ = fit_network("mlp", x[:500], y[:500], 100, 2, seed=0)
    assert (logits(x[500:]).argmax(1) == y[500:]).mean() > 0.85
    again = fit_network("mlp", x[:500], y[:500], 100, 2, seed=0)[0]
    assert np.array_equal(logits(x), again(x))


def test_length_is_chosen_on_the_held_out_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trained_probes, "STEPS", (20, 100))
    monkeypatch.setattr(trained_probes, "HIDDEN", 64)
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(150, 20)).astype(np.float32), rng.integers(0, 2, 150)  # nothing to learn
    assert fit_network("mlp", x, y, 50, 2, seed=0)[1] == min(trained_probes.STEPS)
    memorised = np.concatenate([x[:100], x[:50]]), np.concatenate([y[:100], y[:50]])
    assert fit_network("mlp", *memorised, 50, 2, seed=0)[1] == max(trained_probes.STEPS)


# -- maps -------------------------------------------------------------------------------------------------------------


def test_the_places_of_a_resnet_average_to_its_features() -> None:
    trunk = build_trunk(TINY, 3).eval()
    for side, places in ((32, 1), (160, 25), (320, 49)):
        images = torch.randn(2, 3, side, side)
        maps = last_map(trunk, images)
        assert maps.shape == (2, places, 64)
        if places < 49:
            torch.testing.assert_close(maps.mean(1), trunk(images))


def test_maps_of_windows_and_streams_are_those_of_their_frames() -> None:
    per_frame = build_trunk(replace(TINY, temporal="attention"), 9, frames=3).eval()
    torch.nn.init.normal_(per_frame.score.weight)  # type: ignore[union-attr, arg-type]
    torch.nn.init.normal_(per_frame.age)  # type: ignore[arg-type]
    images = torch.randn(2, 9, 64, 64)
    torch.testing.assert_close(last_map(per_frame, images).mean(1), per_frame(images))
    streams = Streams(TINY, 2).eval()
    assert last_map(streams, images[:, :6]).shape == (2, 8, 64)


@pytest.mark.parametrize(
    ("name", "side", "shape"),
    [("vit_tiny_patch16_224", 32, (2, 5, 192)), ("vit_tiny_patch16_224", 128, (2, 50, 192))],
)
def test_class_tokens_are_kept_and_patches_are_pooled(name: str, side: int, shape: tuple[int, ...]) -> None:
    trunk = timm.create_model(name, img_size=side, num_classes=0, depth=1).eval()
    images = torch.randn(2, 3, side, side)
    maps, tokens = last_map(trunk, images), trunk.forward_features(images)
    assert maps.shape == shape
    torch.testing.assert_close(maps[:, 0], tokens[:, 0])
    first = [1, 2, 9, 10] if side == 128 else [1]  # of 8 x 8 patches, 4 are in the first of 7 x 7 places
    corner = tokens[:, first].mean(1)
    torch.testing.assert_close(maps[:, 1], corner)


def test_maps_with_channels_last() -> None:
    trunk = timm.create_model("swin_tiny_patch4_window7_224", img_size=64, num_classes=0, depths=(1, 1, 1, 1)).eval()
    images = torch.randn(1, 3, 64, 64)
    torch.testing.assert_close(last_map(trunk, images).mean(1), trunk(images))


# -- of a run ---------------------------------------------------------------------------------------------------------


def test_networks_probe_classes_and_values_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trained_probes, "STEPS", (40,))
    pack = build(Toy(values=True), tmp_path / "pack", size=64, workers=1, quiet=True)
    run = replace(recipe("smoke", PackConfig(path=pack.path)), steps=1, eval_every=0)
    run = replace(
        run, augment=replace(run.augment, size=64), encoder=Encoders.both(trunk="mvitac_tiny", weights="scratch")
    )
    path = train(run, tmp_path / "run", quiet=True)
    session = ProbeConfig(probes=("mlp", "attentive"), tasks=("bright", "both"), modalities=("both",))
    result = probe_runs([path], session)
    found = {(r["source"], r["task"], r["modality"], r["probe"]): r for r in result["records"]}
    for source in ("mvitac", "untrained"):
        for kind in ("mlp", "attentive"):
            assert found[source, "bright", "both", kind]["accuracy"] > 0.8
            assert found[source, "both", "both", kind]["targets"][0]["r2"] > 0.3
