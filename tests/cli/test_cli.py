"""The command line: quick to answer, a help that is a golden file, and the whole road in one process."""

import json
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from mvitac.cli.main import _check_choices, help_file, main
from mvitac.cli.options import STDOUT, save_json
from mvitac.cli.pretrain import _chosen_run
from mvitac.data.pack import Pack
from mvitac.datasets import DatasetConfig, dataset
from mvitac.methods.base import MethodConfig
from mvitac.model import load
from mvitac.registry import default
from mvitac.run import Run
from mvitac.training.loop import Interrupted

WRONG = (
    "pretrain --data materials --recipe nosuch",
    "pretrain --data packs/nosuch",
    "finetune nosuch --data mateials",
    "compare --plan nosuch",
    "demo --recipe nosuch",
    "probe nosuch",
    "probe --folds 1",
    "report nosuch",
    "publish nosuch out",
    "export nosuch --out out",
    "predict nosuch touch.mp4",
    "live nosuch",
    "embed pack --model nosuch --out out",
    "probe --bogus",
)


def test_wrong_arguments_are_refused_before_torch_is_imported() -> None:
    code = (
        "import sys; from mvitac.cli.main import main\n"
        f"for command in {WRONG!r}:\n    print(main(command.split()), 'torch' in sys.modules, command)"
    )
    plain = {**os.environ, "PYTHONIOENCODING": "ascii"}  # without the lines of a frame
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=plain)
    assert done.stdout.splitlines() == [f"2 False {command}" for command in WRONG]
    for word in ("nosuch", "mateials", "folds 1", "error: Unrecognized options: --bogus"):
        assert word in done.stderr


def test_a_method_of_ones_own_is_known(smoke_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No stored help lists it; and whoever opens its run without it is told so."""
    monkeypatch.setattr(MethodConfig, "choices", MethodConfig.choices | {"mine": MethodConfig})
    _check_choices(["--method", "mine"], help_file("pretrain"))
    with pytest.raises(ValueError, match="unknown method 'mime': choose from"):
        _check_choices(["--method", "mime"], help_file("pretrain"))
    monkeypatch.setattr(MethodConfig, "choices", {"mine": MethodConfig})
    with pytest.raises(ValueError, match=r"model.safetensors: unknown method 'mvitac': .* once its module is imported"):
        load(smoke_run)


@pytest.mark.parametrize(
    ("words", "again"),
    [("pretrain --data a --out 'my run'", " --resume"), ("finetune imagenet --resume", ""), ("compare --seeds 3", "")],
)
def test_what_is_stopped_says_the_command_that_goes_on(
    words: str, again: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for error in (Interrupted("stopped after step 4 of 8; a folder"), KeyboardInterrupt()):
        monkeypatch.setattr("mvitac.cli.main._run", Mock(side_effect=error))
        assert main(shlex.split(words)) == 130
        assert capsys.readouterr().err.endswith(f"; continue: mvitac {words}{again}\n")


def test_advice_is_of_the_command_and_home_is_read(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    for name, advice in (("data", "--order"), ("predict", "--order of mvitac data pack"), ("pretrain", "--data.order")):
        monkeypatch.setattr("mvitac.cli.main._run", run := Mock(side_effect=ValueError("name --data.order")))
        assert main([name, "--out=~/x"]) == 2 and capsys.readouterr().err == f"mvitac: error: name {advice}\n"
        assert run.call_args.args == ([name, "--out=/home/me/x"],)


def test_a_current_folder_that_was_deleted_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (gone := tmp_path / "gone").mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main(["probe", str(tmp_path)]) == 2
    assert capsys.readouterr().err == "mvitac: error: the current folder was deleted: change to another\n"


def test_a_full_stdout_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", Mock(write=Mock(side_effect=OSError(28, "No space left on device"))))
    with pytest.raises(OSError, match="No space left on device: 'stdout'"):
        save_json(STDOUT, {"a": 1})


def test_a_path_is_data(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pack, a table, a folder; a name of a dataset is that, also beside a folder of this name."""
    (tmp_path / "pairs.csv").touch()
    (tmp_path / "robot" / "meta").mkdir(parents=True)
    (tmp_path / "robot" / "meta" / "info.json").touch()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "materials").mkdir()
    for path, name in {"pairs.csv": "folder", "robot": "lerobot", str(pack.path): "pack", ".": "folder"}.items():
        assert dataset(path) == replace(default(DatasetConfig, name), path=Path(path))
    assert dataset("materials") == default(DatasetConfig, "materials")
    for name in ("pairs.cvs", "packs/mine"):
        with pytest.raises(ValueError, match=f"^{name} does not exist"):
            dataset(name)


