"""Two hundred bad inputs: each ends in one line that says what was given and what to do, exit code 2, nothing left behind.

Every case runs ``mvitac.cli.main.main`` in this process. While it runs, training, packing and probing are traps: a
mistake that is noticed only after the work began fails its case. ``{tmp}``, ``{pack}``, ``{run}`` and ``{out}`` in a
command stand for the test's own folder, a good pack, a good finished run (all copies where they are spoilt) and a free
place for output.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import typing
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import safetensors
import safetensors.torch
import torch
from PIL import Image

import mvitac
from mvitac.cli.main import main
from mvitac.data import build as packing
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.datasets.simulated import GraspsConfig, MaterialsConfig
from mvitac.evaluation import probe as probe_module
from mvitac.experiments.plan import setting
from mvitac.methods.mvitac import MViTacConfig
from mvitac.methods.supervised import SupervisedConfig
from mvitac.model import Model
from mvitac.nn.weights import safetensors_digest
from mvitac.recipes import recipe
from mvitac.registry import to_json
from mvitac.system.files import digest, write_atomic
from mvitac.training import views as batches_module
from mvitac.training.loop import train
from support.forged_packs import Spoil, described, edited, seal
from support.toy import Toy


class WorkBegan(AssertionError):
    """The mistake was not noticed before the work it should have prevented."""


@pytest.fixture(scope="module")
def finished(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good run of two steps."""
    run = replace(recipe("smoke", PackConfig(path=pack.path, size=pack.size)), steps=2, eval_every=0)
    return train(run, tmp_path_factory.mktemp("finished") / "run", quiet=True)


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("COLUMNS", "80")


def snapshot(folder: Path) -> dict[str, str]:
    """Every file and folder below ``folder`` with a digest of its bytes."""
    found = {}
    for path in sorted(folder.rglob("*")):
        content = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        found[str(path.relative_to(folder))] = content
    return found


def stamps(folder: Path) -> dict[Path, tuple[int, int, int]]:
    """Every file and folder below ``folder``: what changes when it is written or replaced."""
    return {path: (s.st_ino, s.st_size, s.st_mtime_ns) for path in folder.rglob("*") for s in [path.stat()]}


@pytest.fixture
def refused(
    pack: Pack,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., str]:
    """Run a command that must be refused; returns its one line. ``left`` are new paths that may stay."""

    def refuse(command: str | list[str], *says: str, left: tuple[str, ...] = (), work: bool = False) -> str:
        places = {"tmp": tmp_path, "pack": pack.path, "run": finished, "out": tmp_path / "out"}
        words = command.split() if isinstance(command, str) else command
        for name, place in places.items():
            words = [word.replace(f"{{{name}}}", str(place)) for word in words]
        if not work:
            for module, name in (
                (batches_module, "make_views"),
                (packing, "read_parts"),
                (probe_module, "features"),
            ):
                monkeypatch.setattr(module, name, trap(name))
        before, elsewhere = snapshot(tmp_path), stamps(pack.path) | stamps(finished)
        capsys.readouterr()
        code = main(words)
        _, error = capsys.readouterr()
        assert code == 2, error
        *progress, last = error.splitlines(keepends=True)
        assert last.startswith("mvitac: error: ") and last.endswith("\n"), error
        assert work or not progress, error
        assert not any(trace in error for trace in ("Traceback", "---", "──", "╭", "Error parsing", "literal for")), (
            error
        )
        for part in says:
            assert part.replace("{tmp}", str(tmp_path)) in error, error
        after = snapshot(tmp_path)
        new = [path for path in after.keys() - before.keys() if not path.startswith(left or "\0")]
        assert not new, f"left behind: {new}"
        assert not [path for path in after if path.endswith(".tmp")]
        assert {path: after.get(path) for path in before} == before, "what was there changed"
        assert stamps(pack.path) | stamps(finished) == elsewhere
        return error

    return refuse


def trap(name: str) -> Callable[..., Any]:
    def sprung(*_: object, **__: object) -> None:
        raise WorkBegan(name)

    return sprung


def cases(table: list[tuple[Any, ...]]) -> Any:
    """Rows (id, ...) as parametrisation."""
    assert len({row[0] for row in table}) == len(table)
    return [pytest.param(*row[1:], id=row[0]) for row in table]


PRETRAIN = "pretrain --recipe smoke --data pack --data.path {pack} --quiet --out {out} "

# -- words ------------------------------------------------------------------------------------------------------------

WORDS: list[tuple[str, str, list[str]]] = [
    ("command", "pretrian", ["'pretrian'", "did you mean 'pretrain'"]),
    ("command-far", "xyzzy", ["'xyzzy'", "choose from", "pretrain"]),
    ("option-for-command", "--frobnicate", ["'--frobnicate'", "choose from"]),
    ("subcommand", "data simulte materials", ["'data simulte'", "did you mean 'data simulate'"]),
    ("simulate-nothing", "data simulate", ["grasps|materials"]),
    ("simulate-unknown", "data simulate graps --out {out}", ["'graps'", "did you mean 'grasps'"]),
    ("simulate-pack", "data simulate pack --out {out}", ["pack", "choose", "materials"]),
    ("simulate-no-out", "data simulate materials --num 4", ["--out", "Folder of the new pack"]),
    ("pack-nothing", "data pack", ["--data", "materials"]),
    ("pack-unknown", "data pack --data materails --out {out}", ["'materails'", "did you mean 'materials'"]),
    ("pack-a-pack", "data pack --data pack --out {out}", ["--data pack reads packs"]),
    ("info-nothing", "data info", ["PACK", "Folder of the pack"]),
    ("info-nowhere", "data info {tmp}/nowhere", ["no pack at {tmp}/nowhere", "mvitac data"]),
    ("info-two", "data info {pack} other", ["part other: no pack at other"]),
    ("method", PRETRAIN + "--method mvitca", ["'mvitca'", "did you mean 'mvitac'"]),
    ("dataset", "pretrain --data graps --out {out}", ["'graps'", "did you mean 'grasps'"]),
    ("recipe", "pretrain --recipe pape --out {out}", ["'pape'", "did you mean 'paper'"]),
    ("logger", PRETRAIN + "--logger tensorbord", ["'tensorbord'", "did you mean 'tensorboard'"]),
    ("logger-by-its-old-name", PRETRAIN + "--sink tensorbord", ["'tensorbord'", "did you mean 'tensorboard'"]),
    ("logger-not-installed", PRETRAIN + "--logger trackio", ["pip install", ".[trackio]"]),
    ("trunk", PRETRAIN + "--encoder.trunk resnet81", ["'resnet81'", "did you mean", "resnet18"]),
    ("trunk-empty", PRETRAIN + "--encoder.trunk=", ["trunk ''", "timm"]),
    ("trunk-tag", PRETRAIN + "--encoder.trunk resnet18.nobody_in1k", ["resnet18.nobody_in1k", "tag"]),
    ("trunk-fixed-size", PRETRAIN + "--encoder.trunk mixer_s32_224", ["mixer_s32_224", "32", "224"]),
    ("weights-nowhere", PRETRAIN + "--encoder.weights {tmp}/none.pth", ["{tmp}/none.pth", "imagenet, scratch"]),
    ("weights-tiny", PRETRAIN + "--encoder.weights imagenet", ["mvitac_tiny", "scratch"]),
    ("weights-folder", PRETRAIN + "--encoder.weights {tmp}", ["{tmp}", "a file that exists"]),
    ("device", PRETRAIN + "--device gpu", ["'gpu'", "cuda:N"]),
    ("device-meta", PRETRAIN + "--device meta", ["'meta'", "auto, cpu, cuda"]),
    ("device-number", PRETRAIN + "--device cuda:99", ["'cuda:99'", "use cpu"]),
    ("device-huge", PRETRAIN + "--device cuda:99999999999", ["cuda:99999999999", "cpu"]),
    ("device-empty", PRETRAIN + "--device=", ["device ''", "cpu"]),
    ("device-of-compare", "compare --device zzz --data materials --out {out}", ["'zzz'", "cuda:N"]),
    ("device-absent", PRETRAIN + "--device mps", ["'mps'", "cpu"]),
    (
        "optimiser",
        PRETRAIN + "--optim.name adma",
        ["--optim.name", "'adma'", "adam, adamw, sgd", "did you mean 'adam'"],
    ),
    ("schedule", PRETRAIN + "--optim.schedule linear", ["--optim.schedule", "'linear'", "cosine"]),
    ("sampler", PRETRAIN + "--sampler random", ["--sampler", "'random'", "one-per-touch"]),
    ("precision", PRETRAIN + "--precision fp16", ["--precision", "'fp16'", "bf16"]),
    ("supervised-task", PRETRAIN + "--method supervised --method.tasks colour", ["'colour'", "pattern"]),
    ("method-has-no-field", PRETRAIN + "--method supervised --method.temperature 1", ["--method.temperature"]),
    ("probe", "probe {run} --probes liner", ["--probes", "'liner'", "did you mean 'linear'"]),
    ("task", "probe {run} --tasks patern", ["'patern'", "did you mean 'pattern'"]),
    ("modality", "probe {run} --modalities sound", ["--modalities", "'sound'", "touch"]),
]


