"""An export is the trained model, or there is none: parity on real inputs, and every way to get it wrong is named."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import mvitac
import mvitac.deploy.export as exports
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.deploy import export_module as graphs
from mvitac.deploy.engine import Engine, cosines
from mvitac.deploy.export import ExportConfig, export
from mvitac.deploy.export_module import ExportModule
from mvitac.deploy.parity import parity, reference
from mvitac.deploy.publish import with_probes
from mvitac.deploy.quantise import this_machine
from mvitac.model import Model
from mvitac.recipes import recipe
from mvitac.system.files import digest, digest_file, write_json
from mvitac.training.loop import train
from support.processes import begin, finish
from support.toy import reordered, toy_pack

EXACT = ExportConfig(min_cosine=0.9999, accuracy_loss=0.0)


@pytest.fixture(scope="module")
def model(artifact: Path) -> Model:
    return mvitac.load(artifact)


def run_graph(graph: ExportModule):
    def call(arrays: list[np.ndarray]) -> list[np.ndarray]:
        with torch.no_grad():
            return [x.numpy() for x in graph(*(torch.from_numpy(a) for a in arrays))]

    return call


def check(model: Model, graph: ExportModule, pack: Pack, config: ExportConfig = EXACT) -> dict:
    rows = pack.rows("test")
    return parity(graph, run_graph(graph), model, pack, rows, reference(model, graph, pack, rows), config)


@pytest.fixture(scope="module")
def written(onnx: Path) -> Iterator[None]:
    """torch.onnx.export, which takes seconds, gives what it gave for ``onnx``, an export of the same model."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exports, "write_onnx", lambda graph, two, out, *_: Path(shutil.copy(onnx / "model.onnx", out)))
        yield