@pytest.mark.parametrize("options", [[], ["--recipe", "paper", "--method", "ssvtp"]])
def test_pretrain_starts_nothing_without_data(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["pretrain", *options]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in ("--data", "folder", "--from RUN.JSON", "mvitac demo"))


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_demo_leaves_its_summary_and_goes_on_where_it_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    small = "--data.num 240 --data.touches 2 --data.size 32 --data.workers 1 --augment.size 32 --augment.whole 32"
    tiny = "--encoder.trunk mvitac_tiny --steps 2 --batch-size 16 --precision fp32"
    command = f"demo --recipe quick --out {tmp_path / 'demo'} --seeds 2 {small} {tiny}".split()
    assert main(command) == 0
    summary = json.loads((tmp_path / "demo" / "summary.json").read_text())
    for modality in ("touch", "vision", "both"):
        cell = summary["category"][modality]["mvitac"]
        assert set(cell) - {"balanced"} == {"mean", "low", "high", "seeds", "groups"} and cell["seeds"] == [0, 1]
        assert cell["low"] <= cell["mean"] <= cell["high"]
    force = summary["force"]  # a value, next to the classes
    assert set(force) == {"none", "touch", "vision", "both"} and set(force["none"]) == {"mean"}
    assert force["touch"]["pixels"]["mean"] > 0.3  # R2: a harder press is a larger imprint
    trained = json.loads((tmp_path / "demo" / "seed0" / "run.json").read_text())["run"]
    assert trained["recipe"] == "quick" and trained["method"]["keys"] == "end-to-end"
    shown = capsys.readouterr().out
    assert "recipe quick: " in shown and "2 steps of 16 pairs" in shown
    assert "report.html" in shown and "majority" in shown and "materials: force" in shown
    assert (tmp_path / "demo" / "report" / "figures" / "probe-force.png").exists()
    weights = tmp_path / "demo" / "seed1" / "model.safetensors"
    before = weights.stat().st_mtime_ns
    monkeypatch.setattr("mvitac.experiments.demo.probe_runs", None)  # calling it would raise
    assert main(command) == 0 and weights.stat().st_mtime_ns == before
    assert json.loads((tmp_path / "demo" / "summary.json").read_text()) == summary


@pytest.mark.parametrize(("there", "expected"), [("package", "locked"), ("", "quick")])
def test_the_demo_starts_from_imagenet_where_its_weights_are(
    there: str, expected: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[Run] = []
    monkeypatch.setattr("mvitac.cli.demo.imagenet.source", lambda trunk: there)
    monkeypatch.setattr("mvitac.cli.demo.run_demo", lambda run, *_: made.append(run))
    assert main(["demo"]) == 0
    assert made[0].recipe == expected and ("from scratch" in capsys.readouterr().out) != bool(there)


def test_epochs_replace_the_steps_of_a_recipe(pack: Pack) -> None:
    chosen = {"--recipe": "smoke", "--data": str(pack.path)}
    steps = [_chosen_run(chosen, words, True).steps for words in ([], ["--epochs", "2"], ["--epochs=2"])]
    assert steps == [8, None, None]
