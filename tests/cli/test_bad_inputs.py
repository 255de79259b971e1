"""Bad inputs: each ends in one line that holds the wrong value or the name it was given to, exit code 2, nothing left.

Every case runs ``mvitac.cli.main.main`` in this process. While it runs, training, packing and probing are traps: a
mistake that is noticed only after the work began fails its case. ``{tmp}``, ``{pack}``, ``{run}`` and ``{out}`` in a
command stand for the test's own folder, a good pack, a good finished run (copied to ``{tmp}`` as p and r where they are
spoilt) and a free place for output.
"""

import dataclasses
import os
import pickle
import shutil
import typing
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import safetensors.torch
import torch
from PIL import Image

from mvitac.cli.main import main
from mvitac.data import build as packing
from mvitac.data.pack import Pack
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.pack import PackConfig
from mvitac.datasets.simulated import GraspsConfig, MaterialsConfig
from mvitac.evaluation import probe as probe_module
from mvitac.methods.mvitac import MViTacConfig
from mvitac.recipes import recipe
from mvitac.registry import to_json
from mvitac.run import Run
from mvitac.system.files import digest_file
from mvitac.training.loop import train
from mvitac.training.views import StepViews
from support import forged_packs
from support.forged_packs import Spoil, described, edited, seal


class WorkBegan(AssertionError):
    """The mistake was not noticed before the work it should have prevented."""


@pytest.fixture(scope="module")
def finished(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = replace(recipe("smoke", PackConfig(path=pack.path, size=pack.size)), steps=2, eval_every=0)
    return train(run, tmp_path_factory.mktemp("finished") / "run", quiet=True)


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MVITAC_CACHE", str(tmp_path / "cache"))


def snapshot(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): digest_file(p) if p.is_file() else "folder" for p in folder.rglob("*")}


@pytest.fixture
def refused(
    pack: Pack, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., str]:
    """Run a command that must be refused; returns its one line. ``left`` are new paths that may stay."""

    def refuse(command: str | list[str], *says: str, left: tuple[str, ...] = (), work: bool = False) -> str:
        words = command.split() if isinstance(command, str) else command
        for name, place in {"tmp": tmp_path, "pack": pack.path, "run": finished, "out": tmp_path / "out"}.items():
            words = [word.replace(f"{{{name}}}", str(place)) for word in words]
        for module, name in () if work else ((StepViews, "make"), (packing, "read_parts"), (probe_module, "features")):
            monkeypatch.setattr(module, name, Mock(side_effect=WorkBegan(name)))
        before, elsewhere = snapshot(tmp_path), snapshot(finished)
        capsys.readouterr()
        code = main(words)
        *progress, last = capsys.readouterr().err.splitlines(keepends=True)
        assert code == 2 and last.startswith("mvitac: error: ") and last.endswith("\n"), last
        assert work or not progress, progress
        for say in says:
            assert say.replace("{tmp}", str(tmp_path)) in last, last
        after = snapshot(tmp_path)
        new = [path for path in after.keys() - before.keys() if not path.startswith(left or "\0")]
        assert not new, f"left behind: {new}"
        assert {path: after.get(path) for path in before} == before and snapshot(finished) == elsewhere
        return last

    return refuse


PRETRAIN = "pretrain --recipe smoke --data pack --data.path {pack} --quiet --out {out} "
SIMULATE = "data pack --data materials --size 16 --quiet --out {out} "
PACKED = "data pack --data folder --path {tmp}/presses.csv --touch-group press --group thing --out {out} "

RANDOM = "external:timm/test_resnet,weights=random"

