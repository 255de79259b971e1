"""Stress scores change what they say they change, and nothing else."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation import robustness as module
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.features import features
from mvitac.evaluation.probe import ProbeSplit, probe_features, split_rows
from mvitac.evaluation.robustness import CLEANED, DROPOUT, LEAK, MISSING, NOISE, NOISED, PREPARED, STRESSES, stress
from mvitac.experiments.collect import gather, lay_out
from mvitac.experiments.jobs import do_all
from mvitac.experiments.table_formats import write_tables
from mvitac.model import Model
from mvitac.model_files import load
from mvitac.recipes import recipe
from mvitac.run import Optim
from mvitac.system.files import read_json
from mvitac.training.loop import train
from support.small_plans import ROWS, small


@pytest.fixture(scope="module")
def trained(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Thirty supervised steps: features that know the pattern by touch and by vision."""
    from mvitac.methods.supervised import SupervisedConfig

    run = replace(recipe("smoke", PackConfig(path=pack.path)), steps=30, batch_size=30, eval_every=0)
    run = replace(run, method=SupervisedConfig(), optim=Optim(name="adamw", lr=3e-3))
    return train(run, tmp_path_factory.mktemp("stress") / "run", quiet=True)


@pytest.fixture(scope="module")
def records(trained: Path, pack: Pack) -> dict[tuple[str, str, str], dict]:
    found = stress(load(trained), pack, pack.spec.tasks, ["touch", "vision", "both"])
    return {(r["task"], r["modality"], r["probe"]): r for r in found}


def test_every_stress_of_every_modality(records: dict) -> None:
    tasks = ("pattern", "bright")
    anywhere = {(t, m, k) for t in tasks for m in ("touch", "vision", "both") for k in (*STRESSES[:6], *LEAK)}
    lost = (*MISSING.values(), DROPOUT, *PREPARED.values())
    assert set(records) == anywhere | {(t, "both", k) for t in tasks for k in lost}
    sizes = {
        leak: {tuple(r["group_sizes"]) for r in records.values() if (r["probe"] in LEAK) == leak} for leak in (0, 1)
    }
    assert len(sizes[0]) == len(sizes[1]) == 1  # all on the same test rows, or all on the same half of them


def test_a_missing_modality_leaves_what_the_other_says(trained: Path, pack: Pack, records: dict) -> None:
    """Zeroed in the probe's own units: exactly the score of the both-probe with its columns at train's mean."""
    model, task = load(trained), pack.spec.tasks[0]
    rows = split_rows(pack, task)
    everything, num = np.concatenate([rows.train, rows.val, rows.test]), len(rows.train) + len(rows.val)
    z = {m: features(model, pack, m, everything).copy() for m in model.encoders}
    z["vision"][num:] = z["vision"][:num].mean(0)
    x = np.concatenate([z["vision"], z["touch"]], axis=1)
    expected = probe_features(x, pack, task, rows, "linear", 0)
    assert records["pattern", "both", "vision missing"]["group_correct"] == expected["group_correct"]
    assert records["pattern", "both", "vision missing"]["accuracy"] > 0.5  # touch alone knows much of it


