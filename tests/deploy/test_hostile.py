"""Artifacts, exports and results made by a stranger: each is refused in one line or used as plain data.

While a command runs, every path and network address that Python touches is recorded by an audit hook. None may lie in the
trap, a folder that only the artifact names, and none may be on the network.
"""

import json
import pickle
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import safetensors
import safetensors.torch
import torch

import mvitac
from mvitac.bench.encoder import About, describe
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.deploy.card import _harmless
from mvitac.deploy.engine import Engine
from mvitac.evaluation.run_names import names_of
from mvitac.system.files import digest, digest_file, read_json, write_json
from support.forged_packs import Change, put

_touched: list[str] | None = None


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _touched is not None and event.split(".")[0] in ("open", "os", "shutil", "socket", "subprocess", "glob"):
        _touched.append(f"{event} {arguments}")


@contextmanager
def untouched(trap: Path) -> Iterator[None]:
    """Meanwhile nothing in the trap is opened, listed or deleted, nothing is sent and nothing started."""
    global _touched
    if not hasattr(sys, "_mvitac_hook"):
        sys.addaudithook(_hook)  # cannot be removed again
        sys._mvitac_hook = True  # type: ignore[attr-defined]
    _touched = seen = []
    try:
        yield
    finally:
        _touched = None
    for one in seen:
        assert f"{trap}" not in one and "/trap" not in one, one
        assert not one.startswith(("socket.connect", "socket.getaddrinfo", "subprocess", "os.system")), one
    assert (trap / "process-1" / "letter.txt").read_text() == "dear"


def forge(
    folder: Path,
    *,
    run: Change | None = None,
    stored: int | None = None,
    about: Change | None = None,
    probes: dict[str, torch.Tensor] | None = None,
    files: dict[str, bytes] | None = None,
) -> None:
    """Change the artifact or export in ``folder``, and make every digest fit again. {trap} in ``run``, that of the
    header of model.safetensors, stands for the trap beside the folder."""
    file = folder / "model.safetensors"
    if run or stored:
        with safetensors.safe_open(file, "pt") as opened:
            header = opened.metadata()
        value = json.loads(header["run"])
        (run or data("pack"))(value)
        header["run"] = json.dumps(value).replace("{trap}", str(folder.parent / "trap"))
        header |= {"stored": str(stored or header["stored"])}
        header["header_digest"] = digest([header["run"], header["spec"], header["stored"]])
        safetensors.torch.save_file(safetensors.torch.load_file(file), file, header)
    if probes:
        kept = folder / "probes.safetensors"
        safetensors.torch.save_file({**safetensors.torch.load_file(kept), **probes}, kept)
    for name, content in (files or {}).items():
        (folder / name).write_bytes(content)
    (described,) = (folder / name for name in ("artifact.json", "export.json") if (folder / name).exists())
    value = read_json(described, "a description")
    value["files"] = {name: digest_file(folder / name) for name in value["files"] if (folder / name).is_file()}
    if about:
        about(value)
    write_json(described, value, sealed=True)


def data(name: str, **fields: Any) -> Change:
    return put("data", value={"name": name, **fields})


COMMANDS = {
    "export": ["export", "{artifact}", "--out", "{out}"],
    "probe": ["probe", "{artifact}"],
    "report": ["report", "{artifact}", "--quiet"],
    "live": ["live", "{artifact}", "--seconds", "1"],
    "publish": ["publish", "{artifact}", "{out}"],
}
PLACES: list[tuple[str, Change]] = [
    *((command, data("pack", path="{trap}")) for command in COMMANDS),
    ("probe", data("folder", path="{trap}/pairs.csv")),
    ("export", data("mix", parts=["a={trap}:1", "b={trap}:2"])),
]


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    folder = tmp_path / "trap"
    (folder / "process-0").mkdir(parents=True)
    (folder / "process-1").mkdir()
    (folder / "process-1" / "letter.txt").write_text("dear")
    (folder / "pairs.csv").write_text("touch\nx.png\n")
    return folder


