"""Artifacts, exports and results made by a stranger: each is refused in one line or used as plain data.

While a command runs, every path and network address that Python touches is recorded by an audit hook. None may lie in the
trap, a folder that only the artifact names, and none may be on the network.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
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
from mvitac.deploy.publish import publish
from mvitac.evaluation.run_names import names_of
from mvitac.nn.encoders import Encoders, build_trunk
from mvitac.nn.imagenet import load
from mvitac.system.files import digest, digest_file, read_json, write_json
from support.training_runs import smoke

_touched: list[str] | None = None


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _touched is not None and event.split(".")[0] in ("open", "os", "shutil", "socket", "subprocess", "glob"):
        _touched.append(f"{event} {arguments}")


@pytest.fixture
def touched(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """What Python opens, lists, deletes, starts and connects to during the test."""
    global _touched
    if not hasattr(sys, "_mvitac_hook"):
        sys.addaudithook(_hook)  # cannot be removed again
        sys._mvitac_hook = True  # type: ignore[attr-defined]
    _touched = []
    yield _touched
    _touched = None


Change = Callable[[Path, dict[str, Any]], object]
"""Changes the run in the header of model.safetensors, given the trap and the run."""


def forge(
    folder: Path, trap: Path, *, run: Change | None = None, about: Change | None = None, stored: int | None = None
) -> None:
    """Change the artifact or export in ``folder``, and make every digest fit again."""
    file = folder / "model.safetensors"
    if run or stored:
        with safetensors.safe_open(file, "pt") as opened:
            header = opened.metadata()
        value = json.loads(header["run"])
        (run or data("pack"))(trap, value)
        header |= {"run": json.dumps(value), "stored": str(stored or header["stored"])}
        header["header_digest"] = digest([header["run"], header["spec"], header["stored"]])
        safetensors.torch.save_file(safetensors.torch.load_file(file), file, header)
    (described,) = (folder / name for name in ("artifact.json", "export.json") if (folder / name).exists())
    value = read_json(described, "a description")
    value["files"] = {name: digest_file(folder / name) for name in value["files"] if (folder / name).is_file()}
    if about:
        about(trap, value)
    write_json(described, value, sealed=True)


def data(name: str, **fields: str) -> Change:
    """The data is said to be of dataset ``name``; {trap} in a field stands for the trap."""

    def change(trap: Path, run: dict[str, Any]) -> None:
        run["data"] = {"name": name, **{k: v.replace("{trap}", str(trap)) for k, v in fields.items()}}

    return change


COMMANDS = {
    "export": ["export", "{artifact}", "--out", "{out}"],
    "explore": ["explore", "{artifact}"],
    "probe": ["probe", "{artifact}"],
    "report": ["report", "{artifact}", "--quiet"],
    "live": ["live", "{artifact}", "--seconds", "1"],
    "publish": ["publish", "{artifact}", "{out}"],
}
PLACES: list[tuple[str, Change]] = [
    *((command, data("pack", path="{trap}")) for command in COMMANDS),
    ("probe", data("folder", path="{trap}/pairs.csv")),
    ("export", data("touch-and-go", root="{trap}")),
    ("export", lambda trap, run: run.update(data={"name": "mix", "parts": [f"a={trap}:1", f"b={trap}:2"]})),
]


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    """A folder of somebody's files."""
    folder = tmp_path / "trap"
    (folder / "process-0").mkdir(parents=True)
    (folder / "process-1").mkdir()
    (folder / "process-1" / "letter.txt").write_text("dear")
    (folder / "pairs.csv").write_text("touch\nx.png\n")
    return folder


def check(touched: list[str], trap: Path) -> None:
    """Nothing in the trap was touched, nothing was sent, nothing was deleted."""
    for one in touched:
        assert f"{trap}" not in one and "/trap" not in one, one
        assert not one.startswith(("socket.connect", "socket.getaddrinfo", "subprocess", "os.system")), one
    assert (trap / "process-1" / "letter.txt").read_text() == "dear"


@pytest.mark.parametrize(("command", "change"), PLACES)
def test_the_place_of_its_data_is_not_opened(
    copy: Path,
    trap: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    touched: list[str],
    command: str,
    change: Change,
) -> None:
    forge(copy, trap, run=change)
    touched.clear()
    words = [w.format(artifact=copy, out=tmp_path / "out") for w in COMMANDS[command]]
    assert main(words) == 2
    seen = list(touched)
    error = capsys.readouterr().err.splitlines()[-1]
    assert "stranger" in error and "--on PACK" in error
    check(seen, trap)
    assert not (tmp_path / "out").exists()


def encoder(**fields: str) -> Change:
    def change(trap: Path, run: dict[str, Any]) -> None:
        for own in run["encoder"].values():
            own |= {k: v.replace("{trap}", str(trap)) for k, v in fields.items()}

    return change


@pytest.mark.parametrize("weights", ["{trap}/letter.pth", "imagenet"])
def test_initial_weights_are_neither_opened_nor_fetched(
    copy: Path, trap: Path, pack: Pack, touched: list[str], weights: str
) -> None:
    forge(copy, trap, run=encoder(weights=weights))
    touched.clear()
    assert main(["probe", str(copy), "--on", str(pack.path), "--tasks", "bright", "--modalities", "touch"]) == 0
    check(list(touched), trap)