@pytest.mark.parametrize(("command", "says"), cases(WORDS))
def test_words(refused: Callable[..., str], command: str, says: list[str]) -> None:
    refused(command, *says)


# -- options ----------------------------------------------------------------------------------------------------------

OPTIONS: list[tuple[str, str, list[str]]] = [
    ("no-value", PRETRAIN + "--batch-size", ["--batch-size", "value"]),
    ("no-value-before-option", PRETRAIN + "--batch-size --seed 3", ["--batch-size", "value"]),
    ("selector-no-value", PRETRAIN + "--method", ["--method", "value"]),
    ("from-no-value", "pretrain --out {out} --from", ["--from", "value"]),
    ("out-no-value", "data simulate materials --out", ["--out", "value"]),
    ("unknown", PRETRAIN + "--frobnicate 3", ["--frobnicate", "see mvitac pretrain --help"]),
    ("misspelt", PRETRAIN + "--bach-size 16", ["--bach-size", "did you mean --batch-size"]),
    ("misspelt-nested", PRETRAIN + "--optim.lrr 1", ["--optim.lrr", "did you mean --optim.lr"]),
    ("stray-word", PRETRAIN + "extra", ["extra", "--help"]),
    ("flag-with-value", PRETRAIN + "--resume yes", ["yes", "--help"]),
    ("not-an-int", PRETRAIN + "--batch-size x", ["--batch-size: 'x' is not an int"]),
    ("not-a-number", PRETRAIN + "--optim.lr fast", ["--optim.lr: 'fast' is not a number"]),
    ("not-optional-int", PRETRAIN + "--steps many", ["--steps: 'many' is not", "int"]),
    ("not-two-numbers", PRETRAIN + "--optim.betas 0.9 x", ["--optim.betas", "x", "FLOAT FLOAT"]),
    ("one-of-two", PRETRAIN + "--optim.betas 0.9", ["--optim.betas", "2"]),
    ("long-value", PRETRAIN + "--batch-size " + "9" * 5000, ["--batch-size", "too long"]),
    ("twice", PRETRAIN + "--seed 1 --seed 2", ["--seed", "twice"]),
    ("twice-equals", PRETRAIN + "--seed=1 --seed 2", ["--seed", "twice"]),
    ("twice-underscore", PRETRAIN + "--batch-size 8 --batch_size 9", ["--batch-size", "twice"]),
    ("twice-selector", PRETRAIN + "--recipe paper", ["--recipe", "twice"]),
    ("twice-simulate", "data simulate materials --out {out} --num 3 --num 4", ["--num", "twice"]),
    ("twice-run", "probe {run} {run}", ["run", "twice"]),
    ("twice-probe", "probe {run} --probes knn knn", ["knn", "twice"]),
    ("twice-task", "probe {run} --tasks pattern pattern", ["pattern", "twice"]),
    ("twice-modality", "probe {run} --modalities touch touch", ["touch", "twice"]),
    ("no-runs", "probe", ["run's folder"]),
    ("no-probes", "probe {run} --probes", ["no probe", "linear, paper, knn"]),
    ("steps-of-a-lifetime", PRETRAIN + "--steps 1000000000", ["1000000000", "at most"]),
    ("epochs-of-a-lifetime", PRETRAIN + "--steps None --epochs 1e300", ["epochs", "1e+300", "at most"]),
    ("batch-larger-than-data", PRETRAIN + "--batch-size 100", ["72 rows", "batch_size is 100", "72 or less"]),
    ("views-larger-than-stored", PRETRAIN + "--augment.size 64", ["64 px", "32 px", "--augment.size 32"]),
    ("whole-larger-than-stored", PRETRAIN + "--augment.whole 64", ["64 px", "32 px", "--augment.whole 32"]),
    ("whole-tiny", PRETRAIN + "--augment.whole 4", ["whole 4", "8 to 1024"]),
    ("seed-beyond-64-bits", PRETRAIN + "--seed 99999999999999999999", ["seed 99999999999999999999", "give"]),
    ("heads-beyond-memory", PRETRAIN + "--method.out 99999999999", ["99999999999", "give"]),
    ("scale-reversed", PRETRAIN + "--augment.touch.scale 0.9 0.1", ["(0.9, 0.1)", "low <= high"]),
    ("gel-flip", PRETRAIN + "--augment.gel-flip color", ["color", "plain, colour"]),
    ("gel-flip-of-stripes", PRETRAIN + "--augment.gel-flip colour", ["'toy'", "slopes", "--augment.gel-flip plain"]),
    ("imagenet-nowhere", "probe {run} --imagenet {tmp}/none.pth", ["{tmp}/none.pth", "file"]),
    ("imagenet-foreign", "probe {run} --imagenet {pack}/pack.json", ["pack.json", "mvitac_tiny"]),
    ("simulate-huge", "data simulate materials --num 1000000000000 --out {out}", ["1000000000000", "at most"]),
    ("simulate-none", "data simulate grasps --num 0 --out {out}", ["num 0", "at least 1"]),
    ("simulate-tiny", "data simulate materials --size 7 --out {out}", ["size 7", "8 to 1024"]),
    ("simulate-large", "data simulate materials --size 1025 --out {out}", ["size 1025", "8 to 1024"]),
    ("damaged-share", "data simulate materials --max-damaged 2 --out {out}", ["max_damaged 2", "0 to 1"]),
    ("damaged-nan", "data simulate materials --max-damaged nan --out {out}", ["max_damaged nan", "0 to 1"]),
    ("workers-huge", "data simulate materials --workers 100000 --out {out}", ["100000", "1024"]),
    ("from-and-method", "pretrain --from {run}/run.json --method mvitac --out {out}", ["--from", "--method"]),
    ("from-and-data", "pretrain --from {run}/run.json --data pack --out {out}", ["--from", "--data"]),
    ("accuracy-loss-nan", "export {run} --accuracy-loss nan --out {out}", ["--accuracy-loss nan", "0 to 100"]),
    ("min-cosine-nan", "export {run} --min-cosine nan --out {out}", ["--min-cosine nan", "-1 to 1"]),
]


@pytest.mark.parametrize(("command", "says"), cases(OPTIONS))
@pytest.mark.parametrize("terminal", ["ascii", "utf-8"])
def test_options(
    refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch, command: str, says: list[str], terminal: str
) -> None:
    """In both kinds of terminal, since tyro draws another frame in each."""
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), encoding=terminal))
    refused(command, *says)


# -- values and windows -----------------------------------------------------------------------------------------------

PACKED = "data pack --data folder --path {tmp}/presses.csv --touch-group press --group thing --out {out} "
WINDOWS = PRETRAIN.replace("--data pack --data.path {pack}", "--data folder --data.path {tmp}/presses.csv") + (
    "--data.touch-group press --data.group thing --data.size 16 --data.num-frames "
)
VALUES: list[tuple[str, str, list[str]]] = [
    ("text", PACKED + "--values text:N", ["presses.csv row 1", "text is 'hard'", "finite number in N"]),
    ("with-its-unit", PACKED + "--values united:N", ["row 1", "'3.2 mN'", "without the unit"]),
    ("infinite", PACKED + "--values endless:N", ["row 3", "'inf'", "finite number"]),
    ("constant", PACKED + "--values still:N", ["'still'", "fewer than two different values"]),
    ("no-unit", PACKED + "--values force", ["values 'force'", "force_n:N"]),
    ("no-such-column", PACKED + "--values farce:N", ["'farce'", "did you mean 'force'"]),
    ("class-and-value", PACKED + "--labels force --values force:N", ["task 'force' occurs twice", "its own name"]),
    ("two-units", PACKED + "--values force:N weight=force:mN", ["'force' has two units, N and mN", "one unit"]),
    ("packed-window", PACKED + "--num-frames 3", ["every frame once", "no effect", "--num-frames"]),
    ("packed-stride", "data simulate materials --stride 2 --out {out}", ["every frame once", "no effect"]),
    ("no-order", PRETRAIN + "--data.num-frames 2", ["none of the columns frame, seq, time", "--data.order"]),
    ("order-of-words", WINDOWS + "2 --data.order text", ["column 'text' is not a number in row 0", "another order"]),
    ("too-long", WINDOWS + "9 --data.order seq", ["frames 9 at stride 1", "longer than every touch", "fewer frames"]),
    ("two-rates", WINDOWS + "2 --data.order time", ["stride 1 is shorter", "'slow', 4", "longest distance"]),
    ("same-moment", WINDOWS + "2 --data.order still", ["two rows of touch", "have still 1", "--touch-group"]),
    (
        "temporal-of-one",
        PRETRAIN + "--encoder.temporal mean",
        ["encoder.temporal mean has no effect", "--data.num-frames"],
    ),
    ("endless-stride", WINDOWS + "2 --data.stride inf", ["stride inf", "positive number"]),
]


