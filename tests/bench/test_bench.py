"""The bench: one protocol for any encoder, results that cannot be changed unseen, and a page that compares them."""

import copy
import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import timm
import torch

from mvitac.bench import score, suite
from mvitac.bench.board import _page, gather, order_of, write_board
from mvitac.bench.check import problems
from mvitac.bench.encoder import About, describe, run_bench
from mvitac.bench.external import open_model
from mvitac.bench.result import FORMAT, pinned_of, read_result, records_of, suite_of
from mvitac.bench.score import Reader, misfit
from mvitac.bench.suite import find_suite, open_set, shipped
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.deploy.artifact import load
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.features import features
from mvitac.model import fresh
from mvitac.system.files import digest
from support.forged_packs import Change, changed, put, seal
from support.pages import drawings
from support.toy import toy_pack, with_columns

RANDOM = "external:timm/test_resnet,weights=random,size=32,seed={}"
SUITE = f"""
name = "toys"
title = "Striped pairs"
probes = ["linear"]
seed = 0
untrained = ["{RANDOM.format(0)}", "{RANDOM.format(1)}"]
imagenet = "external:timm/resnet18.tv_in1k"
[[sets]]
name = "stripes"
names = ["Toy Stripes"]
tasks = [
    {{ name = "pattern", modalities = ["touch", "both"], labels = [0.3] }},
    {{ name = "light", modalities = ["touch"], labels = [0.3] }},
]
[[sets.forms]]
name = "pack"
at = {{ path = "stripes" }}
data = {{ name = "pack" }}
[[sets]]
name = "folded"
folds = 3
tasks = [{{ name = "pattern", modalities = ["touch"] }}]
[[sets.forms]]
name = "clone"
at = {{ path = "clone" }}
data = {{ name = "pack" }}
[[sets.forms]]
name = "copy"
at = {{ path = "stripes" }}
data = {{ name = "pack" }}
[[sets]]
name = "elsewhere"
tasks = [{{ name = "pattern", modalities = ["vision"] }}]
[[sets.forms]]
name = "pack"
at = {{ path = "elsewhere" }}
data = {{ name = "pack" }}
"""
FORM = 'at = { path = "stripes" }\ndata = { name = "pack" }'
BOARD = Path(__file__).parents[2] / "benchmarks" / "board"
GOLDEN = {
    "calandra-v1": "b24a8cc3a08d",
    "real-small-v3": "ed90ebf14ff9",
    "sim-v3": "2135bfd84c32",
    "tag-v1": "21fc0c1cde16",
}
"""First digits of the digests. A definition that changes needs another name, or old results would be compared with new."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("bench")
    toy_pack(root / "stripes", values=True)
    (root / "toys.toml").write_text(SUITE)
    return root


@pytest.fixture(scope="module")
def results(root: Path, smoke_run: Path) -> list[Path]:
    toys, out = find_suite(str(root / "toys.toml")), root / "results"
    places = [str(smoke_run)], [RANDOM.format(5), RANDOM.format(6)]
    return [run_bench(place, toys, out, root, About()) for place in places]


def said(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line of an error of the command line, after progress."""
    assert main([str(word) for word in words]) == 2
    *progress, error = capsys.readouterr().err.splitlines()
    assert error.startswith("mvitac: error: ") and not any("rror" in line for line in progress)
    return error


def test_scores_are_those_of_probe(results: list[Path], smoke_run: Path, root: Path) -> None:
    block = (value := read_result(results[0]))["blocks"][0]
    found = {(r["source"], r["modality"], r["probe"]): r for r in records_of(block, value["encoder"])}
    asked = ProbeConfig(tasks=("pattern", "light"), modalities=("touch", "both"))
    expected = probe_runs([smoke_run], asked, Pack(root / "stripes"), allow_leak=True)["records"]
    name = value["encoder"]["name"]
    assert name == "mvitac (smoke, mvitac_tiny)"
    for record in expected:
        mine = {"mvitac": name, "noise only": "noise only"}.get(record["source"], record["source"])
        if record["task"] == "pattern" and record["source"] not in ("untrained", "imagenet"):
            given = found[mine, record["modality"], "linear"]
            assert given["group_correct"] == record["group_correct"] and given["accuracy"] == record["accuracy"]
    (force,) = (r for r in expected if r["task"] == "light" and r["source"] == "mvitac" and r["modality"] == "touch")
    (given, _) = (r for r in records_of(value["blocks"][1], value["encoder"]) if r["source"] == name)
    assert given["r2"] == pytest.approx(force["r2"], abs=1e-8)
    assert np.allclose(given["group_sums"]["error"], force["group_sums"]["error"])
    assert {r["seed"] for r in block["records"] if r["source"] == "untrained"} == {0, 1}
    few = found[name, "touch", "30 % of labels"]
    assert few["group_sizes"] == found[name, "touch", "linear"]["group_sizes"] and few["group_correct"]


