"""An export is the trained model, or there is none: parity on real inputs, values in their unit, every mistake named."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import mvitac
import mvitac.deploy.export as exports
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.deploy import engine as runtime
from mvitac.deploy import publish
from mvitac.deploy.artifact import ARTIFACT
from mvitac.deploy.engine import Engine, open_model, spread_at
from mvitac.deploy.export import ExportConfig, export, parity, reference
from mvitac.deploy.export_module import ExportModule, quantise
from mvitac.deploy.publish import with_probes
from mvitac.evaluation.probe import score_rows, split_rows
from mvitac.model import Model, fresh
from mvitac.nn.linear_probe import Error
from mvitac.transforms.random_views import plain_view
from support.processes import begin, finish
from support.toy import renumbered, toy_pack, with_columns
from support.training_runs import smoke

EXACT = {"min_cosine": 0.9999, "accuracy_loss": 0.0}


@torch.no_grad()
def run_graph(graph: ExportModule, arrays: list[np.ndarray]) -> list[np.ndarray]:
    return [x.numpy() for x in graph(*(torch.from_numpy(a) for a in arrays))]


def check(model: Model, graph: ExportModule, pack: Pack) -> dict:
    rows = pack.rows("test")
    return parity(graph, partial(run_graph, graph), pack, rows, reference(model, graph, pack, rows), **EXACT)


@contextmanager
def copied(onnx: Path) -> Iterator[None]:
    """torch.onnx.export, which takes seconds, gives what it gave for ``onnx``, an export of the same model."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exports, "write_onnx", lambda graph, path: shutil.copy(onnx / "model.onnx", path))
        yield


@pytest.fixture(scope="module")
def int8(model: Model, onnx: Path, pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "int8"
    with copied(onnx):
        export(model, pack, out, ExportConfig(precision="int8", min_cosine=0.9, accuracy_loss=10))
    return out


def test_where_8_bits_are_too_few_the_way_out_is_said(
    model: Model, onnx: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exports, "quantise", lambda *_: None)
    for precision, says in (("int8", r"\(min_cosine\); fp32 or bf16 may hold it"), ("fp32", r"\(min_cosine\)$")):
        with copied(onnx), pytest.raises(ValueError, match=says):
            export(model, pack, tmp_path / precision, ExportConfig(precision=precision, min_cosine=1.1))  # type: ignore


@pytest.mark.parametrize("stored", [32, 45, 72])
def test_the_resize_in_the_graph_is_the_probes_pixel_by_pixel(stored: int, model: Model) -> None:
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (3, 3, stored, stored), dtype=torch.uint8, generator=generator)
    was, model.stored = model.stored, stored
    try:
        found = ExportModule(model).views["touch"](images.permute(0, 2, 3, 1))
    finally:
        model.stored = was
    torch.testing.assert_close(found, plain_view(images, 32), atol=1e-4, rtol=0)


@pytest.mark.parametrize("wrong", [{"num_rows": 1}, {"num_rows": -3}, {"value_loss": float("inf")}])
def test_a_check_that_checks_nothing_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="give 2 rows or more, and losses from 0"):
        ExportConfig(**wrong)


def test_an_unknown_runtime_is_refused(onnx: Path) -> None:
    wrong: Any = {"engine": "torchscript"}
    for given in (wrong, {"threads": -1}, {"threads": 2**31}, {"threads": "2"}, {"threads": 1.5}):
        with pytest.raises(ValueError, match="give one of auto, onnxruntime, openvino, and 0 to 1024"):
            Engine(onnx, **given)


@pytest.mark.parametrize("name", ["onnxruntime", "openvino"])
def test_an_export_is_the_trained_model(name: Any, model: Model, onnx: Path, pack: Pack) -> None:
    """Whatever the batch and the engine, and with embed() and predict() on the other side."""
    engine = Engine(onnx, engine=name, threads=1)
    for num in (1, 7):
        images = {m: pack.images[m][10 : 10 + num] for m in ("vision", "touch")}
        found = engine(**images)
        features, shared, said = model.embed(**images), model.embed(**images, shared=True), model.predict(**images)
        for m in images:
            np.testing.assert_allclose(found[f"embedding_{m}"], features[m].numpy(), atol=1e-3, rtol=1e-3)
            np.testing.assert_allclose(found[f"shared_{m}"], shared[m].numpy(), atol=1e-3)
        for task, probabilities in said.items():
            np.testing.assert_allclose(found[f"probability_{task}"], probabilities.numpy(), atol=1e-3)
            assert tuple(engine.classes[task]) == model.classes[task]


