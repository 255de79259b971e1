"""What is published is what is loaded; anything else in its place is refused before it can do harm."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from copy import copy as copied
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

import mvitac
from mvitac.cli.main import main
from mvitac.data.images import difference
from mvitac.data.pack import Pack
from mvitac.deploy.artifact import ARTIFACT, preprocessing
from mvitac.deploy.card import card
from mvitac.deploy.publish import fit_probes, push
from mvitac.deploy.search import check_pack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.pack_features import pack_features
from mvitac.evaluation.probe import split_rows
from mvitac.system.files import digest_file, read_json, write_json


def reseal(folder: Path, change: Callable[[dict[str, Any]], object] = lambda m: None) -> None:
    """Make every digest fit again, as an attacker would."""
    manifest = read_json(folder / "artifact.json", "a description")
    for name in manifest["files"]:
        if (folder / name).is_file():
            manifest["files"][name] = digest_file(folder / name)
    change(manifest)
    write_json(folder / "artifact.json", manifest, sealed=True)


class Payload:
    """Unpickling this writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


def test_embeds_as_the_run_does_and_is_in_eval_mode(smoke_run: Path, artifact: Path, pack: Pack) -> None:
    model = mvitac.load(artifact)
    images = pack.images["touch"][:5]
    assert torch.equal(model.embed(touch=images)["touch"], mvitac.load(smoke_run).embed(touch=images)["touch"])
    assert not any(module.training for module in model.modules())


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