def presses(folder: Path) -> None:
    """Five recordings of eight frames, one of them at a quarter of the others' rate, with good and bad columns."""
    lines = ["touch,press,thing,seq,time,force,text,united,endless,still"]
    for i in range(40):
        Image.new("RGB", (16, 16), (6 * i, 0, 0)).save(folder / f"{i}.png")
        press, seq = divmod(i, 8)
        bad = f"{'hard' if i == 0 else i},{'3.2 mN' if i == 0 else i},{'inf' if i == 2 else i},1"
        slow = press == 4
        lines.append(f"{i}.png,{'slow' if slow else press},o{press},{seq},{seq * (4 if slow else 1)},{i % 4},{bad}")
    (folder / "presses.csv").write_text("\n".join(lines))


@pytest.mark.parametrize(("command", "says"), cases(VALUES))
def test_values_and_windows(refused: Callable[..., str], tmp_path: Path, command: str, says: list[str]) -> None:
    presses(tmp_path)
    windows = command.startswith(WINDOWS)  # they are found in the pack of single frames, which stays in the cache
    refused(command, *says, left=("cache",) if windows else (), work=windows)


# Every number of every config, found by reflection: a new field that checks nothing fails here until it does.

HARMLESS_IF_HUGE = {"log_every", "eval_every", "checkpoint_every", "touches"}  # they only mean "never" or "always"


def numbers(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(option, annotation) of every number in a config and the configs inside it."""
    hints = typing.get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value, kind = getattr(config, field.name), hints[field.name]
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{prefix}{field.name}.")
        elif kind in (int, float, int | None, float | None) or kind == tuple[float, float]:
            yield f"{prefix}{field.name}", kind


def impossible(config: Any, start: str, prefix: str = "") -> Iterator[tuple[str, str, list[str]]]:
    for name, kind in numbers(config, prefix):
        option = "--" + name.replace("_", "-")
        whole = int in (kind, *typing.get_args(kind))
        values = ["-1", "0.5"] if whole else ["-1", "nan", "inf"]
        if whole and name.split(".")[-1] not in HARMLESS_IF_HUGE:
            values.append("1" + "0" * 30)
        for value in values:
            words = f"{value} {value}" if kind == tuple[float, float] else value
            command = f"{start} {option} {words}"
            if name == "epochs":
                command += " --steps None"
            yield f"{start.split()[0]} {option} {value[:5]}", command, [name.split(".")[-1].replace("-", "_")]


FIELDS = [
    *impossible(replace(recipe("smoke", PackConfig(), phased=False), method=MViTacConfig()), PRETRAIN.strip()),
    *impossible(MaterialsConfig(), "data simulate materials --out {out}"),
]
_SUPERVISED = replace(recipe("smoke", PackConfig(), phased=False), method=SupervisedConfig())
FIELDS += [row for row in impossible(_SUPERVISED, PRETRAIN + "--method supervised") if " --method." in row[1]]
FIELDS += [(f"grasps {row[0]}", *row[1:]) for row in impossible(GraspsConfig(), "data simulate grasps --out {out}")]


@pytest.mark.parametrize(("command", "says"), cases(FIELDS))
def test_impossible_numbers(refused: Callable[..., str], command: str, says: list[str]) -> None:
    error = refused(command)
    assert any(part in error.replace("-", "_") for part in says), error


def test_reflection_finds_the_fields() -> None:
    options = {row[1].split("{out} ")[1].split()[0] for row in FIELDS}
    assert {"--optim.betas", "--augment.vision.scale", "--method.momentum-end", "--steps", "--touches"} <= options
    assert any("--method.rank" in row[1] for row in FIELDS)


# -- --from -----------------------------------------------------------------------------------------------------------


def leaves(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, (*path, key))
    else:
        yield path


LEAVES = [".".join(path) for path in leaves(to_json(recipe("smoke", PackConfig(), phased=False)))]


@pytest.mark.parametrize("leaf", LEAVES)
def test_from_with_a_field_of_the_wrong_type(
    refused: Callable[..., str], finished: Path, tmp_path: Path, leaf: str
) -> None:
    """An object where a value belongs, for every value of a run."""
    shutil.copy(finished / "run.json", tmp_path / "run.json")
    edited(tmp_path / "run.json", ("run", *leaf.split(".")), {"surprise": 1})
    refused("pretrain --from {tmp}/run.json --out {out}", "run.json", leaf.split(".")[-1], "surprise")


def put(*keys: str, value: Any) -> Spoil:
    return lambda path: edited(path, keys, value)


def write(data: bytes | str) -> Spoil:
    return lambda path: path.write_bytes(data.encode() if isinstance(data, str) else data)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def to_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


FROM: list[tuple[str, Spoil, list[str]]] = [
    ("missing", Path.unlink, ["does not exist", "run.json"]),
    ("empty", write(""), ["not valid JSON", "run.json"]),
    ("truncated", truncate, ["not valid JSON"]),
    ("not-json", write("method: mvitac\n"), ["not valid JSON"]),
    ("not-text", write(b"\xff\xfe\x00\x80" * 9), ["not valid JSON"]),
    ("deep", write("[" * 100_000), ["not valid JSON"]),
    ("huge-number", write("1" * 5000), ["run.json"]),
    ("folder", to_folder, ["run.json", "folder"]),
    ("foreign-list", write("[1, 2]"), ["run.json", "not a run's record"]),
    ("foreign-object", write('{"name": "npm", "version": 1}'), ["run.json", "not a run's record"]),
    ("foreign-null", write("null"), ["run.json", "not a run's record"]),
    ("run-is-text", put("run", value="mvitac"), ["run.json", "expected an object", "'mvitac'"]),
    ("unknown-field", put("run", "batchsize", value=3), ["'batchsize'", "did you mean 'batch_size'"]),
    ("unknown-field-nested", put("run", "optim", "lrr", value=3), ["'lrr'", "run.optim", "did you mean 'lr'"]),
    ("unknown-method", put("run", "method", "name", value="mvitca"), ["'mvitca'", "did you mean 'mvitac'"]),
    ("method-is-number", put("run", "method", "name", value=7), ["run.method", "7"]),
    ("method-is-list", put("run", "method", "name", value=[]), ["run.method", "[]"]),
    ("method-without-name", put("run", "method", value={}), ["method", "mvitac"]),
    ("method-null", put("run", "method", value=None), ["run.method", "None"]),
    ("unknown-dataset", put("run", "data", "name", value="graps"), ["'graps'", "did you mean 'grasps'"]),
    ("unknown-optimiser", put("run", "optim", "name", value="adma"), ["'adma'", "run.optim.name", "adamw"]),
    ("text-for-int", put("run", "batch_size", value="16"), ["run.batch_size", "int", "'16'"]),
    ("bool-for-int", put("run", "steps", value=True), ["run.steps", "int", "True"]),
    ("bool-for-float", put("run", "epochs", value=True), ["run.epochs", "True"]),
    ("float-for-int", put("run", "seed", value=1.5), ["run.seed", "int", "1.5"]),
    ("int-too-large-for-float", put("run", "epochs", value=10**400), ["run.epochs"]),
    ("one-beta", put("run", "optim", "betas", value=[0.9]), ["run.optim.betas", "2"]),
    ("three-betas", put("run", "optim", "betas", value=[0.9, 0.9, 0.9]), ["run.optim.betas", "2"]),
    ("nan-rate", put("run", "optim", "lr", value=float("nan")), ["lr nan", "positive"]),
    ("negative-batch", put("run", "batch_size", value=-4), ["batch_size -4", "at least 2"]),
    ("path-with-nul", put("run", "data", "path", value="a\0b"), ["path", "NUL"]),
]


@pytest.mark.parametrize(("spoil", "says"), cases(FROM))
def test_from(refused: Callable[..., str], finished: Path, tmp_path: Path, spoil: Spoil, says: list[str]) -> None:
    shutil.copy(finished / "run.json", tmp_path / "run.json")
    spoil(tmp_path / "run.json")
    refused("pretrain --from {tmp}/run.json --out {out}", *says)


# -- --out ------------------------------------------------------------------------------------------------------------

SIMULATE = ["data", "simulate", "materials", "--num", "4", "--size", "16", "--quiet", "--out"]
TRAIN = ["pretrain", "--recipe", "smoke", "--data", "pack", "--data.path", "{pack}", "--quiet", "--out"]
DRAW = ["pretrain", "--recipe", "smoke", "--data", "materials", "--data.num", "400", "--quiet", "--out"]
PROBE = ["probe", "{run}", "--json"]
COMMANDS = {"simulate": SIMULATE, "pretrain": TRAIN, "pretrain-simulated": DRAW, "probe-json": PROBE}


def occupy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.tex").write_text("mine")


OUTS: list[tuple[str, str, list[str]]] = [
    ("file", "{tmp}/file", ["{tmp}/file", "another"]),
    ("foreign-folder", "{tmp}/folder", ["{tmp}/folder", "another"]),
    ("below-a-file", "{tmp}/file/below/out", ["{tmp}/file", "not a folder"]),
    ("name-too-long", "{tmp}/" + "n" * 300, ["nnn", "too long"]),
    ("nul", "{tmp}/a\0b", ["a\\x00b", "NUL"]),
    ("proc", "/proc/mvitac-out", ["/proc/mvitac-out", "cannot be written"]),
    ("empty", "", [" ."]),
]


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
@pytest.mark.parametrize(("out", "says"), cases(OUTS))
def test_out(refused: Callable[..., str], tmp_path: Path, command: list[str], out: str, says: list[str]) -> None:
    """A place nothing can be written to is noticed before anything is simulated, trained or probed."""
    if command is PROBE and out == "{tmp}/file":
        pytest.skip("--json replaces a file: that is what it is for")
    occupy(tmp_path)
    refused([*command, out], *says)


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
@pytest.mark.parametrize("number", [13, 30], ids=["no-permission", "read-only"])
def test_out_may_not_be_written(
    refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: list[str], number: int
) -> None:
    """Root may write everywhere, so the system's answer is given for it."""
    locked, real = tmp_path / "locked", os.open
    locked.mkdir()

    def no(path: Any, flags: int, *args: Any, **options: Any) -> int:
        if flags & os.O_WRONLY | flags & os.O_RDWR and str(path).startswith(str(locked)):
            raise OSError(number, os.strerror(number), str(path))
        return real(path, flags, *args, **options)

    monkeypatch.setattr(os, "open", no)
    refused([*command, "{tmp}/locked/out"], "locked", os.strerror(number), "choose another")


def test_cache_that_is_a_file(refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    occupy(tmp_path)
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path / "file"))
    refused([*DRAW, "{out}"], "{tmp}/file", "not a folder", "MVITAC_CACHE")