def test_the_heads_have_a_view_of_their_own_where_they_learned_from_one(smoke_run: Path, pack: Pack) -> None:
    """Embeddings from whole images at one side, the shared space at the side of the training views."""
    model = mvitac.load(smoke_run)
    model.run = replace(model.run, augment=replace(model.run.augment, size=24, whole=32))
    graph = ExportModule(model)
    assert set(graph.head_views) == {"vision", "touch"}
    images = {m: pack.images[m][:5].copy() for m in ("vision", "touch")}
    found = dict(zip(graph.outputs, graph(*(torch.from_numpy(images[m]) for m in graph.modalities)), strict=True))
    features, shared = model.embed(**images), model.embed(**images, shared=True)
    for m in images:
        torch.testing.assert_close(found[f"embedding_{m}"], features[m], atol=1e-3, rtol=1e-3)
        torch.testing.assert_close(found[f"shared_{m}"], shared[m], atol=1e-3, rtol=1e-3)
        assert not torch.allclose(shared[m], model.project(m, features[m]), atol=1e-3)
    check(model, graph, pack)
    graph.head_views["vision"].filter = graph.head_views["vision"].filter.flip(0)
    with pytest.raises(ValueError, match="shared_"):
        check(model, graph, pack)


def test_int8_without_vnni_is_computed_by_onnxruntime(int8: Path, onnx: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report = json.loads((int8 / "export.json").read_text())["report"]
    assert 0.9 < report["cosine"]["embedding_touch"]["min"] < 0.99999  # int8 leaves its mark
    used: list[str] = []
    for name in ("_openvino", "_onnxruntime"):
        monkeypatch.setattr(runtime, name, lambda *_, name=name: used.append(name))
    for isa in ("AVX2", "ALL"):
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", isa)
        monkeypatch.setattr(Path, "read_text", lambda self: "flags: avx512_vnni")
        for folder, precision in ((int8, "int8"), (onnx, "fp32")):
            open_model(folder / "model.onnx", "auto", precision)
    assert used == ["_onnxruntime", "_openvino", "_openvino", "_openvino"]


def test_int8_that_openvino_computes_wrongly_is_computed_by_onnxruntime(
    model: Model, onnx: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it does with means of a network's stages (memory that nobody wrote)."""
    right = runtime._openvino
    monkeypatch.setattr(runtime, "_has_vnni", lambda: True)
    monkeypatch.setattr(runtime, "_openvino", lambda *a: lambda given: [-x for x in right(*a)(given)])
    with copied(onnx):
        export(model, pack, tmp_path / "x", ExportConfig(precision="int8", min_cosine=0.9, accuracy_loss=10))
    assert json.loads((tmp_path / "x" / "export.json").read_text())["runtime"] == "onnxruntime"
    Engine(tmp_path / "x")


def open_int8(said: Path, folder: Path, ones: Path) -> None:
    Engine(folder, engine="openvino", threads=1)
    said.write_text(str(float(np.abs(open_model(ones, "openvino")([np.ones((1, 64, 8, 8), np.float32)])[0] - 1).max())))


@pytest.mark.slow
def test_int8_on_a_cpu_without_vnni(int8: Path, tmp_path: Path) -> None:
    """There sums of pairs of 8-bit products are cut off: the mean of 576 ones would be about a half."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weight = np.full((64, 64, 3, 3), 1 / 576, np.float32)
    given = helper.make_tensor_value_info("ones", TensorProto.FLOAT, (1, 64, 8, 8))
    mean = helper.make_tensor_value_info("mean", TensorProto.FLOAT, (1, 64, 6, 6))
    conv = helper.make_node("Conv", ["ones", "weight"], ["mean"])
    graph = helper.make_graph([conv], "mean", [given], [mean], [numpy_helper.from_array(weight, "weight")])
    path = tmp_path / "ones.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), path)
    quantise(path, ["ones"], [[np.ones((1, 64, 8, 8), np.float32)]])
    said = tmp_path / "said"
    finish(begin(open_int8, said, int8, path, ONEDNN_MAX_CPU_ISA="AVX2"))  # OpenVINO obeys it
    assert float(said.read_text()) < 0.02


def test_export_of_touch_alone(smoke_run: Path, pack: Pack, tmp_path: Path) -> None:
    """From a run: the probes are fitted on the way; one modality: its own probe answers."""
    out = tmp_path / "touch"
    command = ["export", str(smoke_run), "--modalities", "touch", "--out", str(out)]
    assert main(command) == 0
    images = pack.images["touch"][:3]
    found = Engine(out)(touch=images)
    expected = with_probes(mvitac.load(smoke_run), pack).predict(touch=images)["pattern"]
    np.testing.assert_allclose(found["probability_pattern"], expected, atol=1e-4)
    assert main(command) == 2  # it is already there
    recorded, model = with_columns(pack, split=["unlabelled"] * pack.num), with_probes(mvitac.load(smoke_run), pack)
    assert export(model, recorded, tmp_path / "r", ExportConfig(modalities=("touch",), num_rows=9))["num_rows"] == 9


def test_two_sensors_are_normalised_alike(tmp_path: Path) -> None:
    pack = toy_pack(tmp_path / "p", touch_channels=6, num=90)
    model = with_probes(fresh(smoke(pack), pack.spec, pack.size).eval(), pack)
    assert check(model, ExportModule(model), pack)["cosine"]["embedding_touch"]["min"] > 0.9999


def test_a_corrupted_graph_leaves_no_export(model: Model, pack: Pack, onnx: Path, tmp_path: Path) -> None:
    """Other weights in what is written than in the model: parity stops it and the folder is not made."""
    with torch.no_grad():
        weight = next(model.encoders["touch"].parameters())
        before = weight.clone()
        weight.mul_(torch.linspace(-1, 1, weight.numel()).reshape(weight.shape))
    try:
        with copied(onnx), pytest.raises(ValueError, match="not the trained model: embedding_touch"):
            export(model, pack, tmp_path / "x")
    finally:
        weight.data.copy_(before)
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".lock"]


def test_accuracy_is_of_classes_by_name(model: Model, pack: Pack) -> None:
    """The pack that checks may number them otherwise, and may lack a task."""
    graph, other = ExportModule(model), renumbered(pack, "checks", "rows", "columns")
    found = check(model, graph, other)["accuracy"]
    assert found == check(model, graph, pack)["accuracy"] and set(found) == {"pattern", "bright"}
    assert found["pattern"]["original"] == 100 * model.probes["pattern.both"].info.accuracy
    other.spec = replace(pack.spec, tasks=pack.spec.tasks[:1])
    assert set(check(model, graph, other)["accuracy"]) == {"pattern"}


def test_lost_accuracy_stops_an_export(model: Model, pack: Pack) -> None:
    graph, rows = ExportModule(model), pack.rows("test")
    wanted = reference(model, graph, pack, rows)
    at = graph.outputs.index("probability_pattern")

    def worse(arrays: list[np.ndarray]) -> list[np.ndarray]:
        found = run_graph(graph, arrays)
        found[at] = np.roll(found[at], 1, axis=1)
        return found

    with pytest.raises(ValueError, match="lowers accuracy on pattern from"):
        parity(graph, worse, pack, rows, wanted, **EXACT)


def test_an_engine_that_computes_otherwise_is_refused(value_onnx: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The few real inputs that travel are run again: features of twice the length have the same cosine, not the values."""

    def refused(call: Any, says: str) -> None:
        monkeypatch.setattr(runtime, "open_model", lambda *given: lambda arrays: call(open_model(*given), arrays))
        with pytest.raises(ValueError, match=says):
            Engine(value_onnx, threads=1)

    refused(lambda run, arrays: run([255 - x for x in arrays]), "on this machine embedding_vision has cosine")
    refused(lambda run, arrays: [2 * x for x in run(arrays)], r"on this machine level differs by .* levels, at most")


def test_openvino_tells_nobody(onnx: Path, tmp_path: Path) -> None:
    """It looks up an analytics host and writes an id into the home folder, on import and by its converter."""
    code = (
        "import sys; from pathlib import Path; from mvitac.deploy.engine import open_model;"
        "sys.addaudithook(lambda event, given: event.startswith('socket.') and sys.exit(f'{event} {given}'));"
        f"open_model(Path({str(onnx / 'model.onnx')!r}), 'openvino')"
    )
    environment = {**os.environ, "HOME": str(tmp_path), "CI": ""}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.rglob("*"))


def test_a_signal_after_two_models_have_gone_is_handled(onnx: Path) -> None:
    """OpenVINO sets the stack that signals are handled on; a DataLoader's worker that ends is one, too."""
    code = (
        "import signal; from pathlib import Path; from mvitac.deploy.engine import open_model;"
        f"first, second = (open_model(Path({str(onnx / 'model.onnx')!r}), 'openvino') for _ in range(2));"
        "del first; del second; signal.signal(signal.SIGCHLD, print); signal.raise_signal(signal.SIGCHLD)"
    )
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL).returncode == 0


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


