"""The doctor: a healthy dataset is called healthy, and each of fourteen faults is called by its name and nothing else."""

import copy
import json
import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.checks.examine import examine, examine_pack, examine_source
from mvitac.data.checks.finding import Finding, exit_code
from mvitac.data.checks.image_checks import MAX_LAG, motion_correlations
from mvitac.data.checks.image_stats import look_at
from mvitac.data.checks.table_checks import similar_names
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Task
from mvitac.datasets.folder import FolderConfig
from support.toy import altered

NUM_OBJECTS, NUM_FRAMES, SIDE = 20, 16, 32
REAL = Path(__file__).resolve().parents[4] / "shared" / "data" / "tactip_shear"
TEST, VAL = (3, 8, 13, 18), (4, 9)


@dataclass
class Presses(Source):
    """20 objects of 3 materials, each filmed and touched for 16 frames in which it slides at varying speed. A camera
    sees its texture on a brown table, a gel of blue and red light its bump. ``fault`` breaks one thing."""

    fault: str = ""

    def spec(self) -> DataSpec:
        about: Any = {"group_by": "object", "licence": "none", "source": "tests/data/checks/test_checks.py"}
        tasks = (Task(name="material", classes=("wood", "metal", "cloth")),)
        return DataSpec(name="presses", vision_channels=3, touch_channels=3, tasks=tasks, **about)

    def items(self) -> list[str]:
        return [f"object {obj} frame {k}" for obj in range(NUM_OBJECTS) for k in range(NUM_FRAMES)]

    def fingerprint(self) -> dict[str, Any]:
        return {"presses": self.fault}

    def read(self, item: int) -> list[Sample]:
        obj, k = divmod(item, NUM_FRAMES)
        fault, held_out = self.fault, obj in TEST
        if fault == "unreadable" and item % 40 == 7:
            raise ValueError("broken on purpose")
        copied = held_out and k < {"copies": 1, "near-copies": 4}.get(fault, 0)
        shown = 0 if copied else obj  # the very pictures of object 0
        vision, touch = camera(shown, k), gel(shown, max(0, k - 2) if fault == "offset" else k)
        if fault == "near-copies" and shown != obj:
            noise = np.random.default_rng(item)
            changed = [0.94 * image + 6 + noise.normal(0, 1, image.shape) for image in (vision, touch)]
            vision, touch = (np.clip(image, 0, 255).astype(np.uint8) for image in changed)
        if fault == "constant" and item % 50 == 3:
            touch = np.full_like(touch, 7)
        if (fault == "bgr" and obj in (2, 5, 8)) or (fault == "half bgr" and obj % 2):
            touch = touch[:, :, ::-1].copy()
        material, random = obj % 3, Random(item)
        columns: dict[str, Any] = {
            "id": f"{obj:02d}-{k:02d}",
            "group": f"object {0 if fault == 'leak' and held_out and k == 2 else obj}",
            "touch_group": f"touch {obj}",
            "split": "test" if held_out else "val" if obj in VAL else "train",
            "label_material": material,
            "seq": k,
            "sensor": "a" if obj // 3 % 2 else "b",
            "force": 1.0 + (obj * 7 + k * 5) % 11,
        }
        day = material * 100 + obj
        names = {"group": f"{day}", "touch_group": f"2022_{day:06d}", "take": f"{day}_0", "day": str(day)}
        changes: dict[str, dict[str, Any]] = {
            "spelling": {"group": "OBJECT\u00a003"} if obj == 2 else {},  # in train, while "object 3" is in test
            "labels": {"label_material": -1} if item % 30 == 1 else {},
            "unseen class": {"label_material": 2 if held_out else obj // 4 % 2},
            "sensor": {"sensor": f"lab {material}"},
            # 2022_000101 is a recording, though Python reads a number in it
            "names of groups": names,
            # as its table wrote it: an empty cell is an unlabelled row, no number to repair
            "written label": {"material": "" if k == 9 else str(material)},
            "give-away": {"force": material + (obj * 7 + k * 5) % 11 / 10},
            "in one class": {"force": str(columns["force"]) if material == 1 else ""},  # as its table wrote it
            "few labels": {"label_material": material if k < 3 else -1},
            "noise": {"label_material": material if k < 4 else -1, **{n: random.random() for n in "abcde"}},
            "another name": {"number": 7 - material},
        }
        return [Sample(vision=vision, touch=touch, columns=columns | changes.get(fault, {}))]


def path_of(obj: int) -> np.ndarray:
    """[NUM_FRAMES] positions in pixels: a slide in bursts, another for every object."""
    return np.cumsum(np.random.default_rng([5, obj]).choice([0.05, 0.3, 1.6], NUM_FRAMES))


@cache
def camera(obj: int, k: int) -> np.ndarray:
    rng = np.random.default_rng([1, obj])
    y, x = np.mgrid[0:SIDE, 0:SIDE].astype(float)
    shift = path_of(obj)[k]
    waves = sum(np.sin((x - shift) * a + y * b + c) for a, b, c in rng.uniform((0.2, 0.2, 0), (1, 1, 6), (4, 3)))
    colour = np.array([130, 100, 70]) + rng.uniform(-60, 60, 3)
    inside = (np.abs(x - 16) < 12) & (np.abs(y - 16) < 12)
    image = np.where(inside[:, :, None], colour + 22 * np.asarray(waves)[:, :, None], np.array([120.0, 95, 70]))
    return noisy(image, [2, obj, k])


@cache
def gel(obj: int, k: int) -> np.ndarray:
    y, x = np.mgrid[0:SIDE, 0:SIDE].astype(float)
    left, top, wide, angle = np.random.default_rng([3, obj]).uniform((5, 9, 2, 0), (11, 23, 4, 3))
    u, v = x - left - path_of(obj)[k], y - top
    u, v = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
    bump = 80 * np.exp(-((u / wide) ** 2) - (v / (7 - wide)) ** 2) * np.sin(u + obj)
    return noisy(np.stack([60 + 3 * x + bump, 90 + bump, 170 - 2 * x - bump], axis=2), [4, obj, k])


def noisy(image: np.ndarray, seed: list[int]) -> np.ndarray:
    made = np.clip(image + np.random.default_rng(seed).normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)
    made.flags.writeable = False  # it is kept for the next fault
    return made


def check(source: Presses, tmp_path: Path) -> dict[str, Finding]:
    pack = build(source, tmp_path / "pack", size=SIDE, max_damaged=1.0, quiet=True)
    return {finding.item: finding for finding in examine(pack)}


@pytest.mark.parametrize("kind", ["", "names of groups", "written label"])
def test_the_healthy_one_is_healthy(kind: str, tmp_path: Path) -> None:
    findings = check(Presses(kind), tmp_path)
    assert {f.item: f.evidence for f in findings.values() if f.verdict != "ok"} == {}
    assert exit_code(findings.values()) == 0 and "best" in findings["time offset between streams"].evidence


FAULTS = {
    "unreadable": ("unreadable items", "broken", "object 0 frame 7: broken on purpose"),
    "constant": ("constant frames", "look", "touch: 7 of 320 (2.2 %), first 00-03"),
    "bgr": ("red and blue swapped", "look", ", of object object 2, object 5, object 8"),
    "half bgr": ("red and blue swapped", "look", "160 of 320 (50.0 %)"),
    "offset": ("time offset between streams", "look", "touch comes 2 rows late"),
    "unseen class": ("labels of material", "broken", "tested but never seen in training: cloth"),
    "copies": ("identical images across splits", "broken", "vision: 5 of 320"),
    "near-copies": ("near-copies across splits", "look", "vision: 16 of"),
    "leak": ("groups across splits", "broken", "e.g. 'object 0'; 1 of 5 in test are also in train"),
    "spelling": ("names that differ in spelling only", "look", r"group: 'OBJECT\xa003' and 'object 3'"),
    "labels": ("labels of material", "look", "first 00-01"),
    "sensor": ("columns that give a label away", "look", "sensor predicts material with 100 % accuracy"),
    "give-away": ("columns that give a label away", "look", "force predicts material with 91 % accuracy"),
    "in one class": ("columns that give a label away", "look", "force predicts material with 69 % accuracy"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_named_and_nothing_else(fault: str, tmp_path: Path) -> None:
    item, verdict, evidence = FAULTS[fault]
    findings = check(Presses(fault), tmp_path)
    assert {f.item for f in findings.values() if f.verdict in ("look", "broken")} == {item}
    assert (findings[item].verdict, evidence in findings[item].evidence) == (verdict, True), findings[item].evidence
    assert findings[item].advice and exit_code(findings.values()) == {"look": 1, "broken": 2}[verdict]


def test_what_the_search_for_give_aways_left_out_is_said(tmp_path: Path) -> None:
    kinds, item = ("few labels", "another name", "noise"), "columns that give a label away"
    few, same, noise = (check(Presses(kind), tmp_path / kind)[item] for kind in kinds)
    assert few.verdict == "not checkable" and "material has 48 labelled rows outside test, 64 are" in few.evidence
    assert same.verdict == "ok" and "number says the same as material" in same.evidence
    assert noise.verdict == "ok", noise.evidence  # in 8 parts of 64 rows, noise is right for ten points more


def test_classes_that_differ_in_spelling_only(pack: Pack) -> None:
    """Case, leading zeros, a ligature; but not numbers that differ."""
    other = copy.copy(pack)
    for classes, alike in {
        ("Wood", "wood", "cork"): "'Wood' and 'wood'",
        ("1", "01", "10"): "'1' and '01'",
        ("stiff", "stifi", "x"): "",
        ("\ufb01rm", "firm", "x"): "'\\ufb01rm' and 'firm'",
        ("wo\u200bod", "wood", "x"): "'wo\\u200bod' and 'wood'",
        ("hard wood", "hard_wood", "1.05"): "'hard wood' and 'hard_wood'",
        ("1.05", "1.5", "105"): "",
        ("1 2", "12", "-12"): "",
    }.items():
        other.spec = replace(pack.spec, tasks=(Task(name="pattern", classes=classes), pack.spec.tasks[1]))
        found = similar_names(other)
        assert found.verdict == ("look" if alike else "ok"), classes
        assert (f"classes of pattern: {alike}" == found.evidence) == bool(alike), found.evidence


def test_a_damaged_pack_is_told_and_training_refuses_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "pack"
    build(Presses(), path, size=SIDE, quiet=True)
    images = np.lib.format.open_memmap(path / "vision.npy", mode="r+")
    images[137, 5, 5, 0] ^= 1
    images.flush()
    findings = examine_pack(path)
    assert [f.verdict for f in findings] == ["broken"] and exit_code(findings) == 2
    assert "vision.npy does not match its digest" in findings[0].evidence
    command = ["pretrain", "--data", "pack", "--data.path", str(path), "--recipe", "smoke"]
    assert main([*command, "--out", str(tmp_path / "run")]) == 2
    assert "vision.npy does not match its digest" in capsys.readouterr().err


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit codes 0, 1, 2; the JSON says what the table says; the sheet shows the rows themselves."""
    codes = {}
    for fault in ("", "constant", "copies"):
        path = tmp_path / f"pack {fault}"
        build(Presses(fault), path, size=SIDE, quiet=True)
        file = tmp_path / (fault or "fine")
        codes[fault] = main(["data", "check", str(path), "--json", f"{file}.json", "--sheet", f"{file}.png"])
    assert codes == {"": 0, "constant": 1, "copies": 2} and not capsys.readouterr().err
    told = json.loads((tmp_path / "constant.json").read_text())
    assert told["exit_code"] == 1
    found = next(f for f in told["findings"] if f["item"] == "constant frames")
    assert found["verdict"] == "look" and found["rows"] == [3, 53, 103, 153, 203, 253, 303]
    with Image.open(tmp_path / "constant.png") as sheet:
        pixels = np.asarray(sheet)
    constant = (pixels == 7).all(2).sum()  # the touch halves of the seven rows, and of those drawn for a class
    assert constant >= 7 * 96 * 96 and constant % (96 * 96) == 0
    assert pixels.shape[1] <= 1280 and pixels.shape[0] > 2 * 96  # several rows of pairs
    with Image.open(tmp_path / "fine.png") as sheet:
        assert sheet.height > 2 * 96  # pairs of every class


def test_the_command_on_a_source(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng, rows = np.random.default_rng(0), ["touch,label,group,split"]
    for i in range(40):
        Image.fromarray(rng.integers(0, 256, (24, 24, 3), np.uint8)).save(tmp_path / f"{i}.png")
        rows.append(f"{i}.png,{'ab'[i % 2]},g{i // 2},{'test' if i < 10 else 'train'}")
    (tmp_path / "5.png").write_bytes(b"not a picture")
    (tmp_path / "m.csv").write_text("\n".join(rows))
    command = ["data", "check", "--data", "folder", "--path", str(tmp_path / "m.csv"), "--labels", "label"]
    command += ["--quiet", "--workers", "1"]
    assert main(command) == 2 and "row 6:" in capsys.readouterr().out
    (tmp_path / "m.csv").write_text("\n".join([*rows, "30.png,a,g0,train"]))  # g0 is in test
    assert main([*command, "--json", str(tmp_path / "leak.json")]) == 2
    told = {f["item"]: f for f in json.loads((tmp_path / "leak.json").read_text())["findings"]}
    assert told["groups across splits"]["verdict"] == told["unreadable items"]["verdict"] == "broken"
    assert "group (group): 1 of 20 in more than one split, e.g. 'g0'" in told["groups across splits"]["evidence"]
    assert main(["data", "check", str(tmp_path / "nothing")]) == 2 and "no pack at" in capsys.readouterr().err


@pytest.mark.parametrize("late", [-3, 0, 2])
def test_the_lag_is_touch_after_vision(late: int, tmp_path: Path) -> None:
    """Brightness jumps of the same sizes in both streams, in touch ``late`` rows after vision; the signs are random."""

    def flash(_: Sample, item: int) -> dict[str, np.ndarray]:
        obj, k = divmod(item, NUM_FRAMES)
        jumps = np.random.default_rng(obj).choice([1, 12], NUM_FRAMES + 20)
        level, shifts = 128 + np.cumsum(jumps * np.resize([1, -1], len(jumps))), {"vision": 0, "touch": late}
        return {m: np.full((SIDE, SIDE, 3), level[10 + k - shift], np.uint8) for m, shift in shifts.items()}

    pack = build(altered(Presses(), flash), tmp_path / "p", size=SIDE, quiet=True)
    curves = motion_correlations(pack, look_at(pack), pack.column("seq").astype(float))
    assert curves.mean(0).argmax() - MAX_LAG == late and len(curves) == NUM_OBJECTS


def test_what_cannot_be_checked_is_said_and_costs_nothing(tmp_path: Path) -> None:
    def touch_only(sample: Sample, _: int) -> dict[str, Any]:
        both = np.concatenate([sample.touch, sample.touch[::-1]], axis=2)  # type: ignore[index, list-item]
        return {"vision": None, "touch": both, "seq": None, "sensor": None}

    findings = check(altered(Presses(), touch_only, vision_channels=0, touch_channels=6), tmp_path)
    assert {item for item, f in findings.items() if f.verdict == "not checkable"} == {"time offset between streams"}
    assert "touch 2: all in one order" in findings["red and blue swapped"].evidence
    assert exit_code(findings.values()) == 0


def test_missing_images_are_no_faults_of_the_others() -> None:
    """A third of the rows without vision: no constant frames, no copies; only a split without any is worth a look."""
    for fault in ("", "test"):

        def gap(sample: Sample, item: int, fault: str = fault) -> dict[str, Any]:
            gone = item // NUM_FRAMES in TEST if fault else item % 3 == 1
            return {"has_vision": not gone, "vision": None if gone else sample.vision}

        findings = examine_source(altered(Presses(), gap), size=SIDE, quiet=True)
        told = {f.item: f for f in findings}
        assert {f.item for f in findings if f.verdict in ("look", "broken")} == ({"missing images"} if fault else set())
        assert f"{64 if fault else 107} of 320" in told["missing images"].evidence
    assert "no row of test has vision" in told["missing images"].evidence


def test_a_task_is_judged_by_its_own_split(tmp_path: Path) -> None:
    """As Touch and Go's rough/smooth: its lists divide recordings otherwise than those of the categories, and of those
    that they divide they may leave frames out."""

    def otherwise(_: Sample, item: int) -> dict[str, Any]:
        obj = item // NUM_FRAMES
        if item % NUM_FRAMES == 9 and obj > 8:
            return {"label_rough": -1, "split_rough": "test"}
        # By ``split`` no object of class 1 is learned from; by its own column both classes are on both sides.
        return {"label_rough": int(obj in TEST), "split_rough": "test" if obj in (3, 8, 0, 1) else "train"}

    rough = Task(name="rough", classes=("smooth", "rough"), split="split_rough")
    findings = check(altered(Presses(), otherwise, tasks=(*Presses().spec().tasks, rough)), tmp_path)
    assert "always saying 'smooth' scores 50.0 % on test" in findings["labels of rough"].evidence
    assert "; 11 of " in findings["labels of rough"].evidence and "first 09-09" in findings["labels of rough"].evidence
    assert {f.item for f in findings.values() if f.verdict in ("look", "broken")} == {"labels of rough"}
    assert findings["groups across column split_rough"].evidence.startswith("none of group")


def test_what_was_not_compared_is_not_called_well(tmp_path: Path) -> None:
    def untested(_: Sample, item: int) -> dict[str, Any]:
        colours = np.random.default_rng(item).integers(0, 256, (2, 1, 1, 3), np.uint8)
        vision, touch = (np.full((SIDE, SIDE, 3), c, np.uint8) for c in colours)
        vision[:4], touch[:4] = 0, 0
        return {"vision": vision, "touch": touch, "split": "train"}

    findings = check(altered(Presses(), untested), tmp_path)
    near, colour = findings["near-copies across splits"], findings["red and blue swapped"]
    assert (near.verdict, near.evidence) == ("not checkable", "vision: all in one split; touch: all in one split")
    assert colour.verdict == "not checkable" and "colours vary too much to tell" in colour.evidence


def test_other_keys_are_looked_at_too(tmp_path: Path) -> None:
    """Touch and Go's own split: touches are apart, recordings are not."""
    recorded = altered(Presses(), lambda _, item: {"recording": f"day {item // NUM_FRAMES // 5}"})
    own = check(recorded, tmp_path)["groups across splits"]
    assert own.verdict == "look" and "recording: 4 of 4 in more than one split" in own.evidence
    assert "4 of 4 in test are also in train" in own.evidence


def test_what_two_packs_share_is_a_finding(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Here images, under other names. A key that one of them lacks is none of its rows'."""

    def renamed(_: Sample, item: int) -> dict[str, Any]:
        names = dict.fromkeys(("group", "touch_group", "object"), f"new {item // NUM_FRAMES}")
        return {**names, "id": f"new {item}", "split": "test" if item < NUM_FRAMES else "train"}

    for name, source in {"one": Presses(), "other": altered(Presses(), renamed, name="other")}.items():
        build(source, tmp_path / name, size=SIDE, quiet=True)
    both = str(tmp_path / "one"), str(tmp_path / "other")
    assert main(["data", "check", *both, "--json", str(tmp_path / "found.json")]) == 2
    found = {f["item"]: f for f in json.loads((tmp_path / "found.json").read_text())["findings"]}
    shared, says = found["shared by parts"], "is in train or val of part one and in test of part other"
    assert shared["verdict"] == "broken" and says in shared["evidence"]
    assert found["groups across splits"]["verdict"] == "ok"
    assert main(["data", "info", *both]) == 0 and "is in train or val of part one" in capsys.readouterr().out


@pytest.mark.skipif(not REAL.is_dir(), reason="tactip_shear is not beside the project")
def test_real_touches_of_another_size_are_found(tmp_path: Path) -> None:
    """Of 60 touches half is in train of one pack, at 72 px, and in test of the other, at 36 px, and the others so, too."""
    files = sorted((REAL / "cr_test").glob("*.png"))[:60]
    for side, size in ((0, 72), (1, 36)):
        cells = (f"{file},{side}-{i},{('train', 'test')[(i + side) % 2]}" for i, file in enumerate(files))
        (tmp_path / f"{side}.csv").write_text("\n".join(["touch,object,split", *cells]))
        source = FolderConfig(path=tmp_path / f"{side}.csv", group="object", title=str(side)).source()
        build(source, tmp_path / f"pack{side}", size=size, quiet=True)
    file = tmp_path / "found.json"
    assert main(["data", "check", *(str(tmp_path / f"pack{side}") for side in (0, 1)), "--json", str(file)]) == 1
    found = {f["item"]: f for f in json.loads(file.read_text())["findings"]}["near-copies across splits"]
    assert int(re.search(r"touch: (\d+) of", found["evidence"])[1]) > 30, found["evidence"]  # type: ignore[index]


@pytest.mark.parametrize("objects", ["the same", "others", "the same, of two sensors"])
def test_resized_copies_in_another_pack_are_found(tmp_path: Path, objects: str) -> None:
    """What training on one pack and scoring on the other would not call a leak. The other names no sensors."""

    def seen(obj: int, k: int) -> np.ndarray:
        if "sensors" not in objects:
            return gel(obj, k)
        dots, weave = (np.random.default_rng(seed).random((SIDE // 4, SIDE // 4, 1)) for seed in (9, [9, obj, k]))
        own = 60 * weave + 40 * (dots < 0.3) * (obj // 3 % 2)
        return np.clip(gel(obj, k) + np.kron(own, np.ones((4, 4, 1))), 0, 255).astype(np.uint8)

    def renamed(_: Sample, item: int) -> dict[str, Any]:
        obj, k = divmod(item, NUM_FRAMES)
        shown = obj + 100 if objects == "others" else (obj + 1) % NUM_OBJECTS
        names = {"id": f"new {item}", "group": f"new {obj}", "touch_group": f"new {obj}", "sensor": "new"}
        images = {"vision": camera(shown, k), "touch": seen(shown, k)}
        larger = {m: Image.fromarray(image).resize((48, 48), Image.Resampling.BICUBIC) for m, image in images.items()}
        return {m: np.asarray(image) for m, image in larger.items()} | names

    one, other = (tmp_path / name for name in ("one", "other"))
    build(altered(Presses(), lambda _, item: {"touch": seen(*divmod(item, NUM_FRAMES))}), one, size=SIDE, quiet=True)
    build(altered(Presses(), renamed, name="renamed"), other, size=SIDE, quiet=True)
    file = tmp_path / "found.json"
    assert main(["data", "check", str(one), str(other), "--json", str(file)]) in (0, 1)
    found = {f["item"]: f for f in json.loads(file.read_text())["findings"]}["near-copies across splits"]
    assert found["verdict"] == ("ok" if objects == "others" else "look"), found["evidence"]
    assert "sensors" not in objects or int(re.search(r"touch: (\d+) of", found["evidence"])[1]) > 110, found["evidence"]  # type: ignore[index]