# A command, its wrong words, and what the message must hold.
WORDS: list[tuple[str, str, str]] = [
    ("", "pretrian", "did you mean 'pretrain'"),
    ("", "data info {tmp}/nowhere", "no pack at {tmp}/nowhere"),
    ("", "compare --plan mine.toml --data materials --out {out}", "mine.toml does not exist"),
    ("", "pretrain --from {run}/run.json --data pack --out {out}", "--data"),
    ("pretrain --data {pack} ", "--data.path {tmp} --out {out}", "is a path, and --data.path gives another"),
    (PRETRAIN, "--encoder.trunk resnet81", "'resnet81'"),
    (PRETRAIN, "--encoder.weights {tmp}/none.pth", "{tmp}/none.pth"),
    (PRETRAIN, "--encoder.weights imagenet", "mvitac_tiny"),
    (PRETRAIN, "--encoder.temporal mean", "temporal mean"),
    (PRETRAIN, "--device cuda:99", "'cuda:99'"),
    (PRETRAIN, "--method supervised --method.tasks colour", "'colour'"),
    (PRETRAIN, "--method supervised --method.temperature 1", "--method.temperature"),
    (PRETRAIN, "--bach-size 16", "--batch-size"),
    (PRETRAIN, "--batch-size " + "9" * 5000, "--batch-size"),
    (PRETRAIN, "--batch-size 100", "72 rows"),
    ("data pack --data taxim --out {out} ", "--held-out-sensor", "held_out_sensor is of simulated presses: give num"),
    (PACKED, "--every 3", "presses.csv: --every is not for tables"),
    (f"probe --encoder {RANDOM} ", "--allow-leak", "--allow-leak is of runs: name one"),
    ("finetune {run} --data pack --out {out} ", "--seeds 0", "seeds 0: give 1 to 1000"),
    ("finetune {run} --data pack --out {out} ", "--lr --steps 3", "lr is empty: give at least one"),
    (PRETRAIN, "--augment.size 64", "--augment.size 32"),
    (PRETRAIN, "--augment.touch.scale 0.9 0.1", "(0.9, 0.1)"),
    (PRETRAIN, "--data.num-frames 2", "--data.order"),
    (SIMULATE, "--max-damaged nan", "max_damaged nan"),
    (SIMULATE, "--num-frames 2 --order frame", "every frame once"),
    ("bench {run} ", "--suite servo-v2", "did you mean 'servo-v1'"),
    ("bench {run} ", "--suite servo-v1 --data-root {tmp}", "--data-root has no effect on servo-v1"),
    ("bench {run} ", "--suite sim-v3 --data-root {tmp}", "--data-root has no effect on sim-v3"),
    ("bench {run} --suite sim-v3 ", "--licence MIT\x1b", "--licence: 'MIT\\x1b' has a control character"),
    ("data info ", "{tmp}/x\x1b[2J", "no pack at {tmp}/x\\x1b[2J"),
    (SIMULATE, "--data.labels feel", "Unrecognized options: --data.labels"),
    ("live e ", "--touch=", "--vision or --touch is empty: name a SOURCE"),
    ("predict {run} ", "--background {tmp}/a.png --calibration 9 --touch sim --out {out}", "give a video (.mp4"),
    ("compare ", "--data pack --data.path {pack} --dry-run --tables-only --out {out}", "no effect beside --dry-run"),
    ("data pack --data rosbag --path {tmp} --out {out} ", "--allow-missing", "fixed argument"),
    (PRETRAIN, "--data.frames-of both", "--data.frames-of is for rows of several frames"),
    (PRETRAIN, "--data.order press --data.minus-first --data.stride 2", "--data.stride is for rows of several frames"),
    ("data pack --data materials --num 20 --out ", ".", ". already exists: choose another --out"),
    ("predict e ", "g.mp4 --out a.parquet", "--out a.parquet: the table is CSV"),
    ("live e --record {out} ", "--json {out}/pack.json", "is the place of another output, or inside it"),
    ("compare --dry-run ", "--set steps=3 steps=5", "--set steps is given twice"),
    ("compare --plan recipes --dry-run ", "--recipe smoke", "--recipe smoke has no effect: every row of recipes has"),
    ("probe {run} ", "{run}", "twice"),
    ("probe {run} --modalities vision ", "--standardise features", "the touch features of runs, not of vision"),
    (f"probe --on {{pack}} --encoder {RANDOM},reads=touch ", "--modalities vision", "random does not read vision"),
    ("probe {run} ", "--probes knn knn", "twice"),
    ("probe {run} ", "--tasks patern", "did you mean 'pattern'"),
    ("probe {run} ", "--on {run}", "pack.json"),
    ("probe ", "{pack}", "no trained model"),
    ("find x.png --model {run} ", "--known x.parquet", "x.parquet: write it"),
    (PACKED, "--values text:N", "'hard'"),
    (PACKED, "--values united:N", "'3.2 mN'"),
    (PACKED, "--values endless:N", "'inf'"),
    (PACKED, "--values still:N", "'still'"),
    (PACKED, "--values farce:N", "did you mean 'force'"),
    (PACKED, "--labels force --values force:N", "'force'"),
    (PACKED, "--values =force:N", "give the columns one name"),
]


@pytest.mark.parametrize(("command", "words", "says"), WORDS)
def test_words(refused: Callable[..., str], tmp_path: Path, command: str, words: str, says: str) -> None:
    if command is PACKED:
        presses(tmp_path)
    refused(command + words, says)


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


# Every number of every config, found by reflection: a new field that checks nothing fails here until it does.

