"""What is published is what is loaded; anything else in its place is refused before it can do harm."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
import torch

import mvitac
from mvitac.data.pack import Pack
from mvitac.deploy.artifact import ARTIFACT, preprocessing
from mvitac.deploy.card import card
from mvitac.deploy.export import export
from mvitac.deploy.export_config import ExportConfig
from mvitac.deploy.publish import fit_probes, publish, with_probes
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.features import fitting
from mvitac.evaluation.probe import split_rows
from mvitac.model import load
from support.toy import toy_pack, with_columns


def test_predicts_what_the_probe_scored(smoke_run: Path, artifact: Path, pack: Pack) -> None:
    """Each stored probe has the accuracy `mvitac probe` prints, and predict() on raw images has it again."""
    model = mvitac.load(artifact)
    summary = probe_runs([smoke_run], ProbeConfig(controls=False))["summary"]
    for task in pack.spec.tasks:
        rows = split_rows(pack, task).test
        for modality, names in (("touch", ["touch"]), ("vision", ["vision"]), ("both", ["vision", "touch"])):
            found = model.predict(**{m: pack.images[m][rows] for m in names})[task.name]
            accuracy = float((found.argmax(1).numpy() == pack.column(f"label_{task.name}")[rows]).mean())
            assert accuracy == pytest.approx(summary[task.name][modality]["mvitac"]["mean"])
            assert accuracy == pytest.approx(model.probes[f"{task.name}.{modality}"].info.accuracy)
            torch.testing.assert_close(found.sum(1), torch.ones(len(rows)))
        assert model.classes[task.name] == task.classes
    images = pack.images["touch"][:5]
    assert torch.equal(model.embed(touch=images)["touch"], mvitac.load(smoke_run).embed(touch=images)["touch"])
    assert not any(module.training for module in model.modules())
    with pytest.raises(ValueError, match="4 of vision and 5 of touch are no pairs"):
        model.predict(vision=pack.images["vision"][:4], touch=images)
    with pytest.raises(ValueError, match="has one set of weights: leave out 'best'"):
        mvitac.load(artifact, which="best")


def test_the_card_names_what_encoders_and_what_probes_learned_from(artifact: Path) -> None:
    model, manifest, written = mvitac.load(artifact), ARTIFACT.read(artifact), (artifact / "README.md").read_text()
    assert written.startswith("---\nlibrary_name: mvitac") and "columns, rows, checks" in written
    assert "| majority |" in written
    assert "Encoders and probes: toy; source: tests/support/toy.py; licence: none." in card(model, manifest)
    assert "pre-trained without labels" in " ".join(card(model, manifest).split())
    bare = card(model, manifest | {"scores": manifest["scores"] | {"summary": {}}})
    assert "probes on" not in bare and "model.embed(" in bare and "model.predict(" in written
    manifest["data"] = {"name": "other", "licence": "CC-BY", "source": "others"}
    model.tasks = ("pattern",)  # as a supervised method leaves behind
    text = " ".join(card(model, manifest).split())
    assert "# mvitac on toy" in text and "with linear probes on other." in text
    assert "Encoders: toy; source: tests/support/toy.py; licence: none." in text
    assert "Probes: other; source: others; licence: CC-BY." in text
    assert "under: none, and CC-BY" in text and "without labels" not in text


def test_the_part_of_images_is_that_of_the_data_of_the_probes(smoke_run: Path, pack: Pack, tmp_path: Path) -> None:
    part, run = {"touch": "0:0:9:9"}, shutil.copytree(smoke_run, tmp_path / "run")
    (run / "trained_on.safetensors").chmod(0o600)  # which others can read in an artifact
    publish(run, tmp_path / "a", with_columns(pack, spec=replace(pack.spec, crop=part)), allow_leak=True)
    assert mvitac.load(tmp_path / "a").spec.crop == part and (tmp_path / "a/trained_on.safetensors").stat().st_mode & 4
    assert with_probes(load(smoke_run), with_columns(pack, spec=replace(pack.spec, crop=part))).spec.crop == part
    with pytest.raises(ValueError, match="has labelled rows of no task in train and test: leave --on out"):
        publish(smoke_run, tmp_path / "b", with_columns(pack, split=["train"] * pack.num), allow_leak=True)


def test_difference_images_are_told(smoke_run: Path, pack: Pack, tmp_path: Path) -> None:
    """By model and card; raw packs are not taken for them, nor they for raw ones."""
    model = mvitac.load(smoke_run)
    assert preprocessing(model)["background"].startswith("none is subtracted") and fitting(model, pack)
    model.spec = replace(model.spec, difference=True)
    model.save(tmp_path / "model.safetensors")
    found = mvitac.load(tmp_path / "model.safetensors")
    given = preprocessing(found)
    assert found.spec.difference and given["difference"] and given["background"].startswith("subtracted: touch is")
    with pytest.raises(ValueError, match="the model was trained on difference images"):
        fitting(found, pack)
    minus = with_columns(pack, spec=replace(pack.spec, difference=True))
    assert fitting(found, minus) == ("vision", "touch")
    for pair in ((mvitac.load(smoke_run), minus), (found, pack)):
        with pytest.raises(ValueError, match="difference images"):
            fit_probes(*pair)
    with pytest.raises(ValueError, match="has images of 24 px: pack it again with --size 32"):
        fit_probes(mvitac.load(smoke_run), toy_pack(tmp_path / "other", size=24))
    with pytest.raises(ValueError, match="trained without difference images"):
        export(mvitac.load(smoke_run), minus, tmp_path / "e", ExportConfig())


def test_the_hub_offline_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"no folder someone/touch here, and no download from the Hugging Face Hub"):
        mvitac.load("someone/touch")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    with pytest.raises(ValueError, match="no trained model at"):  # a slip in a local path does not ask the Hub
        mvitac.load("runs/frist")
    (tmp_path / "runs/tuned/seed0").mkdir(parents=True)
    (tmp_path / "runs/tuned/seed0/model.safetensors").touch()
    with pytest.raises(ValueError, match="there is one at runs/tuned/seed0"):
        mvitac.load("runs/tuned")


def test_a_download_is_an_artifact_and_no_other_file_is_asked_for(
    artifact: Path, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}
    download = lambda repo, **options: asked.update(options, repo=repo) or str(copy)  # noqa: E731
    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    assert mvitac.load("someone/touch@v3").classes == mvitac.load(artifact).classes
    assert (asked["repo"], asked["revision"]) == ("someone/touch", "v3")
    assert set(asked["allow_patterns"]) == {path.name for path in artifact.iterdir()}
    (copy / "run.json").write_text("{}")
    with pytest.raises(ValueError, match="does not match its digest"):
        mvitac.load("someone/touch")
