"""Files that version 0.1.0 wrote still open, and give what they gave then (tests/fixtures/0.1.0 says how they were made)."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import mvitac
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.datasets.pack import StreamConfig
from mvitac.run import load_run
from support.training_runs import power_cut

OLD = Path(__file__).parent / "fixtures" / "0.1.0"
EXPECTED: dict[str, Any] = json.loads((OLD / "expected.json").read_text())
ROWS = EXPECTED["rows"]
TOLERANCE = 1e-4  # AVX2 and AVX-512 differ by 1e-7


@pytest.fixture(autouse=True)
def old_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All archives, unpacked into the working folder: the runs name their packs relative to it."""
    for archive in sorted(OLD.glob("*.tar.xz")):
        with tarfile.open(archive) as opened:
            opened.extraction_filter = getattr(tarfile, "data_filter", None)  # type: ignore  # not in 3.11.0 to 3.11.3
            opened.extractall(tmp_path)
    monkeypatch.chdir(tmp_path)


def images() -> dict[str, np.ndarray]:
    pack = Pack("pack")
    return {modality: stored[ROWS] for modality, stored in pack.images.items()}


def assert_near(found: torch.Tensor | np.ndarray, expected: list[list[float]]) -> None:
    np.testing.assert_allclose(np.asarray(found), expected, rtol=0, atol=TOLERANCE)


def losses(run: str) -> dict[int, float]:
    lines = [json.loads(line) for line in Path(run, "log.jsonl").read_text().splitlines()]
    return {line["step"]: line["loss"] for line in lines if "loss" in line}


@pytest.mark.parametrize("name", EXPECTED["pack_digests"])
def test_packs(name: str) -> None:
    """The files match their recorded digests, the digest of the whole is the old one, and so are the pixels."""
    pack = Pack(name, verify=True)
    assert pack.digest == EXPECTED["pack_digests"][name]
    means = {modality: float(np.mean(stored[:])) for modality, stored in pack.images.items()}
    assert means == pytest.approx(EXPECTED["pixel_means"][name], abs=0.1)  # JPEG decoders may differ by a level


def test_shards_stream_the_pixels_of_their_pack(tmp_path: Path) -> None:
    streamed, pack = StreamConfig(url="shards", cache=tmp_path / "cache").open(), Pack("pack")
    place = {identity: row for row, identity in enumerate(pack.column("id"))}
    rows = [place[identity] for identity in streamed.column("id")]  # shards mix the rows
    assert sorted(rows) == list(range(len(pack.table)))
    for modality, stored in pack.images.items():
        np.testing.assert_array_equal(streamed.images[modality][:], stored[rows])


@pytest.mark.parametrize("name", EXPECTED["run_digests"])
def test_run_digests(name: str) -> None:
    run, record = load_run(Path(name))
    assert run.digest() == EXPECTED["run_digests"][name]
    assert record["pack"] == EXPECTED["pack_digests"][str(run.data.path)]  # type: ignore[attr-defined]


def test_runs_embed_as_before() -> None:
    model, touch_model, given = mvitac.load("run"), mvitac.load("touch_run"), images()
    for modality, found in model.embed(**given).items():
        assert_near(found, EXPECTED["features"][modality])
    for modality, found in model.embed(**given, shared=True).items():
        assert_near(found, EXPECTED["shared"][modality])
    touch = Pack("touch_pack").images["touch"][ROWS]
    assert_near(touch_model.embed(touch=touch)["touch"], EXPECTED["touch_features"])


def test_artifact_predicts_as_before() -> None:
    found = mvitac.load("artifact").predict(**images())
    assert found.keys() == EXPECTED["predictions"].keys()
    for task, probabilities in found.items():
        assert_near(probabilities, EXPECTED["predictions"][task])


def test_find_answers_from_the_index(capsys: pytest.CaptureFixture[str]) -> None:
    Image.fromarray(images()["touch"][0]).save("touch.png")
    assert main(["find", "touch.png", "--in", "index", "--k", "3"]) == 0
    shown, ids = capsys.readouterr().out, Pack("pack").column("id")
    for row, cosine in zip(EXPECTED["found"][0], EXPECTED["cosines"][0], strict=True):
        assert ids[row] in shown and f"{cosine:.3f}" in shown


def test_probe_scores_the_run_as_before() -> None:
    """Frozen features and nearest neighbours: the same answers, but for a tie that another CPU breaks otherwise."""
    assert main(["probe", "run", "--probes", "knn", "--no-controls", "--json", "new.json"]) == 0
    key = ("source", "task", "modality", "probe")

    def accuracies(file: str) -> dict[tuple[str, ...], float]:
        records = json.loads(Path(file).read_text())["records"]
        return {tuple(r[k] for k in key): r["accuracy"] for r in records if "run" in r and r["probe"] == "knn"}

    assert accuracies("new.json") == pytest.approx(accuracies("probe.json"), abs=0.051)  # of 20 test rows, one


@pytest.mark.usefixtures("undrawn")
def test_report_reads_run_and_probe() -> None:
    assert main(["report", "run", "--probe", "probe.json", "--out", "report", "--quiet"]) == 0
    assert Path("report", "report.html").stat().st_size > 10_000


def test_interrupted_run_goes_on_where_it_stopped() -> None:
    """For 40 of its other 359 steps, with a checkpoint every 20."""
    before = Path("touch_cut", "log.jsonl").read_text()
    with power_cut(40), pytest.raises(RuntimeError, match="power cut"):
        main(["pretrain", "--from", "touch_cut/run.json", "--out", "touch_cut", "--resume", "--quiet"])
    assert Path("touch_cut", "log.jsonl").read_text().startswith(before)
    assert list(losses("touch_cut")) == list(range(2, 81, 2))
    assert load_run(Path("touch_cut"))[0].digest() == EXPECTED["run_digests"]["touch_cut"]
    assert torch.load("touch_cut/checkpoint.pt", weights_only=True)["step"] == 80


def test_from_repeats_a_run() -> None:
    assert main(["pretrain", "--from", "run/run.json", "--out", "again", "--quiet"]) == 0
    assert load_run(Path("again"))[0].digest() == EXPECTED["run_digests"]["run"]
    assert losses("again") == pytest.approx(losses("run"), rel=1e-3)
