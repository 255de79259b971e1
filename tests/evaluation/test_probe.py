"""Probes and their controls: they find what is there, choose nothing on test, and count few labels honestly."""

import io
import re
import shutil
import textwrap
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.linear_model import LogisticRegression

from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.evaluation import controls
from mvitac.evaluation import features as features_module
from mvitac.evaluation.classifiers import fit_knn, fit_linear, fit_papers
from mvitac.evaluation.controls import controls_of, frozen_trunks, imagenet_trunk, label_controls, starts_of
from mvitac.evaluation.diagnostics import linear_probe
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.features import _folded
from mvitac.evaluation.few_labels import few, raised
from mvitac.evaluation.folds import fold_splits
from mvitac.evaluation.leaks import read_sources
from mvitac.evaluation.probe import probe_all, probe_features, probe_model, split_rows
from mvitac.evaluation.regressors import fit_ridge
from mvitac.evaluation.retrieval import cross_modal
from mvitac.evaluation.run_names import names_of
from mvitac.evaluation.score_text import verdicts
from mvitac.methods.supervised import SupervisedConfig
from mvitac.model import Model, fresh, load
from mvitac.nn.encoders import SCRATCH, EncoderConfig
from mvitac.recipes import recipe, with_method
from mvitac.report.report import open_runs
from mvitac.report.tables import print_classes, print_retrieval, print_summary
from mvitac.system.device import Hardware
from mvitac.system.files import read_json
from mvitac.training import setup
from mvitac.training.loop import train
from support.forged_packs import refuse_pipe
from support.toy import Toy, renumbered, toy_pack, with_columns
from support.training_runs import smoke