# -- full disk --------------------------------------------------------------------------------------------------------


def fill_disk(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Files whose name holds ``name`` appear, but take no byte: /dev/full is the kernel's own full disk."""
    real = Path.open

    def opened(self: Path, mode: str = "r", *args: Any, **options: Any) -> Any:
        if name in self.name and (mode[0] in ("a" if name == "log.jsonl" else "wa") or "+" in mode):
            real(self, mode).close()
            return real(Path("/dev/full"), mode, *args, **options)
        return real(self, mode, *args, **options)

    monkeypatch.setattr(Path, "open", opened)


TRAIN_ONE = PRETRAIN + "--steps 1 --eval-every 0"
FULL: list[tuple[str, str, str, tuple[str, ...]]] = [
    ("pack-request", "request.json", " ".join(SIMULATE) + " {out}", ()),
    ("pack-part", "parts.jsonl", " ".join(SIMULATE) + " {out}", ("out.partial",)),
    ("pack-images", "touch.npy", " ".join(SIMULATE) + " {out}", ("out.partial",)),
    ("pack-jpegs", "touch.jpegs", " ".join(SIMULATE) + " {out} --store jpeg", ("out.partial",)),
    ("pack-table", "samples.parquet", " ".join(SIMULATE) + " {out}", ("out.partial",)),
    ("pack-description", "pack.json", " ".join(SIMULATE) + " {out}", ("out.partial",)),
    ("pack-provenance", "provenance.json", " ".join(SIMULATE) + " {out}", ("out.partial",)),
    ("run-record", "run.json", TRAIN_ONE, ()),
    ("run-log", "log.jsonl", TRAIN_ONE, ("out",)),
    ("run-checkpoint", "checkpoint.pt", TRAIN_ONE, ("out",)),
    ("run-model", "model.safetensors", TRAIN_ONE, ("out",)),
    ("probe-record", "probe.json", "probe {tmp}/r --probes knn --tasks pattern --no-controls", ("cache",)),
    ("probe-features", ".npy", "probe {tmp}/r --probes knn --tasks pattern --no-controls", ("cache",)),
    (
        "probe-json",
        "scores.json",
        "probe {tmp}/r --probes knn --tasks pattern --no-controls --json {tmp}/scores.json",
        ("cache", "r/probe.json"),
    ),
    ("index-bank", "touch.npy", "index {pack} --model {tmp}/r --out {out}", ()),
]


def test_numpy_on_a_full_disk(tmp_path: Path) -> None:
    """Of a large array numpy says how much was written, but neither why not more nor where."""

    def write(file: Any) -> None:
        file.write(b"half")
        raise OSError("1000 requested and 4 written")

    with pytest.raises(OSError, match=r"No space left on device.*features\.npy"):
        write_atomic(tmp_path / "features.npy", write)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "command", "left"), cases(FULL))
def test_full_disk(
    refused: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
    finished: Path,
    tmp_path: Path,
    name: str,
    command: str,
    left: tuple[str, ...],
) -> None:
    shutil.copytree(finished, tmp_path / "r")
    fill_disk(monkeypatch, name)
    refused(command, name, "No space left on device", "free some space", left=left, work=True)
    assert not (tmp_path / "out" / "model.safetensors").exists()
    if left == ("out.partial",):
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["checkpoint.pt", "model.safetensors"])
def test_after_a_full_disk_the_run_goes_on(
    refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch, pack: Pack, finished: Path, tmp_path: Path, name: str
) -> None:
    steps = PRETRAIN + "--data.size 32 --steps 2 --eval-every 0 --checkpoint-every 1"
    with monkeypatch.context() as patch:
        fill_disk(patch, name)
        refused(steps, name, left=("out",), work=True)
    words = [w.replace("{pack}", str(pack.path)).replace("{out}", str(tmp_path / "out")) for w in steps.split()]
    assert main([*words, "--resume"]) == 0
    straight = safetensors.torch.load_file(finished / "model.safetensors")
    again = safetensors.torch.load_file(tmp_path / "out" / "model.safetensors")
    assert all(torch.equal(value, again[key]) for key, value in straight.items())


NESTED = "[" * 100_000 + "]" * 100_000


def test_nested_brackets(refused: Callable[..., str], finished: Path, tmp_path: Path) -> None:
    """100,000 of them, wherever JSON is read: a table, a model's header, an option, a pack's description."""
    (tmp_path / "pairs.jsonl").write_text(NESTED)
    refused("data pack --data folder --path {tmp}/pairs.jsonl --out {out}", "line 1 is not JSON", "brackets")
    shutil.copytree(finished, tmp_path / "run")
    weights = safetensors.torch.load_file(finished / "model.safetensors")
    with safetensors.safe_open(finished / "model.safetensors", "pt") as opened:
        header = {**opened.metadata(), "run": NESTED}
    header["header_digest"] = digest([header["run"], header["spec"], header["stored"]])
    safetensors.torch.save_file(weights, tmp_path / "run" / "model.safetensors", header)
    refused("export {tmp}/run --on {pack} --out {out}", "damaged header", "brackets")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "pack.json").write_text(NESTED)
    refused("data info {tmp}/bad", "pack.json is not valid JSON", "brackets")
    assert setting(f"steps={NESTED}") == ("steps", NESTED)


@pytest.mark.parametrize("port", ["-1", "0", "65536"])
def test_port(refused: Callable[..., str], port: str) -> None:
    refused(f"explore {{run}} --port {port}", f"--port {port}: give 1 to 65535")