HARMLESS_IF_HUGE = {"log_every", "eval_every", "checkpoint_every", "touches"}  # they only mean "never" or "always"


def numbers(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, bool]]:
    """(option, annotation, whether only Python sets it) of every number in a config and the configs inside it."""
    hints, marked = (typing.get_type_hints(type(config), include_extras=more) for more in (False, True))
    for field in dataclasses.fields(config):
        value, kind = getattr(config, field.name), hints[field.name]
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{prefix}{field.name}.")
        elif kind in (int, float, int | None, float | None) or kind == tuple[float, float]:
            yield f"{prefix}{field.name}", kind, marked[field.name] != kind


def impossible(config: Any, start: str) -> Iterator[tuple[str, str]]:
    for name, kind, fixed in numbers(config):
        whole = int in (kind, *typing.get_args(kind))
        values = ["-1", "0.5"] if whole else ["-1", "nan", "inf"]
        if whole and name.split(".")[-1] not in HARMLESS_IF_HUGE:
            values.append("1" + "0" * 30)
        for value in values if not fixed else ():
            words = f"{value} {value}" if kind == tuple[float, float] else value
            yield f"{start} --{name.replace('_', '-')} {words}", name


FIELDS = [
    *impossible(replace(recipe("smoke", PackConfig(), phased=False), method=MViTacConfig()), PRETRAIN.strip()),
    *impossible(MaterialsConfig(), "data pack --data materials --out {out}"),
    *impossible(GraspsConfig(), "data pack --data grasps --out {out}"),
]


def test_impossible_numbers(refused: Callable[..., str]) -> None:
    assert {"optim.lr", "augment.vision.scale", "steps", "touches"} <= {name for _, name in FIELDS}
    for command, name in FIELDS:
        assert name.split(".")[-1] in refused(command).replace("-", "_"), command


def test_impossible_numbers_that_only_python_sets() -> None:
    run = recipe("smoke", PackConfig(), phased=False)
    fixed = [name for name, _, only_python in numbers(run) if only_python]
    assert {"optim.eps", "method.hidden", "augment.touch.jitter", "data.quality"} <= set(fixed)
    for name in fixed:
        record = to_json(run)
        forged_packs.put(*name.split("."), value=-1)(record)
        with pytest.raises(ValueError, match=name.split(".")[-1]):
            Run.load(record)


def leaves(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, (*path, key))
    else:
        yield path


def test_a_record_with_a_field_of_the_wrong_type(refused: Callable[..., str], finished: Path, tmp_path: Path) -> None:
    for leaf in leaves(to_json(recipe("smoke", PackConfig(), phased=False))):
        edited(Path(shutil.copy(finished / "run.json", tmp_path)), ("run", *leaf), {"surprise": 1})
        refused("pretrain --from {tmp}/run.json --out {out}", "run.json", leaf[-1])


def put(*keys: str, value: Any) -> Spoil:
    return lambda path: edited(path, keys, value)


def write(data: bytes | str) -> Spoil:
    return lambda path: path.write_bytes(data.encode() if isinstance(data, str) else data)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def within(name: str, spoil: Spoil) -> Spoil:
    return lambda path: spoil(path / name)


def cell(name: str, value: Any) -> Spoil:
    """samples.parquet with another value in row 5, consistently sealed."""

    def spoil(path: Path) -> None:
        columns = pq.read_table(path / "samples.parquet").to_pydict()
        columns[name][5] = value
        pq.write_table(pa.table(columns), path / "samples.parquet")
        seal(path)

    return spoil


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


INFO, PROBE = "data info {tmp}/p", "probe {tmp}/r"
AGAIN = "pretrain --from {tmp}/r/run.json --out {tmp}/r --resume --quiet"
REPEAT = "pretrain --from {tmp}/r/run.json --out {out} --quiet"
MODEL, CHECKPOINT = "model.safetensors", "checkpoint.pt"
DAMAGES = {"missing": Path.unlink, "empty": write(""), "cut": truncate, "foreign": write(bytes(range(256)) * 40)}
PACK_FILES = ("pack.json", "samples.parquet", "vision.npy", "touch.npy")