@pytest.fixture(scope="module")
def runs(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    base, run = tmp_path_factory.mktemp("runs"), smoke(pack, steps=2, eval_every=0)
    return [train(replace(run, seed=seed), base / f"seed{seed}", quiet=True) for seed in (0, 1)]


@pytest.fixture(scope="module")
def result(runs: list[Path]) -> dict:
    return probe_runs(runs, ProbeConfig(probes=("linear", "knn")))


def features_that_know(pack: Pack, how_well: float = 3.0) -> np.ndarray:
    """Features of the first task's (train, val, test) rows in which the label is a direction plus noise."""
    task = pack.spec.tasks[0]
    labels = pack.column(f"label_{task.name}")[split_rows(pack, task).all]
    return (np.eye(8)[labels] * how_well + np.random.default_rng(0).normal(0, 0.3, (len(labels), 8))).astype(np.float32)


def test_the_papers_probe_learns_and_repeats() -> None:
    """60 epochs of 8 Adam steps at 1e-4 move a weight by at most .05: a hundred agreeing features make that decide."""
    y = (rng := np.random.default_rng(0)).integers(0, 3, 2048)
    x = (10 * np.repeat(np.eye(3)[y], 100, axis=1) + rng.normal(0, 5, (2048, 300))).astype(np.float32)
    assert (fit_papers(x, [y], [3], seed=0)[0](x).argmax(1) == y).mean() > 0.9
    first, same, other = (fit_papers(x[:256], [y[:256]], [3], seed=seed)[0](x) for seed in (0, 0, 1))
    assert np.array_equal(first, same) and not np.array_equal(first, other)


def test_linear_equals_scikit_learn_and_nothing_is_chosen_on_test(pack: Pack) -> None:
    """Shuffling the test labels changes the score but not the regularisation nor the predictions."""
    task = pack.spec.tasks[0]
    rows, x = split_rows(pack, task), features_that_know(pack, how_well=0.4)
    found = probe_features(x, pack, task, rows, "linear", 0)[0]
    labels = pack.column("label_pattern")
    num_train, num_both = len(rows.train), len(rows.train) + len(rows.val)
    mean, std = x[:num_train].mean(0), x[:num_train].std(0)
    model = LogisticRegression(C=found["C"], max_iter=2000)
    model.fit((x[:num_both] - mean) / std, labels[np.concatenate([rows.train, rows.val])])
    expected = model.score((x[num_both:] - mean) / std, labels[rows.test])
    assert found["accuracy"] == pytest.approx(expected, abs=1.5 / found["num_test"])  # solvers stop at different digits
    labels[rows.test] = (labels[rows.test] + 1) % 3
    after = probe_features(x, with_columns(pack, label_pattern=labels), task, rows, "linear", 0)[0]
    assert after["C"] == found["C"]
    assert np.array_equal(np.roll(found["confusion"], 1, axis=0), after["confusion"])


def test_val_is_carved_from_train_by_group_if_there_is_none(pack: Pack) -> None:
    split, groups = (pack.column(name).astype(str) for name in ("split", "group"))
    without_val = with_columns(pack, split=np.where(split == "val", "train", split))
    rows = split_rows(without_val, pack.spec.tasks[0])
    assert len(rows.val) and not set(groups[rows.val]) & set(groups[rows.train])
    assert not set(groups[rows.val]) & set(groups[rows.test])
    rows = split_rows(with_columns(without_val, group=np.full(pack.num, "one")), pack.spec.tasks[0])
    assert len(rows.val) and not set(rows.val) & set(rows.train), "rows of the one group"


def test_every_score_has_its_controls(result: dict) -> None:
    for task in ("pattern", "bright"):
        for modality in ("touch", "vision", "both"):
            assert {"mvitac", "untrained", "pixels"} <= set(result["summary"][task][modality])
        assert set(result["summary"][task]["none"]) == {"majority", "noise only"}
        assert "border" in result["summary"][task]["touch"]
        assert result["summary"][task]["touch"]["mvitac"]["seeds"] == [0, 1]
    print_summary(result, file := io.StringIO())
    print_retrieval(result, file)
    print_classes(result, file)
    text = file.getvalue()
    assert "majority" in text and re.search(r"mvitac +touch -> vision", text)
    for task, summary in result["summary"].items():
        assert all(textwrap.fill(line, 80, subsequent_indent="  ") in text for line in verdicts(summary))
        for one in result["per_class"][task]["both"]:
            scores = [score for source in ("mvitac", "untrained", "pixels") for score in one["scores"][source]]
            cells = ["-" if score is None else f"{100 * score:.1f}" for score in scores]
            row = [one["class"], str(one["rows"]), str(one["groups"]), *cells]
            assert row in [line.replace(" / ", " ").split() for line in text.splitlines()]
    assert max(map(len, text.splitlines())) <= 80


def test_folds_test_every_group_once_that_no_run_learned_from(pack: Pack, runs: list[Path]) -> None:
    """Each class in each fold; the seven tenths that were trained on are fitted on, or the folds are of all, elsewhere."""
    groups = pack.column("group").astype(str)
    learned = set(groups[pack.rows("train")])
    task = pack.spec.tasks[0]
    known = read_sources(runs[0]) or []
    images = [replace(source, ids=source.ids[:0], groups=source.groups[:0]) for source in known]  # under other names
    rest = set(groups) - learned
    for sources, free in ((known, rest), (images, rest), ([], set(groups))):
        splits = fold_splits(pack, task, 3, sources)
        tested = [set(groups[split == "test"]) for split in splits]
        assert sorted(group for each in tested for group in each) == sorted(free)
        for split, each in zip(splits, tested, strict=True):
            assert not each & set(groups[split == "train"]) and len(each | set(groups[split == "train"])) == 60
            assert min(np.bincount(pack.labels(task.name)[split == "test"], minlength=3)) > 0
    with pytest.raises(ValueError, match=r"task 'pattern' has 60 instances .* too few for 61 folds"):
        fold_splits(pack, task, 61, [])
    few = np.full(pack.num, -1)
    few[[np.flatnonzero(pack.column("label_pattern") == k)[0] for k in range(3)]] = range(3)  # one row of each class
    splits = fold_splits(with_columns(pack, label_pattern=few), task, 3, [])
    assert [list(split).count("test") for split in splits] == [1] * 3
    before = (runs[0] / "probe.json").exists()
    found = probe_runs(runs, ProbeConfig(folds=3, tasks=("pattern", "bright"), modalities=("touch",)))
    num = len(pack.rows("val", "test"))
    assert {(r["num_test"], sum(r["group_sizes"])) for r in found["records"]} == {(num, num)} and not found["leaks"]
    assert found["summary"]["pattern"]["touch"]["mvitac"]["groups"] == 60 - len(learned)
    assert {"mvitac", "untrained", "pixels", "border"} <= found["summary"]["pattern"]["touch"].keys()
    assert (runs[0] / "probe.folds.json").exists() and (runs[0] / "probe.json").exists() == before


@pytest.mark.parametrize("damage", ["bit", "cut", "no digest"])
def test_damaged_cached_features_are_computed_again(
    smoke_run: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path))
    model, rows = load(smoke_run), np.arange(20)
    first = features_module.features(model, pack, "touch", rows)
    (file,) = tmp_path.rglob("*.npy")
    bit = bytearray(whole := file.read_bytes())
    bit[len(bit) // 2] ^= 1
    file.write_bytes({"bit": bytes(bit), "cut": whole[:500], "no digest": whole[:-32]}[damage])
    np.testing.assert_array_equal(features_module.features(model, pack, "touch", rows), first)
    assert file.read_bytes() == whole
    refuse_pipe(file, lambda: features_module.features(model, pack, "touch", rows))


@pytest.mark.parametrize("same", [True, False])
def test_a_folded_network_is_used_only_where_it_is_the_same(
    smoke_run: Path, pack: Pack, monkeypatch: pytest.MonkeyPatch, same: bool
) -> None:
    model, rows = load(smoke_run), np.arange(300) % pack.num
    made, kept = _folded(model, "touch"), {name: id(module) for name, module in model.named_modules()}
    if not same:
        made.encoders["touch"].conv1[0].weight.data *= 2
    monkeypatch.setattr("mvitac.evaluation.features._folded", lambda *_: made)
    read, whole = [], Model.features
    monkeypatch.setattr(Model, "features", lambda self, *given, **how: read.append(self) or whole(self, *given, **how))
    found = features_module.pack_features(model, pack, "touch", rows)
    assert read[:3] == [model, made, made if same else model] and kept == {n: id(m) for n, m in model.named_modules()}
    torch.testing.assert_close(found[:50], features_module.pack_features(model, pack, "touch", rows[:50]))


def test_retrieval_of_the_untrained_is_chance(pack: Pack) -> None:
    state = torch.manual_seed(99).get_state()
    models = [fresh(smoke(pack, seed=seed), pack.spec, 32) for seed in (0, 1, 2)]
    assert len({model.weights_digest() for model in models}) == 3 and torch.equal(torch.get_rng_state(), state)
    found = [r for model in models for r in cross_modal(model, pack)]
    assert len(found) == 6 and {r["num_groups"] for r in found} == {12}
    for k in (1, 5, 10):
        assert np.mean([r[f"R@{k}"] for r in found]) == pytest.approx(k / 12, abs=0.07)
    assert {r["chance R@5"] for r in found} == {5 / 12}


def test_retrieval_needs_enough_groups_to_choose_from(result: dict, tmp_path: Path) -> None:
    assert len(result["retrieval"]) == 2 * len({(r["source"], r["seed"]) for r in result["retrieval"]})
    ten = toy_pack(tmp_path / "ten")
    test, groups = ten.rows("test"), ten.column("group").astype(str)
    names = np.unique(groups[test])
    groups[np.isin(groups, names[10:])] = names[0]
    ten = with_columns(ten, group=groups)
    assert len(set(groups[test])) == 10  # the best five of ten are half of them
    assert cross_modal(fresh(smoke(ten), ten.spec, ten.size), ten) == []


def test_a_model_of_both_senses_is_probed_on_one(tmp_path: Path) -> None:
    """Twelve test groups, enough for retrieval, but nothing to find them in."""
    touch = toy_pack(tmp_path / "touch", vision_channels=0)
    model = fresh(smoke(touch), Toy().spec(), touch.size)
    assert cross_modal(model, touch) == []
    assert [r["modality"] for r in probe_model(model, touch, touch.spec.tasks[:1], ["touch"], ["knn"])] == ["touch"]


def test_a_runs_own_classifier_answers_by_the_names_of_classes(pack: Pack) -> None:
    model = fresh(smoke(pack, method=SupervisedConfig()), pack.spec, pack.size)

    def own(*classes: str) -> list[dict]:
        other = renumbered(pack, *classes)
        return [r for r in probe_model(model, other, other.spec.tasks[:1], ["both"], ["knn"]) if r["probe"] == "own"]

    names = pack.spec.tasks[0].classes
    assert own("checks", "columns", "rows")[0]["group_correct"] == own(*names)[0]["group_correct"]
    (fewer,) = own("rows", "columns")
    assert np.sum(fewer["confusion"]) == fewer["num_test"]  # asked among these two
    assert own("waves", *names) == []  # it was never told of waves


def test_runs_of_other_data_and_settings_are_no_seeds_of_one_another(runs: list[Path], tmp_path: Path) -> None:
    """Two temperatures are two lines, each by its folder; what the two seeds share is one."""
    other = toy_pack(tmp_path / "p", num=90)
    path = train(smoke(other, steps=1), tmp_path / "r", quiet=True)
    with pytest.raises(ValueError, match="trained on different data"):
        probe_runs([runs[0], path], ProbeConfig())
    run = load(runs[0]).run
    colder = train(replace(run, method=replace(run.method, temperature=0.5)), tmp_path / "colder", quiet=True)
    session = ProbeConfig(probes=("knn",), tasks=("pattern",), modalities=("touch",), controls=False)
    found = probe_runs([*runs, colder], session)["summary"]["pattern"]["touch"]
    seeds, other = f"mvitac ({runs[0].parent.name})", "mvitac (colder)"
    assert {source: cell["seeds"] for source, cell in found.items()} == {seeds: [0, 1], other: [0]}
    assert [r.source for r in open_runs([colder, *runs])] == [other, seeds, seeds]
    with pytest.raises(ValueError, match="the same run"):
        probe_runs([*runs, shutil.copytree(runs[0], tmp_path / "again")], session)


def test_classes_that_train_lacks_are_named_below_the_scores(runs: list[Path], pack: Pack) -> None:
    labels, test = pack.labels("pattern").copy(), pack.rows("test")
    for rows in (pack.rows("train"), pack.rows("val")):
        labels[rows] = labels[rows] % 2  # nothing is a "rows"
    asked = ProbeConfig(probes=("knn",), tasks=("pattern",), modalities=("touch",), controls=False)
    found = probe_runs(runs[:1], asked, with_columns(pack, label_pattern=labels))
    num, name = (labels[test] == 2).sum(), pack.spec.tasks[0].classes[2]
    assert found["notes"] == [f"pattern: {num} of {len(test)} test rows have classes that train lacks: {name}"]
    labels[:] = labels % 2
    labels[np.isin(pack.column("group"), pack.column("group")[test[0]])] = 2  # in one fold's test alone
    found = probe_runs(runs[:1], replace(asked, folds=2), with_columns(pack, label_pattern=labels))
    num, of = (labels == 2).sum(), {record["num_test"] for record in found["records"]}
    assert found["notes"][1:] == [f"pattern: {num} of {of.pop()} test rows have classes that train lacks: {name}"]
    one = with_columns(pack, has_touch=pack.column("group") == pack.column("group")[0])
    with pytest.raises(ValueError, match=r"fold . of 2: .* with touch in split"):
        probe_runs(runs[:1], replace(asked, folds=2), one)


def test_seeds_whose_automatic_precision_differs_are_seeds_of_one_run(pack: Pack, tmp_path: Path) -> None:
    """Noise of the clock may give one seed bf16 and the next fp32."""
    run, paths = smoke(pack, steps=1, precision="auto"), []
    for seed in (0, 1):
        with pytest.MonkeyPatch.context() as patch:
            found = Hardware(torch.device("cpu"), ("fp32", "bf16")[seed], "")
            patch.setattr(setup, "hardware_of", lambda *_, found=found: found)
            paths.append(train(replace(run, seed=seed), tmp_path / f"s{seed}", quiet=True))
    models = [load(path) for path in paths]
    assert [m.run.precision for m in models] == ["fp32", "bf16"] and names_of(paths, models) == ["mvitac", "mvitac"]


def test_tasks_of_one_run_are_probed_together(pack: Pack) -> None:
    x, tasks = features_that_know(pack), list(pack.spec.tasks)
    order = split_rows(pack, tasks[0]).all

    def matrix(modality: str, rows: np.ndarray) -> np.ndarray:
        return x[[int(np.flatnonzero(order == row)[0]) for row in rows]]

    for task, record in zip(tasks, probe_all(matrix, pack, tasks, ["touch"], ["paper"], 3), strict=True):
        alone = probe_features(x, pack, task, split_rows(pack, task), "paper", 3)[0]
        assert record["accuracy"] == alone["accuracy"] and record["confusion"] == alone["confusion"]


def test_each_share_has_its_rows_and_one_of_each_class(pack: Pack) -> None:
    task = pack.spec.tasks[0]
    rows, labels = split_rows(pack, task), pack.labels("pattern")
    drawn = {}
    for percent in (1, 10, 50):
        train, val = drawn[percent] = few(pack, task, rows.train, rows.val, percent, seed=3)
        assert set(labels[rows.train[train]]) == set(labels[rows.val[val]]) == {0, 1, 2}
        assert len(set(train)) == len(train) == max(3, round(percent / 100 * len(rows.train)))
    assert not np.array_equal(few(pack, task, rows.train, rows.val, 10, seed=4)[0], drawn[10][0])
    said = f"pattern: 1 % of labels is 6 of {len(rows.train) + len(rows.val)} rows: each kind of label is kept"
    assert raised(pack, task, rows.train, rows.val, (1, 50)) == [said]


def test_few_values_keep_two_of_each_target(measured: Pack) -> None:
    task, number = measured.spec.values[1], np.arange(measured.num)
    pack = with_columns(measured, weight=np.where(number // 3 % 2, number, np.nan))  # one row of each group has it
    rows = split_rows(pack, task)
    train, val = few(pack, task, rows.train, rows.val, 1, seed=0)
    for kept in (rows.train[train], rows.val[val]):
        assert np.isfinite(pack.values(task)[kept]).any(0).all()
    assert len(np.unique(pack.values(task)[rows.train[train], 0])) > 1


def test_a_control_of_values_sees_as_few_labels(measured: Pack) -> None:
    task, few_kind = measured.spec.values[0], "10 % of labels"
    light = measured.values(task)[:, 0] + np.random.default_rng(0).normal(0, 9, measured.num)
    pack = with_columns(measured, light=light)
    pack.spec = replace(pack.spec, controls={"light": ("light",)})
    found = {(r["source"], r["probe"]): r["r2"] for r in label_controls(pack, [task], (), ("linear", few_kind))}
    assert found.keys() == {(source, kind) for source in ("mean", "light") for kind in ("linear", few_kind)}
    assert found["light", few_kind] < found["light", "linear"] > 0.5
    rows, y = split_rows(pack, task), pack.values(task)[:, 0]
    train, val = few(pack, task, rows.train, rows.val, 10, seed=0)
    wrong = y[rows.test] - y[np.r_[rows.train[train], rows.val[val]]].mean()
    assert found["mean", few_kind] == pytest.approx(1 - np.mean(wrong**2) / y[rows.test].var())


def test_the_command_shows_few_labels(smoke_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["--tasks", "pattern", "--modalities", "touch", "--json", str(tmp_path / "scores.json")]
    assert main(["probe", str(smoke_run), *asked, "--fractions", "1", "10", "50"]) == 0
    assert "(10 % of labels;" in (said := capsys.readouterr().out) and "(50 % of labels;" in said
    assert "note: pattern: 1 % of labels is 6 of" in said
    records = {(r["source"], r["probe"]): r for r in read_json(tmp_path / "scores.json", "")["records"]}
    for source in ("mvitac", "untrained"):
        sizes = {str(records[source, kind]["group_sizes"]) for kind in ("linear", "10 % of labels", "50 % of labels")}
        assert len(sizes) == 1  # the same test rows
        assert records[source, "10 % of labels"]["accuracy"] < records[source, "linear"]["accuracy"] + 0.1
    for words, says in (("101", "fractions (101.0,): give"), ("33.33331 33.33332", "labels' is given twice")):
        assert main(["probe", str(smoke_run), "--fractions", *words.split()]) == 2 and says in capsys.readouterr().err


def test_a_thumbnail_is_the_mean_of_its_pixels_and_the_border_sees_nothing_of_the_middle() -> None:
    """The border is two of sixteen thumbnails deep: the outer four of 32 pixels."""

    def pictures(*images: np.ndarray) -> Any:
        return SimpleNamespace(images={"touch": np.stack(images)})

    image = np.random.default_rng(0).integers(0, 255, (32, 32, 6), np.uint8)
    found = controls.thumbnails(pictures(image), "touch", np.array([0]), side=8)
    blocks = image.reshape(8, 4, 8, 4, 6).mean((1, 3)) / 255
    assert np.allclose(found[0], blocks.transpose(2, 0, 1).ravel(), atol=1e-6)
    plain = np.full((32, 32, 3), 7, np.uint8)
    middle, edge = plain.copy(), plain.copy()
    middle[4:-4, 4:-4] = 200
    edge[16, 3] = 200
    found = controls.borders(pictures(plain, middle, edge), "touch", np.arange(3))
    assert found.shape == (3, 3 * (16 * 16 - 12 * 12))
    assert np.array_equal(found[0], found[1]) and not np.array_equal(found[0], found[2])


def test_frozen_trunks_are_imagenet_and_files_that_runs_started_from() -> None:
    run = recipe("smoke")
    started = replace(run, encoder=run.encoder.changed(weights="b.pth"))
    found = frozen_trunks([run, started, started])
    assert [name for name, _ in found] == ["imagenet", "start"] and found[1][1].encoder == started.encoder
    large = replace(started, augment=replace(run.augment, whole=48))
    assert frozen_trunks([run, large])[1][1].augment.whole_of("touch") == 48  # as that run saw them
    (_, control), *rest = frozen_trunks([run])
    assert not rest and {control.encoder[m].trunk for m in ("vision", "touch")} == {"tf_efficientnet_lite0"}
    assert {control.augment.whole_of(m) for m in ("vision", "touch")} == {controls.IMAGENET_SIDE}


def test_the_runs_own_trunk_is_the_imagenet_control_where_its_weights_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvitac.nn.imagenet.source", lambda trunk: "cache" if trunk == "resnet18" else "")
    found = imagenet_trunk(EncoderConfig(trunk="resnet18", weights=SCRATCH, locked=True))
    assert found == EncoderConfig(trunk="resnet18")
    assert imagenet_trunk(EncoderConfig(trunk="mvitac_tiny", weights=SCRATCH)) is None


def test_neighbours_are_by_cosine_and_vote_in_shares() -> None:
    x, y = np.array([[1.0, 0.0], [0.0, 10.0]]), np.array([0, 2])
    shares = fit_knn(x, y, 3)(np.array([[3.0, 4.0]]))[0]  # nearer to the first, but turned towards the second
    assert shares[2] / shares[0] == pytest.approx(np.exp((0.8 - 0.6) / 0.07), rel=1e-4)
    assert shares.sum() == pytest.approx(1) and shares[1] == 0


def test_classes_never_seen_get_probability_zero() -> None:
    x, y = np.array([[-1.0], [-0.9], [0.9], [1.0]]), np.array([0, 0, 2, 2])
    found = fit_linear(x, y, x, y, 4)[0](np.array([[1.0]]))[0]
    assert found[2] > found[0] > 0 and found[[1, 3]].tolist() == [0, 0] and found.sum() == pytest.approx(1)
    fit_linear(x := np.eye(24), y := np.arange(24) % 20, x, y)  # so few rows that scikit-learn alone would warn


def test_the_scale_of_a_feature_does_not_matter_to_any_linear_probe() -> None:
    rng = np.random.default_rng(0)
    x, scales = rng.normal(size=(400, 12)).astype(np.float32), (10.0 ** rng.integers(-12, 9, 13)).astype(np.float32)
    y = (x @ rng.normal(size=12) > 0).astype(int)
    kept = np.hstack([x, np.full((400, 1), 0.1, np.float32)])  # one is constant
    for fit in (
        lambda z: fit_linear(z[:200], y[:200], z[200:300], y[200:300])[0](z[300:]),
        lambda z: fit_ridge(z[:300], y[:300, None].astype(float), 100)[0](z[300:]),
        lambda z: linear_probe(*map(torch.from_numpy, (z[:300], x[:300, :1], np.arange(300) // 4, z[300:]))).numpy(),
    ):
        assert np.allclose(fit(kept), fit(kept * scales), atol=1e-2) and fit(kept).std() > 0.1


def test_an_untrained_trunk_stands_beside_every_modality_and_search() -> None:
    """Whatever the order of the runs, the control is of one that has all the others have."""
    base, spec = recipe("smoke"), Toy().spec()
    again = replace(base, seed=1)
    touch, vision = (replace(base, method=SupervisedConfig(modalities=(m,))) for m in ("touch", "vision"))
    apart = with_method(base, "simclr")  # both modalities, no space that they share
    for runs, starts in (
        ([touch, apart, base], [base]),
        ([base, apart, touch], [base]),
        ([apart, touch, base], [base]),
        ([base, again, touch], [base, again]),
        ([touch, vision, touch], [touch, vision]),
    ):
        assert [run for run, _ in starts_of(runs, [spec] * 3)] == starts


def test_the_untrained_trunk_is_of_the_runs_own_data(tmp_path: Path) -> None:
    """A classifier of ``bright`` and a method of pairs, probed on touch alone without that label."""
    pack = toy_pack(tmp_path / "p", num=60, vision_channels=0)
    base = recipe("smoke")
    runs = [replace(base, method=SupervisedConfig(tasks=("bright",))), with_method(replace(base, seed=1), "ssvtp")]
    pack.spec, own = replace(pack.spec, tasks=pack.spec.tasks[:1]), Toy().spec()
    records, retrieval = controls_of(runs, pack, pack.spec.tasks, ["touch"], ["knn"], specs=[own, own])
    assert {r["seed"] for r in records if r["source"] == "untrained"} == {0, 1} and not retrieval
    assert {r["probe"] for r in records if r["source"] in ("pixels", "border")} == {"knn"}
