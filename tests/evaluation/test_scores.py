"""Scores, intervals, differences and diagnostics: worked cases, and error rates over simulated pairs of equal methods."""

from pathlib import Path

import numpy as np
import pytest
import torch
from benchmarks.calibration import rates_of_error, value_rates_of_error
from scipy.stats import t as student
from sklearn.linear_model import Ridge
from sklearn.metrics import confusion_matrix, f1_score, precision_score, recall_score, roc_auc_score

from mvitac.evaluation import diagnostics as d
from mvitac.evaluation import score_text
from mvitac.evaluation.controls import label_controls
from mvitac.evaluation.intervals import interval, least_p, mean_interval, paired_difference
from mvitac.evaluation.scores import per_class, pool_retrieval, score, summarise
from support.toy import toy_pack


def record(correct: list[int], seed: int | None, sizes: int = 10) -> dict:
    return {"group_sizes": [sizes] * len(correct), "group_correct": correct, "seed": seed}


@pytest.mark.parametrize("equal", [True, False], ids=["equal", "unequal"])
@pytest.mark.parametrize("groups", [4, 8, 106, 240])
@pytest.mark.parametrize("seeds", [1, 3])
def test_error_rates_are_no_more_than_stated(groups: int, equal: bool, seeds: int) -> None:
    """At most 7 % instead of 5 %, also near the ceiling; with one seed there is no p to be wrong."""
    for accuracy, seed_sd in ((0.6, 0.03), (0.9, 0.012)):
        found = rates_of_error(groups, equal, seeds, accuracy, seed_sd, trials=150)
        assert found["outside interval"] <= 0.07
        assert (found["p < .05"] is None) == (seeds == 1) and (found["p < .05"] or 0) <= 0.07


@pytest.mark.parametrize(("groups", "seeds"), [(4, 1), (8, 3), (29, 1)])
def test_error_rates_of_values_are_no_more_than_stated(groups: int, seeds: int) -> None:
    """Where errors differ much between groups, 8 to 13 % of intervals missed that were as long above R2 as below it."""
    found = value_rates_of_error(groups, True, seeds, r2=0.9, between=0.1, scale_sd=0.6, trials=300)
    assert found["outside interval"] <= 0.07
    assert (found["p < .05"] is None) == (seeds == 1) and (found["p < .05"] or 0) <= 0.07


def test_a_difference_in_every_group_is_found() -> None:
    """Groups differ wildly, but ours has one more right in each, under three seeds."""
    base = np.random.default_rng(0).integers(0, 9, (3, 40))
    theirs = [record(one.tolist(), seed) for seed, one in enumerate(base)]
    ours = [record((one + 1).tolist(), seed) for seed, one in enumerate(base)]
    mean, low, high, p = paired_difference(ours, theirs)
    assert (mean, low, high) == pytest.approx((0.1, 0.1, 0.1)) and p is not None and p < 0.002
    assert paired_difference(theirs, ours)[0] == pytest.approx(-0.1)
    assert paired_difference(ours, ours) == (0.0, 0.0, 0.0, 1.0)


