"""Several packs as one: rows, images, tasks and splits are those of the parts, and what cannot be mixed is refused."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvitac.cli.main import main
from mvitac.data.images import fit
from mvitac.data.pack import Pack
from mvitac.data.several import MixedPack
from mvitac.data.spec import Target, ValueTask, Window
from mvitac.data.windows import windowed
from mvitac.datasets.mix import MixConfig
from mvitac.evaluation.leaks import Scored, source_of
from support.mixes import Gel, Slice, built
from support.toy import Toy, altered, swapped


@pytest.fixture(scope="module")
def gel(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return built(Gel(num=60), tmp_path_factory.mktemp("gel") / "pack", size=24)


def test_rows_are_those_of_the_parts_together_and_alone(pack: Pack, gel: Pack) -> None:
    mix = MixedPack({"toy": pack, "gel": gel})
    assert (mix.num, mix.size) == (pack.num + gel.num, 32)
    assert mix.column("part").tolist() == ["toy"] * pack.num + ["gel"] * gel.num
    assert mix.column("sensor").tolist() == ["toy"] * pack.num + ["mini"] * gel.num
    assert mix.column("split").tolist() == pack.column("split").tolist() + gel.column("split").tolist()
    for name in ("id", "group", "touch_group"):
        assert mix.column(name)[-1] == f"gel/{gel.column(name)[-1]}" and len(set(mix.column("id"))) == mix.num
    assert mix.own_ids.tolist() == pack.own_ids.tolist() + gel.own_ids.tolist()
    assert mix.has("touch").all() and mix.has("vision").tolist() == [True] * pack.num + [False] * gel.num
    assert mix.whole.all() and len(mix.rows("train", having=("vision",))) == len(pack.rows("train"))
    rows = np.array([pack.num + 3, 5, pack.num + 3, 0])
    small, large = gel.images["touch"][3], pack.images["touch"]
    np.testing.assert_array_equal(mix.images["touch"][rows], [fit(small, 32), large[5], fit(small, 32), large[0]])
    np.testing.assert_array_equal(mix.images["touch"][pack.num + 3], fit(small, 32))
    assert not mix.images["vision"][rows[0]].any() and mix.images["vision"][5].any()
    assert "gel: images of 24 px are resized to 32 px as they are read" in mix.spec.notes
    assert mix.spec.licence == "toy: none; gel: none"
    assert MixedPack({"toy": pack, "gel": gel}, size=16).images["touch"].shape[1:] == (16, 16, 3)
    alone = mix.alone("gel")
    np.testing.assert_array_equal(alone.rows("train"), pack.num + gel.rows("train"))
    assert alone.spec.modalities == ("touch",) and mix.spec.modalities == ("vision", "touch")
    assert len(mix.rows("train")) > len(gel.rows("train"))


def test_the_digest_is_of_parts_and_size(pack: Pack, gel: Pack) -> None:
    one = MixedPack({"a": pack, "b": gel})
    others = [MixedPack({"a": gel, "b": pack}), MixedPack({"a": pack, "c": gel})]
    others.append(MixedPack({"a": pack, "b": gel}, size=24))
    assert MixedPack({"a": pack, "b": gel}).digest == one.digest
    assert len({one.digest, *(other.digest for other in others)}) == 4


def test_one_task_if_classes_agree_else_two(pack: Pack, gel: Pack) -> None:
    mix = MixedPack({"toy": pack, "gel": gel})
    assert [task.name for task in mix.spec.tasks] == ["pattern", "toy/bright", "gel/bright"]
    assert mix.spec.tasks[0].classes == pack.spec.tasks[0].classes
    expected = np.concatenate([pack.labels("pattern"), (gel.labels("pattern") - 1) % 3])
    mix.labels("pattern")[:] = 0  # of a copy
    np.testing.assert_array_equal(mix.labels("pattern"), expected, "classes go by name")
    for name, part, first in (("toy/bright", pack, 0), ("gel/bright", gel, pack.num)):
        expected = np.full(mix.num, -1)
        expected[first : first + part.num] = part.labels("bright")
        np.testing.assert_array_equal(mix.labels(name), expected)
    ((name, (column,)),) = mix.spec.controls.items()
    assert (name, column) == ("noise only", "control/noise only/noise")  # a column of this name is no control in gel
    np.testing.assert_array_equal(np.isfinite(mix.column(column)), mix.column("part") == "toy")


def test_a_control_of_one_part_is_no_value_of_another(tmp_path: Path) -> None:
    """Here force is in mN, and nothing that the part measures."""
    aside = altered(Slice(num=30, first=60), lambda _, item: {"force": 1000.0 * item}, controls={"force": ("force",)})
    mix = MixedPack({"a": built(pressed(), tmp_path / "a"), "b": built(aside, tmp_path / "b")})
    (task,) = mix.spec.values
    inside = mix.column("part") == "a"
    np.testing.assert_array_equal(np.isfinite(mix.values(task)[:, 0]), inside)
    assert mix.spec.controls["force"] == ("control/force/force",)
    np.testing.assert_array_equal(mix.column("control/force/force")[~inside], 1000.0 * np.arange(30))
    assert np.isnan(mix.column("control/force/force")[inside]).all()


def test_a_column_is_of_the_task_and_the_control_that_name_it(tmp_path: Path) -> None:
    """Here z is a depth, a control called near; there it is a height, a control called far."""
    parts = {}
    for k, (name, control) in enumerate((("depth", "near"), ("height", "far"))):
        task = ValueTask(name=name, targets=(Target(name="z", unit="mm"),))
        spec: dict[str, Any] = {"values": (task,), "controls": {control: ("z",)}}
        parts[name] = built(altered(Slice(num=30, first=60 * k), lambda _, i: {"z": i / 2}, **spec), tmp_path / name)
    mix = MixedPack(parts)
    assert [task.name for task in mix.spec.values] == ["depth/depth", "height/height"]
    for task, columns in zip(mix.spec.values, mix.spec.controls.values(), strict=True):
        for found in (mix.values(task)[:, 0], mix.column(columns[0])):
            np.testing.assert_array_equal(np.isfinite(found), mix.column("part") == task.name.partition("/")[0])


def pressed(first: int = 0, unit: str = "N", kind: Any = 1, own_split: bool = False) -> Toy:
    extra = {"kind": kind, **({"split_force": "test"} if own_split else {})}
    split = "split_force" if own_split else "split"
    task = ValueTask(name="force", targets=(Target(name="force", unit=unit),), only={"kind": "1"}, split=split)
    return altered(Slice(num=30, first=first), lambda _, item: {"force": item / 2, **extra}, values=(task,))


@pytest.mark.parametrize("other", [{"unit": "mN"}, {"own_split": True}, {"kind": "1"}, {}], ids=str)
def test_values_keep_their_unit_rows_and_split(gel: Pack, tmp_path: Path, other: dict[str, Any]) -> None:
    """Where ``kind`` is a number here and a text there, the task is the same: conditions compare text."""
    a, b = built(pressed(), tmp_path / "a"), built(pressed(60, **other), tmp_path / "b")
    mix = MixedPack({"a": a, "b": b, "gel": gel})
    apart = bool(other) and "kind" not in other
    assert [task.name for task in mix.spec.values] == (["a/force", "b/force"] if apart else ["force"])
    for task in mix.spec.values:
        values = mix.values(task)[:, 0]
        there = np.isin(mix.column("part"), [task.name[0]] if apart else ["a", "b"])
        np.testing.assert_array_equal(np.isfinite(values), there)
        np.testing.assert_array_equal(values[there], np.tile(np.arange(30) / 2, there.sum() // 30))
        if task.split != "split":
            assert (mix.column(task.split)[~there] == "hidden").all()
    if "unit" in other:
        found = [task.targets[0] for task in mix.spec.values]
        assert found == [Target(name="a/force", unit="N"), Target(name="b/force", unit="mN")]


def test_rows_are_hidden_as_in_their_part(pack: Pack, tmp_path: Path) -> None:
    """A part whose tasks all have splits of their own hides no row, though the other part has tasks of the common split."""
    task = replace(pack.spec.tasks[1], split="split_bright")
    source = Slice(num=60, prefix="listed ")
    own = altered(source, lambda sample, _: {"split_bright": sample.columns["split"]}, tasks=(task,))
    listed = built(own, tmp_path / "p", size=16)
    mix = MixedPack({"toy": pack, "listed": listed})
    assert [task.name for task in mix.spec.tasks] == ["pattern", "toy/bright", "listed/bright"]
    assert not mix.hidden.any() and not listed.hidden.any()
    assert len(mix.rows("test")) == len(pack.rows("test")) + len(listed.rows("test"))


def test_windows_of_a_mix_stay_within_a_touch_of_a_part(measured: Pack, tmp_path: Path) -> None:
    other = built(Slice(num=30, values=True, prefix="other "), tmp_path / "p")
    window = Window(frames=2)
    mix = windowed(MixedPack({"a": measured, "b": other}), window)
    for rows, part in ((np.arange(measured.num), measured), (measured.num + np.arange(30), other)):
        np.testing.assert_array_equal(mix.images["touch"][rows], windowed(part, window).images["touch"][:])


def test_a_group_on_two_sides_is_refused_or_marked(pack: Pack, tmp_path: Path) -> None:
    turned = built(swapped(Slice(num=60)), tmp_path / "p")
    says = r"instance '0-6' is in train or val of part b and in test of part a, one of \d+"
    with pytest.raises(ValueError, match=says):
        MixedPack({"b": turned, "a": pack})
    mix = MixedPack({"a": pack, "b": turned}, allow_leak=True)
    assert mix.spec.notes[0].startswith("instance")
    assert "test instances were trained on" in Scored(mix).leak([source_of(mix, mix.rows("train"))], mix.rows("test"))


def test_a_leak_between_a_mix_and_a_pack_is_found(pack: Pack, gel: Pack) -> None:
    """Groups of a mix are those of its parts, whatever prefix they have in it."""
    mix = MixedPack({"toy": pack, "gel": gel})
    learned = source_of(mix, mix.rows("train"))
    assert Scored(pack).leak([learned], pack.rows("train")).startswith(f"{len(pack.rows('train'))} of ")
    assert Scored(pack).leak([learned], pack.rows("test")) == ""


def test_an_image_on_two_sides_under_two_names_is_refused(pack: Pack, tmp_path: Path) -> None:
    copies = swapped(Slice(num=60, prefix="copy "))
    turned = built(copies, tmp_path / "p")
    says = r"the vision image of row 'copy 0\d+' is in train or val of part a and in test of part b, one of \d+: pack"
    with pytest.raises(ValueError, match=says):
        MixedPack({"a": pack, "b": turned})
    small = built(copies, tmp_path / "small", size=16)
    MixedPack({"a": pack, "b": small})  # images of other sizes cannot be compared


def test_what_cannot_be_mixed_is_refused(pack: Pack, tmp_path: Path) -> None:
    tested = altered(Slice(num=12), lambda *_: {"split": "test"})
    cases: list[tuple[Toy, str]] = [
        (tested, "part b .* has no rows in split train or unlabelled: leave it out"),
        (Slice(num=12, touch_channels=6), "touch channels differ: .*'a': 3, 'b': 6.; pack"),
        (altered(Slice(num=12), difference=True), "touch is minus its background in b and not in a: pack both alike"),
        (Toy(), "two of the parts a, b are the same data: give each pack once, with a weight"),
    ]
    for number, (source, message) in enumerate(cases):
        other = built(source, tmp_path / str(number))
        with pytest.raises(ValueError, match=message):
            MixedPack({"a": pack, "b": other})


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["a=x", "a=y"], "part 'a' is given twice"),
        (["a=x:2", "b=y"], r"parts a=x:2 b=y: give every part a weight \(NAME=FOLDER:WEIGHT\), or none"),
        (["a=x:0", "b=y:1"], "part 'a=x:0' has weight '0': give a positive number"),
        (["a=x", "b=y"], "part a: no pack at x"),
    ],
)
def test_a_mistake_is_one_line(given: list[str], says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    asked = ["pretrain", "--data", "mix", "--recipe", "smoke", "--out", str(tmp_path / "run"), "--data.parts", *given]
    assert main(asked) == 2
    said = capsys.readouterr().err
    assert re.search(says, said) and said.count("\n") == 1 and not (tmp_path / "run").exists()


def test_names_folders_and_weights() -> None:
    config = MixConfig(parts=("tag=packs/tag:2", "packs/mine:.5"))
    assert config.named_parts() == [("tag", Path("packs/tag"), 2.0), ("mine", Path("packs/mine"), 0.5)]
    assert MixConfig(parts=("a=b=c", "d:e/f")).named_parts() == [("a", Path("b=c"), None), ("f", Path("d:e/f"), None)]


def test_a_mix_is_told_and_checked(pack: Pack, gel: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = [f"toy={pack.path}", f"gel={gel.path}"]
    assert main(["data", "info", *parts, "--json", str(tmp_path / "info.json")]) == 0
    found = json.loads((tmp_path / "info.json").read_text())
    assert (found["rows"], found["rows_without"]) == (pack.num + gel.num, {"vision": gel.num})
    written = ["--json", str(tmp_path / "check.json"), "--sheet", str(tmp_path / "x.png")]
    assert main(["data", "check", *parts, *written]) in (0, 1) and (tmp_path / "x.png").stat().st_size
    assert main(["data", "pack", "--data", "mix", "--out", str(tmp_path / "p")]) == 2
    assert "--data mix reads packs" in capsys.readouterr().err
