"""What is published is what is loaded; anything else in its place is refused before it can do harm."""

import shutil
from copy import copy as copied
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import mvitac
from mvitac.data.images import difference
from mvitac.data.pack import Pack
from mvitac.deploy.artifact import ARTIFACT, preprocessing
from mvitac.deploy.card import card
from mvitac.deploy.publish import fit_probes
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.features import fitting, pack_features
from mvitac.evaluation.probe import split_rows
from mvitac.system.files import digest_file


def test_predicts_what_the_probe_scored(smoke_run: Path, artifact: Path, pack: Pack) -> None:
    """Each stored probe has the accuracy `mvitac probe` prints, and predict() on raw images has it again."""
    model = mvitac.load(artifact)
    summary = probe_runs([smoke_run], ProbeConfig(controls=False))["summary"]
    for task in pack.spec.tasks:
        rows = split_rows(pack, task).test
        labels = pack.column(f"label_{task.name}")[rows]
        for modality, names in (("touch", ["touch"]), ("vision", ["vision"]), ("both", ["vision", "touch"])):
            found = model.predict(**{m: pack.images[m][rows] for m in names})[task.name]
            accuracy = float((found.argmax(1).numpy() == labels).mean())
            assert accuracy == pytest.approx(summary[task.name][modality]["mvitac"]["mean"])
            assert accuracy == pytest.approx(model.probes[f"{task.name}.{modality}"].info.accuracy)
            torch.testing.assert_close(found.sum(1), torch.ones(len(rows)))
        assert model.classes[task.name] == task.classes
    images = pack.images["touch"][:5]
    assert torch.equal(model.embed(touch=images)["touch"], mvitac.load(smoke_run).embed(touch=images)["touch"])
    assert not any(module.training for module in model.modules())


def test_a_probe_gives_scikit_learns_probabilities(smoke_run: Path, pack: Pack) -> None:
    from mvitac.evaluation.classifiers import fit_linear

    model = mvitac.load(smoke_run)
    for task in pack.spec.tasks:  # one of three classes, one of two
        rows = split_rows(pack, task)
        labels = pack.column(f"label_{task.name}").astype(int)
        x = {r: pack_features(model, pack, "touch", getattr(rows, r)).numpy() for r in ("train", "val", "test")}
        fitted, _ = fit_linear(x["train"], labels[rows.train], x["val"], labels[rows.val])
        probe = fit_probes(model, pack)[f"{task.name}.touch"]
        np.testing.assert_allclose(probe(torch.from_numpy(x["test"])).numpy(), fitted(x["test"]), atol=1e-4)


def test_the_card_names_what_encoders_and_what_probes_learned_from(artifact: Path) -> None:
    model, manifest, written = mvitac.load(artifact), ARTIFACT.read(artifact), (artifact / "README.md").read_text()
    assert written.startswith("---\nlibrary_name: mvitac") and "columns, rows, checks" in written
    assert "| majority |" in written
    assert "Encoders and probes: toy; source: tests/support/toy.py; licence: none." in card(model, manifest)
    assert "pre-trained without labels" in " ".join(card(model, manifest).split())
    manifest["data"] = {"name": "other", "licence": "CC-BY", "source": "others"}
    model.tasks = ("pattern",)  # as a supervised method leaves behind
    text = " ".join(card(model, manifest).split())
    assert "# mvitac on toy" in text and "with linear probes on other." in text
    assert "Encoders: toy; source: tests/support/toy.py; licence: none." in text
    assert "Probes: other; source: others; licence: CC-BY." in text
    assert "under: none, and CC-BY" in text and "without labels" not in text


def test_difference_images_are_told(smoke_run: Path, pack: Pack, tmp_path: Path) -> None:
    """By model and card; raw packs are not taken for them."""
    model = mvitac.load(smoke_run)
    assert preprocessing(model)["background"].startswith("none is subtracted") and fitting(model, pack)
    model.spec = replace(model.spec, difference=True)
    model.save(tmp_path / "model.safetensors")
    found = mvitac.load(tmp_path / "model.safetensors")
    given = preprocessing(found)
    assert found.spec.difference and given["difference"] and given["background"].startswith("subtracted: touch is")
    with pytest.raises(ValueError, match="the model was trained on difference images"):
        fitting(found, pack)
    minus = copied(pack)
    minus.spec = replace(pack.spec, difference=True)
    assert fitting(found, minus) == ("vision", "touch")


def test_predict_subtracts_the_background(copy: Path, pack: Pack) -> None:
    model = mvitac.load(copy)
    model.spec = replace(model.spec, difference=True)
    press, free = pack.images["touch"][3], pack.images["touch"][4]
    expected = model.predict(touch=difference(press, free))["pattern"]
    assert torch.equal(model.predict(touch=press, background=free)["pattern"], expected)
    assert not torch.equal(model.predict(touch=press)["pattern"], expected)


def test_the_hub_offline_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"no folder someone/touch here, and no download from the Hugging Face Hub"):
        mvitac.load("someone/touch")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    with pytest.raises(ValueError, match="no trained model at"):  # a slip in a local path does not ask the Hub
        mvitac.load("runs/frist")


def test_the_hub_mixin_takes_the_artifact_there_and_back(
    artifact: Path, tmp_path: Path, pack: Pack, monkeypatch: pytest.MonkeyPatch
) -> None:
    import huggingface_hub
    from huggingface_hub import hub_mixin

    hub, asked = tmp_path / "hub", {}

    def create_repo(repo_id: str, **options: Any) -> Any:
        asked.update(options)
        return SimpleNamespace(repo_id=repo_id)

    def upload_folder(*, repo_id: str, folder_path: Path, **options: Any) -> str:
        shutil.copytree(folder_path, hub / repo_id)
        return f"somewhere/{repo_id}"

    api = SimpleNamespace(create_repo=create_repo, upload_folder=upload_folder)
    monkeypatch.setattr(hub_mixin, "HfApi", lambda token=None: api)
    download = lambda repo, **options: asked.update(options) or str(hub / repo)  # noqa: E731
    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    assert mvitac.load(artifact).push_to_hub("someone/touch", private=True) == "somewhere/someone/touch"  # type: ignore[operator]
    assert asked["private"]
    files = {path.name: digest_file(path) for path in (hub / "someone/touch").iterdir()}
    assert files == {path.name: digest_file(path) for path in artifact.iterdir()}

    model = mvitac.PublishedModel.from_pretrained("someone/touch", revision="v2", local_files_only=True)
    assert asked["revision"] == "v2" and asked["local_files_only"]
    images = pack.images["touch"][:5]
    assert torch.equal(model.embed(touch=images)["touch"], mvitac.load(artifact).embed(touch=images)["touch"])
    assert mvitac.load("someone/touch@v3").classes == model.classes and asked["revision"] == "v3"
    assert set(asked["allow_patterns"]) == files.keys()
    model.save_pretrained(tmp_path / "again")
    assert mvitac.PublishedModel.from_pretrained(tmp_path / "again").classes == model.classes
    (hub / "someone/touch/run.json").write_text("{}")
    for load in (model.from_pretrained, mvitac.load):
        with pytest.raises(ValueError, match="does not match its digest"):
            load("someone/touch")