def test_a_small_limit_of_memory_is_one_line(pack: Pack) -> None:
    """``ulimit -v``: OpenBLAS would try again and again to allocate, at 488 MB for ever."""
    limit = "import resource; resource.setrlimit(resource.RLIMIT_AS, (488 << 20,) * 2); "
    code = f"{limit} from mvitac.cli.main import main; raise SystemExit(main(['data', 'info', {str(pack.path)!r}]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20)
    assert done.returncode == 2 and done.stderr.startswith("mvitac: error: 488 MB of memory are allowed"), done.stderr


def too_large() -> None:
    torch.empty(1 << 50, dtype=torch.uint8)  # what torch itself raises


def not_mapped() -> None:
    raise ImportError("libtorch_cpu.so: failed to map segment from shared object")


@pytest.mark.parametrize("fails", [too_large, not_mapped])
def test_out_of_memory_is_one_line(
    refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch, fails: Callable[[], None]
) -> None:
    monkeypatch.setattr(batches_module, "make_views", lambda *_: fails())
    refused(PRETRAIN, "not enough memory", "--batch-size", left=("out",), work=True)


# -- packs ------------------------------------------------------------------------------------------------------------


def within(name: str, spoil: Spoil, *, sealed: bool = False) -> Spoil:
    def both(path: Path) -> None:
        spoil(path / name)
        if sealed:
            seal(path)

    return both


def table(change: Callable[[dict[str, list[Any]]], object]) -> Spoil:
    """samples.parquet with its columns changed, consistently sealed."""

    def spoil(path: Path) -> None:
        columns = pq.read_table(path / "samples.parquet").to_pydict()
        columns = change(columns) or columns
        pq.write_table(pa.table(columns), path / "samples.parquet")
        seal(path)

    return spoil


def cell(name: str, value: Any, *, rows: slice = slice(5, 6)) -> Spoil:
    def change(columns: dict[str, list[Any]]) -> None:
        for i in range(*rows.indices(len(columns[name]))):
            columns[name][i] = value

    return table(change)


def column(name: str, make: Callable[[int], Any]) -> Spoil:
    return table(lambda columns: columns.update({name: [make(i) for i in range(len(columns["id"]))]}))


