"""Rows that lack a modality: stored and marked, never trained on as a pair, never probed on what they lack."""

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.deploy import search
from mvitac.deploy.export import ExportConfig, _examples, export
from mvitac.deploy.export_module import ExportModule
from mvitac.deploy.publish import with_probes
from mvitac.evaluation import sensors
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.probe import split_rows
from mvitac.model import Model, load
from mvitac.training.loop import train
from mvitac.training.sampler import draw_positives
from mvitac.training.views import StepViews
from support.toy import Holes, Toy, altered
from support.training_runs import smoke


@pytest.fixture(scope="module")
def holes(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return build(Holes(), tmp_path_factory.mktemp("holes") / "pack", size=32, quiet=True)


def test_holes_are_zeros_and_marked(holes: Pack) -> None:
    items = np.arange(120)
    for modality, lacking in (("vision", items % 7 == 3), ("touch", items % 5 == 1)):
        assert (holes.has(modality) == ~lacking).all()
        assert ((holes.images[modality].reshape(120, -1) == 0).all(1) == lacking).all()
    both = set(holes.rows("train", having=("vision", "touch")))
    assert both < set(holes.rows("train", having=("touch",))) < set(holes.rows("train"))


@pytest.mark.parametrize("column", [True, None])
def test_an_image_must_agree_with_its_mark(tmp_path: Path, column: bool | None) -> None:
    lying = altered(Toy(), lambda sample, item: {"touch": sample.touch if item != 3 else None, "has_touch": column})
    with pytest.raises(ValueError, match="first item 3: no touch image, against its column has_touch"):
        build(lying, tmp_path / "p", size=32, quiet=True)


def test_training_sees_whole_pairs_only(holes: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    real = StepViews.make
    monkeypatch.setattr(StepViews, "make", lambda self, rows, seed: seen.extend(rows) or real(self, rows, seed))
    train(smoke(holes, steps=4, eval_every=4, positives="same-touch"), tmp_path / "run", quiet=True)
    whole = holes.has("vision") & holes.has("touch")
    assert whole[seen].all() and set(seen) <= set(holes.rows("train", "unlabelled"))
    assert whole[draw_positives(holes, np.array(seen), torch.Generator().manual_seed(0))].all()


@pytest.fixture(scope="module")
def trained(holes: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(smoke(holes, steps=1, eval_every=0), tmp_path_factory.mktemp("holes") / "run", quiet=True)


def test_probes_see_only_what_is_there(holes: Pack, trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    features = Mock(wraps=sensors.features)
    monkeypatch.setattr(sensors, "features", features)
    result = probe_runs([trained], ProbeConfig(tasks=("pattern",)), holes)
    for modality in ("vision", "touch"):
        asked = [call.args[3] for call in features.call_args_list if call.args[2] == modality]
        assert asked and holes.has(modality)[np.concatenate(asked)].all()
    num = {r["modality"]: r["num_test"] for r in result["records"] if r["source"] == "mvitac"}
    assert num == {m: len(split_rows(holes, holes.spec.tasks[0], m).test) for m in ("vision", "touch", "both")}
    assert num["both"] < min(num["vision"], num["touch"])


@pytest.fixture(scope="module")
def model(trained: Path) -> Model:
    return load(trained)


def test_published_probes_are_of_what_is_there(holes: Pack, model: Model) -> None:
    found = with_probes(model, holes).probes
    for task in holes.spec.tasks:
        for modality in ("vision", "touch", "both"):
            assert found[f"{task.name}.{modality}"].info.num_test == len(split_rows(holes, task, modality).test)


def test_an_export_is_checked_and_calibrated_on_what_is_there(holes: Pack, model: Model, tmp_path: Path) -> None:
    report = export(model, holes, tmp_path / "x", ExportConfig(modalities=("touch",)))
    assert report["num_rows"] == len(holes.rows("test", having=("touch",))) < len(holes.rows("test"))
    examples = _examples(ExportModule(model, ("touch",)), holes)
    assert len(examples) == len(holes.rows("train", "unlabelled", having=("touch",)))
    assert all(x.any() for (x,) in examples)


def test_what_is_not_there_is_not_searched_or_embedded(holes: Pack, model: Model, tmp_path: Path) -> None:
    whole = np.flatnonzero(holes.has("vision") & holes.has("touch"))
    search.embed(model, holes, tmp_path / "e.parquet")
    known = search.Embeddings(tmp_path / "e.parquet", model.weights_digest())
    for m, bank in known.banks.items():
        assert (np.isnan(bank).all(1) == ~holes.has(m)).all() and (np.isnan(bank).any(1) == ~holes.has(m)).all()
        rows, _ = known.find(model, holes.images[m][whole[:2]], m, m, len(whole))
        assert rows[:, 0].tolist() == whole[:2].tolist() and holes.has(m)[rows].all()