def test_publish_command_and_card(smoke_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a"
    assert main(["publish", str(smoke_run), str(out)]) == 0
    assert "pattern" in capsys.readouterr().out
    text = (out / "README.md").read_text()
    assert text.startswith("---\nlibrary_name: mvitac")
    assert "columns, rows, checks" in text and "| majority |" in text and "tests/support/toy.py" in text
    assert main(["publish", str(smoke_run), str(out)]) == 2
    assert "already exists" in capsys.readouterr().err


def test_the_card_names_what_encoders_and_what_probes_learned_from(artifact: Path) -> None:
    model, manifest = mvitac.load(artifact), ARTIFACT.read(artifact)
    assert "Encoders and probes: toy; source: tests/support/toy.py; licence: none." in card(model, manifest)
    assert "pre-trained without labels" in card(model, manifest)
    manifest["data"] = {"name": "other", "licence": "CC-BY", "source": "others"}
    model.tasks = ("pattern",)  # as a supervised method leaves behind
    text = card(model, manifest)
    assert "# mvitac on toy" in text and "with linear probes on other." in text
    assert (
        "Encoders: toy; source: tests/support/toy.py; licence: none." in text
        and "Probes: other; source: others; licence: CC-BY." in text
    )
    assert "under: none, and CC-BY" in text and "without labels" not in text


def test_difference_images_are_told(smoke_run: Path, pack: Pack, tmp_path: Path) -> None:
    """By model and card; raw packs are not taken for them."""
    model = mvitac.load(smoke_run)
    assert preprocessing(model)["background"].startswith("none is subtracted") and check_pack(model, pack)
    model.spec = replace(model.spec, difference=True)
    model.save(tmp_path / "model.safetensors")
    found = mvitac.load(tmp_path / "model.safetensors")
    given = preprocessing(found)
    assert found.spec.difference and given["difference"] and given["background"].startswith("subtracted: touch is")
    with pytest.raises(ValueError, match="the model was trained on difference images"):
        check_pack(found, pack)
    minus = copied(pack)
    minus.spec = replace(pack.spec, difference=True)
    assert check_pack(found, minus) == ("vision", "touch")


def test_predict_subtracts_the_background(copy: Path, pack: Pack) -> None:
    model = mvitac.load(copy)
    model.spec = replace(model.spec, difference=True)
    press, free = pack.images["touch"][3], pack.images["touch"][4]
    expected = model.predict(touch=difference(press, free))["pattern"]
    assert torch.equal(model.predict(touch=press, background=free)["pattern"], expected)
    assert not torch.equal(model.predict(touch=press)["pattern"], expected)


def test_a_pickle_is_never_opened(copy: Path, tmp_path: Path) -> None:
    for name in ("model.safetensors", "probes.safetensors"):
        (copy / name).write_bytes(pickle.dumps(Payload(tmp_path / "owned")))
        reseal(copy)
        with pytest.raises(ValueError, match="cannot be read as safetensors"):
            mvitac.load(copy)
    assert not (tmp_path / "owned").exists()


def test_a_huge_header_is_refused_before_it_is_read(copy: Path) -> None:
    with (copy / "model.safetensors").open("wb") as file:
        file.write((1 << 40).to_bytes(8, "little") + b"{")
    reseal(copy)
    with pytest.raises(ValueError, match="cannot be read as safetensors"):
        mvitac.load(copy)


def test_a_network_larger_than_the_machine_is_refused_before_it_is_made(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A header of a few kilobytes may name one, with every digest in order."""
    path = copy / "model.safetensors"
    tensors, model = safetensors.torch.load_file(path), mvitac.load(copy)
    monkeypatch.setattr(model, "run", replace(model.run, encoder=model.run.encoder.changed(trunk="resnetv2_152x4_bit")))
    monkeypatch.setattr(model, "state_dict", lambda: tensors)
    model.save(path)
    reseal(copy)
    made: list[str] = []
    parameter = torch.nn.Parameter.__new__
    monkeypatch.setattr(
        torch.nn.Parameter,
        "__new__",
        lambda cls, data=None, requires_grad=True: made.append(data.device.type) or parameter(cls, data, requires_grad),
    )
    with pytest.raises(ValueError, match="holds other weights than its run describes"):
        mvitac.load(copy)
    assert set(made) == {"meta"}


@pytest.mark.parametrize("name", ["model.safetensors", "probes.safetensors", "run.json", "README.md"])
def test_a_changed_byte_is_found(copy: Path, name: str) -> None:
    data = bytearray((copy / name).read_bytes())
    data[-2] ^= 1
    (copy / name).write_bytes(data)
    with pytest.raises(ValueError, match="does not match its digest"):
        mvitac.load(copy)


def test_a_changed_description_is_found(copy: Path) -> None:
    text = (copy / "artifact.json").read_text()
    (copy / "artifact.json").write_text(text.replace("columns", "walls"))
    with pytest.raises(ValueError, match="does not match its digest"):
        mvitac.load(copy)


def test_another_normalisation_or_colour_order_is_refused(copy: Path) -> None:
    """Even with every digest in order, an artifact must ask for the preprocessing its model was trained with."""
    for name, value in (("mean", [0.5, 0.5, 0.5]), ("colour_order", "BGR"), ("size", 31)):
        before = json.loads((copy / "artifact.json").read_text())["preprocessing"][name]
        reseal(copy, lambda m, n=name, v=value: m["preprocessing"].update({n: v}))
        with pytest.raises(ValueError, match=f"{name} is .*, its model was trained with"):
            mvitac.load(copy)
        reseal(copy, lambda m, n=name, v=before: m["preprocessing"].update({n: v}))
    mvitac.load(copy)


def test_probes_of_another_shape_are_refused(copy: Path) -> None:
    tensors = safetensors.torch.load_file(copy / "probes.safetensors")
    for name, wrong, message in (
        ("pattern.touch.weight", torch.zeros(3, 9), "reads 9 features"),
        ("pattern.touch.weight", torch.tensor(1.0), r"weights of shape \(\)"),
        ("pattern.touch.bias", torch.zeros(2), "do not fit 3 classes"),
        ("pattern.touch.weight", torch.full((3, 64), torch.nan), "not all finite"),
    ):
        safetensors.torch.save_file({**tensors, name: wrong}, copy / "probes.safetensors")
        reseal(copy)
        with pytest.raises(ValueError, match=message):
            mvitac.load(copy)


def test_the_hub_offline_is_one_clear_line(artifact: Path) -> None:
    with pytest.raises(ValueError, match=r"no folder someone/touch here, and no download from the Hugging Face Hub"):
        mvitac.load("someone/touch")
    with pytest.raises(ValueError, match="is complete, but someone/touch cannot be written on the Hub"):
        push(artifact, "someone/touch")
    with pytest.raises(ValueError, match="give owner/name"):
        push(artifact, "touch")


def test_a_slip_in_a_local_path_does_not_ask_the_hub(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, artifact: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    with pytest.raises(ValueError, match="no trained model at"):
        mvitac.load("runs/frist")


def test_the_hub_mixin_takes_the_artifact_there_and_back(
    artifact: Path, tmp_path: Path, pack: Pack, monkeypatch: pytest.MonkeyPatch
) -> None:
    import huggingface_hub
    from huggingface_hub import hub_mixin

    hub, asked = tmp_path / "hub", {}

    class Api:
        def __init__(self, token: str | None = None) -> None:
            pass

        def create_repo(self, repo_id: str, *, private: bool, exist_ok: bool) -> Any:
            asked.update(private=private)
            return SimpleNamespace(repo_id=repo_id)

        def upload_folder(self, *, repo_id: str, folder_path: Path, **options: Any) -> str:
            shutil.copytree(folder_path, hub / repo_id)
            return f"somewhere/{repo_id}"

    def download(repo: str, **options: Any) -> str:
        asked.update(options)
        return str(hub / repo)

    monkeypatch.setattr(hub_mixin, "HfApi", Api)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    assert push(artifact, "someone/touch", private=True) == "somewhere/someone/touch" and asked["private"]
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