def array(make: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    return lambda path: np.save(path, make(np.load(path)))


FILES = ("pack.json", "samples.parquet", "vision.npy", "touch.npy")
DAMAGES: dict[str, Spoil] = {
    "missing": Path.unlink,
    "empty": write(""),
    "truncated": truncate,
    "garbage": write(bytes(range(256)) * 40),
    "folder": to_folder,
}
PACKS: list[tuple[str, Spoil, list[str]]] = [
    *((f"{name}-{kind}", within(name, spoil), [name]) for name in FILES for kind, spoil in DAMAGES.items()),
    *(
        (f"{name}-{kind}-sealed", within(name, DAMAGES[kind], sealed=True), [name])
        for name in FILES[1:]
        for kind in ("missing", "empty", "truncated", "garbage")
    ),
    ("format-foreign", within("pack.json", write('{"name": "npm"}')), ["pack.json", "does not describe a pack"]),
    ("format-list", within("pack.json", write("[]")), ["pack.json", "does not describe a pack"]),
    ("version-99", described("format_version", value=99), ["format 99", "re-pack"]),
    ("version-text", described("format_version", value="1.0"), ["format 1.0", "re-pack"]),
    ("edited-by-hand", within("pack.json", put("spec", "name", value="mine")), ["pack.json", "digest"]),
    ("num-wrong", described("num", value=99), ["99", "120"]),
    ("num-text", described("num", value="120"), ["pack.json", "num", "'120'"]),
    ("num-negative", described("num", value=-120), ["pack.json", "-120"]),
    ("size-wrong", described("size", value=64), ["64", "32"]),
    ("size-null", described("size", value=None), ["pack.json", "size"]),
    ("digests-list", described("digests", value=[]), ["pack.json", "digests"]),
    ("digests-short", described("digests", value={}), ["pack.json", "digests"]),
    ("spec-null", described("spec", value=None), ["pack.json", "spec"]),
    ("spec-empty", described("spec", value={}), ["pack.json", "spec", "name"]),
    ("spec-unknown", described("spec", "colour", value=1), ["pack.json", "'colour'"]),
    ("spec-channels", described("spec", "touch_channels", value=6), ["touch.npy", "6"]),
    ("spec-channels-odd", described("spec", "touch_channels", value=4), ["touch_channels 4", "3"]),
    ("spec-channels-none", described("spec", "touch_channels", value=-3), ["touch_channels -3", "3"]),
    ("spec-tasks-text", described("spec", "tasks", value="pattern"), ["pack.json", "spec.tasks"]),
    ("spec-controls-list", described("spec", "controls", value=[1]), ["pack.json", "spec.controls"]),
    ("spec-control-unknown", described("spec", "controls", value={"x": ["force"]}), ["'force'", "noise"]),
    (
        "spec-task-without-column",
        described("spec", "tasks", value=[{"name": "colour", "classes": ["a"], "only": {}}]),
        ["label_colour", "samples.parquet"],
    ),
    (
        "spec-task-twice",
        described("spec", "tasks", value=[{"name": "pattern", "classes": ["a", "b", "c"], "only": {}}] * 2),
        ["pattern", "twice"],
    ),
    (
        "spec-only-without-column",
        described("spec", "tasks", value=[{"name": "pattern", "classes": list("abc"), "only": {"phase": "during"}}]),
        ["'phase'", "samples.parquet"],
    ),
    ("images-float", within("touch.npy", array(lambda a: a.astype(np.float32)), sealed=True), ["touch.npy", "float32"]),
    ("images-signed", within("touch.npy", array(lambda a: a.astype(np.int8)), sealed=True), ["touch.npy", "int8"]),
    ("images-fewer", within("touch.npy", array(lambda a: a[:-1]), sealed=True), ["touch.npy", "119"]),
    ("images-gray", within("vision.npy", array(lambda a: a[..., 0]), sealed=True), ["vision.npy", "(120, 32, 32)"]),
    ("images-small", within("vision.npy", array(lambda a: a[:, :16]), sealed=True), ["vision.npy", "16"]),
    ("images-objects", within("touch.npy", write(pickle.dumps([1])), sealed=True), ["touch.npy"]),
    ("rows-fewer", table(lambda c: {k: v[:-1] for k, v in c.items()}), ["119", "120"]),
    ("rows-none", table(lambda c: {k: v[:0] for k, v in c.items()}), ["0", "120"]),
    *(
        (f"no-{name}", table(lambda c, name=name: {k: v for k, v in c.items() if k != name}), [name, "samples.parquet"])
        for name in ("id", "group", "split", "label_pattern", "noise")
    ),
    ("label-nan", column("label_pattern", lambda i: float("nan") if i == 5 else float(i % 3)), ["label_pattern"]),
    ("label-null", cell("label_pattern", None), ["label_pattern", "samples.parquet"]),
    ("label-fraction", column("label_pattern", lambda i: 0.5), ["label_pattern", "whole number"]),
    ("label-text", column("label_pattern", lambda i: "rows"), ["label_pattern", "whole number"]),
    ("label-too-large", cell("label_pattern", 3), ["label_pattern", "3", "0 to 2"]),
    ("label-negative", cell("label_pattern", -2), ["label_pattern", "-2", "0 to 2"]),
    ("label-bool", column("label_bright", lambda i: True), ["label_bright", "whole number"]),
    ("split-unknown", cell("split", "tests"), ["'tests'", "did you mean 'test'"]),
    ("split-null", cell("split", None), ["split"]),
    ("split-number", column("split", lambda i: 1), ["split", "1"]),
    ("group-null", cell("group", None), ["group", "row 5"]),
    ("touch-group-null", cell("touch_group", None), ["touch_group", "row 5"]),
    ("id-twice", cell("id", "0000"), ["id", "'0000'", "twice"]),
    ("id-null", cell("id", None), ["id", "row 5"]),
    ("control-nan", cell("noise", float("nan")), ["noise", "row 5"]),
    ("control-text", column("noise", lambda i: "loud"), ["noise", "number"]),
]


@pytest.mark.parametrize(("spoil", "says"), cases(PACKS))
def test_pack(refused: Callable[..., str], pack: Pack, tmp_path: Path, spoil: Spoil, says: list[str]) -> None:
    shutil.copytree(pack.path, tmp_path / "p")
    spoil(tmp_path / "p")
    refused("data info {tmp}/p", *says)


@pytest.mark.parametrize("command", ["pretrain", "probe"])
def test_damaged_pack_is_noticed_by_the_others_too(
    refused: Callable[..., str], pack: Pack, tmp_path: Path, command: str
) -> None:
    shutil.copytree(pack.path, tmp_path / "p")
    truncate(tmp_path / "p" / "touch.npy")
    words = {"pretrain": PRETRAIN.replace("{pack}", "{tmp}/p"), "probe": "probe {run} --on {tmp}/p"}
    refused(words[command], "touch.npy", "damaged")


def splits(rename: dict[str, str]) -> Spoil:
    return table(lambda columns: columns.update(split=[rename.get(s, s) for s in columns["split"]]))


def labels_off(columns: dict[str, list[Any]]) -> None:
    for name in ("label_pattern", "label_bright"):
        columns[name] = [-1] * len(columns[name])


ON_PACK = "pretrain --recipe smoke --data pack --data.path {tmp}/p --quiet --out {out} "
CONTENTS: list[tuple[str, Spoil, str, list[str]]] = [
    ("no-train-rows", splits({"train": "test"}), ON_PACK, ["no rows", "train or unlabelled"]),
    ("no-train-rows-probe", splits({"train": "unlabelled"}), "probe {run} --on {tmp}/p", ["pattern", "split train"]),
    ("no-test-rows", splits({"test": "val"}), "probe {run} --on {tmp}/p", ["pattern", "split test"]),
    ("all-unlabelled", table(labels_off), "probe {run} --on {tmp}/p", ["pattern", "no labelled rows"]),
    ("supervised-unlabelled", table(labels_off), ON_PACK + "--method supervised", ["pattern", "no labelled rows"]),
    ("no-tasks", described("spec", "tasks", value=[]), "probe {run} --on {tmp}/p", ["no labels"]),
    ("supervised-no-tasks", described("spec", "tasks", value=[]), ON_PACK + "--method supervised", ["no labels"]),
    ("batch-too-large", splits({"val": "test"}), ON_PACK + "--batch-size 99", ["72 rows", "99"]),
]


@pytest.mark.parametrize(("spoil", "command", "says"), cases(CONTENTS))
def test_pack_without_what_is_needed(
    refused: Callable[..., str], pack: Pack, tmp_path: Path, spoil: Spoil, command: str, says: list[str]
) -> None:
    shutil.copytree(pack.path, tmp_path / "p")
    spoil(tmp_path / "p")
    refused(command, *says)


def test_one_class_is_odd_but_no_mistake(pack: Pack, finished: Path, tmp_path: Path) -> None:
    shutil.copytree(pack.path, tmp_path / "p")
    column("label_pattern", lambda i: 1)(tmp_path / "p")
    words = ["probe", str(finished), "--on", str(tmp_path / "p"), "--tasks", "pattern", "--modalities", "touch"]
    before = (finished / "probe.json").read_bytes() if (finished / "probe.json").exists() else None
    assert main([*words, "--json", str(tmp_path / "s.json")]) == 0
    if before is None:
        (finished / "probe.json").unlink()
    records = json.loads((tmp_path / "s.json").read_text())["records"]
    assert {record["accuracy"] for record in records} == {1.0}


# -- building packs ---------------------------------------------------------------------------------------------------


class Spoilt(Toy):
    """The toy with one sample changed."""

    def __init__(self, change: Callable[[dict[str, Any], int], Any]) -> None:
        super().__init__(num=40)
        self.change = change

    def read(self, item: int) -> list[Any]:
        sample = super().read(item)[0]
        parts = {"vision": sample.vision, "touch": sample.touch, "columns": sample.columns}
        self.change(parts, item)
        return [replace(sample, **parts)]


def at(item: int, part: str, make: Callable[[Any], Any]) -> Callable[[dict[str, Any], int], None]:
    def change(parts: dict[str, Any], number: int) -> None:
        if number == item:
            parts[part] = make(parts[part])

    return change


SAMPLES: list[tuple[str, Any, str]] = [
    ("no-image", at(3, "touch", lambda image: None), "no touch image"),
    ("float-image", at(3, "touch", lambda image: image / 255), "float64"),
    ("gray-image", at(3, "vision", lambda image: image[..., 0]), r"\(32, 32\)"),
    ("alpha-image", at(3, "vision", lambda image: image[..., [0, 1, 2, 2]]), r"\(32, 32, 4\)"),
    ("empty-image", at(3, "vision", lambda image: image[:0]), r"\(0, 32, 3\)"),
    (
        "label-nan",
        at(3, "columns", lambda c: {**c, "label_pattern": float("nan")}),
        "column label_pattern holds double",
    ),
    (
        "label-text",
        at(3, "columns", lambda c: {**c, "label_pattern": "rows"}),
        "the rows from item 0 on: column 'label_pattern' mixes",
    ),
    ("label-none", at(3, "columns", lambda c: {**c, "label_pattern": None}), "column label_pattern is empty in row 3"),
    ("label-fraction", at(3, "columns", lambda c: {**c, "label_pattern": 0.5}), "column label_pattern holds double"),
    ("label-large", at(3, "columns", lambda c: {**c, "label_pattern": 7}), "label_pattern is 7.*0 to 2"),
    ("split-unknown", at(3, "columns", lambda c: {**c, "split": "tset"}), "'tset'.*did you mean 'test'"),
    ("split-none", at(3, "columns", lambda c: {**c, "split": None}), "column split is empty in row 3"),
    (
        "no-group",
        at(3, "columns", lambda c: {k: v for k, v in c.items() if k != "group"}),
        "column group is empty in row 3",
    ),
    ("group-none", at(3, "columns", lambda c: {**c, "group": None}), "column group is empty in row 3"),
    ("id-twice", at(3, "columns", lambda c: {**c, "id": "0004"}), "'0004'.*twice"),
    ("mixed-types", at(3, "columns", lambda c: {**c, "noise": "loud"}), "noise"),
]


@pytest.mark.parametrize(("change", "says"), cases(SAMPLES))
def test_bad_samples_make_no_pack(tmp_path: Path, change: Any, says: str) -> None:
    with pytest.raises(ValueError, match=says) as error:
        build(Spoilt(change), tmp_path / "p", size=32, quiet=True)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "p").exists()


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        *(("request.json", damage) for damage in ("empty", "truncated", "garbage", "folder")),
        ("parts.jsonl", "folder"),
    ],
)
def test_unfinished_pack_is_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, damage: str) -> None:
    """A damaged leftover is named (a list that is only damaged is made again: tests/data/test_pack.py)."""
    with monkeypatch.context() as patch:
        patch.setattr(packing._Partial, "finish", trap("finish"))
        with pytest.raises(WorkBegan):
            build(Toy(num=40), tmp_path / "p", size=32, quiet=True)
    DAMAGES[damage](tmp_path / "p.partial" / name)
    with pytest.raises((ValueError, OSError), match=name.replace(".", r"\.")) as error:
        build(Toy(num=40), tmp_path / "p", size=32, quiet=True)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "p").exists()


# -- models -----------------------------------------------------------------------------------------------------------


def resaved(change: Callable[[dict[str, Any], dict[str, str]], object]) -> Spoil:
    """model.safetensors with tensors or header changed, and digests that agree."""

    def spoil(path: Path) -> None:
        file = path / "model.safetensors"
        with safetensors.safe_open(file, framework="pt") as opened:
            header, tensors = dict(opened.metadata()), {k: opened.get_tensor(k) for k in opened.keys()}  # noqa: SIM118
        change(tensors, header)
        if "digest" in header:
            header["digest"] = safetensors_digest(tensors)
        if "header_digest" in header:
            header["header_digest"] = digest([header.get(k) for k in ("run", "spec", "stored")])
        file.write_bytes(safetensors.torch.save(tensors, metadata=header))

    return spoil


def flip_last_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