def test_scores_of_one_probe_are_scikit_learns() -> None:
    """Classes that only the labels or only the answers have, or neither."""
    rng = np.random.default_rng(0)
    y, answers = rng.choice([0, 1, 3], 40), rng.choice([0, 2, 3], 40)
    found = score(y, np.eye(5)[answers], np.arange(40) // 4, 5)
    assert found["confusion"] == confusion_matrix(y, answers, labels=range(5)).tolist()
    assert found["macro_f1"] == f1_score(y, answers, labels=[0, 1, 3], average="macro", zero_division=0)
    assert found["accuracy"] == (y == answers).mean()
    assert found["balanced_accuracy"] == pytest.approx(np.mean([(answers[y == k] == k).mean() for k in (0, 1, 3)]))
    assert found["class_groups"] == [len({i // 4 for i in np.flatnonzero(y == k)}) for k in range(5)]
    p = rng.random(40)
    two = score((y == 1).astype(int), np.stack([1 - p, p], 1), np.arange(40) // 4, 2)
    assert found["auroc"] is None and two["auroc"] == roc_auc_score(y == 1, p)


def told(source: str, seed: int | None, y: np.ndarray, answers: np.ndarray, modality: str = "both") -> dict:
    known = {"task": "t", "modality": modality, "source": source, "seed": seed, "probe": "linear"}
    return {**known, **score(y, np.eye(4)[answers], np.arange(len(y)) // 4, 4)}


def test_each_class_has_scikit_learns_precision_and_recall_over_seeds() -> None:
    """None where there is nothing to divide by; counts are those of one seed."""
    rng = np.random.default_rng(1)
    y, each = rng.choice([0, 1, 2], 40), [rng.choice([0, 1, 3], 40) for _ in range(2)]
    records = [told("mvitac", seed, y, answers) for seed, answers in enumerate(each)]
    records.append(told("majority", None, y, np.zeros(40, int), "none"))
    found = per_class(records, {"t": list("abcd")}, "linear")["t"]
    assert [one["class"] for one in found["both"]] == list("abcd")
    assert [one["rows"] for one in found["both"]] == [*np.bincount(y).tolist(), 0]
    assert [one["groups"] for one in found["none"]] == records[0]["class_groups"]
    twice = np.concatenate([y, y]), np.concatenate(each)
    for k, one in enumerate(found["both"]):
        only = {"labels": [k], "average": None, "zero_division": np.nan}
        wanted = [float(f(*twice, **only)[0]) for f in (precision_score, recall_score)]
        assert one["scores"]["mvitac"] == [None if np.isnan(w) else pytest.approx(w) for w in wanted]
    assert found["none"][0]["scores"]["majority"][1] == 1.0


def test_uneven_classes_show_what_accuracy_hides() -> None:
    """70 % by saying one class: every class counts alike in a second row, of all sources, and not where they are even."""
    y = np.repeat([0, 1], [28, 12])
    summary = summarise([told("mvitac", 0, y, np.zeros(40, int)), told("untrained", 0, y, y)])["t"]
    shown = score_text.score_rows(summary, ["both"])[2:]
    assert shown == [["mvitac, balanced", "50.0"], ["untrained, balanced", "100.0"]]
    even = np.repeat([0, 1], 20)
    assert len(score_text.score_rows(summarise([told("mvitac", 0, even, even)])["t"], ["both"])) == 1


def test_the_verdict_names_what_a_method_is_not_above() -> None:
    def cell(low: float | None, high: float) -> dict:
        return {"mean": high, "low": low, "high": high}

    task = {
        "both": {"mvitac": cell(0.5, 0.6), "imagenet": cell(0.7, 0.8), "untrained": cell(0.4, 0.55)},
        "touch": {"mvitac": cell(0.5, 0.6), "imagenet": cell(0.1, 0.2)},
        "none": {"majority": cell(0.2, 0.3)},
    }
    assert score_text.verdicts(task) == [
        "mvitac by touch + vision: interval below imagenet and overlaps untrained",
        "mvitac: not above a frozen ImageNet trunk beyond the intervals, by touch + vision",
    ]
    task["both"] = {"mvitac": cell(0.5, 0.6), "cmc": cell(None, 0.6), "imagenet": cell(0.1, 0.4)}
    assert score_text.verdicts(task) == [
        "mvitac by touch + vision: interval above every control",
        "cmc by touch + vision: interval overlaps imagenet, majority",
        "cmc: not above a frozen ImageNet trunk beyond the intervals, by touch + vision",
    ]
    assert score_text.verdicts({"touch": {"mvitac": cell(0.5, 0.6)}}) == []  # --no-controls


def test_equal_groups_give_the_t_test() -> None:
    counts, gains = np.array([2, 5, 3, 6, 7, 4]), (3, 1, 0, 2, 1, 2)
    ours = [record((counts + np.array(gains)).tolist(), seed) for seed in range(2)]
    theirs = [record(counts.tolist(), seed) for seed in range(2)]
    per_group = np.array(gains) / 10
    margin = student.ppf(0.975, 5) * per_group.std(ddof=1) / 6**0.5
    assert paired_difference(ours, theirs)[1:3] == pytest.approx((0.15 - margin, 0.15 + margin))
    p = 2 * student.sf(0.15 / (per_group.std(ddof=1) / 6**0.5), 5)
    assert p < least_p(6) == 2 / 2**6 == paired_difference(ours, theirs)[3]


def test_seeds_give_the_t_test_over_seeds_and_equal_ones_are_paired() -> None:
    """Ours is better by chance of one seed of two: 1 degree of freedom."""
    ours, theirs = [record([9] * 30, 0), record([3] * 30, 1)], [record([5] * 30, 0), record([5] * 30, 1)]
    mean, low, high, p = paired_difference(ours, theirs)
    assert mean == pytest.approx(0.1) and (low, high) == (-1.0, 1.0) and student.ppf(0.975, 1) * 0.3 > 1
    assert p == pytest.approx(2 * student.sf(0.1 / 0.3, 1))
    # Seeds differ by 50 points, but ours has one more right under each: certain where seeds are the same, not where not.
    theirs = [record([2] * 30, 0), record([7] * 30, 1)]
    ours = [record([3] * 30, 0), record([8] * 30, 1)]
    assert paired_difference(ours, theirs)[1:3] == pytest.approx((0.1, 0.1))
    assert paired_difference([{**r, "seed": r["seed"] + 5} for r in ours], theirs)[1] < 0


def test_one_seed_has_no_p() -> None:
    three = [record([9] * 30, seed) for seed in range(3)]
    one, control = [record([5] * 30, 0)], [record([5] * 30, None)]
    assert paired_difference(one, three)[3] is None and paired_difference(three, one)[3] is None
    assert paired_difference(three, control)[3] is not None  # a control without seeds has nothing to vary
    assert paired_difference([record([3], 0)], [record([9], 0)])[1:] == (-1.0, 1.0, None)


def test_a_difference_in_under_six_groups_is_never_sure() -> None:
    """Equal gaps have no variance; a sign test over five groups cannot fall below .05."""
    for num, low in ((2, 0.0), (5, 0.0), (6, 0.1)):
        assert paired_difference([record([4] * num, 0)], [record([3] * num, 0)])[:2] == pytest.approx((0.1, low))
        assert mean_interval(np.full((1, num), 0.1))[:2] == pytest.approx((0.1, low))


def test_intervals_stay_within_0_and_1_are_never_empty_and_count_groups_with_rows() -> None:
    mean, low, high = interval([record([10] * 6, 0)])
    assert (mean, high) == (1.0, 1.0) and 0.7 < low < 0.9
    assert interval([record([0] * 6, 0)])[1:] == pytest.approx((0.0, 1 - low))
    assert interval([{"group_sizes": [10], "group_correct": [9]}]) == (0.9, 0.0, 1.0)  # says nothing about others
    for most in (10**9, 10**12, 10**15):  # one is nearly all
        mean, low, high = interval([{"group_sizes": [most, *[5] * 9], "group_correct": [most // 10, *[5] * 9]}])
        assert mean == pytest.approx(0.1) and low <= mean <= high
    holes = {"group_sizes": [10, 0, 10, 10, 0, 10, 10], "group_correct": [5, 0, 7, 2, 0, 9, 4], "seed": 0}
    assert interval([holes]) == interval([record([5, 7, 2, 9, 4], 0)])


def test_collapsed_features_look_collapsed_and_isotropic_ones_spread() -> None:
    same = torch.ones(50, 8)
    assert d.spread(same) == pytest.approx(0, abs=1e-6) and d.rank_me(same) == pytest.approx(1, abs=1e-3)
    z = torch.randn(4000, 16, generator=torch.Generator().manual_seed(0))
    assert d.spread(z) == pytest.approx(1, abs=0.03) and d.rank_me(z) == pytest.approx(16, abs=0.2)
    assert d.rank_me(torch.eye(7)) == pytest.approx(7, rel=1e-4)


def test_retrieval_by_group() -> None:
    """Three groups of two rows; queries point at their own group, at the next one, or nowhere."""
    groups = torch.tensor([0, 0, 1, 1, 2, 2])
    gallery = torch.eye(3)[groups]
    assert d.retrieval_ranks(gallery, gallery, groups).tolist() == [0] * 6
    wrong = torch.eye(3)[(groups + 1) % 3] + 0.1 * torch.eye(3)[groups]
    assert d.retrieval_ranks(wrong, gallery, groups).tolist() == [1] * 6
    assert d.retrieval_ranks(-gallery, gallery, 7 * groups + 3).tolist() == [2] * 6
    constant = torch.ones(6, 3)
    assert d.retrieval_ranks(constant, constant, groups).tolist() == [2] * 6, "ties must not retrieve"
    assert d.recall_at(torch.tensor([0, 1, 4, 9]), (1, 5, 10)) == {"R@1": 0.25, "R@5": 0.75, "R@10": 1.0}


@pytest.mark.parametrize(("rows", "width"), [(60, 8), (40, 64)])
def test_linear_probe_is_ridge_regression_with_a_chosen_strength(rows: int, width: int) -> None:
    """Equal to scikit-learn's at one of the strengths, in both forms; a value that half the features carry is found."""
    rng = torch.Generator().manual_seed(0)
    x, new = (3 * torch.randn(n, width, generator=rng) + 5 for n in (rows, 30))
    weight = torch.randn(width, 2, generator=rng)
    groups = torch.arange(rows) // 4
    guess = d.linear_probe(x, x @ weight, groups, new)
    scaled = ((x - x.mean(0)) / x.std(0)).double(), ((new - x.mean(0)) / x.std(0)).double()
    expected = [Ridge(alpha=a).fit(scaled[0], (x @ weight).double()).predict(scaled[1]) for a in d.ALPHAS]
    distances = [np.abs(guess.numpy() - each).max() for each in expected]
    assert min(distances) < 1e-3 < sorted(distances)[1]
    assert int(np.argmin(distances)) == 0  # without noise the weakest is best
    noise = torch.randn(rows, 1, generator=rng)
    assert float(d.linear_probe(x, noise, groups, new).std()) < 0.5 * float(noise.std())  # and here a strong one
    broken = torch.cat([x, torch.full((rows, 1), torch.inf)], 1), torch.cat([new, torch.ones(30, 1)], 1)
    assert torch.isfinite(d.linear_probe(broken[0], x @ weight, groups, broken[1])).all()


def test_a_feature_that_is_hardly_there_in_the_fitted_rows_does_not_decide_the_linear_probe() -> None:
    rng = torch.Generator().manual_seed(0)
    x, new = (torch.randn(n, 20, generator=rng) for n in (200, 100))
    x[:, 7], new[:, 7] = 0.0, 0.0
    x[3, 7], new[5, 7] = 1e-4, 0.2
    y = x[:, :1] + 0.3 * torch.randn(200, 1, generator=rng)
    assert float((d.linear_probe(x, y, torch.arange(200) // 4, new) - new[:, :1]).abs().max()) < 1


def test_an_r2_far_below_0_weighs_no_more_than_a_few_accuracies() -> None:
    assert d.mean_error([[0.9], [0.6]]) == pytest.approx((0.1 * 0.4) ** 0.5)
    assert d.mean_error([[1.0], [0.5, 0.98]]) == pytest.approx((0.01 * (0.5 * 0.02) ** 0.5) ** 0.5)
    assert d.mean_error([[0.95], [-403.7]]) < d.mean_error([[0.1], [-300.0]])


def test_folds_of_retrieval_are_one_record_of_all_queries() -> None:
    seed = {"source": "a", "seed": 0, "direction": "touch -> vision", "leak": ""}
    one = {**seed, "R@1": 0.5, "R@5": 0.5, "num_groups": 2, "group_sizes": [1, 1], "group_correct": [0, 1]}
    two = {**seed, "R@1": 0.0, "R@5": 1.0, "num_groups": 1, "group_sizes": [6], "group_correct": [6]}
    (found,) = pool_retrieval([one, two])
    assert found["group_sizes"] == [1, 1, 6] and found["num_groups"] == 3 and found["group_correct"] == [0, 1, 6]
    assert (found["R@1"], found["R@5"]) == (0.125, 0.875)


def test_label_controls_are_scored_on_the_rows_of_each_modality(tmp_path: Path) -> None:
    pack = toy_pack(tmp_path / "pack")
    y, has = pack.labels("pattern"), pack.labels("pattern") == 0
    has[np.flatnonzero(y == 1)[::4]] = True
    pack.has = lambda modality: has if modality == "touch" else np.ones_like(has)  # type: ignore[method-assign]
    task = next(task for task in pack.spec.tasks if task.name == "pattern")
    found = {r["modality"]: r for r in label_controls(pack, [task], ("touch", "vision", "both"))}
    assert [*found] == ["none", "touch", "both"] and found["touch"]["num_test"] == has[pack.rows("test")].sum()
    assert found["touch"]["accuracy"] > found["none"]["accuracy"]