# A command, what is done to the copy of a pack or run, and what the message must hold.
FILES: list[tuple[str, Spoil, str]] = [
    *((INFO, within(name, spoil), name) for name in PACK_FILES for spoil in DAMAGES.values()),
    *((PROBE, within(MODEL, spoil), MODEL) for spoil in DAMAGES.values()),
    *((AGAIN, within(CHECKPOINT, spoil), CHECKPOINT) for name, spoil in DAMAGES.items() if name != "missing"),
    *((REPEAT, within("run.json", spoil), "run.json") for spoil in DAMAGES.values()),
    (INFO, described("format_version", value=99), "format 99"),
    (INFO, within("pack.json", write('{"name": "an npm package"}')), "does not describe a pack"),
    (INFO, within("pack.json", put("spec", "name", value="mine")), "digest"),
    (INFO, within("pack.json", write('{"name": "\\u001b[2J"}')), "control character"),
    (INFO, within("pack.json", write('{"name": "\\u202Ea"}')), "control character"),
    (INFO, within("pack.json", write('{"name": "C:\\\\\\bin"}')), "control character"),
    (INFO, within("pack.json", write('{"name": "C:\\\\bin"}')), "does not describe a pack"),
    (INFO, described("spec", "touch_channels", value=6), "touch.npy"),
    (INFO, described("spec", "controls", value={"x": ["force"]}), "'force'"),
    (INFO, cell("label_pattern", 3), "label_pattern"),
    (INFO, cell("split", "tests"), "did you mean 'test'"),
    (INFO, cell("group", None), "group"),
    (INFO, cell("id", "0000"), "twice"),
    (INFO, described("num", value=7), "samples.parquet cannot be used (it has"),
    ("probe {run} --on {tmp}/p", described("spec", "tasks", value=[]), "no labels"),
    (PROBE, bomb(MODEL, torch.save), MODEL),
    (PROBE, within(MODEL, write(safetensors.torch.save({"w": torch.ones(2)}))), "not written by mvitac"),
    (AGAIN, bomb(CHECKPOINT, pickle.dump), CHECKPOINT),
    (AGAIN + " --seed 4", lambda path: None, "different run"),
    (AGAIN, within("run.json", put("pack", value="0" * 64)), "different run"),
    (REPEAT, within("run.json", write("[" * 100_000)), "not valid JSON"),
    (REPEAT, within("run.json", put("run", "optim", "lrr", value=3)), "did you mean 'lr'"),
    (REPEAT, within("run.json", put("run", "data", "path", value="a\0b")), "control character"),
]


@pytest.mark.parametrize(("command", "spoil", "says"), FILES)
def test_files(
    refused: Callable[..., str], pack: Pack, finished: Path, tmp_path: Path, command: str, spoil: Spoil, says: str
) -> None:
    spoilt = "p" if "{tmp}/p" in command else "r"
    shutil.copytree(pack.path if spoilt == "p" else finished, tmp_path / spoilt)
    if command.startswith(AGAIN):
        (tmp_path / "r" / MODEL).unlink()
    spoil(tmp_path / spoilt)
    refused(command, says)
    assert not (tmp_path / "exploded").exists()


PLACES = {"{tmp}/file/below": "Not a directory", "{tmp}/" + "n" * 300: "too long"}
PLACES |= {"/proc/mvitac-out": "/proc/mvitac-out", "{tmp}/mine": "{tmp}/mine"}


@pytest.mark.parametrize("command", [PRETRAIN, "probe {run} --json {out}"])
@pytest.mark.parametrize(("out", "says"), PLACES.items(), ids=("below a file", "long name", "proc", "there"))
def test_a_place_nothing_can_be_written_to(
    refused: Callable[..., str], tmp_path: Path, command: str, out: str, says: str
) -> None:
    """It is noticed before anything is simulated, trained or probed, and what is there stays."""
    (tmp_path / "mine").mkdir()
    for name in ("file", "mine/thesis.tex"):
        (tmp_path / name).write_text("mine")
    refused(command.replace("{out}", out), says)


def test_contact_in_a_pack(refused: Callable[..., str], tmp_path: Path) -> None:
    for option in ("--contact 3", "--calibration 9", "--background x.png"):
        (tmp_path / "x.png").write_bytes(b"")
        refused(f"predict e {{pack}} {option} --out {{out}}", "--background, --calibration and --contact are for rec")
    refused("predict e {pack} --touch gel --out {out}", "--touch is for recordings and tables, /")