def test_modality_dropout_learns_from_each_row_three_times(
    trained: Path, pack: Pack, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned: list[tuple[np.ndarray, ProbeSplit]] = []
    real = module.fit_probe
    monkeypatch.setattr(
        module,
        "fit_probe",
        lambda x, pack, task, rows, *rest: learned.append((x, rows)) or real(x, pack, task, rows, *rest),
    )
    task = pack.spec.tasks[0]
    found = {r["probe"]: r for r in stress(load(trained), pack, [task], ["both"])}
    (x, rows), (noised, twice), (prepared, thrice) = learned
    assert np.array_equal(twice.train, np.tile(rows.train, 2)) and np.array_equal(
        noised[: len(rows.train)], x[: len(rows.train)]
    )
    assert np.array_equal(thrice.train, np.tile(rows.train, 3)) and np.array_equal(thrice.val, np.tile(rows.val, 3))
    assert np.array_equal(thrice.test, rows.test)
    num, width = len(rows.train), x.shape[1] // 2
    whole, no_vision, no_touch = prepared[: 3 * num].reshape(3, num, -1)
    assert np.array_equal(whole, x[:num])
    mean = x.mean(0)
    assert np.array_equal(no_vision[:, width:], x[:num, width:]) and np.allclose(no_vision[:, :width], mean[:width])
    assert np.array_equal(no_touch[:, :width], x[:num, :width]) and np.allclose(no_touch[:, width:], mean[width:])
    assert np.array_equal(prepared[3 * num : 3 * num + len(rows.val)], x[num:])
    lost = {kind: found[kind]["accuracy"] for kind in (DROPOUT, *PREPARED.values(), *MISSING.values())}
    assert lost["modality dropout, vision missing"] >= lost["vision missing"] - 0.05
    assert lost[DROPOUT] > 0.5


def test_few_labels_take_their_share_and_one_of_each_class(pack: Pack) -> None:
    rows, labels = split_rows(pack, pack.spec.tasks[0]), pack.labels("pattern")
    for share in (0.01, 0.1, 0.5):
        keep, few = module._few(rows, labels, share, seed=3)
        assert set(labels[few.train]) == set(labels[few.val]) == {0, 1, 2}
        assert len(few.train) == max(3, round(share * len(rows.train)))
        assert set(few.train) <= set(rows.train) and set(few.val) <= set(rows.val)
        everything = np.concatenate([rows.train, rows.val, rows.test])
        assert np.array_equal(everything[keep], np.concatenate([few.train, few.val, rows.test]))
    assert not np.array_equal(
        module._few(rows, labels, 0.1, seed=4)[1].train, module._few(rows, labels, 0.1, 3)[1].train
    )


def test_a_leak_gives_half_of_each_test_group_away_and_nothing_else(pack: Pack) -> None:
    rows, groups = split_rows(pack, pack.spec.tasks[0]), pack.column("group")
    everything = np.concatenate([rows.train, rows.val, rows.test])
    (keep, honest), (keep_leaking, leaking) = (module._halved(rows, groups, leaks, seed=1) for leaks in (False, True))
    assert np.array_equal(everything[keep], np.concatenate([honest.train, honest.val, honest.test]))
    assert np.array_equal(everything[keep_leaking], np.concatenate([leaking.train, leaking.val, leaking.test]))
    assert np.array_equal(honest.test, leaking.test) and np.array_equal(honest.train, rows.train)
    assert not set(groups[honest.train]) & set(groups[honest.test])
    given = set(leaking.train) - set(rows.train)
    assert given == set(rows.test) - set(leaking.test) and len(leaking.train) == len(rows.train)
    assert {str(name) for name in groups[sorted(given)]} == {str(name) for name in groups[leaking.test]}
    few = ProbeSplit(rows.train[:8], rows.val, rows.test)
    honest, leaking = (module._halved(few, groups, leaks, seed=1)[1] for leaks in (False, True))
    assert len(leaking.train) == len(honest.train) == 8  # half of test is more than there is to replace
    assert not set(leaking.train) & {*rows.train, *leaking.test}
    lonely = np.array([f"{i}" for i in range(len(groups))])
    assert not len(module._halved(rows, lonely, True, seed=1)[1].test)  # no group can leak: nothing to score


def test_noise_is_that_strong_and_the_same_for_all(trained: Path, pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.full((64, 64, 3), 128, np.uint8)
    noise = module._noisy(image, 0, 5).astype(float) - 128
    assert noise.std() == pytest.approx(20, rel=0.03) and abs(noise.mean()) < 0.6
    assert np.array_equal(module._noisy(image, 0, 5), module._noisy(image, 0, 5))
    assert not np.array_equal(module._noisy(image, 0, 5), module._noisy(image, 0, 6))
    rows: list[int] = []
    real = module._noisy
    monkeypatch.setattr(module, "_noisy", lambda image, seed, row: rows.append(row) or real(image, seed, row))
    stress(load(trained), pack, pack.spec.tasks, ["touch"])
    # Train and val: to know the noise, and for a probe that learns from noisy images, too.
    assert set(rows) == set(pack.rows("test", "train", "val"))


def test_cleaned_features_have_the_statistics_of_clean_ones(
    trained: Path, pack: Pack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What noise does to all features alike, here a factor and a shift, is undone without a label."""
    levels: list[float] = []

    def shifted(model: Model, pack: Pack, modality: str, rows: np.ndarray, seed: int, level: float = 0.0) -> np.ndarray:
        levels.append(level)
        return features(model, pack, modality, rows) * 3 + 5

    monkeypatch.setattr(module, "_noisy_features", shifted)
    found = {r["probe"]: r["accuracy"] for r in stress(load(trained), pack, pack.spec.tasks[:1], ["touch"])}
    (plain,) = (
        r["accuracy"]
        for r in probe_runs([trained], ProbeConfig(controls=False, modalities=("touch",), tasks=("pattern",)))[
            "records"
        ]
        if r["probe"] == "linear"
    )
    assert abs(found[CLEANED] - plain) <= 0.05 and found[NOISE] < plain - 0.1
    assert min(found[kind] for kind in NOISED) > found[NOISE] + 0.1  # a probe that knows both does for both
    assert levels[0] == 0 and min(levels[1:]) == pytest.approx(20, rel=0.25)  # the noise of the images was measured


def test_without_noise_it_is_the_plain_probe(trained: Path, pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "NOISE_LEVELS", 0.0)
    found = stress(load(trained), pack, pack.spec.tasks, ["touch", "both"])
    plain = probe_runs([trained], ProbeConfig(controls=False))["records"]
    for record in (r for r in found if r["probe"] == NOISE):
        same = [r for r in plain if all(r[k] == record[k] for k in ("task", "modality")) and r["probe"] == "linear"]
        assert record["group_correct"] == same[0]["group_correct"]


def test_strong_noise_hurts(records: dict, trained: Path, pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "NOISE_LEVELS", 200.0)
    found = stress(load(trained), pack, pack.spec.tasks[:1], ["touch"])
    drowned = next(r for r in found if r["probe"] == NOISE)
    assert drowned["accuracy"] < records["pattern", "touch", NOISE]["accuracy"]


def test_touch_only_models_miss_nothing(pack: Pack) -> None:
    from mvitac.methods.supervised import SupervisedConfig

    run = replace(recipe("smoke", PackConfig(path=pack.path)), method=SupervisedConfig(modalities=("touch",)))
    torch.manual_seed(0)
    model = Model(run.method.build(pack.spec, run.encoder), run, pack.spec, pack.size)
    found = stress(model, pack, pack.spec.tasks[:1], ["touch", "vision", "both"])
    assert {r["modality"] for r in found} == {"touch"}
    assert {r["probe"] for r in found} == {*STRESSES[:6], *LEAK}


def test_in_a_comparison_and_on_the_command_line(
    pack: Pack, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = small(
        pack, rows=(ROWS[0], ROWS[2]), seeds=1, stress=True, tasks=("pattern",), set={"steps": 1, "eval_every": 0}
    )
    session = ProbeConfig(tasks=("pattern",))
    work = lay_out(plan, pack, tmp_path, session)
    do_all(work, 1, lambda line: None)
    stress = read_json(work.jobs[0].out / "stress.json", "scores")
    assert {record["leak"] for record in stress["records"]} == {""}
    text = write_tables(gather(work, tmp_path, session), tmp_path)[0].read_text()
    block = text[text.index("**vision missing**") : text.index("**touch missing**")]
    assert "| MViTac | both |" in block and "| touch |" not in block and "untrained" not in block
    assert main(["probe", str(trained), "--stress", "--tasks", "pattern", "--json", str(tmp_path / "p.json")]) == 0
    assert "10 % of labels" in capsys.readouterr().out
    kinds = {r["probe"] for r in json.loads((tmp_path / "p.json").read_text())["records"]}
    assert kinds >= {"linear", *STRESSES}
