"""Probes: they find what is there, choose nothing on test, and their intervals are what they say."""

import dataclasses
import io
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import torch
from sklearn.linear_model import LogisticRegression

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample
from mvitac.data.spec import DataSpec
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation import features as features_module
from mvitac.evaluation.classifiers import fit_papers, train_heads
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.probe import probe_all, probe_features, probe_model, split_rows
from mvitac.evaluation.retrieval import cross_modal
from mvitac.evaluation.run_names import _places, names_of
from mvitac.evaluation.scores import summarise
from mvitac.methods.supervised import SupervisedConfig
from mvitac.model_files import fresh, load
from mvitac.recipes import recipe
from mvitac.report.report import open_runs
from mvitac.report.tables import print_retrieval, print_summary
from mvitac.run import Optim
from mvitac.system.device import Hardware
from mvitac.training import setup
from mvitac.training.loop import train
from support.toy import Toy, toy_pack


@pytest.fixture(scope="module")
def runs(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    base = tmp_path_factory.mktemp("runs")
    run = replace(recipe("smoke", PackConfig(path=pack.path)), steps=2, eval_every=0)
    return [train(replace(run, seed=seed), base / f"seed{seed}", quiet=True) for seed in (0, 1)]


@pytest.fixture(scope="module")
def result(runs: list[Path]) -> dict:
    return probe_runs(runs, ProbeConfig(probes=("linear", "knn")))


def features_that_know(pack: Pack, task_index: int, how_well: float = 3.0) -> np.ndarray:
    """Features of the task's (train, val, test) rows in which the label is a direction plus noise."""
    task = pack.spec.tasks[task_index]
    rows = split_rows(pack, task)
    everything = np.concatenate([rows.train, rows.val, rows.test])
    labels = pack.column(f"label_{task.name}")[everything]
    rng = np.random.default_rng(0)
    return (np.eye(8)[labels] * how_well + rng.normal(0, 0.3, (len(labels), 8))).astype(np.float32)


@pytest.mark.parametrize("kind", ["linear", "knn"])
@pytest.mark.parametrize("task_index", [0, 1])
def test_finds_what_is_there(pack: Pack, kind: str, task_index: int) -> None:
    task = pack.spec.tasks[task_index]
    found = probe_features(features_that_know(pack, task_index), pack, task, split_rows(pack, task), kind, 0)
    assert found["accuracy"] == 1.0
    assert found["balanced_accuracy"] == 1.0
    assert found["macro_f1"] == 1.0
    assert found["auroc"] == (1.0 if len(task.classes) == 2 else None)
    assert np.trace(found["confusion"]) == found["num_test"]


def test_finds_nothing_in_noise(pack: Pack) -> None:
    task = pack.spec.tasks[0]
    noise = np.random.default_rng(1).normal(size=features_that_know(pack, 0).shape).astype(np.float32)
    found = probe_features(noise, pack, task, split_rows(pack, task), "linear", 0)
    assert found["accuracy"] < 0.65


def test_the_papers_probe_learns_and_repeats() -> None:
    """60 epochs of 8 Adam steps at 1e-4 move a weight by at most .05: a hundred agreeing features make that decide."""
    rng = np.random.default_rng(0)
    y = rng.integers(0, 3, 2048)
    x = (10 * np.repeat(np.eye(3)[y], 100, axis=1) + rng.normal(0, 5, (2048, 300))).astype(np.float32)
    predict = fit_papers(x, [y], [3], seed=0)[0]
    assert (predict(x).argmax(1) == y).mean() > 0.9
    first, same, other = (fit_papers(x[:256], [y[:256]], [3], seed=seed)[0](x) for seed in (0, 0, 1))
    assert np.array_equal(first, same) and not np.array_equal(first, other)


def test_linear_equals_scikit_learn(pack: Pack) -> None:
    task = pack.spec.tasks[0]
    rows, x = split_rows(pack, task), features_that_know(pack, 0, how_well=0.4)
    found = probe_features(x, pack, task, rows, "linear", 0)
    labels = pack.column("label_pattern")
    num_train, num_both = len(rows.train), len(rows.train) + len(rows.val)
    mean, std = x[:num_train].mean(0), x[:num_train].std(0)
    model = LogisticRegression(C=found["C"], max_iter=2000)
    model.fit((x[:num_both] - mean) / std, labels[np.concatenate([rows.train, rows.val])])
    expected = model.score((x[num_both:] - mean) / std, labels[rows.test])
    assert found["accuracy"] == pytest.approx(expected, abs=1.5 / found["num_test"])  # solvers stop at different digits


def test_nothing_is_chosen_on_test(pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shuffling the test labels changes the score but not the regularisation nor the predictions."""
    task = pack.spec.tasks[0]
    rows, x = split_rows(pack, task), features_that_know(pack, 0, how_well=0.6)
    before = probe_features(x, pack, task, rows, "linear", 0)
    real = Pack.labels

    def shuffled(self: Pack, task: str, *splits: str) -> np.ndarray:
        values = real(self, task, *splits).copy()
        values[rows.test] = (values[rows.test] + 1) % 3
        return values

    monkeypatch.setattr(Pack, "labels", shuffled)
    after = probe_features(x, pack, task, rows, "linear", 0)
    assert after["C"] == before["C"]
    assert np.array_equal(np.roll(before["confusion"], 1, axis=0), after["confusion"])


def test_val_is_carved_from_train_by_group_if_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pack = toy_pack(tmp_path / "p")
    real = Pack.column

    def without_val(self: Pack, name: str) -> np.ndarray:
        values = real(self, name)
        return np.where(values == "val", "train", values) if name == "split" else values

    monkeypatch.setattr(Pack, "column", without_val)
    rows = split_rows(pack, pack.spec.tasks[0])
    groups = pack.column("group")
    assert len(rows.val) and not set(groups[rows.val]) & set(groups[rows.train])
    assert not set(groups[rows.val]) & set(groups[rows.test])


def test_every_score_has_its_controls(result: dict) -> None:
    for task in ("pattern", "bright"):
        for modality in ("touch", "vision", "both"):
            assert {"mvitac", "untrained", "pixels"} <= set(result["summary"][task][modality])
        assert set(result["summary"][task]["none"]) == {"majority", "noise only"}
        assert "border" in result["summary"][task]["touch"]
        assert result["summary"][task]["touch"]["mvitac"]["seeds"] == [0, 1]
    print_summary(result, file := io.StringIO())
    print_retrieval(result, file)
    text = file.getvalue()
    assert "majority" in text and re.search(r"mvitac +touch -> vision", text)


def test_majority_is_the_share_of_trains_commonest_class(pack: Pack, result: dict) -> None:
    rows = split_rows(pack, pack.spec.tasks[1])
    labels = pack.column("label_bright")
    common = np.bincount(labels[np.concatenate([rows.train, rows.val])]).argmax()
    expected = float((labels[rows.test] == common).mean())
    assert result["summary"]["bright"]["none"]["majority"]["mean"] == pytest.approx(expected)


def test_untrained_is_this_runs_trunk_before_training(pack: Pack, tmp_path: Path) -> None:
    """What train() begins with: one step of next to no length leaves it where it was."""
    run = replace(recipe("smoke", PackConfig(path=pack.path)), steps=1, eval_every=0, log_every=1)
    still = replace(run, optim=Optim(name="sgd", lr=1e-30, warmup=0.0, weight_decay=0.0))
    start, seed1 = fresh(run, pack.spec, 32), fresh(replace(run, seed=1), pack.spec, 32)
    begun = dict(load(train(still, tmp_path / "still", quiet=True)).named_parameters())
    for name, value in start.named_parameters():
        torch.testing.assert_close(value, begun[name], rtol=0, atol=1e-20)
    assert any(not torch.allclose(value, begun[name]) for name, value in seed1.named_parameters())


def test_summary_shows_a_controls_only_probe(result: dict) -> None:
    knn = summarise(result["records"], "knn")
    assert "majority" in knn["pattern"]["none"] and "pixels" in knn["pattern"]["touch"]
    assert knn["pattern"]["touch"]["pixels"] == result["summary"]["pattern"]["touch"]["pixels"]  # its linear one
    wanted = {"source": "mvitac", "task": "pattern", "modality": "touch", "probe": "knn"}
    scores = [r["accuracy"] for r in result["records"] if wanted.items() <= r.items()]
    assert len(scores) == 2 and knn["pattern"]["touch"]["mvitac"]["mean"] == pytest.approx(np.mean(scores))


def test_features_are_computed_once(runs: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    session = ProbeConfig(probes=("knn",), controls=False)
    first = probe_runs(runs[:1], session)

    def never(*_: object, **__: object) -> None:
        raise AssertionError("the features were in the cache")

    monkeypatch.setattr(features_module, "pack_features", never)
    assert probe_runs(runs[:1], session)["records"] == first["records"]


@pytest.mark.parametrize("damage", ["bit", "cut", "no digest"])
def test_damaged_cached_features_are_computed_again(
    smoke_run: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path))
    model, rows = load(smoke_run), np.arange(20)
    first = features_module.features(model, pack, "touch", rows)
    (file,) = tmp_path.rglob("*.npy")
    whole = file.read_bytes()
    bit = bytearray(whole)
    bit[len(bit) // 2] ^= 1
    file.write_bytes({"bit": bytes(bit), "cut": whole[:500], "no digest": whole[:-32]}[damage])
    np.testing.assert_array_equal(features_module.features(model, pack, "touch", rows), first)
    assert file.read_bytes() == whole


def test_retrieval_of_the_untrained_is_chance(pack: Pack) -> None:
    run = recipe("smoke", PackConfig(path=pack.path))
    found = [r for seed in (0, 1, 2) for r in cross_modal(fresh(replace(run, seed=seed), pack.spec, 32), pack)]
    assert len(found) == 6 and {r["num_groups"] for r in found} == {12}
    for k in (1, 5, 10):
        mean = np.mean([r[f"R@{k}"] for r in found])
        assert mean == pytest.approx(k / 12, abs=0.07)
    assert {r["chance R@5"] for r in found} == {5 / 12}


def test_retrieval_needs_enough_groups_to_choose_from(result: dict, tmp_path: Path) -> None:
    assert len(result["retrieval"]) == 2 * len({(r["source"], r["seed"]) for r in result["retrieval"]})
    few = toy_pack(tmp_path / "few", num=60)
    run = recipe("smoke", PackConfig(path=few.path))
    assert len(set(few.column("group")[few.rows("test")])) < 10
    assert cross_modal(fresh(run, few.spec, few.size), few) == []
    ten = toy_pack(tmp_path / "ten")
    test, groups = ten.rows("test"), ten.column("group").astype(str)
    names = np.unique(groups[test])
    groups[np.isin(groups, names[10:])] = names[0]
    ten.table = ten.table.set_column(ten.table.schema.get_field_index("group"), "group", pa.array(groups))
    assert len(set(groups[test])) == 10  # the best five of ten are half of them
    assert cross_modal(fresh(run, ten.spec, ten.size), ten) == []


def test_a_model_of_both_senses_is_probed_on_one(tmp_path: Path) -> None:
    """Twelve test groups, enough for retrieval, but nothing to find them in."""
    touch = toy_pack(tmp_path / "touch", vision_channels=0)
    both = Toy().spec()
    model = fresh(recipe("smoke", PackConfig(path=touch.path)), both, touch.size)
    assert cross_modal(model, touch) == []
    found = probe_model(model, touch, touch.spec.tasks[:1], ["touch"], ["knn"])
    assert [r["modality"] for r in found] == ["touch"]


@dataclasses.dataclass
class Renumbered(Toy):
    """The toy, its patterns listed in another order, as ``classes``; others have no label."""

    classes: tuple[str, ...] = ("checks", "columns", "rows")

    def spec(self) -> DataSpec:
        spec = super().spec()
        return replace(spec, tasks=(replace(spec.tasks[0], classes=self.classes),))

    def read(self, item: int) -> list[Sample]:
        (sample,) = super().read(item)
        name = Toy().spec().tasks[0].classes[sample.columns["label_pattern"]]
        label = self.classes.index(name) if name in self.classes else -1
        return [replace(sample, columns={**sample.columns, "label_pattern": label})]


def test_a_runs_own_classifier_answers_by_the_names_of_classes(tmp_path: Path) -> None:
    plain = toy_pack(tmp_path / "plain", num=60)
    run = replace(recipe("smoke", PackConfig(path=plain.path)), method=SupervisedConfig())
    model = fresh(run, plain.spec, plain.size)

    def own(pack: Pack) -> list[dict]:
        found = probe_model(model, pack, pack.spec.tasks[:1], ["both"], ["knn"])
        return [r for r in found if r["probe"] == "own"]

    turned = build(Renumbered(num=60), tmp_path / "turned", size=32, quiet=True)
    assert own(turned)[0]["group_correct"] == own(plain)[0]["group_correct"]
    fewer = build(Renumbered(num=60, classes=("rows", "columns")), tmp_path / "fewer", size=32, quiet=True)
    assert np.sum(own(fewer)[0]["confusion"]) == own(fewer)[0]["num_test"]  # asked among these two
    more = build(
        Renumbered(num=60, classes=("waves", *plain.spec.tasks[0].classes)), tmp_path / "m", size=32, quiet=True
    )
    assert own(more) == []  # it was never told of waves


def test_runs_on_different_data_are_not_mixed(runs: list[Path], tmp_path: Path) -> None:
    other = toy_pack(tmp_path / "p", num=90)
    run = replace(recipe("smoke", PackConfig(path=other.path)), steps=1)
    path = train(run, tmp_path / "r", quiet=True)
    with pytest.raises(ValueError, match="trained on different data"):
        probe_runs([runs[0], path], ProbeConfig())


def test_runs_of_other_settings_are_no_seeds_of_one_another(runs: list[Path], tmp_path: Path) -> None:
    """Two temperatures are two lines, each by its folder; what the two seeds share is one."""
    run = load(runs[0]).run
    colder = train(replace(run, method=replace(run.method, temperature=0.5)), tmp_path / "colder", quiet=True)
    session = ProbeConfig(probes=("knn",), tasks=("pattern",), modalities=("touch",), controls=False)
    found = probe_runs([*runs, colder], session)["summary"]["pattern"]["touch"]
    seeds, other = f"mvitac ({runs[0].parent.name})", "mvitac (colder)"
    assert {source: cell["seeds"] for source, cell in found.items()} == {seeds: [0, 1], other: [0]}
    assert [r.source for r in open_runs([colder, *runs])] == [other, seeds, seeds]
    again = shutil.copytree(runs[0], tmp_path / "again")
    with pytest.raises(ValueError, match="the same run"):
        probe_runs([*runs, again], session)


def test_seeds_whose_automatic_precision_differs_are_seeds_of_one_run(pack: Pack, tmp_path: Path) -> None:
    """Noise of the clock may give one seed bf16 and the next fp32."""
    run, paths = replace(recipe("smoke", PackConfig(path=pack.path)), steps=1, precision="auto"), []
    for seed in (0, 1):
        with pytest.MonkeyPatch.context() as patch:
            found = Hardware(torch.device("cpu"), ("fp32", "bf16")[seed], "")
            patch.setattr(setup, "_hardware", lambda *_, found=found: found)
            paths.append(train(replace(run, seed=seed), tmp_path / f"s{seed}", quiet=True))
    models = [load(path) for path in paths]
    assert [m.run.precision for m in models] == ["fp32", "bf16"] and names_of(paths, models) == ["mvitac", "mvitac"]


def test_runs_are_told_apart_by_the_end_of_their_path() -> None:
    a, b, c = (Path(f"/runs/{name}") for name in "abc")
    assert _places([[a / "seed0"], [b / "seed0"]]) == ["a/seed0", "b/seed0"]
    assert _places([[a / "seed0", a / "seed1"], [b / "seed0", b / "seed1"]]) == ["a", "b"]
    assert _places([[a, b], [c]]) == ["runs", "c"]
    assert _places([[a, b], [c, Path("/runs/d")]]) == ["a, b", "c, d"]


def test_heads_trained_together_are_the_heads_trained_alone() -> None:
    """Three tasks on the features of two models at once: the weights of each trained by itself."""
    rng = np.random.default_rng(0)
    features = torch.from_numpy(rng.normal(size=(2, 600, 12)).astype(np.float32))
    classes = [3, 2, 4]
    labels = torch.from_numpy(np.stack([rng.integers(0, k, 600) for k in classes]))
    together = train_heads(features, labels, classes, [5, 6])
    for model, seed in enumerate((5, 6)):
        alone = train_heads(features[model : model + 1], labels, classes, [seed])[0]
        for a, b in zip(together[model], alone, strict=True):
            torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-4)
    single = train_heads(features[:1], labels[1:2], classes[1:2], [5])[0][0]  # other tasks beside it change nothing
    torch.testing.assert_close(together[0][1], single, atol=1e-5, rtol=1e-4)
    assert not torch.allclose(together[0][0], together[1][0], atol=1e-2)


def test_tasks_of_one_run_are_probed_together(pack: Pack) -> None:
    """The records are those of each task probed on its own."""
    x = features_that_know(pack, 0)
    tasks = list(pack.spec.tasks)
    order = np.concatenate([*dataclasses.astuple(split_rows(pack, tasks[0]))])

    def matrix(modality: str, rows: np.ndarray) -> np.ndarray:
        return x[[int(np.flatnonzero(order == row)[0]) for row in rows]]

    records = probe_all(matrix, pack, tasks, ["touch"], ["paper"], 3)
    for task, record in zip(tasks, records, strict=True):
        alone = probe_features(x, pack, task, split_rows(pack, task), "paper", 3)
        assert record["accuracy"] == alone["accuracy"] and record["confusion"] == alone["confusion"]
