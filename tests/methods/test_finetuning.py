"""Fine-tuning as a method: parts that are trained, shares of the labels, heads that start as probes, exact resumes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.evaluation.classifiers import fit_linear
from mvitac.evaluation.pack_features import pack_features
from mvitac.evaluation.regressors import fit_ridge
from mvitac.methods.supervised import Supervised, SupervisedConfig
from mvitac.model import Model
from mvitac.model_files import load
from mvitac.registry import from_json, to_json
from mvitac.run import Optim
from mvitac.training.heads import fit_heads
from mvitac.training.loop import train
from support.small_methods import TINY, outcome, views
from support.toy import Toy
from support.training_runs import assert_equal_weights, power_cut, smoke


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return build(Toy(values=True), tmp_path_factory.mktemp("measured") / "pack", size=32, workers=1, quiet=True)


def test_older_records_and_digests_stay() -> None:
    plain = to_json(SupervisedConfig())
    assert not {"train", "rank", "share", "draw", "hold_out", "heads_from"} & set(plain)
    changed = SupervisedConfig(train="lora", share=0.1, hold_out=True)
    assert from_json(SupervisedConfig, to_json(changed)) == changed
    with pytest.raises(ValueError, match=r"share 0: give a share of the groups, above 0, at most 1"):
        SupervisedConfig(share=0)


@pytest.mark.parametrize("part", ["head", "attentive", "last-stage", "lora", "all"])
def test_only_the_part_gets_gradients(part: str) -> None:
    method = SupervisedConfig(train=part).build(Toy().spec(), TINY)  # type: ignore[arg-type]
    assert method.part == part
    method.prepare(torch.arange(8))
    outcome(method.train(), views(method))["loss"].backward()
    for name, parameter in method.named_parameters():
        assert (parameter.grad is not None) == parameter.requires_grad, name
    trained = {name for name, p in method.named_parameters() if p.requires_grad}
    assert all(f"heads.{i}.weight" in trained for i in (0, 1))
    frozen = {
        "head": "trunks",
        "attentive": "trunks.touch.trunk",
        "last-stage": "trunks.touch.layer1",
        "lora": "original",
    }
    assert part == "all" or not any(frozen[part] in name for name in trained)


@pytest.mark.parametrize("part", ["attentive", "last-stage", "lora"])
def test_resumed_equals_straight_and_is_a_plain_model(pack: Pack, tmp_path: Path, part: str) -> None:
    method = SupervisedConfig(train=part, heads_from="probe", share=0.7)  # type: ignore[arg-type]
    run = smoke(pack, method=method, steps=6, checkpoint_every=2, eval_every=0, optim=Optim(name="adamw", lr=3e-3))
    train(run, tmp_path / "straight", quiet=True)
    with power_cut(3), pytest.raises(RuntimeError, match="power cut"):
        train(run, tmp_path / "cut", quiet=True)
    train(run, tmp_path / "cut", resume=True, quiet=True)
    assert_equal_weights(tmp_path / "straight", tmp_path / "cut")
    model = load(tmp_path / "cut")
    plain = SupervisedConfig().build(pack.spec, run.encoder)
    assert part == "attentive" or {k for k, _ in model.encoders.state_dict().items()} == {
        k.removeprefix("trunks.") for k, _ in plain.trunks.named_parameters()
    } | {k.removeprefix("trunks.") for k, _ in plain.trunks.named_buffers()}


def groups_of(pack: Pack, rows: np.ndarray) -> set[str]:
    return set(pack.column("group")[rows].astype(str))


def test_shares_are_nested_have_every_class_and_leave_test_alone(pack: Pack) -> None:
    whole = SupervisedConfig(tasks=("pattern",))
    everything = groups_of(pack, whole.training_rows(pack))
    before: set[str] = set()
    for share in (0.05, 0.2, 0.5, 1.0):
        rows = replace(whole, share=share).training_rows(pack)
        found = groups_of(pack, rows)
        assert before <= found <= everything and len(found) == max(3, round(share * len(everything)))
        assert set(pack.labels("pattern")[rows]) == {0, 1, 2}
        assert set(rows) == {r for r in whole.training_rows(pack) if pack.column("group")[r] in found}  # whole groups
        before = found
    draws = [replace(whole, share=0.3, draw=seed).training_rows(pack).tolist() for seed in (1, 2, 3)]
    assert draws[0] != draws[1] and draws[1] != draws[2]


def test_held_out_groups_are_of_the_drawn_ones(pack: Pack) -> None:
    for share in (0.5, 1.0):
        config = SupervisedConfig(tasks=("pattern",), share=share)
        drawn, learned = config.training_rows(pack), replace(config, hold_out=True).training_rows(pack)
        held = np.setdiff1d(drawn, learned)
        assert len(held) and set(learned) <= set(drawn) and not groups_of(pack, held) & groups_of(pack, learned)
        assert set(pack.labels("pattern")[learned]) == {0, 1, 2}
        assert set(pack.column("split")[held]) == {"val"}  # where there are enough of them
    only = SupervisedConfig(tasks=("pattern",), labels="train")
    held = np.setdiff1d(only.training_rows(pack), replace(only, hold_out=True).training_rows(pack))
    assert 0 < len(groups_of(pack, held)) == len(groups_of(pack, only.training_rows(pack))) // 5
    with pytest.raises(ValueError, match="3 labelled instances are too few to hold some out"):
        SupervisedConfig(tasks=("pattern",), share=0.05, hold_out=True).training_rows(pack)


def test_heads_start_as_the_linear_probes_of_their_rows(measured: Pack) -> None:
    config = SupervisedConfig(tasks=("pattern", "both"), heads_from="probe")
    run = smoke(measured, method=config)
    rows = config.training_rows(measured)
    method = config.build(measured.spec, run.encoder)
    method.learn_scale({t.name: torch.from_numpy(measured.values(t)[rows]) for t in measured.spec.values})
    assert isinstance(method, Supervised)
    fit_heads(method, run, measured, rows)
    model = Model(method, run, measured.spec, measured.size)
    x = torch.cat([pack_features(model, measured, m, rows, for_heads=True) for m in ("vision", "touch")], dim=1)
    is_val = measured.column("split")[rows] == "val"
    order = np.concatenate([np.flatnonzero(~is_val), np.flatnonzero(is_val)])
    num, z = int((~is_val).sum()), x.numpy()[order]
    y = measured.labels("pattern")[rows][order]
    fitted, _ = fit_linear(z[:num], y[:num], z[num:], y[num:])
    own = method.classifiers()
    np.testing.assert_allclose(own["pattern"](x[order]).softmax(1).detach(), fitted(z), atol=1e-4)
    values = measured.values(measured.spec.values[1])[rows][order]
    expected = fit_ridge(z, values, int(is_val.sum()))[0](z)
    np.testing.assert_allclose(own["both"](x[order]).detach(), expected, rtol=1e-3, atol=1e-2)
