"""The model that the package brings: found by its name, whole, and with the leaks of its training known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mvitac
from mvitac.cli.evaluate import _ProbeOptions
from mvitac.cli.main import main
from mvitac.cli.options import parse
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.deploy.publish import own_data
from mvitac.evaluation.leaks import read_sources
from mvitac.shipped import BASE, named
from mvitac.training.start import read_start
from support.toy import toy_pack


def test_base_answers_offline_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    model = mvitac.load("base")
    image = np.random.default_rng(0).integers(0, 255, (90, 120, 3), np.uint8)
    found = model.embed(vision=image, touch=image)
    assert {m: value.shape for m, value in found.items()} == {"vision": (1, 1280), "touch": (1, 512)}
    assert all(value.isfinite().all() for value in found.values()) and set(model.probes)
    assert read_sources(BASE) and (BASE / "model.safetensors").stat().st_size < 25e6
    (tmp_path / "base").mkdir()
    assert named("base") == "base"  # what is here has the name


def test_commands_know_base_and_a_report_of_it_is_not_in_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    found = parse(_ProbeOptions, ["base", "--tasks", "feel", "base"], "probe")
    assert found.runs == (BASE,) and found.config.tasks == ("feel", "base")
    start = read_start(replace(mvitac.recipe("locked"), init=mvitac.Init(path=Path("base"))).init)
    assert start is not None and set(start.model.encoders) == {"vision", "touch"}
    monkeypatch.setattr("mvitac.report.report.write_report", lambda runs, out, **_: f"{runs[0]} in {out}")
    assert main(["report", "base"]) == 0 and capsys.readouterr().out == f"written: {BASE} in runs/report\n"


def test_base_is_exported_on_a_few_rows_and_only_if_it_can_be_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its own 24,000 rows take minutes to simulate."""
    opened: list[MaterialsConfig] = []
    monkeypatch.setattr(MaterialsConfig, "open", lambda self, **_: opened.append(self))
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (32, 32)).save("frame.png")
    assert main(["predict", "base", ".", "--out", "x.csv"]) == 2 and not opened
    assert "takes vision and touch" in capsys.readouterr().err
    model = mvitac.load("base")
    own_data(model, "", few=100)
    assert opened == [replace(model.run.data, num=100)]


def test_a_probe_of_base_writes_nothing_into_the_package(tmp_path: Path) -> None:
    before = sorted(BASE.iterdir())
    found = mvitac.probe("base", on=toy_pack(tmp_path / "p"), tasks=("bright",), modalities=("touch",), controls=False)
    assert found["summary"]["bright"]["touch"]["base"]["mean"] > 0.5 and sorted(BASE.iterdir()) == before
