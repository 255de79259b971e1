"""Sensors in probes: statistics from unlabelled images, colours of known sensors."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.several import JoinedPack, MixedPack
from mvitac.data.source import Sample
from mvitac.evaluation import sensors as module
from mvitac.evaluation.features import features
from mvitac.evaluation.sensors import RecolouredPack, about_new, sensors_of, touch_features, unlabelled_rows
from mvitac.model import Model, load
from mvitac.nn.initial import Init
from mvitac.run import load_run
from mvitac.training.loop import train
from support.toy import Toy, altered, with_columns
from support.training_runs import smoke


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    """The striped pairs through two sensors, by turns; the second inverts touch."""

    def change(sample: Sample, item: int) -> dict[str, Any]:
        return {"sensor": "negative", "touch": 255 - sample.touch} if item % 2 else {"sensor": "plain"}  # type: ignore

    return build(altered(Toy(), change), tmp_path_factory.mktemp("others") / "pack", size=32, quiet=True)


def test_models_keep_sensors_of_their_training_rows(smoke_run: Path, pack: Pack, others: Pack, tmp_path: Path) -> None:
    """And those of the weights they start from, if it is touch that they take. Older files name none."""
    assert load(smoke_run).spec.sensors == ("toy",) and "sensors" not in repr(load(smoke_run))
    assert load_run(smoke_run)[1]["data"]["sensors"] == ["toy"]
    for modality, known in (("touch", ("negative", "plain", "toy")), ("vision", ("negative", "plain"))):
        init = Init(path=smoke_run, modalities=(modality,))
        started = train(smoke(others, steps=1, init=init, eval_every=1), tmp_path / modality, quiet=True)
        assert load(started).spec.sensors == load(started, "best").spec.sensors == known
    assert pack.spec.sensors == ()
    model = load(smoke_run)
    assert about_new(model, pack) == ""
    assert "negative, plain is new to the model, which knows toy" in about_new(model, others)
    model.spec = replace(model.spec, sensors=("other",))
    assert "toy is named by no column sensor and may be new to the model, which knows other" in about_new(model, pack)
    model.spec = replace(model.spec, sensors=())
    assert about_new(model, others) == ""


def test_sensors_of_a_mix_have_the_names_of_their_parts(pack: Pack, others: Pack) -> None:
    both = MixedPack({"a": pack, "b": others}, allow_leak=True)
    assert both.sensor_names == ("a", "negative", "plain")  # "a" has no column
    assert sensors_of(both, np.arange(both.num)) == ("negative", "plain", "toy")
    assert sensors_of(both, np.array([3, 120, 122])) == ("plain", "toy")


def test_statistics_never_take_test_images_while_there_are_others(others: Pack) -> None:
    split = others.column("split").astype(str)
    rows = unlabelled_rows(others, 0)
    assert set(split[rows]) == {"train"} and set(others.sensors[rows]) == {0}
    many = with_columns(others, sensor=np.full(others.num, "one"))
    assert set(split[unlabelled_rows(many, 0)]) == {"train"} and len(unlabelled_rows(many, 0)) == 72
    assert len(unlabelled_rows(many, 0, 40)) == 40
    few = with_columns(others, sensor=np.where(split == "test", "one", "two"))
    assert set(split[unlabelled_rows(few, 0)]) == {"test"}
    used = module.describe_statistics(few, ("features",))
    assert "test images among them" in used[0] and "test" not in used[1]


def test_joined_packs_take_statistics_from_hidden_rows(pack: Pack, others: Pack) -> None:
    """Of the scored pack: its train rows, which a joined pack hides, and no test row."""
    named = (pack, "old"), (others, "new")
    both = JoinedPack(*(with_columns(part, sensor=np.full(part.num, name)) for part, name in named))
    assert both.sensor_names == ("new", "old")
    new, old = (unlabelled_rows(both, number) for number in (0, 1))
    assert (new >= pack.num).all() and set(both.column("split")[new]) == {"hidden"}
    assert (old < pack.num).all() and set(both.column("split")[old]) == {"train"}


def test_features_are_standardised_by_each_sensors_own_images(model: Model, others: Pack) -> None:
    rows = others.rows("test")
    found = touch_features(model, others, "touch", rows, ("features",))
    for number in (0, 1):
        seen = features(model, others, "touch", unlabelled_rows(others, number))
        own = others.sensors[rows] == number
        expected = (features(model, others, "touch", rows[own]) - seen.mean(0)) / seen.std(0)
        np.testing.assert_allclose(found[own], expected, rtol=1e-5, atol=1e-5)
    for modality, kinds in (("vision", ("features",)), ("touch", ()), ("touch", ("colours",))):  # no sensor is new here
        plain = touch_features(model, others, modality, rows, kinds)  # type: ignore[arg-type]
        np.testing.assert_allclose(plain, features(model, others, modality, rows), rtol=1e-5, atol=1e-6)


def test_new_sensors_are_shown_as_each_known_one(
    pack: Pack, others: Pack, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only they change, and their features are the mean over the known sensors."""
    monkeypatch.setattr(module, "learn_colours", lambda images: float(images.mean()))
    monkeypatch.setattr(module, "recolour", lambda images, source, target: (images // 2 + int(target)).astype(np.uint8))
    learn = with_columns(pack, sensor=np.where(pack.labels("bright"), "lit", "dim"))
    both = RecolouredPack(learn, with_columns(others, sensor=np.full(120, "new")))
    assert both.sensor_names == ("dim", "lit", "new") and both.new == {2} and len(both.looks) == 2
    for look in both.looks:
        np.testing.assert_array_equal(look.images["touch"][:120], pack.images["touch"])
        assert (look.images["touch"][120:] != others.images["touch"]).mean() > 0.9
        np.testing.assert_array_equal(look.images["vision"][120:], others.images["vision"])
    assert len({both.digest, *(look.digest for look in both.looks)}) == 3  # features are cached by it
    rows = np.concatenate([both.rows("val"), both.rows("test")])
    found = touch_features(model, both, "touch", rows, ("colours",))
    each = [features(model, look, "touch", rows) for look in both.looks]
    np.testing.assert_allclose(found, (each[0] + each[1]) / 2, rtol=1e-4, atol=1e-5)
    both_kinds = touch_features(model, both, "touch", rows, ("features", "colours"))
    seen = np.mean([features(model, look, "touch", unlabelled_rows(both, 2)) for look in both.looks], axis=0)
    new = rows >= 120
    expected = (found[new] - seen.mean(0)) / (seen.std(0) + 1e-6)
    np.testing.assert_allclose(both_kinds[new], expected, rtol=1e-3, atol=1e-3)
    with pytest.raises(ValueError, match=r"all sensors of .* are in"):
        RecolouredPack(learn, with_columns(others, sensor=np.full(120, "lit")))


def test_stripes_have_no_slope_colours(pack: Pack, others: Pack) -> None:
    with pytest.raises(ValueError, match=r"'(negative|plain|toy)'.*leave --standardise colours out"):
        RecolouredPack(pack, others)


def test_probe_command_says_what_it_used(
    smoke_run: Path, pack: Pack, others: Pack, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    on = ["--on", str(others.path), "--learn-on", str(pack.path), "--tasks", "pattern", "--modalities", "touch"]
    out = tmp_path / "scores.json"
    arguments = ["probe", str(smoke_run), *on, "--no-controls", "--allow-leak", "--json", str(out)]
    assert main([*arguments, "--standardise", "features"]) == 0
    printed = capsys.readouterr().out
    assert "unlabelled images of sensor toy" in printed
    assert "sensor negative, plain is new to the model, which knows toy: --standardise features is used" in printed
    result = json.loads(out.read_text())
    assert result["asked"]["standardise"] == ["features"] and "sensor negative" in " ".join(result["statistics"])
    assert main(["probe", str(smoke_run), "--standardise", "colours"]) == 2
    assert "name that pack as well" in capsys.readouterr().err
    assert main(["probe", str(smoke_run), "--standardise", "features", "features"]) == 2
    assert "given twice" in capsys.readouterr().err
