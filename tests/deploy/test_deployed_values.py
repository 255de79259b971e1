"""Probes of values after publishing: in the artifact, its card, ``Model.predict`` and exports."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import mvitac
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.data.spec import Target
from mvitac.deploy import engine as runtime
from mvitac.deploy import publish
from mvitac.deploy.artifact import ARTIFACT
from mvitac.deploy.engine import Engine, spread_at
from mvitac.deploy.export_module import ExportModule
from mvitac.deploy.parity import parity, reference
from mvitac.evaluation.probe import score_rows, split_rows
from mvitac.nn.linear_probe import Error

LEVEL = Target(name="level", unit="levels")


def test_predicted_values_score_as_the_artifact_says(value_artifact: Path, measured: Pack) -> None:
    model, summary = mvitac.load(value_artifact), ARTIFACT.read(value_artifact)["scores"]["summary"]
    for task in measured.spec.values:
        rows = split_rows(measured, task).test
        for modality, names in (("touch", ["touch"]), ("both", ["vision", "touch"])):
            found = model.predict(**{m: measured.images[m][rows] for m in names})[task.name]
            again = score_rows(measured, task, rows, found.numpy())
            errors = model.probes[f"{task.name}.{modality}"].info.errors
            for target, error in zip(again["targets"], errors, strict=True):
                assert (error.r2, error.mae) == pytest.approx((target["r2"], target["mae"]), abs=1e-4)
            assert again["r2"] == pytest.approx(summary[task.name][modality]["mvitac"]["mean"], abs=1e-4)
            assert "untrained" in summary[task.name][modality] and "mean" in summary[task.name]["none"]
        assert model.targets[task.name] == task.targets
    assert set(model.classes) == {"pattern", "bright"}
    probe = model.probes["light.touch"]
    assert torch.equal(probe(probe.bounds[1:] + 1e6), probe(probe.bounds[1:])), "clipped as in the scores"


def test_the_spread_of_a_prediction_is_that_of_test_rows_in_its_range(
    value_artifact: Path, measured: Pack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "RANGE_ROWS", 5)
    model, task = mvitac.load(value_artifact), measured.spec.values[0]
    model.probes = publish.fit_probes(model, measured)
    rows = split_rows(measured, task).test
    found = model.predict(touch=measured.images["touch"][rows])["light"][:, 0].numpy()
    off = found - measured.values(task)[rows, 0]
    (error,) = model.probes["light.touch"].info.errors
    assert len(error.spread) == len(rows) // 5 > 2
    assert min(error.spread) <= error.rmse <= max(error.spread)
    for value in found:
        same = np.searchsorted(error.edges, found, side="right") == np.searchsorted(error.edges, value, side="right")
        assert error.spread_at(value) == pytest.approx(float((off[same] ** 2).mean() ** 0.5), rel=1e-3)
    wide = Error(r2=0.5, mae=1.0, rmse=2.0, edges=(1.0, 3.0), spread=(0.1, 0.2, 0.4))
    assert [wide.spread_at(v) for v in (-9.0, 0.99, 1.0, 2.9, 3.0, 99.0)] == [0.1, 0.1, 0.2, 0.2, 0.4, 0.4]


def test_the_card_has_errors_in_the_unit(value_artifact: Path) -> None:
    text = (value_artifact / "README.md").read_text()
    model = mvitac.load(value_artifact)
    errors = model.probes["both.touch"].info.errors
    assert "Accuracy or R2 in percent" in text and "- both: level in levels, weight in N" in text
    assert f"{errors[1].mae:.3g} ({errors[1].rmse:.3g}) N" in text
    assert "| mean |" in text and "| untrained |" in text


# -- exports ----------------------------------------------------------------------------------------------------------


def test_an_export_gives_the_models_values_with_unit_and_spread(
    value_onnx: Path, value_artifact: Path, measured: Pack
) -> None:
    engine, model = Engine(value_onnx, threads=1), mvitac.load(value_artifact)
    images = {m: np.asarray(measured.images[m][:5]) for m in measured.images}
    found, said = engine(**images), model.predict(**images)
    for task, targets in model.targets.items():
        np.testing.assert_allclose(found[f"value_{task}"], said[task].numpy(), rtol=1e-3, atol=1e-3)
        assert [(t["name"], t["unit"]) for t in engine.values[task]] == [(t.name, t.unit) for t in targets]
        (error, *_) = model.probes[f"{task}.both"].info.errors
        assert spread_at(engine.values[task][0], 99.0) == error.spread_at(99.0)
    assert set(engine.classes) == set(model.classes)
    (light,) = engine.meta["report"]["values"]["light"]
    assert light["unit"] == "levels" and light["num"] == 24 and light["change"] < 1e-3 * light["allowed"]
    assert light["export"] == pytest.approx(model.probes["light.both"].info.errors[0].mae, rel=1e-3)
    spread = float(np.std(measured.values(measured.spec.values[0])[measured.rows("test")]))
    assert light["allowed"] == pytest.approx(0.1 * spread)


def test_an_export_that_changes_a_value_is_refused_in_the_unit(
    value_artifact: Path, measured: Pack, pack: Pack
) -> None:
    model = mvitac.load(value_artifact)
    graph, rows = ExportModule(model), measured.rows("test")
    wanted = reference(model, graph, measured, rows)
    std = float(np.nanstd(measured.values(measured.spec.values[1])[rows, 1]))  # weight

    def call(arrays: list[np.ndarray]) -> list[np.ndarray]:
        found = _run(graph, arrays)
        found[-1] = found[-1] + np.array([0, 0.2 * std], np.float32)  # of task both: the weight alone
        return found

    with pytest.raises(
        ValueError, match=f"changes weight by {0.2 * std:.3g} N .* at most {0.1 * std:.3g} is allowed .--value-loss"
    ):
        parity(graph, call, measured, rows, wanted, min_cosine=0.99)
    report = parity(graph, call, measured, rows, wanted, min_cosine=0.99, value_loss=0.3)
    assert report["values"]["both"][1]["change"] == pytest.approx(0.2 * std, rel=1e-3)
    assert report["values"]["both"][1]["num"] == 16 and report["values"]["light"][0]["change"] < 1e-3
    # Of a pack that lacks them they are still compared.
    rows, wanted = pack.rows("test"), reference(model, graph, pack, pack.rows("test"))
    light = parity(graph, lambda a: _run(graph, a), pack, rows, wanted, min_cosine=0.99)["values"]["light"][0]
    assert light["num"] == 0 and light["original"] is None
    assert light["allowed"] == pytest.approx(0.1 * wanted["value_light"].std(), rel=1e-4)


def _run(graph: ExportModule, arrays: list[np.ndarray]) -> list[np.ndarray]:
    with torch.no_grad():
        return [x.numpy() for x in graph(*(torch.from_numpy(a) for a in arrays))]


def test_a_value_that_differs_on_the_robot_is_refused(value_onnx: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice as long features have the same cosine, but not the same values."""
    real = runtime.open_model
    names = json.loads((value_onnx / "export.json").read_text())["outputs"]

    def longer(*given: object) -> runtime.Call:
        call = real(*given)  # type: ignore[arg-type]
        return lambda arrays: [
            x * 2 if name.startswith(("embedding", "value")) else x for name, x in zip(names, call(arrays), strict=True)
        ]

    monkeypatch.setattr(runtime, "open_model", longer)
    with pytest.raises(ValueError, match=r"on this machine level differs by .* levels, at most"):
        Engine(value_onnx, threads=1)


def test_export_command_prints_errors_in_the_unit(
    value_artifact: Path,
    value_onnx: Path,
    measured: Pack,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wrote = lambda graph, path: shutil.copy(value_onnx / "model.onnx", path)  # noqa: E731
    monkeypatch.setattr("mvitac.deploy.export.write_onnx", wrote)  # it takes seconds, and gives the same
    command = ["export", str(value_artifact), "--precision", "int8", "--on", str(measured.path)]
    assert main([*command, "--out", str(tmp_path / "e"), "--value-loss", "9", "--accuracy-loss", "100"]) == 0
    assert "weight, mean absolute error, N" in " ".join(capsys.readouterr().out.split())
    report = json.loads((tmp_path / "e" / "export.json").read_text())["report"]
    assert 0 < report["values"]["both"][1]["change"] < report["values"]["both"][1]["allowed"]
    assert main([*command, "--out", str(tmp_path / "f"), "--value-loss", "nan", "--accuracy-loss", "100"]) == 2
    assert "(--value-loss)" in capsys.readouterr().err and not (tmp_path / "f").exists()
