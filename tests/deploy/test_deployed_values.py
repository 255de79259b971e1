"""Probes of values after publishing: in the artifact, its card and ``Model.predict``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import mvitac
from mvitac.data.pack import Pack
from mvitac.data.spec import Target
from mvitac.deploy import publish
from mvitac.deploy.artifact import read_manifest
from mvitac.evaluation.probe import score_predictions, split_rows
from mvitac.nn.linear_probe import Error, ValueInfo

LEVEL = Target(name="level", unit="levels")


def test_predicted_values_score_as_the_artifact_says(value_artifact: Path, measured: Pack) -> None:
    model, summary = mvitac.load(value_artifact), read_manifest(value_artifact)["scores"]["summary"]
    for task in measured.spec.values:
        rows = split_rows(measured, task).test
        for modality, names in (("touch", ["touch"]), ("both", ["vision", "touch"])):
            found = model.predict(**{m: measured.images[m][rows] for m in names})[task.name]
            again = score_predictions(measured, task, rows, found.numpy())
            errors = model.readouts[f"{task.name}.{modality}"].question.errors
            for target, error in zip(again["targets"], errors, strict=True):
                assert (error.r2, error.mae) == pytest.approx((target["r2"], target["mae"]), abs=1e-4)
            assert again["r2"] == pytest.approx(summary[task.name][modality]["mvitac"]["mean"], abs=1e-4)
            assert "untrained" in summary[task.name][modality] and "mean" in summary[task.name]["none"]
        assert model.targets[task.name] == task.targets
    assert set(model.classes) == {"pattern", "bright"} and "weight (N)" in model._repr_html_()


def test_the_spread_of_a_prediction_is_that_of_test_rows_in_its_range(
    value_artifact: Path, measured: Pack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "RANGE_ROWS", 5)
    model, task = mvitac.load(value_artifact), measured.spec.values[0]
    model.readouts = publish.fit_readouts(model, measured)
    rows = split_rows(measured, task).test
    found = model.predict(touch=measured.images["touch"][rows])["light"][:, 0].numpy()
    off = found - measured.values(task)[rows, 0]
    (error,) = model.readouts["light.touch"].question.errors
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
    errors = model.readouts["both.touch"].question.errors
    assert "Accuracy or R2 in percent" in text and "- both: level in levels, weight in N" in text
    assert f"{errors[1].mae:.3g} ({errors[1].rmse:.3g}) N" in text
    assert "| mean |" in text and "| untrained |" in text


def test_values_of_a_damaged_description_are_refused() -> None:
    error = Error(r2=0.5, mae=1.0, rmse=2.0, edges=(), spread=(0.1,))
    with pytest.raises(ValueError, match="2 errors for 1 targets"):
        ValueInfo(task="light", modality="touch", targets=(LEVEL,), errors=(error, error), num_test=9)
    for wrong in ({"edges": (2.0, 1.0), "spread": (1.0, 1.0, 1.0)}, {"edges": (1.0,)}, {"spread": (float("nan"),)}):
        with pytest.raises(ValueError, match=r"ascending|finite"):
            replace(error, **wrong)


def test_an_artifact_of_classes_says_nothing_of_values(artifact: Path) -> None:
    assert "values" not in read_manifest(artifact) and "## Values" not in (artifact / "README.md").read_text()
    assert "## Classes" in (artifact / "README.md").read_text()
    json.dumps(read_manifest(artifact), allow_nan=False)
    assert torch.is_tensor(mvitac.load(artifact).predict(touch=np.zeros((2, 32, 32, 3), np.uint8))["pattern"])