class Bomb:
    """Unpickling it leaves a mark."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return (os.mkdir, (str(self.mark),))


def bomb(name: str, save: Callable[[Any, Any], object]) -> Spoil:
    def spoil(path: Path) -> None:
        with (path / name).open("wb") as file:
            save({"step": 1, "method": Bomb(path.parent / "exploded")}, file)

    return spoil


MODEL = "model.safetensors"
MODELS: list[tuple[str, Spoil, list[str]]] = [
    *((f"{kind}", within(MODEL, spoil), [MODEL]) for kind, spoil in DAMAGES.items()),
    ("unfinished", within(MODEL, Path.unlink), ["not finished", "--resume"]),
    ("bit-flipped", within(MODEL, flip_last_bit), [MODEL, "digest"]),
    ("pickle", bomb(MODEL, pickle.dump), [MODEL, "safetensors"]),
    ("torch-save", bomb(MODEL, torch.save), [MODEL, "safetensors"]),
    ("foreign", within(MODEL, write(safetensors.torch.save({"w": torch.ones(2)}))), [MODEL, "not written by mvitac"]),
    ("other-format", resaved(lambda t, h: h.update(format="theirs")), [MODEL, "not written by mvitac"]),
    ("tensor-renamed", resaved(lambda t, h: t.update(new=t.pop("encoders.touch.fc1", t.popitem()[1]))), [MODEL, "new"]),
    ("tensor-gone", resaved(lambda t, h: t.pop(sorted(t)[0])), [MODEL, "encoders"]),
    ("tensor-reshaped", resaved(lambda t, h: t.update({sorted(t)[0]: torch.ones(3)})), [MODEL, "encoders"]),
    ("no-run", resaved(lambda t, h: h.pop("run")), [MODEL, "run"]),
    ("no-spec", resaved(lambda t, h: h.pop("spec")), [MODEL, "spec"]),
    ("no-stored", resaved(lambda t, h: h.pop("stored")), [MODEL, "stored"]),
    ("stored-text", resaved(lambda t, h: h.update(stored="big")), [MODEL, "damaged header"]),
    ("no-digest", resaved(lambda t, h: h.pop("digest")), [MODEL, "digest"]),
    ("run-not-json", resaved(lambda t, h: h.update(run="{")), [MODEL, "run"]),
    ("run-null", resaved(lambda t, h: h.update(run="null")), [MODEL, "run"]),
    ("spec-list", resaved(lambda t, h: h.update(spec="[]")), [MODEL, "spec"]),
    ("spec-empty", resaved(lambda t, h: h.update(spec="{}")), [MODEL, "spec"]),
    (
        "unknown-method",
        resaved(lambda t, h: h.update(run=h["run"].replace('"mvitac"', '"mvitca"'))),
        [MODEL, "did you mean 'mvitac'"],
    ),
    (
        "other-trunk",
        resaved(lambda t, h: h.update(run=h["run"].replace("mvitac_tiny", "resnet18"))),
        [MODEL, "tensor", "other weights"],
    ),
]


@pytest.mark.parametrize(("spoil", "says"), cases(MODELS))
def test_model(refused: Callable[..., str], finished: Path, tmp_path: Path, spoil: Spoil, says: list[str]) -> None:
    shutil.copytree(finished, tmp_path / "r")
    spoil(tmp_path / "r")
    refused("probe {tmp}/r", *says)
    assert not (tmp_path / "exploded").exists()


def test_model_of_an_edited_header_is_refused(refused: Callable[..., str], finished: Path, tmp_path: Path) -> None:
    """Another seed of the same length, so that only the header's own digest can tell."""
    shutil.copytree(finished, tmp_path / "r")
    file = tmp_path / "r" / MODEL
    data = file.read_bytes()
    assert data.count(rb"\"seed\": 0") == 1
    file.write_bytes(data.replace(rb"\"seed\": 0", rb"\"seed\": 7"))
    refused("probe {tmp}/r", MODEL, "digest")


# -- checkpoints ------------------------------------------------------------------------------------------------------

CHECKPOINT = "checkpoint.pt"


def checkpoint(change: Callable[[dict[str, Any]], object]) -> Spoil:
    def spoil(path: Path) -> None:
        state = torch.load(path / CHECKPOINT, weights_only=True)
        state = change(state) or state
        torch.save(state, path / CHECKPOINT)

    return spoil


def other_run(path: Path) -> None:
    """The checkpoint of the same run with another seed."""
    run, _ = mvitac.run.load_run(path)  # type: ignore[attr-defined]
    out = train(replace(run, seed=5), path.parent / "other", quiet=True)
    shutil.copy(out / CHECKPOINT, path / CHECKPOINT)


CHECKPOINTS: list[tuple[str, Spoil, list[str]]] = [
    *((kind, within(CHECKPOINT, DAMAGES[kind]), [CHECKPOINT]) for kind in ("empty", "truncated", "garbage", "folder")),
    ("pickle-with-code", bomb(CHECKPOINT, pickle.dump), [CHECKPOINT, "delete it"]),
    ("torch-with-code", bomb(CHECKPOINT, torch.save), [CHECKPOINT, "delete it"]),
    ("foreign-list", checkpoint(lambda s: [1, 2]), [CHECKPOINT, "delete it"]),
    ("foreign-weights", checkpoint(lambda s: {"w": torch.ones(2)}), [CHECKPOINT, "delete it"]),
    ("no-optimiser", checkpoint(lambda s: s.pop("optimiser") and None), [CHECKPOINT, "optimiser"]),
    ("step-text", checkpoint(lambda s: s.update(step="one")), [CHECKPOINT, "step"]),
    ("step-beyond-the-end", checkpoint(lambda s: s.update(step=99)), [CHECKPOINT, "99"]),
    ("step-negative", checkpoint(lambda s: s.update(step=-1)), [CHECKPOINT, "-1"]),
    ("tensor-gone", checkpoint(lambda s: s["method"].popitem() and None), [CHECKPOINT, "delete it"]),
    ("optimiser-foreign", checkpoint(lambda s: s.update(optimiser={})), [CHECKPOINT, "delete it"]),
    ("of-another-run", other_run, [CHECKPOINT, "another run"]),
]


@pytest.mark.parametrize(("spoil", "says"), cases(CHECKPOINTS))
def test_checkpoint(refused: Callable[..., str], finished: Path, tmp_path: Path, spoil: Spoil, says: list[str]) -> None:
    shutil.copytree(finished, tmp_path / "r")
    (tmp_path / "r" / MODEL).unlink()
    spoil(tmp_path / "r")
    refused("pretrain --from {tmp}/r/run.json --out {tmp}/r --resume --quiet", *says)
    assert not (tmp_path / "exploded").exists()


RESUMES: list[tuple[str, Spoil, str, list[str]]] = [
    ("without-resume", lambda path: None, "", ["already holds a run", "--resume"]),
    ("other-seed", lambda path: None, "--seed 4 --resume", ["different run"]),
    ("other-pack", within("run.json", put("pack", value="0" * 64)), "--resume", ["different run"]),
    ("record-truncated", within("run.json", truncate), "--resume", ["run.json", "not valid JSON"]),
    ("record-foreign", within("run.json", write("{}")), "--resume", ["run.json", "not a run's record"]),
]


@pytest.mark.parametrize(("spoil", "options", "says"), cases(RESUMES))
def test_resume(
    refused: Callable[..., str], finished: Path, tmp_path: Path, spoil: Spoil, options: str, says: list[str]
) -> None:
    shutil.copytree(finished, tmp_path / "r")
    spoil(tmp_path / "r")
    refused(f"pretrain --from {{run}}/run.json --out {{tmp}}/r --quiet {options}", *says)


def test_log_with_foreign_lines_is_cut_there(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "r")
    (tmp_path / "r" / MODEL).unlink()
    whole = (finished / "log.jsonl").read_bytes()
    (tmp_path / "r" / "log.jsonl").write_bytes(whole + b'[3]\n{"loss": 2}\n\xff\xfe\n{"step"')
    assert main(["pretrain", "--from", str(finished / "run.json"), "--out", str(tmp_path / "r"), "--resume"]) == 0
    assert [json.loads(line)["step"] for line in (tmp_path / "r" / "log.jsonl").read_text().splitlines()][:1] == [0]


# -- probing ----------------------------------------------------------------------------------------------------------


def toy(**options: Any) -> Spoil:
    return lambda path: build(Toy(num=48, **options), path.parent / "p", size=32, quiet=True)


PROBES: list[tuple[str, Spoil, str, list[str]]] = [
    ("nowhere", lambda path: None, "probe {tmp}/nowhere", ["no trained model at {tmp}/nowhere"]),
    ("model-file", lambda path: None, "probe {run}/model.safetensors", ["model.safetensors", "folder"]),
    ("foreign-file", write("text"), "probe {tmp}/r", ["{tmp}/r", "folder"]),
    ("empty-folder", Path.mkdir, "probe {tmp}/r", ["no trained model at {tmp}/r"]),
    ("pack-for-run", lambda path: None, "probe {pack}", ["no trained model", "pack"]),
    ("on-nowhere", lambda path: None, "probe {run} --on {tmp}/nowhere", ["no pack at {tmp}/nowhere"]),
    ("on-a-run", lambda path: None, "probe {run} --on {run}", ["pack.json"]),
    ("on-two-sensors", toy(touch_channels=6), "probe {run} --on {tmp}/p", ["touch", "6"]),
    ("on-no-touch", toy(touch_channels=0), "probe {run} --on {tmp}/p --modalities touch", ["'touch'", "vision"]),
    ("on-no-vision", toy(vision_channels=0), "probe {run} --on {tmp}/p --modalities both", ["'both'", "touch"]),
]