def test_start_weights_of_another_run_are_not_opened(copy: Path, trap: Path) -> None:
    """They would be an error here: what opens them is no Python, so that no hook sees it."""
    (trap / "letter.safetensors").write_text("dear")
    record = read_json(copy / "run.json", "a record") | {"start": {"name": "older", "trained_on": ["tag"]}}
    (copy / "run.json").write_text(json.dumps(record))
    forge(copy, trap, run=lambda trap, run: run.update(init={"path": str(trap / "letter.safetensors")}))
    model = mvitac.load(str(copy))
    assert model.run.init.path is None and model.run.init.digest == "unknown"
    assert names_of([copy], [model]) == ["mvitac"]
    found = describe([model], [str(copy)], About())
    assert found["trained_on"] == "toy; starts from older, which was trained on: tag" and found["images_seen"] is None


def setting(*keys: str | int, value: Any) -> Change:
    """``value`` at ``keys`` of what is changed."""

    def change(trap: Path, whole: dict[str, Any]) -> None:
        inner: Any = whole
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value

    return change


def above(trap: Path, whole: dict[str, Any]) -> None:
    whole["files"]["../trap/pairs.csv"] = "0"


NO_SPREAD = {"name": "n", "unit": "N", "edges": [], "spread": []}
LARGE = 10**9  # every image would be resized to it
SIZE = {"stored": LARGE, "about": setting("preprocessing", "stored", value=LARGE)}
RUNS: dict[str, tuple[Change, str]] = {
    "trunk from the Hub": (encoder(trunk="hf-hub:stranger/model"), "unknown trunk"),
    "trunk from a folder": (encoder(trunk="local-dir:{trap}"), "unknown trunk"),
    "another trunk": (encoder(trunk="resnet18"), "holds other weights"),
    "unknown dataset": (setting("data", value={"name": "evil"}), "unknown dataset 'evil'"),
    "a field that is none": (setting("exec", value="rm"), "unknown field in run 'exec'"),
    "a list for a number": (setting("steps", value=[1]), "steps"),
}
ARTIFACTS: dict[str, tuple[Change, str]] = {
    "file above": (above, "names others than"),
    "files are a list": (setting("files", value=["model.safetensors"]), "lacks files"),
    "without model": (lambda trap, about: about["files"].pop("model.safetensors"), "lacks files"),
    "version": (setting("format_version", value=99), "is not mvitac-artifact"),
    "no preprocessing": (setting("preprocessing", value=3), "is damaged"),
    "probe of sound": (setting("probes", 0, "modality", value="sound"), "is damaged"),
    "one class more": (setting("probes", 0, "classes", value=["x"] * 4), "do not fit"),
}
EXPORTS: dict[str, tuple[Change, str]] = {
    "file above": (above, "names others than"),
    "no tolerance": (lambda trap, about: about.pop("tolerance"), "is damaged"),
    "a number for a class": (setting("classes", value={"pattern": [1]}), "expected str, got 1"),
    "a value without unit": (setting("values", value={"force": [{"name": "n"}]}), "field 'unit' is missing"),
    "no spread": (setting("values", value={"force": [NO_SPREAD]}), "0 edges and 0 spreads: give n ascending"),
    "a number for outputs": (setting("outputs", value=1e308), "is damaged"),
    "no inputs": (setting("inputs", value={}), "cannot be run"),
}
FORGED = [("artifact", SIZE, "stored 1000000000: expected 1 to 1024 px")]
FORGED += [("artifact", {"run": change}, says) for change, says in RUNS.values()]
FORGED += [("artifact", {"about": change}, says) for change, says in ARTIFACTS.values()]
FORGED += [("onnx", {"about": change}, says) for change, says in EXPORTS.values()]


@pytest.mark.parametrize(("kind", "changes", "says"), FORGED, ids=["size", *RUNS, *ARTIFACTS, *EXPORTS])
def test_a_run_or_a_description_that_is_none_is_refused(
    request: pytest.FixtureRequest,
    trap: Path,
    tmp_path: Path,
    touched: list[str],
    kind: str,
    changes: dict[str, Any],
    says: str,
) -> None:
    folder = shutil.copytree(request.getfixturevalue(kind), tmp_path / kind)
    forge(folder, trap, **changes)
    touched.clear()
    with pytest.raises(ValueError, match=says):
        mvitac.load(folder) if kind == "artifact" else Engine(folder)
    check(list(touched), trap)


@pytest.mark.parametrize("weights", ["imagenet", "{trap}/trunk.pth"])
def test_weights_that_an_artifact_names_are_not_opened(
    pack: Pack, trap: Path, tmp_path: Path, touched: list[str], monkeypatch: pytest.MonkeyPatch, weights: str
) -> None:
    """Of a trunk that timm has weights for. The artifact's controls are of random weights."""
    scratch = Encoders.both(trunk="test_resnet.r160_in1k", weights="scratch")
    torch.save(build_trunk(scratch.touch, 3).state_dict(), trap / "trunk.pth")
    mvitac.train(replace(smoke(pack, steps=1, eval_every=0), encoder=scratch), tmp_path / "run", quiet=True)
    made = publish(tmp_path / "run", tmp_path / "made", pack)
    forge(made, trap, run=encoder(weights=weights))
    asked: list[str] = []
    monkeypatch.setattr("mvitac.nn.imagenet.load", lambda trunk, kwargs: asked.append(trunk) or load(trunk, kwargs))
    touched.clear()
    publish(made, tmp_path / "again", pack, allow_leak=True)
    check(list(touched), trap)
    assert set(asked) == {"tf_efficientnet_lite0"}  # the control, from the installed package
    assert "| untrained |" in (tmp_path / "again" / "README.md").read_text()


def test_a_card_shows_labels_as_text() -> None:
    line = "Note: <img src=http://x/y.png> ![a](http://x) [b](javascript:1)\x1b[31m\n# title"
    assert _harmless(line) == "Note: &lt;img src=http://x/y.png> ![a]\\(http://x) [b]\\(javascript:1) [31m # title"