def test_the_result_says_what_it_is_of(results: list[Path], smoke_run: Path) -> None:
    value = read_result(results[0])
    encoder, model = value["encoder"], load(smoke_run)
    assert encoder["images_seen"] == 8 * 16 and encoder["trained_on"] == "toy" and encoder["licence"] is None
    assert encoder["weights"] == [model.weights_digest()]
    assert encoder["parameters"]["touch"] == sum(p.numel() for p in model.encoders["touch"].parameters())
    assert "torch" in value["versions"] and "machine" in value["about"] and "time" in value["about"]
    assert not problems(value)
    by_hand = {key: part for key, part in json.loads(results[0].read_text()).items() if key not in ("digest", "about")}
    assert value["digest"] == digest(by_hand) and value["format"] == FORMAT
    other = read_result(results[1])["encoder"]
    assert other["parameters"]["touch"] == other["external"]["encoders"]["touch"]["parameters"]
    assert other["images_seen"] == 0 and other["trained_on"] == "nothing" and "random" in other["name"]
    assert other["seeds"] == [5, 6] and not problems(read_result(results[1]))
    assert not any(leak for block in read_result(results[1])["blocks"] for leak in block.get("leaks", ()))
    given = describe([model], [str(smoke_run)], About(name="mine", licence="MIT"))
    assert (given["name"], given["licence"]) == ("mine", "MIT")


