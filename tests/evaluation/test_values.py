"""Tasks with values: numbers in the table, ridge probes, and scores in the unit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from sklearn.linear_model import Ridge
from sklearn.metrics import mean_absolute_error, r2_score, root_mean_squared_error
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from mvitac.data.pack import Pack
from mvitac.data.several import JoinedPack
from mvitac.data.spec import Target
from mvitac.evaluation.evaluate import ProbeConfig, chosen, probe_runs
from mvitac.evaluation.intervals import interval, mean_interval, paired_difference
from mvitac.evaluation.probe import split_rows
from mvitac.evaluation.regressors import fit_curve, fit_ridge
from mvitac.evaluation.scores import pool
from mvitac.evaluation.value_scores import r2_without_each_group, score_values
from mvitac.training.loop import train
from support.toy import with_columns
from support.training_runs import smoke

NEWTON = (Target(name="force_n", unit="N"),)
POSE = (Target(name="z_mm", unit="mm"), Target(name="tilt_deg", unit="deg"))


def drawn(num: int = 300, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    y = (rng := np.random.default_rng(seed)).normal(3, 2, (num, 2))
    return y, y + rng.normal(0, (0.5, 1.5), (num, 2)), rng.integers(0, 12, num)


def test_scores_are_those_of_scikit_learn_without_a_group_and_over_the_rows_that_were_measured() -> None:
    y, guess, groups = drawn()
    found = r2_without_each_group(score_values(y, guess, groups, POSE))
    assert found == pytest.approx([r2_score(y[groups != g], guess[groups != g]) for g in range(12)])
    y[::3, 1] = np.nan
    record = score_values(y, guess, groups, POSE)
    for t, found in enumerate(record["targets"]):
        have = ~np.isnan(y[:, t])
        for name, score in (("r2", r2_score), ("mae", mean_absolute_error), ("rmse", root_mean_squared_error)):
            assert found[name] == pytest.approx(score(y[have, t], guess[have, t])), name
        assert sum(part["n"] for part in found["ranges"]) == have.sum()
    assert record["r2"] == pytest.approx(np.mean([found["r2"] for found in record["targets"]]))
    assert record["num_test"] == len(y)
    json.dumps(record, allow_nan=False)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_r2_is_the_same_in_any_unit(unit: float) -> None:
    """A current in A or in nA."""
    y, guess, groups = drawn()
    small, usual = (score_values(unit * y, unit * guess, groups, POSE) for unit in (unit, 1))
    assert small["r2"] == pytest.approx(usual["r2"])
    assert r2_without_each_group(small) == pytest.approx(r2_without_each_group(usual))
    x = np.random.default_rng(1).normal(size=(300, 60))
    assert fit_ridge(x, unit * y, 60)[1] == fit_ridge(x, y, 60)[1]


def test_the_interval_of_r2_holds_it_and_a_worse_method_is_told_apart() -> None:
    y, guess, groups = drawn(600)
    good, bad = (
        [{**score_values(y, g + shift, groups, POSE), "seed": seed} for seed, shift in enumerate((0.0, 0.01))]
        for g in (guess, guess + np.random.default_rng(2).normal(0, 1, y.shape))
    )
    mean, low, high = interval(good[:1])
    assert low < mean < high < 1 and mean == pytest.approx(r2_score(y, guess))
    difference, low, high, p = paired_difference(good, bad)
    assert 0 < low < difference < high and p is not None and p < 0.05
    assert paired_difference(good[:1], bad[:1])[3] is None


@pytest.mark.parametrize("still", [0.0, 0.1, 0.25])
def test_one_group_that_moves_alone_gives_its_own_r2_and_no_interval(still: float) -> None:
    """Without it the others have no spread, and R2 no sense."""
    groups, rng = np.arange(48) // 6, np.random.default_rng(0)
    y = np.where(groups == 0, rng.uniform(0, 3, 48), still)[:, None]
    ours, theirs = ({**score_values(y, y + rng.normal(0, 1, y.shape), groups, NEWTON), "seed": 0} for _ in range(2))
    mean, low, high = interval([ours])
    assert mean == pytest.approx(ours["r2"]) and low == -np.inf and high > 0.99
    difference, low, high, _ = paired_difference([ours], [theirs])
    assert difference == pytest.approx(ours["r2"] - theirs["r2"]) and (low, high) == (-np.inf, np.inf)


def test_a_level_over_few_groups_is_no_difference_from_0() -> None:
    values = np.array([[0.773, 0.701, 0.794, 0.931, 0.771]])
    _, low, high, p = mean_interval(values, level=True)
    t = stats.t(4).ppf(0.975) * values.std(ddof=1) / 5**0.5
    assert (low, high) == pytest.approx((values.mean() - t, values.mean() + t)) and p > 0.05
    assert mean_interval(values)[1] == 0


def test_error_by_range_finds_where_predictions_are_wrong() -> None:
    y = np.linspace(0, 8, 400)[:, None]
    record = score_values(y, np.minimum(y, 6), np.arange(400) % 4, NEWTON)  # saturates above 6 N
    ranges = record["targets"][0]["ranges"]
    assert all(part["mae"] == 0 for part in ranges if part["high"] < 6)
    assert ranges[-1]["bias"] < -1.3 and ranges[-1]["high"] == pytest.approx(8)


def test_ridge_finds_a_linear_relation_in_any_unit_and_skips_what_was_not_measured() -> None:
    x = np.random.default_rng(0).normal(0, (1, 100, 0.01), (400, 3))
    y = x @ np.array([[2000.0, 0.001], [3.0, 0], [0, 0.4]]) + [1e5, 0]
    y[:200, 1] = np.nan
    predict, alphas = fit_ridge(x[:300], y[:300], 60)
    assert len(alphas) == 2 and r2_score(y[300:], predict(x[300:])) > 0.999


def test_alpha_is_chosen_on_the_held_out_rows_by_squared_error() -> None:
    x = (rng := np.random.default_rng(0)).normal(size=(80, 60))
    y = x[:, :1] + rng.normal(0, 3, (80, 1))  # noise: weak regularisation overfits
    memorised = np.concatenate([x[:60], x[:20]]), np.concatenate([y[:60], y[:20]])  # held out rows that were learned
    assert fit_ridge(x, y, 20)[1][0] > fit_ridge(*memorised, 20)[1][0]
    x, y = rng.normal(size=(80, 60)), rng.normal(2, 1, (80, 1))  # nothing to learn
    y[60:] = 2.0  # one value in the rows it is chosen on: R2 is 0 for all alphas
    assert fit_ridge(x, y, 20)[1][0] >= 1e3


def test_a_feature_that_one_row_has_does_not_predict_metres() -> None:
    x = (rng := np.random.default_rng(0)).normal(size=(1100, 3))
    y = x[:, :1] + rng.normal(0, 0.1, (1100, 1))
    dead = np.zeros((1100, 1))
    dead[7], dead[1000] = 1e-6, 0.02  # after a ReLU: hardly there in one row of train, an ordinary value in one of test
    x = np.hstack([x, dead])
    predict, _ = fit_ridge(x[:1000], y[:1000], 200)
    assert np.abs(predict(x[1000:]) - y[1000:]).max() < 1
    assert predict.clipped(x[1000:]) == [1, 4] and predict.clipped(x[:1000]) == [0, 4]
    weights, bias = predict.weights()
    assert np.allclose(x.clip(*predict.bounds) @ weights.T + bias, predict(x))


def test_features_that_few_rows_have_are_worth_what_plain_ridge_makes_of_them() -> None:
    rng = np.random.default_rng(0)
    x = rng.random((6000, 10)) * (rng.random((6000, 10)) < 0.002)  # a contact in two of a thousand rows each
    y = x.sum(1, keepdims=True) + rng.normal(0, 0.005, (6000, 1))
    x = np.hstack([x, rng.normal(size=(6000, 10))])
    plain = make_pipeline(StandardScaler(), Ridge(1.0)).fit(x[:3000], y[:3000]).predict(x[3000:])
    found = r2_score(y[3000:], fit_ridge(x[:3000], y[:3000], 600)[0](x[3000:]))
    assert found == pytest.approx(r2_score(y[3000:], plain), abs=0.04) and found > 0.95


def test_a_control_may_be_a_curve() -> None:
    x = np.linspace(-1, 1, 200)[:, None]
    y = x**2
    assert r2_score(y, fit_curve(x, y, 50)(x)) > 0.99 and r2_score(y, fit_ridge(x, y, 50)[0](x)) < 0.1


@pytest.mark.parametrize(("scale", "offset"), [(1e300, 0), (1e-300, 0), (1, 1e12)])
def test_values_that_rounding_would_score_are_refused(scale: float, offset: float, measured: Pack) -> None:
    """Squares of the first are infinite, of the second 0; of the third, such as stamps in ms, the digits are gone."""
    light = measured.spec.values[0]
    pack = Pack(measured.path)
    pack._answers[(repr(light),)] = measured.values(light) * scale + offset
    with pytest.raises(ValueError, match=r"level is from .* rounding would decide R2"):
        split_rows(pack, light)


def test_probes_of_classes_and_values_side_by_side(measured: Pack, tmp_path: Path) -> None:
    run = smoke(measured, steps=2, eval_every=0)
    asked = ProbeConfig(probes=("linear", "paper", "knn"), modalities=("touch",))
    result = probe_runs([train(run, tmp_path / "run", quiet=True)], asked)
    found = {(r["task"], r["source"], r["modality"], r["probe"]): r for r in result["records"]}
    assert result["targets"]["both"] == [{"name": "level", "unit": "levels"}, {"name": "weight", "unit": "N"}]
    assert found["light", "mvitac", "touch", "linear"]["r2"] > 0.4  # brightness survives any trunk
    assert found["light", "pixels", "touch", "linear"]["r2"] > 0.9
    assert found["light", "mean", "none", "linear"]["r2"] <= 0 and ("light", "noise only", "none", "linear") in found
    assert ("light", "mvitac", "touch", "knn") in found and ("light", "mvitac", "touch", "paper") not in found
    assert ("pattern", "mvitac", "touch", "paper") in found and ("pattern", "mean", "none", "linear") not in found
    shown = result["summary"]["light"]["touch"]["mvitac"]["mean"]
    assert shown == pytest.approx(found["light", "mvitac", "touch", "linear"]["r2"])


def test_the_papers_probe_alone_is_refused_for_values(measured: Pack) -> None:
    with pytest.raises(ValueError, match="probe paper is for classes, these are values: give linear or knn"):
        chosen(measured, ProbeConfig(probes=("paper",), tasks=("light",)))


def test_packs_with_other_units_cannot_be_joined(measured: Pack) -> None:
    task = replace(measured.spec.values[0], targets=(Target(name="level", unit="%"),))
    other = with_columns(measured, spec=replace(measured.spec, values=(task,)))
    with pytest.raises(ValueError, match=r"'light' has values level:levels in \S+, level:% in \S+: pack both alike"):
        JoinedPack(measured, other)
    assert [task.name for task in JoinedPack(measured, other, ["pattern"]).spec.all_tasks] == ["pattern"]


def test_folds_are_pooled_to_the_scores_of_all_groups_together() -> None:
    y, guess, groups = drawn()
    about = {"source": "m", "seed": 0, "task": "pose", "modality": "touch", "probe": "linear"}
    folds = []
    for half in (groups < 6, groups >= 6):
        _, own = np.unique(groups[half], return_inverse=True)
        folds.append([{**about, **score_values(y[half], guess[half], own, POSE)}])
    (pooled,) = pool(folds)
    whole = score_values(y, guess, groups, POSE)
    for found, wanted in zip(pooled["targets"], whole["targets"], strict=True):
        for name in ("r2", "mae", "rmse"):
            assert found[name] == pytest.approx(wanted[name])
    assert interval([pooled]) == pytest.approx(interval([{**about, **whole}]))
