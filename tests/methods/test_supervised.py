"""Fine-tuning as a method, and the supervised methods on tasks with values."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from sklearn.metrics import mean_absolute_error

from mvitac.data.pack import Pack
from mvitac.evaluation.features import pack_features
from mvitac.evaluation.probe import probe_model, split_rows
from mvitac.methods.base import Views
from mvitac.methods.calandra import CalandraConfig
from mvitac.methods.supervised import SupervisedConfig, ValueHead
from mvitac.model import load
from mvitac.run import Optim
from mvitac.training.loop import train
from mvitac.training.views import values_of
from support.small_methods import TINY
from support.toy import with_columns
from support.training_runs import smoke


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
    with pytest.raises(ValueError, match="3 labelled instances are too few to hold some out"):
        SupervisedConfig(tasks=("pattern",), share=0.05, hold_out=True).training_rows(pack)


NAN = float("nan")


def test_loss_is_smooth_l1_of_standardised_values_that_were_measured() -> None:
    head = ValueHead(torch.nn.Linear(3, 2), 2)
    values = torch.tensor([[1000.0, 0.1], [3000.0, NAN], [NAN, 0.3], [5000.0, 0.2]])
    head.learn_scale(values)
    assert head.mean.tolist() == pytest.approx([3000, 0.2])
    assert head.std.tolist() == pytest.approx([np.std([1000, 3000, 5000]), np.std([0.1, 0.3, 0.2])])
    x = torch.randn(4, 3, requires_grad=True)
    measured = ((head(x) - values) / head.std)[~values.isnan()]
    expected = F.smooth_l1_loss(measured, torch.zeros_like(measured))
    torch.testing.assert_close(head.loss(x, values), expected, rtol=1e-4, atol=1e-4)
    (gradient,) = torch.autograd.grad(head.loss(x, values), x)
    assert gradient.isfinite().all() and gradient.any(1).all() and head.loss(x, torch.full((4, 2), NAN)) == 0


@pytest.mark.parametrize("config", [SupervisedConfig, CalandraConfig])
def test_classes_are_the_default_and_values_are_learned_by_name_or_alone(measured: Pack, config: type) -> None:
    spec = measured.spec
    assert list(config().build(spec, TINY).classifiers()) == ["pattern", "bright"]  # as before there were values
    assert list(config().build(replace(spec, tasks=()), TINY).classifiers()) == ["light", "both"]
    heads = config(tasks=("both", "pattern")).build(spec, TINY).classifiers()
    assert {task: isinstance(head, ValueHead) for task, head in heads.items()} == {"both": True, "pattern": False}
    with pytest.raises(ValueError, match="unknown task 'x': choose from pattern, bright, light, both"):
        config(tasks=("x",)).build(spec, TINY)
    with pytest.raises(ValueError, match="no labels and no values"):
        config().build(replace(spec, tasks=(), values=()), TINY)


def test_values_are_learned_from_the_rows_that_probes_are_fitted_on(measured: Pack) -> None:
    both = measured.spec.values[1]
    weight = replace(both, name="weight", targets=both.targets[1:])
    measured = with_columns(measured, spec=replace(measured.spec, values=(*measured.spec.values[:2], weight)))
    rows = SupervisedConfig(tasks=("weight",)).training_rows(measured)
    assert set(rows) == set(split_rows(measured, weight).fitted) and 0 < len(rows) < measured.num
    given = values_of(smoke(measured, method=SupervisedConfig()), measured, np.arange(measured.num))["light"][:, 0]
    assert np.array_equal(~given.isnan().numpy(), np.isin(measured.column("split"), ["train", "val"]))


def test_the_own_head_is_trained_and_scored_in_the_unit(measured: Pack, tmp_path: Path) -> None:
    run = smoke(measured, steps=40, batch_size=30, eval_every=0, optim=Optim(name="adamw", lr=3e-3))
    run = replace(run, method=SupervisedConfig(tasks=("both", "pattern")))
    model, both = load(train(run, tmp_path / "run", quiet=True)), measured.spec.values[1]
    rows = split_rows(measured, both).test
    z = {m: pack_features(model, measured, m, rows) for m in ("vision", "touch")}
    guess, true = model.answer("both", z).numpy(), measured.values(both)[rows]
    records = probe_model(model, measured, measured.spec.all_tasks, ["both"], [])
    own = {r["task"]: r for r in records if r["probe"] == "own"}
    assert set(own) == {"pattern", "both"}  # what it learned
    assert own["pattern"]["accuracy"] > 0.7
    for t, found in enumerate(own["both"]["targets"]):
        have = ~np.isnan(true[:, t])
        assert found["mae"] == pytest.approx(mean_absolute_error(true[have, t], guess[have, t]), rel=1e-4)
        assert found["r2"] > 0.5
    # A pack with the targets in another order, and one whose unit differs.
    turned = replace(both, targets=both.targets[::-1])
    record = next(r for r in probe_model(model, measured, [turned], ["both"], []) if r["probe"] == "own")
    first, second = (found["r2"] for found in own["both"]["targets"])
    assert [found["r2"] for found in record["targets"]] == pytest.approx([second, first])
    other = replace(both, targets=tuple(replace(target, unit="kN") for target in both.targets))
    assert not probe_model(model, measured, [other], ["both"], [])


def test_one_batch_without_a_value_and_one_without_a_label(measured: Pack) -> None:
    method = SupervisedConfig(tasks=("light", "pattern")).build(measured.spec, TINY)
    images = {m: [torch.randn(4, 3, 32, 32)] for m in ("vision", "touch")}
    batch = Views(images, {"pattern": torch.full((4,), -1)}, torch.arange(4), {"light": torch.full((4, 1), NAN)})
    assert {name: loss.item() for name, loss in method(batch).items()} == {"loss": 0, "light": 0, "pattern": 0}