def test_the_spread_is_that_of_its_range(value_artifact: Path, measured: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publish, "RANGE_ROWS", 5)
    model, task = mvitac.load(value_artifact), measured.spec.values[0]
    model.probes = {}
    publish.with_probes(model, measured)
    rows = split_rows(measured, task).test
    found = model.predict(touch=measured.images["touch"][rows])["light"][:, 0].numpy()
    off = found - measured.values(task)[rows, 0]
    (error,) = model.probes["light.touch"].info.errors
    assert len(error.spread) == len(rows) // 5 > 2 and min(error.spread) <= error.rmse <= max(error.spread)
    for value in found:
        same = np.searchsorted(error.edges, found, side="right") == np.searchsorted(error.edges, value, side="right")
        assert spread_at(vars(error), value) == pytest.approx(float((off[same] ** 2).mean() ** 0.5), rel=1e-3)
    wide = Error(r2=0.5, mae=1.0, rmse=2.0, edges=(1.0, 3.0), spread=(0.1, 0.2, 0.4))
    assert [spread_at(vars(wide), v) for v in (-9.0, 0.99, 1.0, 2.9, 3.0, 99.0)] == [0.1, 0.1, 0.2, 0.2, 0.4, 0.4]


def test_the_card_has_errors_in_the_unit(value_artifact: Path) -> None:
    text = (value_artifact / "README.md").read_text()
    errors = mvitac.load(value_artifact).probes["both.touch"].info.errors
    assert "Accuracy or R2 in percent" in text and "- both: level in levels, weight in N" in text
    assert f"{errors[1].mae:.3g} ({errors[1].rmse:.3g}) N" in text
    assert "| mean |" in text and "| untrained |" in text


