"""Real sets as one ``git clone`` brings them: fixtures in the owners' exact layout, and the genuine samples beside us."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvitac.bench.suite import find_suite, open_set
from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.video import spread
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.physiclear import PhysiclearConfig
from mvitac.datasets.slip_grasp import SlipGraspConfig
from mvitac.datasets.slip_gsmini import SlipGSMiniConfig
from mvitac.datasets.table.splits import folds
from mvitac.datasets.vt60 import VT60Config
from support.videos import film, level, picture, shade


def make_slip_grasp(root: Path) -> None:
    """4 objects, 3 to 4 grasps, 21 frames each; the words for the outcome and the infix differ as they do there."""
    for k in range(4):
        lines, words = [], (("fail", "ok"), ("slip", "success"))[k % 2]
        for g in range(3 + k % 2):
            held, folder, infix = g % 2, f"04{k}_{2 * g}0", ("_s09_", "_s010_")[k % 2]
            key = 1000 * (g + 1) + k
            lines.append(f"4{k}.{2 * g} {words[held]} {held} {key - 200} {key + 60} {key} {folder} {infix}")
            for frame in range(key - 5, key + 16):
                for kind, shift in (("external", 0), ("gelsight", 100), ("gelsight_lab", 200)):
                    name = f"{kind}_imgw{folder}{infix}{frame:08d}.jpg"
                    picture(root / f"data/object{k + 1:03d}/{folder}_mm" / name, shift + frame - key + 5 + 25 * (g % 2))
        (root / f"data/object{k + 1:03d}_result.dat").write_text("\n".join(lines))  # no final newline


def make_slip_gsmini(root: Path) -> None:
    """9 objects x 2 recordings, most of them copied elsewhere; one copy of one recording lacks its slip.txt."""
    base = root / "docs/franka-servo/datasets"
    for k in range(9):
        name = "bag_peanuts" if k == 3 else f"thing_{k}"
        side = "base_data_for_training" if k < 6 else "base_data_for_validation"
        for n in (1, 2):
            folder = base / "base_data" / side / name / f"exp_num_{n}"
            film(folder / "camera_0.avi", 30 + n, which=k)
            film(folder / "camera_2.avi", 30 + n, which=k + n + 1)
            slips = (k + n) % 3 == 0
            if slips:
                (folder / "slip.txt").touch()
            if k < 5:
                copy = root / "docs/base_data" / side / ("bag_of_peanuts" if k == 3 else name) / f"exp_num_{n}"
                shutil.copytree(folder, copy)
                if k == 2 and slips:
                    (copy / "slip.txt").unlink()
    (lonely := base / "thing_9/exp_num_1/camera_2.avi").parent.mkdir(parents=True)
    shutil.copy(folder / "camera_2.avi", lonely)


THINGS = [f"thing_{k}" for k in range(12)]


def make_physiclear(root: Path) -> None:
    """12 rated things and one unrated, 2 videos each, labels in a constants.py that would raise if it were run."""
    for k, thing in enumerate([*THINGS, "stranger"]):
        for video in (0, 1):
            film(root / f"dataset/{thing}_{video}.mov", 41, which=k + video)
    (root / "dataset/stranger_1.mov").rename(root / "dataset/stranger_1.MOV")

    def ranks(shift: int, values: tuple[Any, ...]) -> dict[str, Any]:
        return {f"physiclear_{thing}": values[(k + shift) % len(values)] for k, thing in enumerate(THINGS)}

    constants = {
        "TRAIN_OBJECTS": [f"physiclear_{t}" for t in THINGS[:8]],
        "VAL_OBJECTS": [f"physiclear_{t}" for t in THINGS[8:10]],
        "TEST_OBJECTS": [f"physiclear_{t}" for t in THINGS[10:]],
        "MATERIALS": ranks(0, ("wood", "metal")),
        "HARDNESS_RANK": ranks(0, (0, 1, 2)),
        "ROUGHNESS_RANK": ranks(1, (0, 1, 2)),
        "TEXTURE_RANK": ranks(2, (0, 1, 2)),
    }
    text = "".join(f"{name} = {value!r}\n" for name, value in constants.items())
    (root / "utils").mkdir(parents=True)
    (root / "utils/constants.py").write_text(f"import nothing_there\n{text}RANKS = dict(h=HARDNESS_RANK)\n1 / 0\n")


def make_vt60(root: Path) -> None:
    base = root / "code/data/vt60"
    for category in ("01_stapler", "02_bottleempty", "03_ball"):
        for i in range(1, 7):
            for k in range(3):
                name = f"IMG_inst_{i}_img_{9 + k}_validframeID_{62 + k}.jpg"  # 9, 10, 11: not in the order of names
                picture(base / f"vision/{category}/0{i}" / name, 10 * k + i)
            for k in range(5):
                name = f"touch_{i}_img_{8 + k}_name_{category[3:]}_red_at_{42094 + k}_-{k}_25275.jpg"
                picture(base / f"touch/{category}/0{i}" / name, 100 + 10 * k + i)
    touch = next(base.glob("touch/03_ball/01/*_8_*"))
    touch.rename(touch.with_suffix(".JPG"))
    for k in range(2):
        picture(base / f"vision/03_ball/07/IMG_inst_7_img_{k}_validframeID_1.jpg", k)  # photos only


SETS: dict[str, tuple[Callable[[Path], None], type[DatasetConfig]]] = {
    "slip_grasp": (make_slip_grasp, SlipGraspConfig),
    "slip_gsmini": (make_slip_gsmini, SlipGSMiniConfig),
    "physiclear": (make_physiclear, PhysiclearConfig),
    "vt60": (make_vt60, VT60Config),
}


@pytest.fixture(scope="module")
def clones(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("clones")
    for name, (make, _) in SETS.items():
        make(root / name)
    return root


@pytest.fixture(scope="module")
def packs(clones: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Pack]:
    out = tmp_path_factory.mktemp("packs")
    configs = {name: kind(path=clones / name, size=16) for name, (_, kind) in SETS.items()}  # type: ignore[call-arg]
    return {name: build(c.source(), out / name, size=16, quiet=True) for name, c in configs.items()}


@pytest.mark.parametrize("name", SETS)
def test_the_contract(packs: dict[str, Pack], clones: Path, name: str) -> None:
    pack = packs[name]
    assert pack.spec.name == name and pack.spec.source.startswith("https://github.com/")
    assert pack.spec.licence and pack.spec.licence != "unknown"
    groups = {split: set(pack.column("group")[pack.rows(split)]) for split in ("train", "val", "test")}
    assert groups["train"] and groups["test"] and not groups["test"] & (groups["train"] | groups["val"])
    for task in pack.spec.tasks:
        assert all((pack.column(f"label_{task.name}")[pack.rows(split)] >= 0).any() for split in ("train", "test"))
    _, kind = SETS[name]
    config = kind(path=clones / name, size=16)  # type: ignore[call-arg]
    assert config.source().fingerprint() == kind(path=clones / name, size=16).source().fingerprint()  # type: ignore[call-arg]
    assert str(clones) not in str(config.source().fingerprint())


@pytest.mark.parametrize("name", SETS)
def test_something_else_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert main(["data", "pack", "--data", name, "--path", str(tmp_path), "--out", str(tmp_path / "p")]) == 2
    error = capsys.readouterr().err
    assert "holds no " in error and "git clone https://github.com/" in error and error.count("\n") == 1


def test_every_group_is_tested_once() -> None:
    groups = [f"g{i % 17}" for i in range(100)]
    strata = [f"s{i % 17 % 3}" for i in range(100)]
    columns = folds(groups, strata, 4)
    assert (np.array([[side == "test" for side in column] for column in columns.values()]).sum(0) == 1).all()
    for column in columns.values():
        assert len({*zip(groups, column, strict=True)}) == 17
        for stratum in set(strata):
            inside = {g for g, s, side in zip(groups, strata, column, strict=True) if s == stratum and side == "test"}
            assert len(inside) in (1, 2)
    order = np.random.default_rng(0).permutation(100)
    again = folds([groups[i] for i in order], [strata[i] for i in order], 4)
    assert again["fold2"] == [columns["fold2"][i] for i in order]


def test_frames_are_spread() -> None:
    assert spread(12, 450)[:3] == [0, 41, 82] and spread(12, 450)[-1] == 449
    assert spread(8, 3) == [0, 1, 2] and spread(3, 101, 0.25, 0.75) == [25, 50, 75]


def test_slip_grasp_labels_no_late_frame_where_early_ones_are_lost(tmp_path: Path) -> None:
    make_slip_grasp(tmp_path)
    for path in (tmp_path / "data/object001").glob("*_mm/*.jpg"):
        if int(path.stem[-8:]) % 1000 in (*range(995, 1000), 0):  # up to the key frame
            path.unlink()
    rows = [row for row in SlipGraspConfig(path=tmp_path).manifest().rows if row["object"] == "001"]
    assert len(rows) == 3 * 15 and {int(row["seq"]) for row in rows} == {*range(6, 21)}
    whole = (file := tmp_path / "data/object001_result.dat").read_bytes()
    for old, new, says in (
        (b" 040_0", b" ../object002/041_0", "is not a grasp of eight words"),
        (whole, b"\xff\xfe 1 0 1 2 x y z", "is not a grasp of eight words"),
        (b" 1000 ", b" 1007 ", "frames 1001 to 1015 .* not 5 before key frame 1007 "),
        (b" 1000 ", b" 999 ", "frames 1001 to 1015 .* not 5 before key frame 999 "),
    ):
        file.write_bytes(whole.replace(old, new))
        with pytest.raises(ValueError, match=f"object001_result.dat line 1: .*{says}"):
            SlipGraspConfig(path=tmp_path).manifest()
    file.unlink()
    (note,) = SlipGraspConfig(path=tmp_path).source().spec().notes
    assert note == "object001 is left out: object001_result.dat says nothing of it"


def test_slip_grasp_pairs_by_frame(packs: dict[str, Pack]) -> None:
    pack = packs["slip_grasp"]
    assert pack.num == (3 + 4 + 3 + 4) * 21
    seq, success = pack.column("seq").astype(int), pack.column("label_success")
    late = pack.column("success").astype(int)
    assert ((success == -1) == (seq > 4)).all()  # late frames show the outcome
    assert (pack.column("frame_rel_key").astype(int) == seq - 5).all()
    for i in range(0, pack.num, 7):
        expected = seq[i] + 25 * late[i]
        assert abs(level(pack.images["vision"][i]) - expected) < 3
        assert abs(level(pack.images["touch"][i]) - expected - 100) < 3
    grasps = {f"{k + 1:03d}_04{k}_{2 * g}0" for k in range(4) for g in range(3 + k % 2)}
    assert set(pack.column("touch_group")) == grasps
    assert np.isclose(np.unique(pack.column("width_in_sweep")[pack.column("group") == "001"]), [-0.2, 0.0, 0.2]).all()
    assert pack.spec.controls["width"] == ("width_mm",)


def test_slip_gsmini_counts_copies_once(packs: dict[str, Pack]) -> None:
    pack = packs["slip_gsmini"]
    assert pack.num == 9 * 2 * 12 and pack.spec.touch_channels == 6
    assert set(pack.column("group")) == {"bag_peanuts", *(f"thing_{k}" for k in range(9) if k != 3)}
    for i in range(0, pack.num, 5):
        thing, n = pack.column("group")[i], int(pack.column("experiment")[i][-1])
        k, frame = 3 if thing == "bag_peanuts" else int(thing[-1]), int(pack.column("frame")[i])
        assert abs(level(pack.images["touch"][i][..., :3]) - shade(frame, k)) < 6
        assert abs(level(pack.images["touch"][i][..., 3:]) - shade(frame, k + n + 1)) < 6
        conflict = k == 2 and (k + n) % 3 == 0
        assert pack.column("label_slip")[i] == (-1 if conflict else int((k + n) % 3 == 0))
        assert pack.column("label_conflict")[i] == str(int(conflict))
        assert pack.column("author_split")[i] == ("train" if k < 6 else "val") and pack.column("n_frames")[i] == 30 + n
    assert (pack.column("label_conflict") == "1").sum() == 12
    alone = "franka-servo/datasets/thing_9/exp_num_1"
    assert pack.spec.notes == (f"1 folders without both videos are left out, such as {alone}",)


def test_physiclear_labels_are_read_not_run(packs: dict[str, Pack], clones: Path) -> None:
    pack = packs["physiclear"]
    assert pack.num == 13 * 2 * 8
    assert [task.name for task in pack.spec.tasks] == ["material", "hardness", "roughness", "bumpiness"]
    for i in range(pack.num):
        thing, video = pack.column("video")[i].rsplit("_", 1)
        k = 12 if thing == "stranger" else int(thing.split("_")[1])
        frame = int(pack.column("frame")[i])
        assert 12 <= frame <= 24 and abs(level(pack.images["touch"][i]) - shade(frame, k + int(video))) < 6
        expected = [-1] * 4 if k == 12 else [(k + 1) % 2, k % 3, (k + 1) % 3, (k + 2) % 3]
        assert [pack.column(f"label_{task.name}")[i] for task in pack.spec.tasks] == expected
    assert set(pack.column("split")[pack.column("group") == "stranger"]) == {"unlabelled"}
    owners = PhysiclearConfig(path=clones / "physiclear", size=16, split="owners_split").source()
    sides = {s.columns["object"]: s.columns["split"] for i in range(len(owners.items())) for s in owners.read(i)}
    assert sides["stranger"] == "unlabelled"
    assert [sides[thing] for thing in THINGS] == ["train"] * 8 + ["val"] * 2 + ["test"] * 2


def test_physiclear_differences(clones: Path, tmp_path: Path) -> None:
    config = PhysiclearConfig(path=clones / "physiclear", size=16, difference=True, frames=2)
    pack = build(config.source(), tmp_path / "p", size=16, quiet=True)
    k = 5
    row = np.flatnonzero(pack.column("video") == f"thing_{k}_0")[0]
    frame = int(pack.column("frame")[row])
    assert abs(level(pack.images["touch"][row]) - (shade(frame, k) - shade(0, k) + 256) / 2) < 6


def test_physiclear_newer_layout_and_missing_labels(clones: Path, tmp_path: Path) -> None:
    shutil.copytree(clones / "physiclear", tmp_path / "new")
    (tmp_path / "new/src").mkdir()
    (tmp_path / "new/utils").rename(tmp_path / "new/src/utils")
    assert PhysiclearConfig(path=tmp_path / "new").source().items()
    file = tmp_path / "new/src/utils/constants.py"
    file.write_text(file.read_text().replace("TEXTURE_RANK", "OTHER"))
    with pytest.raises(ValueError, match="does not define TEXTURE_RANK"):
        PhysiclearConfig(path=tmp_path / "new").source()
    file.write_text(file.read_text() + "TEXTURE_RANK = ['physiclear_thing_1']\n")
    with pytest.raises(ValueError, match="TEXTURE_RANK is no dict of names"):
        PhysiclearConfig(path=tmp_path / "new").source()
    file.write_text(f"a = {'1+' * 3000}1")
    with pytest.raises(ValueError, match=r"constants\.py cannot be read as labels"):
        PhysiclearConfig(path=tmp_path / "new").source()


def test_vt60_pairs_are_weak_but_right(packs: dict[str, Pack]) -> None:
    pack = packs["vt60"]
    assert pack.num == 18 * 5 and pack.spec.notes == ("objects without touches are left out: 03_ball/07",)
    for row in range(pack.num):
        i, k = int(pack.column("group")[row][-1]), int(pack.column("seq")[row])
        assert abs(level(pack.images["vision"][row]) - (10 * (k % 3) + i)) < 3
        assert abs(level(pack.images["touch"][row]) - (100 + 10 * k + i)) < 3
        assert [pack.column(axis)[row] for axis in "xyz"] == [str(42094 + k), f"-{k}", "25275"]
    assert pack.spec.tasks[0].classes == ("01_stapler", "02_bottleempty", "03_ball")


def test_the_suite_of_the_bench_reads_the_clones(clones: Path, tmp_path: Path) -> None:
    """By their readers, each group tested once; manifests of copies are the other form."""
    found = {one.name: one for one in find_suite("real-small-v3").sets}
    for name in SETS:
        clone, manifest = found[name].forms
        (tmp_path / clone.at["path"]).symlink_to(clones / name)
        small = replace(clone, data={**clone.data, "size": 16})
        opened = open_set(replace(found[name], folds=2, forms=(small, manifest)), tmp_path)
        assert not isinstance(opened, str) and opened.form == "clone", name
        tested = [set(view.column("group")[view.rows("test")].tolist()) for view in opened.packs]
        assert all(tested) and not tested[0] & tested[1], name
    assert open_set(found["wedge_force"], tmp_path) == f"{tmp_path / 'wedge_force.csv'} is not there"