def test_the_same_suite_twice_gives_the_same_digest_and_continues(
    results: list[Path], smoke_run: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toys, whole, done = find_suite(str(root / "toys.toml")), Reader.score, []

    def dying(self: Reader, *given: Any) -> Any:
        if given[3] == "" and len(done) == 2:
            raise KeyboardInterrupt
        done.extend([given[2].name] * (given[3] == ""))
        return whole(self, *given)

    monkeypatch.setattr(Reader, "score", dying)
    with pytest.raises(KeyboardInterrupt):
        run_bench([str(smoke_run)], toys, tmp_path, root, About())
    assert done == ["pattern", "light"] and not list(tmp_path.glob("*.json"))
    again: list[str] = []
    monkeypatch.setattr(Reader, "score", lambda self, *given: again.append(given[3]) or whole(self, *given))
    one, other, *_ = sorted((tmp_path / "parts").glob("controls-*"))
    kept = one.read_text()
    one.write_text(other.read_text())
    with pytest.raises(ValueError, match="it is of another task, data or encoder"):
        run_bench([str(smoke_run)], toys, tmp_path, root, About())
    one.write_text(kept)
    path = run_bench([str(smoke_run)], toys, tmp_path, root, About())
    assert again == [""]  # the third task; its controls were kept
    assert read_result(path)["digest"] == read_result(results[0])["digest"]
    assert {part.name.partition("-")[0] for part in (tmp_path / "parts").iterdir()} == {"controls"}


def test_controls_of_changed_data_are_redone(results: list[Path], smoke_run: Path, root: Path, tmp_path: Path) -> None:
    """A pack's digests of images and rows have no controls; a page does not mix both."""
    toys, out = find_suite(str(root / "toys.toml")), shutil.copytree(root, tmp_path / "root")
    pack = Pack(out / "stripes")
    pq.write_table(with_columns(pack, noise=pack.labels("pattern").astype(float)).table, pack.path / "samples.parquet")
    seal(pack.path)
    second = run_bench([str(smoke_run)], toys, out / "results", out, About(name="again"))
    told = [read_result(path)["blocks"] for path in (results[0], second)]
    noise = [[r["sums"] for r in blocks[0]["records"] if r["source"] == "noise only"] for blocks in told]
    assert told[0][0]["data"] == told[1][0]["data"] and noise[0] != noise[1]
    with pytest.raises(ValueError, match="the control noise only differs between"):
        gather({path.stem: read_result(path) for path in (results[0], second)})


def test_what_is_not_there_is_said(results: list[Path], root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blocks = read_result(results[0])["blocks"]
    assert blocks[3]["not_run"].endswith("elsewhere is not there") and blocks[2]["form"] == "copy"
    empty = "bench", RANDOM.format(0), "--suite", root / "toys.toml", "--out", root / "nothing"
    assert "was scored on no task of toys: no --data-root was given, where stripes would be" in said(capsys, *empty)
    assert not list((root / "nothing").glob("*.json"))


def test_imagenet_is_a_control_where_its_weights_are(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    toys = find_suite(str(root / "toys.toml"))
    run_bench([RANDOM.format(5)], toys, tmp_path / "without", root, About())
    assert "without the control imagenet: ImageNet weights of resnet18" in capsys.readouterr().err
    monkeypatch.setattr(score, "open_model", lambda text: open_model({toys.imagenet: RANDOM.format(9)}.get(text, text)))
    value = read_result(run_bench([RANDOM.format(5)], toys, tmp_path / "with", root, About()))
    found = {(r["modality"], r["probe"], r["seed"]) for r in value["blocks"][0]["records"] if r["source"] == "imagenet"}
    assert found == {(m, p, None) for m in ("touch", "both") for p in ("linear", "30 % of labels")}
    assert problems(value) == [] and "imagenet" in gather({value["encoder"]["name"]: value}).controls
    drop(value, source="imagenet", modality="both")
    assert problems(value)[0] == "stripes, pattern: lacks imagenet, both, 30 % of labels, None"


def test_folds_test_every_group_once(root: Path, results: list[Path]) -> None:
    opened = open_set(find_suite(str(root / "toys.toml")).sets[1], root)
    assert not isinstance(opened, str) and len(opened.packs) == 3
    tested = [set(view.column("group")[view.rows("test")].tolist()) for view in opened.packs]
    assert sum(map(len, tested)) == len(set().union(*tested)) == 60
    for view in opened.packs:
        sides = [set(view.column("group")[view.rows(side)].tolist()) for side in ("train", "val", "test")]
        assert all(sides) and not sides[0] & sides[2] and not sides[1] & sides[2]
    block = read_result(results[0])["blocks"][2]
    assert len(block["groups"]) == 60 and set(block["groups"]) == set().union(*tested)
    with pytest.raises(ValueError, match=r"has 60 labelled groups, the suite asks for 61 folds"):
        open_set(replace(find_suite(str(root / "toys.toml")).sets[1], folds=61), root)


def test_a_model_that_saw_the_test_groups_is_marked_and_not_ordered(results: list[Path], tmp_path: Path) -> None:
    read = {r["encoder"]["name"]: r for r in map(read_result, results)}
    blocks = next(iter(read.values()))["blocks"]
    assert blocks[0]["leaks"] == [""] and "72 of 120 test rows and 36 of 60 test instances" in blocks[2]["leaks"][0]
    board = gather(read)
    leaked, clean = list(read)
    alike = [(name, read[clean]) for name in ("one", "two")]
    assert gather(dict(alike)).encoders == gather(dict(alike[::-1])).encoders == ["one", "two"]
    text = {row.task: order_of(row, board.encoders) for row in board.rows}
    assert text["folded: pattern"].endswith(f"not ordered because of LEAK: {leaked}")
    other = read | {clean: {**read[clean], "blocks": [{**b, "form": "clone"} for b in read[clean]["blocks"]]}}
    forms = [row.task for row in gather(other).rows if row.task.startswith("folded")]
    assert forms == ["folded: pattern (copy)", "folded: pattern (clone)"]  # scores of two forms are not compared
    assert leaked in text["stripes: light"] and "LEAK" not in text["stripes: light"]
    page = write_board(results, tmp_path / "board.html").read_text()
    assert "Few labels" in page
    assert "Few labels" not in _page(replace(board, rows=[row for row in board.rows if not row.few]))
    (drawn,) = drawings(page)
    assert len(re.findall(r">\d+L<", drawn)) == len([row for row in board.rows if row.task == "folded: pattern"])
    assert "LEAK: 72 of 120 test rows" in page and " LEAK</td>" in page.replace("\xa0", " ")
    assert "none found" in page and clean in page


def test_the_board(results: list[Path], tmp_path: Path) -> None:
    assert main(["bench", "board", *map(str, results), "--out", str(tmp_path / "board.html")]) == 0
    page = (tmp_path / "board.html").read_text()
    board = gather({r["encoder"]["name"]: r for r in map(read_result, results)})
    assert board.controls == ["majority or mean", "noise only", "border", "pixels", "untrained"]
    table = page[page.index("<table") :]
    assert table.index(f">{board.encoders[0]}<") < table.index(">untrained<") < table.index(">majority or mean<")
    for text in ("stripes: pattern", "12 test instances", "touch, R2", "2 tasks that were not run", "levels", "30"):
        assert text in page, text
    (drawn,) = drawings(page)
    assert len(re.findall(r">-?\d+L?<", drawn)) == sum(len(row.cells) for row in board.rows)
    assert "30 % of labels" in page.replace("\xa0", " ")
    assert "≈" in page and "<script" not in page and "http" not in page.replace("http-equiv", "")
    (light,) = (row for row in board.rows if row.task == "stripes: light")
    first, *_ = sorted(board.results, key=lambda name: -light.cells[name]["mean"])
    assert order_of(light, board.encoders).startswith(f"{first} ")


def drop(value: dict[str, Any], **about: Any) -> None:
    for block in (block for block in value["blocks"] if "records" in block):
        block["records"] = [r for r in block["records"] if any(r.get(name) != wanted for name, wanted in about.items())]


def all_right(value: dict[str, Any]) -> None:
    record = next(r for r in value["blocks"][0]["records"] if r["source"] == "majority")
    record["sums"]["correct"] = record["sums"]["n"]


def worse_mean(factor: float, folds: int, value: dict[str, Any]) -> None:
    """Errors ``factor`` times as large, which no answer of a fold has."""
    value["suite"]["sets"][0]["folds"] = folds
    value["suite_digest"] = suite_of(value).digest()
    sums = next(r["sums"] for r in value["blocks"][1]["records"] if r["source"] == "mean")
    for name, times in (("error", factor), ("squared_error", factor**2)):
        sums[name] = [[times * x for x in each] for each in sums[name]]


def other_share(value: dict[str, Any]) -> None:
    """A probe on all labels has the sums of one on few, in one control."""
    records = [record for record in value["blocks"][1]["records"] if record["source"] == "untrained"]
    few, linear = (next(r for r in records if (r["seed"], r["probe"]) == (0, kind)) for kind in (FEW, "linear"))
    linear["sums"] = few["sums"]


def best_seed(value: dict[str, Any]) -> None:
    """A second seed, which is another in classes, has the first one's values."""
    value["encoder"]["seeds"], value["encoder"]["weights"] = [0, 1], [value["encoder"]["weights"][0], "0" * 64]
    for block in (block for block in value["blocks"] if "records" in block):
        block["leaks"] *= 2
        again = [{**copy.deepcopy(record), "seed": 1} for record in block["records"] if not record["source"]]
        for record in again if block["task"] == "pattern" else ():
            record["sums"]["correct"][0] = 1 - min(1, record["sums"]["correct"][0])
        block["records"] += again


def copied(to: str, of: str, value: dict[str, Any], names: Sequence[str] = ("sums", "clipped")) -> None:
    """The values of one source, in its last seed, are those that another one says in its first."""
    records = value["blocks"][1]["records"]
    one, other = (next(r for r in some if r["source"] == s) for some, s in ((records[::-1], to), (records, of)))
    one |= {name: other[name] for name in names if name in other}


def other_unit(value: dict[str, Any]) -> None:
    """Values a thousand times as large, alike in each group, errors as they were: all R2 are 100 %."""
    for sums in (record["sums"] for record in value["blocks"][1]["records"]):
        sums["value"] = [[1e3 * x for x in each] for each in sums["value"]]
        sums["squared_value"] = (np.square(sums["value"]) / np.maximum(sums["n"], 1)).tolist()


def simulated_values(value: dict[str, Any]) -> None:
    value["suite"]["sets"][0]["tasks"][1]["name"] = value["blocks"][1]["task"] = "force"
    own_data({"name": "materials"}, value)


def own_data(data: dict[str, Any], value: dict[str, Any]) -> None:
    form = value["suite"]["sets"][0]["forms"][0]
    form |= {"data": data, "at": form["at"] if data["name"] == "folder" else {}}
    value["suite_digest"] = suite_of(value).digest()


def not_run(block: dict[str, Any], why: str = "no time") -> None:
    for key in block.keys() - {"set", "task"}:
        del block[key]
    block["not_run"] = why


def no_vision(value: dict[str, Any]) -> None:
    """All of the encoder's records with vision are gone, which it says that it reads."""
    drop(value, source="", modality="both")
    value["blocks"][0]["left_out"] = {"both": "x"}


def other_frames(value: dict[str, Any]) -> None:
    """A set is left out as if the run took windows, in which it scored another set's single frames."""
    for block in value["blocks"][:2]:
        not_run(block, "the encoder takes windows of 3 frames, the data has single ones")


def simulated(value: dict[str, Any]) -> None:
    value["suite"]["sets"][2]["forms"][0]["at"] = {}
    value["suite_digest"] = suite_of(value).digest()


def no_touch(value: dict[str, Any]) -> None:
    """One task is left out, as if the encoder had no touch, which other tasks have scores of."""
    for about in ("parameters", "features"):
        del value["encoder"][about]["touch"]
    not_run(value["blocks"][1], NO_TOUCH)


RECORDS, VALUES = ("blocks", 0, "records"), ("blocks", 1, "records", 0)
MORE_CORRECT = put(*RECORDS, 0, "sums", "correct", 0, value=1000)
LUMEN, WIDTH = ({"name": "folder"} | own for own in ({"values": ["light=lumen:lm"]}, {"controls": ["width = w,h"]}))
FEW, NO_VISION, NO_TOUCH = "30 % of labels", "the encoder has no vision", "the encoder has no touch"


def untrained_as(known: Callable[..., bool], value: dict[str, Any]) -> None:
    """Give each record of an untrained trunk the sums of the first that it is ``known`` by."""
    for records in (block.get("records", ()) for block in value["blocks"]):
        for record in (r for r in records if r["source"] == "untrained"):
            record["sums"] = next(r["sums"] for r in records if known(r, record))


def twin(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return all(one[key] == other[key] for key in ("source", "modality", "probe"))


FORGED: dict[str, tuple[Change, str]] = {
    "correct": (MORE_CORRECT, "more correct rows than rows"),
    "negative squares": (put(*VALUES, "sums", "squared_error", 0, 0, value=-1.0), "squared errors are smaller"),
    "large squares": (put(*VALUES, "sums", "squared_error", 0, 0, value=1e9), "squared errors are smaller or larger"),
    "unit": (put(*VALUES, "targets", 0, 1, value="kN"), "is scored on other rows"),
    "data": (put("blocks", 1, "data", "rows", value="0" * 64), "its data or groups are not those of the set's other"),
    "groups": (put("blocks", 1, "group_by", value="frame"), "its data or groups are not those of the set's other"),
    "licence": (put("encoder", "licence", value={}), "licence is no text"),
    "infinity": (put(*VALUES, "sums", "error", 0, 0, value=1e999), "is not finite"),
    "no sums": (put(*RECORDS, 0, "sums", value={}), "its sums"),
    "hidden score": (put(*RECORDS, 0, "task", value="light"), "its fields are"),
    "rows": (put(*RECORDS, 0, "sums", "n", value=lambda sizes: [2 * n for n in sizes]), "is scored on other rows"),
    "weights twice": (put("encoder", value=lambda e: e | {"seeds": [0, 1], "weights": 2 * e["weights"]}), "has 1 wei"),
    "group twice": (put("blocks", 0, "groups", value=lambda names: [*names[:-1], names[0]]), "a group is there twice"),
    "field": (put("mine", value=1), "has the unknown field 'mine'"),
    "field about": (put("about", "mine", value=1), "has the unknown field 'mine'"),
    "field of a block": (put("blocks", 0, "mine", value=1), "has the unknown field 'mine'"),
    "field of the encoder": (put("encoder", "mine", value=1), "has the unknown field 'mine'"),
    "field of the network": (put("encoder", "external", value={"mine": 1}), "has the unknown field 'mine'"),
    "no imagenet": (lambda value: value["blocks"][1].pop("notes"), "lacks imagenet, touch, "),
    "a truth for a count": (put(*RECORDS, 0, "sums", "correct", 0, value=True), "its sums are no numbers"),
    "all guesses right": (all_right, "one answer is right for all rows"),
    "a worse mean": (partial(worse_mean, 3, 0), "its errors are not those of one answer$"),
    "another share of labels": (other_share, "light: touch, untrained, .* has the sums of linear"),
    "best seed": (best_seed, "the encoder by touch: seeds 0 and 1 have the same values in some tasks"),
    "a mean of folds": (partial(worse_mean, 1.02, 3), "its errors are not those of one answer per fold"),
    "a mean of a group": (partial(worse_mean, 9, 99), "its errors are not those of one answer per fold"),
    "a better mean": (partial(worse_mean, 0.02, 99), "its errors are not those of one answer per fold"),
    "values of pixels": (partial(copied, "", "pixels"), "light: touch, the encoder, .* has the sums of touch"),
    "controls alike": (partial(copied, "border", "pixels"), "touch, .*, linear, seed None: has the sums of touch, "),
    "a control knows nothing": (partial(copied, "untrained", "mean"), "untrained, .* has the sums of mean"),
    "sums of a network": (partial(copied, "", "untrained", names=["sums"]), "the encoder, .*, seed 0: has"),
    "seeds alike": (partial(copied, "untrained", "untrained"), "untrained, linear, seed 0: has the sums of"),
    "no unit": (put(*VALUES, "targets", value=[["light"]]), "not names and units"),
    "other seed": (put("encoder", "external", value={"seed": 9}), "its network is of other seeds, weights or senses"),
    "no licence": (lambda value: value["encoder"].pop("licence"), r"a\.json is damaged: .*'licence'"),
    "leaks by name": (put("blocks", 0, "leaks", value={"a": 1}), "a leak mark, a note, a group or what"),
    "rows in floats": (put(*RECORDS, 0, "sums", "n", 0, value=float), "its sums are no numbers"),
    "no features": (put("encoder", "features", value={}), "its features and parameters are of other senses"),
    "unit of the suite": (partial(own_data, LUMEN), r"its values are .*, those of the suite \[\['lumen', 'lm'\]\]"),
    "errors in another unit": (other_unit, "its errors are not those of one answer"),
    "control of the data": (partial(own_data, WIDTH), "lacks width, none, linear, None"),
    "values of simulated data": (simulated_values, r"its values are .*, those of the suite \[\['force_n', 'N'\]\]"),
    "control of simulated data": (partial(own_data, {"name": "grasps"}), "lacks contact only, none, linear"),
    "note": (put("blocks", 0, "notes", value=[5]), "a leak mark, a note, a group or what groups are is no text"),
    "clipped of what": (put(*VALUES, "clipped", value=[9]), r"it says that \[9\] features were clipped"),
    "features": (put("encoder", "features", "touch", value=-64), "touch is -64"),
    "clipped": (put(*VALUES, "clipped", value=[9, 4]), r"it says that \[9, 4\] features were clipped"),
    "excuse": (put("blocks", 0, "left_out", value={"vision": NO_VISION}), NO_VISION),
    "excuse of a lost encoder": (no_touch, f"stripes, light: touch cannot be left out because {NO_TOUCH}"),
    "no reason": (no_vision, "stripes, pattern: both cannot be left out because x"),
    "no reason for a task": (lambda value: not_run(value["blocks"][1]), "touch cannot be left out because no time"),
    "untrue of a set": (lambda value: not_run(value["blocks"][1], "the encoder takes"), "light: touch cannot be left"),
    "windows of a set": (other_frames, "pattern: touch and both cannot be left out because the encoder takes windows"),
    "weights of no digest": (put("encoder", "weights", value=[1]), "a digest of weights is none"),
    "no versions": (put("versions", value=None), "its versions are no texts"),
    "simulated": (simulated, "elsewhere, pattern: vision cannot be left out because .*elsewhere is not there"),
    "group by": (lambda value: value["blocks"][0].pop("group_by"), "a leak mark, a note, a group or what"),
    "nothing": (lambda value: [not_run(block) for block in value["blocks"]], "was run on no task"),
    "twice": (put(*RECORDS, value=lambda records: [*records, records[0]]), "is there twice"),
    "modality": (lambda value: drop(value, source="", modality="both"), f"lacks the encoder, both, {FEW}, 0"),
    "control": (lambda value: drop(value, source="pixels"), "lacks pixels, both, linear, None"),
    "seed of a control": (lambda value: drop(value, source="untrained", seed=1), "lacks untrained, both, 30 %"),
    "other control": (put(*RECORDS, value=lambda all: [*all, {**all[0], "source": "mine"}]), "has too much of mine"),
    "task": (lambda value: value["blocks"].pop(3), "the suite asks for"),
    "same name": (put("encoder", "name", value=" Untrained"), "the name of a control, ' Untrained'"),
    "no name": (put("encoder", "name", value="a "), "has the name 'a '"),
    "images": (put("encoder", "images_seen", value=-5), "images_seen is -5"),
    "parameters": (put("encoder", "parameters", "touch", value=float("nan")), "touch is nan"),
    "a text for a number": (put("encoder", "size", value="32"), "size is 32"),
    "form": (put("blocks", 0, "form", value="mine"), "the suite has no form 'mine'"),
    "twins": (partial(untrained_as, twin), "untrained has the same sums in every record of seeds 0 and 1"),
    "true for a number": (put("encoder", "images_seen", value=True), "images_seen is True"),
}


@pytest.mark.parametrize("kind", FORGED)
def test_forgery_is_refused(kind: str, results: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, words = FORGED[kind]
    forged = changed(results[0], tmp_path / "a.json", change)
    for command in ("check", "board"):
        assert re.search(words, said(capsys, "bench", command, forged)), command


def more_spread(value: dict[str, Any]) -> None:
    for record in value["blocks"][1]["records"]:
        for name in ("value", "error") if record["source"] == "mean" else ("value",):
            for sums, by in ((name, 2), (f"squared_{name}", 4)):
                record["sums"][sums] = [[by * x for x in each] for each in record["sums"][sums]]


def blind_pixels(value: dict[str, Any]) -> None:
    for record in (r for r in value["blocks"][0]["records"] if r["source"] == "pixels"):
        record["sums"]["correct"] = [0] * len(record["sums"]["n"])


def test_rows_and_leaks_are_compared(results: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    forged = changed(results[1], tmp_path / "a.json", more_spread)
    assert main(["bench", "check", str(forged)]) == 0
    assert "the control mean differs between" in said(capsys, "bench", "board", results[0], forged)
    nothing = partial(untrained_as, lambda a, b: a is b if "targets" in b else a["modality"] == "none")
    assert main(["bench", "check", str(changed(results[1], tmp_path / "a.json", nothing))]) == 0
    forged = changed(results[1], tmp_path / "a.json", blind_pixels)
    assert main(["bench", "check", str(forged)]) == 0
    shown = write_board([results[0], forged], tmp_path / "x.html").read_text().split("tasks that were not run")[0]
    assert "pattern: pixels of the result of " in shown and "differ from those shown" in shown
    forged = changed(results[1], tmp_path / "a.json", put("encoder", "trained_on", value="ImageNet; toy stripes"))
    assert "its marks of leaks are not those of data trained on, Image" in said(capsys, "bench", "check", forged)


def test_names_in_results_are_text(results: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    title = put("encoder", "name", value="\x1b]0;owned\x07")
    error = said(capsys, "bench", "check", changed(results[0], tmp_path / "b.json", title))
    assert "control character" in error and "\x1b" not in error
    file = changed(results[0], tmp_path / "a.json", put("encoder", "name", value="<img src=http://198.51.100.7>"))
    page = write_board([file], tmp_path / "x.html").read_text()
    assert "&lt;img src" in page and "<img src=http" not in page


def test_a_changed_result_is_refused(results: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "check", *map(str, results)]) == 0 and "are those of its sums" in capsys.readouterr().out
    bad = changed(results[0], tmp_path / "a.json", MORE_CORRECT, signed=False)
    for command in ("check", "board"):
        assert "does not match its digest" in said(capsys, "bench", command, bad)
    (tmp_path / "g.json").write_text('{"format": "else"}')
    assert "is not a result of the bench" in said(capsys, "bench", "board", tmp_path / "g.json")


def test_data_other_than_that_of_its_pins_is_refused(
    results: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pins are those of the suite that this version has, whatever a file says."""
    rows = {block["set"]: block["data"]["rows"] for block in read_result(results[0])["blocks"] if "data" in block}
    text = SUITE.replace(FORM, f'{FORM}\npins = {{ rows = "{rows["stripes"]}" }}', 1)
    monkeypatch.setattr(suite, "SUITES", tmp_path)
    (tmp_path / "toys.toml").write_text(text)
    value = read_result(results[0])
    assert pinned_of(suite_of(value), value["blocks"][0]) == "other pixels" and problems(value) == []

    def own_pins(value: dict[str, Any]) -> None:
        value["blocks"][0]["data"] = {**value["blocks"][2]["data"], "rows": rows["folded"]}
        value["suite"]["sets"][0]["forms"][0]["pins"] = value["blocks"][0]["data"]

    forged = changed(results[0], tmp_path / "b.json", own_pins)
    assert "other rows, labels or splits than the suite" in said(capsys, "bench", "check", forged)


def test_an_encoder_of_one_sense_says_which_it_lacks(root: Path, tmp_path: Path) -> None:
    text = f"{RANDOM.format(7)},reads=touch"
    value = read_result(run_bench([text], find_suite(str(root / "toys.toml")), tmp_path, root, About()))
    assert value["blocks"][0]["left_out"] == {"both": "the encoder has no vision"} and problems(value) == []
    board = gather({value["encoder"]["name"]: value})
    assert any("pattern, both" in line and "the encoder has no vision" in line for line in board.not_run)


def test_results_of_other_suites_are_refused(
    results: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    older = changed(results[0], tmp_path / "a.json", put("suite", "seed", value=1))
    assert "does not have the digest" in said(capsys, "bench", "check", older)

    def resigned(value: dict[str, Any], **fields: str) -> None:
        value["suite"] |= {"seed": 1, **fields}
        value["suite_digest"] = suite.from_json(suite.Suite, value["suite"], "suite").digest()

    other = changed(results[1], tmp_path / "b.json", resigned)
    assert "is of another suite" in said(capsys, "bench", "board", results[0], other)
    assert "bench one of them with --name" in said(capsys, "bench", "board", results[0], results[0])
    old = changed(results[1], tmp_path / "old.json", partial(resigned, name="sim-v1"))
    says = "is of another sim-v1 than sim-v3 of this version: run the bench again"
    assert says in said(capsys, "bench", "check", old)
    monkeypatch.setattr(suite, "SUITES", tmp_path)
    (tmp_path / "toys.toml").write_text(SUITE)
    assert main(["bench", "check", str(results[0])]) == 0
    capsys.readouterr()
    (tmp_path / "toys.toml").write_text(SUITE.replace("seed = 0\nuntrained", "seed = 7\nuntrained"))
    assert "is of another toys than toys of this" in said(capsys, "bench", "check", results[0])


def test_encoders_are_refused(smoke_run: Path, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, spec = (model := load(smoke_run)).run, model.spec
    bench = "--suite", root / "toys.toml", "--data-root", root, "--out", tmp_path / "out"
    broken = shutil.copytree(smoke_run, tmp_path / "nan")
    with torch.no_grad():
        next(model.encoders["touch"].parameters()).fill_(float("nan"))
    model.save(broken / "model.safetensors")
    assert "gives NaN or infinite features of touch for 120 of 120 images" in said(capsys, "bench", broken, *bench)
    (tmp_path / "six").mkdir()
    fresh(run, replace(spec, touch_channels=6, vision_channels=0), 32).save(tmp_path / "six" / "model.safetensors")
    assert "takes 6 channels of touch, the data has 3" in said(capsys, "bench", tmp_path / "six", *bench)
    assert not list((tmp_path / "out").glob("*.json"))
    window, difference = replace(spec.window, frames=3), fresh(run, replace(spec, difference=True), 32)
    pack = Pack(root / "stripes")
    assert "windows of 3 frames" in misfit(fresh(run, replace(spec, window=window), 32), pack, "touch")
    assert "minus its background" in misfit(difference, pack, "touch") and not misfit(difference, pack, "vision")


def test_another_encoder_does_not_replace_a_result(results: list[Path], root: Path, smoke_run: Path) -> None:
    toys, name = find_suite(str(root / "toys.toml")), read_result(results[0])["encoder"]["name"]
    with pytest.raises(ValueError, match=r"is the result of .*, weights "):
        run_bench([RANDOM.format(6)], toys, results[0].parent, root, About(name=name))
    with pytest.raises(ValueError, match=r"is the result of .*, weights "):
        run_bench([str(smoke_run)], toys, results[0].parent, root, About(name=name.replace(" ", "-")))
    changed(results[0], root / results[0].name, put("blocks", 0, "data", "rows", value="0" * 64))
    with pytest.raises(ValueError, match="is the result on other data of stripes: move it"):
        run_bench([str(smoke_run)], toys, root, root, About())
    changed(results[0], root / results[0].name, put("blocks", 0, "task", value="left"))
    with pytest.raises(ValueError, match="is the result on stripes: left, which is not run now: move it"):
        run_bench([str(smoke_run)], toys, root, root, About())
    with pytest.raises(ValueError, match="is the result of another suite 'toys'"):
        run_bench([str(smoke_run)], replace(toys, seed=toys.seed + 1), results[0].parent, root, About())
    with pytest.raises(ValueError, match="not seeds of one encoder"):
        run_bench([RANDOM.format(6), RANDOM.format(6)], toys, results[0].parent, root, About())
    torch.save(timm.create_model("test_resnet").state_dict(), root / "w.pth")
    same = [f"external:timm/test_resnet,weights={root}/w.pth,size=32,seed={seed}" for seed in (0, 1)]
    with pytest.raises(ValueError, match="not seeds of one encoder"):
        run_bench(same, toys, results[0].parent, root, About())


def test_stacked_gels_one_by_one(tmp_path: Path, smoke_run: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy_pack(tmp_path / "stripes", touch_channels=6)
    opened = open_set(find_suite(str(root / "toys.toml")).sets[1], tmp_path)
    assert not isinstance(opened, str)
    model, pack, rows = load(smoke_run), opened.packs[0], np.array([0, 5, 9])
    found = Reader(model, opened, "x").read("touch", rows)
    images = torch.from_numpy(pack.images["touch"][rows]).permute(0, 3, 1, 2)
    expected = torch.cat([model.features("touch", images[:, :3]), model.features("touch", images[:, 3:])], dim=1)
    assert np.allclose(found, expected.numpy(), atol=1e-5)
    left, right = (features(model, view, "touch", rows) for view in score.sensors(pack, "touch", 3))
    assert not np.allclose(left, right)
    monkeypatch.chdir(tmp_path)
    about = 'import torch\n\ndef pairs():\n    return torch.nn.Conv2d(6, 5, 4, 4), {"size": 16, "frames": 2}\n'
    (tmp_path / "frames_here.py").write_text(about)
    (note,) = Reader(load("external:python:frames_here:pairs"), opened, "x").notes
    assert "the current frame is repeated" in note and Reader(model, opened, "x").notes == []


def test_data_is_compared_with_the_pins(root: Path) -> None:
    one = find_suite(str(root / "toys.toml")).sets[0]
    opened = open_set(one, root)
    assert not isinstance(opened, str) and set(opened.digests) == {"rows", "touch", "vision"}
    (form,) = one.forms
    same, pixels, rows = (replace(form, pins={**opened.digests, **new}) for new in ({}, {"touch": "0"}, {"rows": "0"}))
    found = [suite.pinned(f, opened.digests) for f in (form, same, pixels, rows, replace(form, pins={"touch": "0"}))]
    assert found == ["not pinned", "same", "other pixels", "other rows", "other rows"]
    with pytest.raises(ValueError, match="other rows, labels or splits than the suite"):
        open_set(replace(one, forms=(rows,)), root)
    made = replace(rows, at={}, data={**form.data, "path": str(root / "stripes")})  # as another processor makes it
    assert not isinstance(open_set(replace(one, forms=(made,)), None), str)


def test_shipped_suites_keep_their_definitions() -> None:
    found = {name: find_suite(name) for name in shipped()}
    assert {name: one.name for name, one in found.items()} == {name: name for name in GOLDEN}
    assert {name: one.digest()[:12] for name, one in found.items()} == GOLDEN
    sim = found["sim-v3"]
    without = replace(sim, sets=tuple(replace(s, forms=tuple(replace(f, pins={}) for f in s.forms)) for s in sim.sets))
    assert without.digest() == sim.digest() and replace(sim, seed=1).digest() != sim.digest()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name = ", "is not a suite"),
        (SUITE.replace('"toys"', '" "'), "the suite has no name"),
        (SUITE.replace(FORM, f'{FORM}\npins = {{ rows = "0" }}', 1), "form 'pack' has pins, .* leave them out"),
        (SUITE.replace("title = ", r'title = "\u0007" #', 1), "is not a suite .control character"),
        (SUITE.replace('"folded"', '"stripes"'), "of stripes, stripes, elsewhere one is there twice"),
        (SUITE.replace("labels = [0.3]", "labels = [0.3, 0.3]"), "'pattern': give touch, vision or both, and nothing"),
        (SUITE.replace('"toys"', '"sim-v1"'), "sim-v3 of this version is another suite: give it another name"),
        (SUITE.replace(RANDOM.format(1), RANDOM.format(1) + ",reads=touch"), "which reads both"),
        (SUITE.replace('"clone" }', '"../clone" }', 1), "not a place below --data-root"),
        (SUITE.replace('name = "pack" }', 'name = "pack", path = "/etc" }', 1), "names a place in 'path'"),
        (SUITE.replace('name = "pack" }', 'name = "folder", log = ["../log.csv:t"] }', 1), "is not a place below"),
        ("a = " + "[" * 5000, "too many brackets"),
        (SUITE.replace(FORM, 'data = { name = "mix", parts = ["/a", "/b"] }', 1), "a place in 'parts'"),
        (SUITE.replace(RANDOM.format(0), "external:python:antigravity:fly"), "weights=random, which"),
        (SUITE.replace("external:timm/resnet18.tv_in1k", RANDOM.format(1)), "give external:timm/NAME"),
        (SUITE.replace("folds = 3", "folds = -3"), "folds -3: give 2 or more"),
        (SUITE.replace('probes = ["linear"]', 'probes = ["paper"]'), "needs linear or knn"),
        (SUITE.replace("labels = [0.3]", "labels = [nan]"), "task 'pattern': labels nan: give fractions above 0"),
        (SUITE.replace("labels = [0.3]", "labels = [0.3, 0.30000001]"), "nothing twice"),
    ],
)
def test_suites_that_are_wrong(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "suite.toml").write_text(text)
    with pytest.raises(ValueError, match=expected):
        find_suite(str(tmp_path / "suite.toml"))


@pytest.mark.parametrize("path", sorted(BOARD.rglob("*.json")), ids=lambda path: path.stem)
def test_results_in_the_repository(path: Path) -> None:
    value = read_result(path)
    assert problems(value) == [] and path.parent.name == value["suite"]["name"] and path.stat().st_size < 400_000