@pytest.mark.parametrize(("spoil", "command", "says"), cases(PROBES))
def test_probe(refused: Callable[..., str], tmp_path: Path, spoil: Spoil, command: str, says: list[str]) -> None:
    spoil(tmp_path / "r")
    refused(command, *says)


@pytest.mark.parametrize(("lacks", "given"), [("touch", "vision"), ("vision", "touch")])
def test_probe_on_a_modality_the_model_lacks(
    refused: Callable[..., str], pack: Pack, tmp_path: Path, lacks: str, given: str
) -> None:
    one = build(Toy(num=48, **{f"{lacks}_channels": 0}), tmp_path / "one", size=32, quiet=True)
    run = replace(recipe("smoke", PackConfig(path=one.path, size=32)), steps=1, eval_every=0)
    train(run, tmp_path / "r", quiet=True)
    refused("probe {tmp}/r --on {pack}", lacks, "cannot embed", "trained on")


def test_runs_on_different_data(refused: Callable[..., str], finished: Path, tmp_path: Path) -> None:
    other = build(Toy(num=48), tmp_path / "other", size=32, quiet=True)
    run = replace(recipe("smoke", PackConfig(path=other.path, size=32)), steps=1, eval_every=0)
    train(run, tmp_path / "r", quiet=True)
    refused("probe {run} {tmp}/r", "different data", "--on")


# -- embed() ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model(finished: Path) -> Model:
    return mvitac.load(finished)


GOOD = np.zeros((32, 32, 3), np.uint8)
EMBEDS: list[tuple[str, dict[str, Any], str]] = [
    ("nothing", {}, "give vision"),
    ("bright-array", {"touch": GOOD + 2.5}, r"0, 1\]"),
    ("nan-array", {"touch": np.full((32, 32, 3), np.nan)}, "uint8.*float64"),
    ("int-array", {"touch": GOOD.astype(int)}, "uint8.*int64"),
    ("bool-array", {"touch": GOOD > 0}, "uint8.*bool"),
    ("object-array", {"touch": np.full((2, 2, 3), None)}, "uint8.*object"),
    ("bright-tensor", {"touch": 255 * torch.ones(3, 32, 32)}, r"0, 1\]"),
    ("two-sensors", {"touch": np.zeros((32, 32, 6), np.uint8)}, "3 channels.*6"),
    ("gray", {"vision": GOOD[..., :1]}, "3 channels.*1"),
    ("flat", {"vision": GOOD[..., 0]}, r"\(32, 32\)"),
    ("five-axes", {"vision": np.zeros((1, 2, 32, 32, 3), np.uint8)}, "uint8"),
    ("no-axes", {"vision": np.uint8(3)}, "vision"),
    ("no-height", {"vision": GOOD[:0]}, r"\(0, 32, 3\)"),
    ("no-width", {"vision": [GOOD, GOOD[:, :0]]}, r"\(32, 0, 3\)"),
    ("empty-list", {"vision": []}, "no images"),
    ("empty-batch", {"vision": GOOD[None][:0]}, "no images"),
    ("text", {"vision": "photo.png"}, "photo.png does not exist"),
    ("texts", {"vision": ["photo.png"]}, "photo.png does not exist"),
    ("bytes", {"vision": b"\x89PNG"}, "bytes"),
    ("path", {"vision": Path("photo.png")}, "photo.png does not exist"),
    ("number", {"vision": 7}, "int"),
    ("none-in-list", {"vision": [GOOD, None]}, "NoneType"),
    ("dict", {"vision": {"image": GOOD}}, "dict"),
    ("list-of-lists", {"vision": GOOD.tolist()}, "list"),
    ("generator-of-nothing", {"vision": iter(())}, "no images"),
]


@pytest.mark.parametrize(("given", "says"), cases(EMBEDS))
def test_embed(model: Model, given: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says) as error:
        model.embed(**given)
    assert "\n" not in str(error.value)


def test_embed_a_modality_the_model_lacks(tmp_path: Path) -> None:
    one = build(Toy(num=48, vision_channels=0), tmp_path / "one", size=32, quiet=True)
    run = replace(recipe("smoke", PackConfig(path=one.path, size=32)), steps=1, eval_every=0)
    model = mvitac.load(train(run, tmp_path / "r", quiet=True))
    with pytest.raises(ValueError, match="no vision encoder: it has touch"):
        model.embed(vision=GOOD)


def test_embed_of_a_two_sensor_model_refuses_a_picture(pack: Pack, tmp_path: Path) -> None:
    two = build(Toy(num=48, touch_channels=6), tmp_path / "two", size=32, quiet=True)
    run = replace(recipe("smoke", PackConfig(path=two.path, size=32)), steps=1, eval_every=0)
    model = mvitac.load(train(run, tmp_path / "r", quiet=True))
    with pytest.raises(ValueError, match="6 channels"):
        model.embed(touch=Image.fromarray(GOOD))


# -- random damage ----------------------------------------------------------------------------------------------------

NUM_DAMAGES = 40


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """One byte changed, a stretch zeroed, or the end cut off, at a random place."""
    place, kind = int(rng.integers(len(data))), int(rng.integers(4))
    if kind == 0:
        return data[:place]
    length = min(int(rng.integers(1, 64)), len(data) - place)
    if kind == 1:
        return data[:place] + bytes(length) + data[place + length :]
    changed = data[place] ^ int(rng.integers(1, 256)) if kind == 2 else int(rng.integers(32, 127))  # 3: still text
    return data[:place] + bytes([changed]) + data[place + 1 :]


def content(pack: Pack) -> Any:
    images = {m: hashlib.sha256(np.ascontiguousarray(a).tobytes()).hexdigest() for m, a in pack.images.items()}
    return pack.spec, pack.num, pack.size, pack.digest, pack.table.to_pydict(), images


def in_one_line(error: ValueError) -> int:
    assert "\n" not in str(error)
    return 1


@pytest.mark.parametrize("name", FILES)
def test_random_damage_to_a_pack(pack: Pack, tmp_path: Path, name: str) -> None:
    """Opening says what is wrong in one line, or gives the very same content."""
    good, path = content(pack), tmp_path / "p"
    path.mkdir()
    for file in FILES:
        (path / file).symlink_to(pack.path / file)
    (path / name).unlink()
    data, rng, noticed = (pack.path / name).read_bytes(), np.random.default_rng(11), 0
    for _ in range(NUM_DAMAGES):
        (path / name).write_bytes(damaged(data, rng))
        try:
            assert content(Pack(path)) == good
        except ValueError as error:
            noticed += in_one_line(error)
    assert noticed > NUM_DAMAGES // 2


def test_random_damage_to_a_model(finished: Path, model: Model, tmp_path: Path) -> None:
    path, rng, noticed = tmp_path / MODEL, np.random.default_rng(12), 0
    data = (finished / MODEL).read_bytes()
    header = 8 + int.from_bytes(data[:8], "little")
    for i in range(2 * NUM_DAMAGES):  # every other one in the header, which is the smaller part
        part = damaged(data[:header], rng) + data[header:] if i % 2 else damaged(data, rng)
        path.write_bytes(part)
        try:
            again = mvitac.load(path)
            assert again.run == model.run and again.spec == model.spec
            assert again.weights_digest() == model.weights_digest()
        except ValueError as error:
            noticed += in_one_line(error)
    assert noticed > NUM_DAMAGES


@pytest.mark.parametrize("kind", ["run.json", "checkpoint.pt"])
def test_random_damage_to_a_run(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """Resuming trains, or refuses in one line; it never shows a traceback."""
    monkeypatch.setattr(batches_module, "make_views", trap("make_views"))
    shutil.copytree(finished, tmp_path / "r")
    (tmp_path / "r" / MODEL).unlink()
    data, rng = (finished / kind).read_bytes(), np.random.default_rng(13)
    run, _ = mvitac.run.load_run(finished)  # type: ignore[attr-defined]
    noticed = 0
    for _ in range(NUM_DAMAGES):
        while (other := damaged(data, rng)) == data:  # zeros for zeros
            pass
        (tmp_path / "r" / kind).write_bytes(other)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                train(run, tmp_path / "r", resume=True, quiet=True)
        except ValueError as error:
            noticed += in_one_line(error)
        finally:
            (tmp_path / "r" / MODEL).unlink(missing_ok=True)
    assert noticed == NUM_DAMAGES if kind == CHECKPOINT else noticed > NUM_DAMAGES // 4