@pytest.fixture(scope="module")
def openvino(model: Model, written: None, pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "openvino"
    export(model, pack, out, ExportConfig(kind="openvino", int8=True, min_cosine=0.9, accuracy_loss=10))
    return out


@pytest.mark.parametrize("stored", [32, 45, 72])
def test_the_resize_in_the_graph_is_the_probes_pixel_by_pixel(stored: int, model: Model) -> None:
    from mvitac.transforms.random_views import plain_view

    images = torch.randint(
        0, 256, (3, 3, stored, stored), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
    )
    was, model.stored = model.stored, stored
    try:
        graph = ExportModule(model)
        found = graph.view(images.permute(0, 2, 3, 1), graph.filter)
    finally:
        model.stored = was
    torch.testing.assert_close(found, plain_view(images, 32), atol=1e-4, rtol=0)


def test_an_export_is_the_trained_model(model: Model, onnx: Path, pack: Pack) -> None:
    """Whatever the batch, and with embed() and predict() on the other side."""
    engine = Engine(onnx, threads=1)
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
    assert graph.twice
    images = {m: pack.images[m][:5].copy() for m in ("vision", "touch")}
    found = dict(zip(graph.outputs, graph(*(torch.from_numpy(images[m]) for m in graph.modalities)), strict=True))
    features, shared = model.embed(**images), model.embed(**images, shared=True)
    for m in images:
        torch.testing.assert_close(found[f"embedding_{m}"], features[m], atol=1e-3, rtol=1e-3)
        torch.testing.assert_close(found[f"shared_{m}"], shared[m], atol=1e-3, rtol=1e-3)
        assert not torch.allclose(shared[m], model.project(m, features[m]), atol=1e-3)
    check(model, graph, pack)
    graph.head_filter = graph.head_filter.flip(0)  # the parity check looks at the shared space too
    with pytest.raises(ValueError, match="shared_"):
        check(model, graph, pack)


def test_int8_reports_what_it_keeps_and_runs(openvino: Path, pack: Pack, model: Model) -> None:
    meta = json.loads((openvino / "export.json").read_text())
    report = meta["report"]
    assert meta["int8"] and report["num_rows"] == len(pack.rows("test"))
    assert report["target"] in ("avx2", "vnni")
    assert 0.9 < report["cosine"]["embedding_touch"]["min"] < 0.99999  # int8 leaves its mark
    assert report["size_mb"] > 0 and 0 < report["latency_ms"]["p50"] <= report["latency_ms"]["p99"]
    images = {m: pack.images[m][:5] for m in ("vision", "touch")}
    found = Engine(openvino, threads=1)(**images)
    assert cosines(found["embedding_touch"], model.embed(**images)["touch"].numpy()).min() > 0.9


def open_all(said: Path, *folders: Path) -> None:
    lines = [this_machine("openvino")]
    for folder in folders:
        try:
            lines.append(Engine(folder, threads=1).meta["report"]["target"])
        except ValueError as error:
            lines.append(str(error))
    said.write_text("\n".join(lines))


def test_int8_on_a_cpu_without_vnni(
    openvino: Path, model: Model, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There 8-bit weights saturate: auto takes 7-bit ones, and an 8-bit export is refused, here or from elsewhere."""
    config = ExportConfig(kind="openvino", int8=True, min_cosine=0.95, accuracy_loss=10)
    eight_bits = json.loads((openvino / "export.json").read_text())["report"]["target"] == "vnni"
    if not eight_bits:  # this CPU is one of them
        with pytest.raises(ValueError, match="cosine"):
            export(model, pack, tmp_path / "vnni", replace(config, target="vnni"))
    monkeypatch.setattr(exports, "this_machine", lambda kind: "avx2")
    export(model, pack, tmp_path / "auto", config)
    said = tmp_path / "said"
    finish(begin(open_all, said, tmp_path / "auto", openvino, ONEDNN_MAX_CPU_ISA="AVX2"))  # OpenVINO obeys it
    machine, opened, second = said.read_text().splitlines()
    assert machine == opened == "avx2"
    refused = "on this machine embedding_vision has cosine" in second and "with --target avx2" in second
    assert refused if eight_bits else second == "avx2"


def test_torch_export_of_touch_alone(
    smoke_run: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a run: the probes are fitted on the way; one modality: its own probe answers."""
    out = tmp_path / "touch"
    command = ["export", str(smoke_run), "--format", "torch", "--modality", "touch", "--out", str(out)]
    assert main([*command, "--threads", "1"]) == 0
    model = with_probes(mvitac.load(smoke_run), pack)
    images = pack.images["touch"][:3]
    used: list[int] = []
    with monkeypatch.context() as patch:
        patch.setattr(torch, "set_num_threads", used.append)
        found = Engine(out, threads=3)(touch=images)
    assert used == [3, torch.get_num_threads()] * 2  # with the inputs that travel with it, then with ours
    np.testing.assert_allclose(found["probability_pattern"], model.predict(touch=images)["pattern"], atol=1e-4)
    assert main([*command, "--threads", "1"]) == 2  # it is already there


def test_rows_that_check_and_calibrate_are_of_every_class(
    model: Model, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although the pack's three classes take turns: every third test row, or the first ones, would be of one."""
    monkeypatch.setattr(exports, "NUM_CALIBRATION", 20)
    rows = {r.tobytes(): i for i, r in enumerate(pack.images["touch"])}
    labels = pack.column("label_pattern")
    ranges = [rows[touch[0].tobytes()] for _, touch in exports._examples(ExportModule(model), pack)]
    assert len(set(ranges)) == 20 and set(pack.column("split")[ranges]) == {"train"}
    assert np.bincount(labels[ranges]).min() >= 3
    seen: list[int] = []

    class Stop(Exception):
        pass

    def checked(model: Model, graph: ExportModule, pack: Pack, rows: np.ndarray, *_: object) -> dict[str, np.ndarray]:
        seen.extend(rows.tolist())
        raise Stop

    monkeypatch.setattr(exports, "reference", checked)
    with pytest.raises(Stop):
        export(model, pack, tmp_path / "x", ExportConfig(kind="torch", num_rows=len(pack.rows("test")) // 3))
    assert np.bincount(labels[seen], minlength=3).min() >= 1 and set(pack.column("split")[seen]) == {"test"}


def test_two_sensors_are_normalised_alike(tmp_path: Path) -> None:
    pack = toy_pack(tmp_path / "p", touch_channels=6, num=90)
    run = train(recipe("smoke", PackConfig(path=pack.path)), tmp_path / "r", quiet=True)
    model = with_probes(mvitac.load(run))
    assert check(model, ExportModule(model), pack)["cosine"]["embedding_touch"]["min"] > 0.9999


def test_a_wrong_normalisation_is_named(model: Model, pack: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    check(model, ExportModule(model), pack)
    for mean, std, message in (
        ((0.5,) * 3, (0.5,) * 3, r"normalises to \[-1, 1\]"),
        ((0.0,) * 3, (1.0,) * 3, "does not normalise by the ImageNet mean"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(graphs, "IMAGENET_MEAN", mean)
            patch.setattr(graphs, "IMAGENET_STD", std)
            wrong = ExportModule(model)
        with pytest.raises(ValueError, match=f"not the trained model: embedding_vision has cosine .*{message}"):
            check(model, wrong, pack)


def test_bgr_input_is_named(model: Model, tmp_path: Path) -> None:
    """A pack of strong colours, so that swapping red and blue shows; the engine is fed as OpenCV would feed it."""
    rng = np.random.default_rng(0)

    pack = toy_pack(tmp_path / "p")
    images = rng.integers(0, 256, (pack.num, 4, 4, 3)).repeat(8, 1).repeat(8, 2).astype(np.uint8)
    images[..., 0] //= 8
    pack.images = dict.fromkeys(("vision", "touch"), images)
    graph, rows = ExportModule(model), pack.rows("test")
    call = run_graph(graph)
    wanted = reference(model, graph, pack, rows)
    parity(graph, call, model, pack, rows, wanted, EXACT)

    def bgr(arrays: list[np.ndarray]) -> list[np.ndarray]:
        return call([np.ascontiguousarray(a[..., ::-1]) for a in arrays])

    with pytest.raises(ValueError, match="its input is BGR, the model wants RGB"):
        parity(graph, bgr, model, pack, rows, wanted, EXACT)


def test_refused_roundings_name_what_can_be_done(model: Model, pack: Pack) -> None:
    graph, rows = ExportModule(model), pack.rows("test")
    wanted = reference(model, graph, pack, rows)

    def rounded(arrays: list[np.ndarray]) -> list[np.ndarray]:
        return [np.random.default_rng(0).normal(size=found.shape) for found in run_graph(graph)(arrays)]

    for config, advice in (
        (ExportConfig(kind="openvino", int8=True), ": use another precision, or allow less"),
        (EXACT, "$"),
    ):
        with pytest.raises(ValueError, match=f"at least {config.min_cosine} is allowed{advice}"):
            parity(graph, rounded, model, pack, rows, wanted, config)


def test_corrupted_weights_in_the_graph_leave_no_export(
    model: Model, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Same weights for the reference, other ones in what is written: parity stops it and the folder is not made."""
    real = ExportModule.forward

    def corrupted(self: ExportModule, *images: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found = real(self, *images)
        return (found[0] * torch.linspace(-1, 1, found[0].shape[1]), *found[1:])

    monkeypatch.setattr(ExportModule, "forward", corrupted)
    with pytest.raises(ValueError, match="not the trained model"):
        export(model, pack, tmp_path / "x", ExportConfig(kind="torch"))
    assert list(tmp_path.iterdir()) == []


def test_accuracy_is_of_classes_by_name(model: Model, pack: Pack) -> None:
    """The pack that checks may number them otherwise, and may lack a task."""
    graph, other = ExportModule(model), reordered(pack)
    found = check(model, graph, other)["accuracy"]
    assert found == check(model, graph, pack)["accuracy"] and set(found) == {"pattern", "bright"}
    assert found["pattern"]["original"] == 100 * model.probes["pattern.both"].info.accuracy
    other.spec = replace(pack.spec, tasks=pack.spec.tasks[:1])
    assert set(check(model, graph, other)["accuracy"]) == {"pattern"}


def test_lost_accuracy_stops_an_export(model: Model, pack: Pack) -> None:
    graph, rows = ExportModule(model), pack.rows("test")
    wanted, call = reference(model, graph, pack, rows), run_graph(graph)
    at = graph.outputs.index("probability_pattern")

    def worse(arrays: list[np.ndarray]) -> list[np.ndarray]:
        found = call(arrays)
        found[at] = np.roll(found[at], 1, axis=1)
        return found

    with pytest.raises(ValueError, match="points of accuracy on pattern"):
        parity(graph, worse, model, pack, rows, wanted, EXACT)


@pytest.mark.parametrize("name", ["model.onnx", "check.safetensors", "export.json"])
def test_a_changed_byte_of_an_export_is_found(onnx: Path, tmp_path: Path, name: str) -> None:
    import shutil

    copy = shutil.copytree(onnx, tmp_path / "copy")
    data = bytearray((copy / name).read_bytes())
    data[len(data) // 2] ^= 1
    (copy / name).write_bytes(data)
    with pytest.raises(ValueError, match=r"does not match its digest|not valid JSON"):
        Engine(copy)


def test_a_pickle_or_a_library_in_a_torch_export_is_never_run(smoke_run: Path, pack: Pack, tmp_path: Path) -> None:
    """Even with every digest in order; torch itself would fall back to unpickling it."""

    class Payload:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "owned",))

    buffer = io.BytesIO()
    torch.save({"a": Payload()}, buffer)
    good = tmp_path / "good"
    export(mvitac.load(smoke_run), pack, good, ExportConfig(kind="torch", modalities=("touch",)))
    with zipfile.ZipFile(good / "model.pt2") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    inputs = next(name for name in members if "sample_inputs" in name)
    root = inputs.partition("/")[0]
    for name, message in (
        (inputs, "cannot be opened"),
        (f"{root}/data/constants/opaque_obj_0", "may be a program: refused"),
        (f"{root}/data/aotinductor/model/a.wrapper.so", "may be a program: refused"),
    ):
        folder = shutil.copytree(good, tmp_path / "bad", dirs_exist_ok=True)
        with zipfile.ZipFile(folder / "model.pt2", "w") as archive:
            for member, content in {**members, name: buffer.getvalue()}.items():
                archive.writestr(member, content)
        meta = json.loads((folder / "export.json").read_text())
        meta["files"]["model.pt2"] = digest_file(folder / "model.pt2")
        del meta["digest"]
        write_json(folder / "export.json", {**meta, "digest": digest(meta)})
        with pytest.raises(ValueError, match=message):
            Engine(folder)
    assert not (tmp_path / "owned").exists()


def test_an_engine_that_computes_otherwise_is_refused_on_the_spot(onnx: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The few real inputs that travel with an export are run again where it is opened."""
    from mvitac.deploy import engine as runtime

    real = runtime.open_engine
    monkeypatch.setattr(runtime, "open_engine", lambda *a, **k: lambda arrays: real(*a, **k)([255 - x for x in arrays]))
    with pytest.raises(ValueError, match="on this machine embedding_vision has cosine"):
        Engine(onnx)


def test_foreign_inputs_are_named(onnx: Path, pack: Pack) -> None:
    engine = Engine(onnx, threads=1)
    one = pack.images["touch"][:1]
    with pytest.raises(ValueError, match="takes vision, touch; got touch"):
        engine(touch=one)
    with pytest.raises(ValueError, match="touch: expected uint8"):
        engine(vision=one, touch=one.astype(np.float32))
    with pytest.raises(ValueError, match="vision: expected uint8"):
        engine(vision=one[:, :16], touch=one)


def test_impossible_requests_are_refused_first(
    model: Model, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for options, message in (
        ({"kind": "torch", "int8": True}, "--int8 is for onnx and openvino"),
        ({"kind": "onnx", "precision": "bf16"}, "--format openvino"),
        ({"kind": "onnx", "target": "avx2"}, "add --int8"),
        ({"modalities": ("smell",)}, "no smell encoder"),
    ):
        with pytest.raises(ValueError, match=message):
            export(model, pack, tmp_path / "x", ExportConfig(**options))
    larger = toy_pack(tmp_path / "p", size=40)
    for given, calibrate, config in ((larger, None, ExportConfig()), (pack, larger, ExportConfig(int8=True))):
        with pytest.raises(ValueError, match="p cannot check this model"):
            export(model, given, tmp_path / "x", config, calibrate=calibrate)
    monkeypatch.setattr(model, "spec", replace(model.spec, difference=True))
    with pytest.raises(ValueError, match="at 32 px minus their background"):
        export(model, pack, tmp_path / "x")


def test_running_an_onnx_export_needs_no_torch() -> None:
    code = "import sys, mvitac.deploy.engine; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


def test_conversion_to_openvino_tells_nobody(onnx: Path, tmp_path: Path) -> None:
    """OpenVINO looks up an analytics host and writes an id into the home folder, on import and by its converter."""
    shutil.copy(onnx / "model.onnx", tmp_path)
    (tmp_path / "home").mkdir()
    code = (
        "import sys; from pathlib import Path; from mvitac.deploy.quantise import to_openvino;"
        "sys.addaudithook(lambda event, given: event.startswith('socket.') and sys.exit(f'{event} {given}'));"
        f"to_openvino(Path({str(tmp_path / 'model.onnx')!r}))"
    )
    environment = {**os.environ, "HOME": str(tmp_path / "home"), "CI": ""}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "model.xml").stat().st_size and not list((tmp_path / "home").rglob("*"))