@pytest.mark.parametrize("command", ["demo --recipe smoke", "pretrain --data folder", "pretrain --data materials"])
def test_a_run_that_cannot_begin_makes_no_data(
    refused: Callable[..., str], command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(DatasetConfig, "open", None)
    for option, says in (
        ("--init nope", "init nope does not exist: give a finished run"),
        ("--encoder.weights nope", "weights 'nope': give imagenet, scratch, or a file that exists"),
        ("--device nope", "device 'nope' does not exist"),
    ):
        refused(f"{command} {option} --out {{out}}", says)


def test_an_option_given_twice(refused: Callable[..., str], finished: Path) -> None:
    for option, other in (("--tasks", "--tasks"), ("--allow-leak", "--allow_leak"), ("--folds", "--folds=3")):
        refused(f"probe {finished} {option} 2 {other} 3", f"{option} is given twice: give it once, with all its values")


def test_an_output_that_is_an_input(refused: Callable[..., str], finished: Path, tmp_path: Path) -> None:
    for name in ("model.safetensors", "run.json"):
        refused(f"probe {finished} --json {finished / name}", "may be what the command reads")
    refused(f"bench board {finished}/run.json --out {finished}/run.json", "may be what the command reads")
    (tmp_path / "mine").touch()
    refused(f"report {finished} --out {tmp_path}/mine", "mine is a file: give a folder")
    (finished / "policy.py").touch()
    (finished / "frames").mkdir(exist_ok=True)
    (frame := finished / "frames" / "3.png").write_bytes(b"0")
    for source in ("frames", "frames@30", "frames@30#0:0:9:9", "."):
        refused(f"predict e {finished}/{source} --out {frame}", "may be what the command reads")
    (table := frame.with_name("t.csv")).write_text("touch\nframes/3.png\n")
    refused(f"predict e {table} --out {frame}", "may be what the command reads")
    for name in ("look.png", "png"):  # beside a table, that of last time
        frame.with_name(name).touch()
        refused(f"predict e {table} --out {frame.with_name(name)}", "no trained model at e")
    pq.write_table(pa.table({"touch": ["../frames/3.png"]}), frame.with_name("t.parquet"))
    refused(f"data check {frame.with_name('t.parquet')} --sheet {frame}", "may be what the command reads")
    frame.with_name("bad.parquet").write_bytes(b"0")
    refused(f"data info {frame.with_name('bad.parquet')} --json {finished}/run.json", "no pack at")
    times, log = frame.with_name("press_timestamps.csv"), frame.with_name("press_force.csv")
    for name in (times, log):
        name.touch()
        refused(f"predict e press.mp4 --log {{}}_force.csv:stamp --out {name}", "may be what the command reads")
    refused("probe {run} --json {pack}/pack.json", "may be what the command reads")  # it was trained on
    refused("find x.png --model {run} --known k --json o.png --sheet ./o.png", "is the place of another output")
    (loop := tmp_path / "loop").symlink_to(loop)
    refused(f"probe {finished} --json {loop}", "cannot be written: Too many levels of symbolic links")
    refused(f"bench board {finished}/run.json --out {{tmp}}", "is a folder")
    refused("export {run} --out .", ". already exists: choose another place")
    (link := frame.with_name("link")).symlink_to(finished / "run.json")
    refused(f"probe {finished} --json {link}", "may be what the command reads")
    refused(f"find x.png --model {finished} --known k --sheet {finished}/pack.json", "give the name of a .png file")
    refused(f"ablate {finished}/policy.py:act --data a --json {finished}/policy.py", "may be what the command")


def fill_disk(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Files whose name holds ``name`` appear, but take no byte: /dev/full is the kernel's own full disk."""
    real = Path.open

    def opened(self: Path, mode: str = "r", *args: Any, **options: Any) -> Any:
        if name in self.name and (mode[0] in ("a" if name == "log.jsonl" else "wa") or "+" in mode):
            real(self, mode).close()
            return real(Path("/dev/full"), mode, *args, **options)
        return real(self, mode, *args, **options)

    monkeypatch.setattr(Path, "open", opened)


ONE_STEP = PRETRAIN + "--steps 1 --eval-every 0"


@pytest.mark.parametrize(
    ("name", "command", "left"),
    [
        ("touch.npy", SIMULATE + "--num 4", "out.partial"),
        ("samples.parquet", SIMULATE + "--num 4", "out.partial"),
        ("run.json", ONE_STEP, "out"),
        ("log.jsonl", ONE_STEP, "out"),
        (CHECKPOINT, ONE_STEP, "out"),
        (MODEL, ONE_STEP, "out"),
        ("scores.json", "probe {tmp}/r --probes knn --tasks pattern --json {tmp}/scores.json", "cache r/probe.json"),
    ],
)
def test_full_disk(
    refused: Callable[..., str], monkeypatch: Any, finished: Path, tmp_path: Path, name: str, command: str, left: str
) -> None:
    shutil.copytree(finished, tmp_path / "r")
    fill_disk(monkeypatch, name)
    refused(command, name, "No space left on device", left=tuple(left.split()), work=True)
    assert not (tmp_path / "out" / MODEL).exists() and not list(tmp_path.rglob("*.tmp"))
