"""Two packs as one: learned from is the one's train, scored the other's test, and nothing leaks between them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.several import JoinedPack
from mvitac.data.source import Sample
from mvitac.data.spec import Task
from mvitac.training.loop import train
from support.toy import Toy, altered, toy_pack
from support.training_runs import smoke

ELSEWHERE = {"train": "test", "test": "train", "val": "train"}
"""Splits in which other groups are test."""


@pytest.fixture(scope="module")
def negative(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    """The toy under another sensor, whose touch is inverted and whose classes are numbered otherwise."""
    task = replace(Toy().spec().tasks[0], classes=("checks", "columns", "rows"))

    def change(sample: Sample, _: int) -> dict[str, Any]:
        label = (sample.columns["label_pattern"] + 1) % 3
        return {"touch": 255 - sample.touch, "has_touch": True, "label_pattern": label, "label_bright": None}  # type: ignore

    source = altered(Toy(), change, name="negative", tasks=(task,), controls={})
    return build(source, tmp_path_factory.mktemp("negative") / "p", size=32, quiet=True)


def test_train_is_of_the_one_and_test_of_the_other(pack: Pack, negative: Pack) -> None:
    both = JoinedPack(pack, negative)
    np.testing.assert_array_equal(both.rows("train", "val"), pack.rows("train", "val"))
    np.testing.assert_array_equal(both.rows("test"), pack.num + negative.rows("test"))
    assert both.num == pack.num + negative.num == len(both.column("id")) == len(set(both.column("id")))
    rows = np.array([pack.num + 3, 5, pack.num, 5])
    for modality in ("vision", "touch"):
        images = [negative.images[modality][3], pack.images[modality][5], negative.images[modality][0]]
        np.testing.assert_array_equal(both.images[modality][rows], [*images, images[1]])
    assert [task.name for task in both.spec.tasks] == ["pattern"]
    assert both.spec.tasks[0].classes == pack.spec.tasks[0].classes
    np.testing.assert_array_equal(both.labels("pattern"), np.tile(pack.labels("pattern"), 2), "classes go by name")
    assert both.has("touch").all() and not both.spec.controls
    assert both.spec.name == f"{negative.path.name}, probes learned on {pack.path.name}"
    assert both.digest not in (pack.digest, negative.digest) and JoinedPack(negative, pack).digest != both.digest


@pytest.mark.parametrize("column", ["sensor", "lamp", "phase"])
def test_columns_matter_that_probes_read(tmp_path: Path, column: str) -> None:
    """A name here, a number there: of no matter in a column beside, and text in one that says what a task is about."""
    task = replace(Toy().spec().tasks[0], only={"phase": "during"} if column == "phase" else {})
    packs = []
    for name, mark in (("a", "during"), ("b", 3)):
        source = altered(Toy(), lambda *_, mark=mark: {column: mark}, tasks=(task,))
        packs.append(build(source, tmp_path / name, size=32, quiet=True))
    if column == "sensor":  # text on both sides
        assert JoinedPack(*packs).sensor_names == ("3", "during")
    elif column == "lamp":
        assert "lamp" not in JoinedPack(*packs).table.column_names
    else:
        joined = JoinedPack(*packs)
        assert (joined.labels("pattern")[packs[0].num :] == -1).all() and (joined.labels("pattern") >= 0).any()
        with pytest.raises(ValueError, match=r"task 'pattern' has rows phase=during in .*, all in"):
            JoinedPack(packs[0], toy_pack(tmp_path / "c"))


def test_what_cannot_be_compared_is_refused(pack: Pack, tmp_path: Path) -> None:
    def elsewhere(sample: Sample, _: int) -> dict[str, str]:
        return {"split": ELSEWHERE[sample.columns["split"]]}

    def renamed(sample: Sample, _: int) -> dict[str, int]:
        return {f"label_other {name}": sample.columns[f"label_{name}"] for name in ("pattern", "bright")}

    tasks = tuple(replace(task, name=f"other {task.name}") for task in Toy().spec().tasks)
    cases: dict[str, Toy] = {
        r"instance '.*' is learned from in .* and scored in .*, one of \d+": altered(Toy(), elsewhere),
        "no task is in both packs: .* has pattern, bright, .* other pattern": altered(Toy(), renamed, tasks=tasks),
        "class of pattern.*waves": altered(Toy(), tasks=(Task(name="pattern", classes=("columns", "rows", "waves")),)),
    }
    for number, (says, source) in enumerate(cases.items()):
        with pytest.raises(ValueError, match=says):
            JoinedPack(pack, build(source, tmp_path / str(number), size=32, quiet=True))
    with pytest.raises(ValueError, match=r"vision: 3 channels at 32 px in .*, 3 channels at 24 px in"):
        JoinedPack(pack, toy_pack(tmp_path / "small", size=24))
    with pytest.raises(ValueError, match=r"touch: 3 channels at 24 px"):  # not the vision that both lack
        JoinedPack(*(toy_pack(tmp_path / f"touch{size}", size=size, vision_channels=0) for size in (24, 32)))


def test_an_image_that_is_learned_from_and_scored_is_refused(pack: Pack, tmp_path: Path) -> None:
    """Under other names, with another photo, and every row its own group."""

    def change(sample: Sample, item: int) -> dict[str, Any]:
        names = {"id": f"new {item}", "group": f"{item + 1}", "split": ELSEWHERE[sample.columns["split"]]}
        return {"vision": np.rot90(sample.vision), **names}  # type: ignore[arg-type]

    renamed = build(altered(Toy(), change, name="renamed", group_by="row"), tmp_path / "renamed", size=32, quiet=True)
    for learn, score, row in ((pack, renamed, "new 0"), (renamed, pack, "0036")):
        with pytest.raises(ValueError, match=rf"the touch image of row '{row}' is learned from in .* one of \d+: give"):
            JoinedPack(learn, score)


def test_probe_meets_other_pack(pack: Pack, negative: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train(smoke(pack, steps=1, eval_every=0), tmp_path / "run", quiet=True)
    asked = ["probe", str(tmp_path / "run"), "--tasks", "pattern", "--modalities", "touch", "--json"]
    assert not main([*asked, str(tmp_path / "new.json"), "--on", str(negative.path), "--learn-on", str(pack.path)])
    result = json.loads((tmp_path / "new.json").read_text())
    assert result["pack"] == JoinedPack(pack, negative).digest
    assert {r["num_test"] for r in result["records"]} == {len(negative.rows("test"))}
    sources = {"mvitac", "imagenet", "majority", "untrained", "pixels", "border"}
    assert {r["source"] for r in result["records"]} == sources and "probes learned on" in capsys.readouterr().out
    assert main(["probe", str(tmp_path / "run"), "--learn-on", str(pack.path)]) == 2
    assert "name the pack on which they are scored, --on PACK" in " ".join(capsys.readouterr().err.split())