@pytest.mark.parametrize(("command", "change"), PLACES)
def test_the_place_of_its_data_is_not_opened(
    copy: Path, trap: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, change: Change
) -> None:
    forge(copy, run=change)
    with untouched(trap):
        assert main([w.format(artifact=copy, out=tmp_path / "out") for w in COMMANDS[command]]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "stranger" in error and "--on PACK" in error and not (tmp_path / "out").exists()


def encoder(**fields: str) -> Change:
    return put("encoder", value=lambda old: {sense: {**own, **fields} for sense, own in old.items()})


@pytest.mark.parametrize(
    ("weights", "command"),
    [
        ("imagenet", ["probe", "--tasks", "bright", "--modalities", "touch"]),
        ("{trap}/letter.pth", ["probe", "--tasks", "bright", "--modalities", "touch"]),
        ("{trap}/letter.pth", ["publish", "{out}"]),
    ],
)
def test_initial_weights_are_neither_opened_nor_fetched(
    copy: Path, trap: Path, tmp_path: Path, pack: Pack, weights: str, command: list[str]
) -> None:
    """Nor for the controls, which are then of random weights."""
    (trap / "letter.pth").write_text("dear")
    forge(copy, run=encoder(weights=weights))
    name, *options = (word.format(out=tmp_path / "out") for word in command)
    with untouched(trap):
        assert main([name, str(copy), *options, "--on", str(pack.path)]) == 0
    if name == "publish":
        assert "| untrained |" in (tmp_path / "out" / "README.md").read_text()


def test_start_weights_of_another_run_are_not_opened(copy: Path, trap: Path) -> None:
    """They would be an error here: what opens them is no Python, so that no hook sees it."""
    (trap / "letter.safetensors").write_text("dear")
    record = read_json(copy / "run.json", "a record") | {"start": {"name": "older", "trained_on": ["tag"]}}
    (copy / "run.json").write_text(json.dumps(record))
    forge(copy, run=put("init", value={"path": "{trap}/letter.safetensors"}))
    model = mvitac.load(str(copy))
    assert model.run.init.path is None and model.run.init.digest == "unknown"
    assert names_of([copy], [model]) == ["mvitac"]
    found = describe([model], [str(copy)], About())
    assert found["trained_on"] == "toy; starts from older, which was trained on: tag" and found["images_seen"] is None


class Payload:
    """Unpickling this ends the test."""

    def __reduce__(self) -> tuple[Any, ...]:
        return sys.exit, ("unpickled",)


MODEL = "model.safetensors"
WEIGHT, BIAS = "pattern.touch.weight", "pattern.touch.bias"
NO_SPREAD = {"name": "n", "unit": "N", "edges": [], "spread": []}
LARGE = 10**9  # every image would be resized to it
OTHER = "its model was trained with"
ARTIFACTS: dict[str, tuple[dict[str, Any], str]] = {
    "a pickle": ({"files": {MODEL: pickle.dumps(Payload())}}, "cannot be read as safetensors"),
    "a huge header": ({"files": {MODEL: (1 << 40).to_bytes(8, "little") + b"{"}}, "cannot be read as safetensors"),
    "size": ({"stored": LARGE, "about": put("preprocessing", "stored", value=LARGE)}, "stored 1000000000: expected"),
    "trunk from the Hub": ({"run": encoder(trunk="hf-hub:stranger/model")}, "unknown trunk"),
    "trunk from a folder": ({"run": encoder(trunk="local-dir:{trap}")}, "unknown trunk"),
    "a field that is none": ({"run": put("exec", value="rm")}, "unknown field in run 'exec'"),
    "file above": ({"about": put("files", "../trap/pairs.csv", value="0")}, "names others than"),
    "without model": ({"about": lambda about: about["files"].pop(MODEL)}, "lacks files"),
    "normalisation": ({"about": put("preprocessing", "mean", value=[0.5] * 3)}, f"mean is .*, {OTHER}"),
    "side": ({"about": put("preprocessing", "size", value=31)}, f"size is 31, {OTHER}"),
    "no majority": ({"about": put("probes", 0, "majority", value=[])}, r"artifact\.json: probes\.majority: expected"),
    "probe of sound": ({"about": put("probes", 0, "modality", value="sound")}, "is damaged"),
    "wide probe": ({"probes": {WEIGHT: torch.zeros(3, 9)}}, "reads 9 features"),
    "short bias": ({"probes": {BIAS: torch.zeros(2)}}, "do not fit 3 outputs"),
    "no numbers": ({"probes": {WEIGHT: torch.full((3, 64), torch.nan)}}, "not all finite float32"),
}
EXPORTS: dict[str, tuple[dict[str, Any], str]] = {
    "no tolerance": ({"about": lambda about: about.pop("tolerance")}, "is damaged"),
    "no spread": ({"about": put("values", value={"force": [NO_SPREAD]})}, "damaged.*edges and spread of n"),
    "class of no text": ({"about": put("classes", "pattern", value=[1])}, r"export\.json: classes\.pattern: expected"),
    "no runtime": ({"about": put("runtime", value="x")}, r"export\.json: runtime"),
    "no inputs": ({"about": put("inputs", value={})}, "cannot be run"),
    "too few classes": ({"about": put("classes", "pattern", value=["a"])}, "damaged.*classes of pattern"),
}
FORGED = [("artifact", *each) for each in ARTIFACTS.values()] + [("onnx", *each) for each in EXPORTS.values()]


def opened(folder: Path) -> None:
    mvitac.load(folder) if (folder / "artifact.json").exists() else Engine(folder)


@pytest.mark.parametrize(("kind", "changes", "says"), FORGED, ids=[*ARTIFACTS, *EXPORTS])
def test_what_is_forged_is_refused(
    request: pytest.FixtureRequest, trap: Path, tmp_path: Path, kind: str, changes: dict[str, Any], says: str
) -> None:
    """Although every digest is in order."""
    folder = shutil.copytree(request.getfixturevalue(kind), tmp_path / kind)
    forge(folder, **changes)
    with untouched(trap), pytest.raises(ValueError, match=says):
        opened(folder)


def test_a_network_larger_than_the_machine_is_not_made(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A header of a few kilobytes may name one."""
    forge(copy, run=encoder(trunk="resnetv2_152x4_bit"))
    made, parameter = set(), torch.nn.Parameter.__new__

    def counted(cls: type, data: torch.Tensor, requires_grad: bool = True) -> torch.nn.Parameter:
        made.add(data.device.type)
        return parameter(cls, data, requires_grad)

    monkeypatch.setattr(torch.nn.Parameter, "__new__", counted)
    with pytest.raises(ValueError, match="holds other weights than its run describes"):
        mvitac.load(copy)
    assert made == {"meta"}


FILES = {
    "artifact": ("model.safetensors", "run.json", "artifact.json", "trained_on.safetensors"),
    "onnx": ("model.onnx", "check.safetensors", "export.json"),
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in FILES.items() for name in names])
def test_a_changed_byte_is_found(request: pytest.FixtureRequest, tmp_path: Path, kind: str, name: str) -> None:
    folder = shutil.copytree(request.getfixturevalue(kind), tmp_path / kind)
    changed = bytearray((folder / name).read_bytes())
    place = changed.find(b"columns")  # of a description another class, or else its JSON may be none
    changed[place if place > 0 else len(changed) // 2] ^= 1
    (folder / name).write_bytes(changed)
    with pytest.raises(ValueError, match="does not match its digest"):
        opened(folder)


def test_a_card_shows_labels_as_text() -> None:
    line = "Note: <img src=http://x/y.png> ![a](http://x) [b](javascript:1)\x1b[31m\n# title"
    assert _harmless(line) == "Note: &lt;img src=http://x/y.png> ![a]\\(http://x) [b]\\(javascript:1) [31m # title"