def test_an_export_gives_values_with_unit_and_spread(value_onnx: Path, value_artifact: Path, measured: Pack) -> None:
    engine, model = Engine(value_onnx, threads=1), mvitac.load(value_artifact)
    images = {m: np.asarray(measured.images[m][:5]) for m in measured.images}
    found, said = engine(**images), model.predict(**images)
    for task, targets in model.targets.items():
        np.testing.assert_allclose(found[f"value_{task}"], said[task].numpy(), rtol=1e-3, atol=1e-3)
        assert [(t["name"], t["unit"]) for t in engine.values[task]] == [(t.name, t.unit) for t in targets]
        (error, *_) = model.probes[f"{task}.both"].info.errors
        assert spread_at(engine.values[task][0], 99.0) == error.spread[-1]
    assert set(engine.classes) == set(model.classes)
    (light,) = engine.meta["report"]["values"]["light"]
    assert light["unit"] == "levels" and light["num"] == 24 and light["change"] < 1e-3 * light["allowed"]
    assert light["export"] == pytest.approx(model.probes["light.both"].info.errors[0].mae, rel=1e-3)
    spread = float(np.std(measured.values(measured.spec.values[0])[measured.rows("test")]))
    assert light["allowed"] == pytest.approx(0.1 * spread)
    engine.values["light"] = []  # as in a file that somebody edited
    with pytest.raises(AssertionError, match="values of light"):
        engine._check()


def test_an_export_that_changes_a_value_is_refused(value_artifact: Path, measured: Pack, pack: Pack) -> None:
    model = mvitac.load(value_artifact)
    graph, rows = ExportModule(model), measured.rows("test")
    wanted = reference(model, graph, measured, rows)
    std = float(np.nanstd(measured.values(measured.spec.values[1])[rows, 1]))  # weight

    def call(arrays: list[np.ndarray]) -> list[np.ndarray]:
        found = run_graph(graph, arrays)
        found[-1] = found[-1] + np.array([0, 0.2 * std], np.float32)  # of task both: the weight alone
        return found

    says = f"changes weight by {0.2 * std:.3g} N .* at most {0.1 * std:.3g} is .*--value-loss"
    with pytest.raises(ValueError, match=says):
        parity(graph, call, measured, rows, wanted, min_cosine=0.99)
    report = parity(graph, call, measured, rows, wanted, min_cosine=0.99, value_loss=0.3)
    assert report["values"]["both"][1]["change"] == pytest.approx(0.2 * std, rel=1e-3)
    assert report["values"]["both"][1]["num"] == 16 and report["values"]["light"][0]["change"] < 1e-3
    # Of a pack that lacks them they are still compared.
    rows, wanted = pack.rows("test"), reference(model, graph, pack, pack.rows("test"))
    light = parity(graph, partial(run_graph, graph), pack, rows, wanted, min_cosine=0.99)["values"]["light"][0]
    assert light["num"] == 0 and light["original"] is None
    assert light["allowed"] == pytest.approx(0.1 * wanted["value_light"].std(), rel=1e-4)
