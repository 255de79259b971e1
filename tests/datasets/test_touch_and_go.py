"""Touch and Go as published: the lists to their counts, the tree to its pairs, the splits to what they share."""

import os
import resource
import shutil
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from mvitac.bench.suite import find_suite, open_set
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.video import frames
from mvitac.datasets.table.splits import stratify
from mvitac.datasets.touch_and_go import lists
from mvitac.datasets.touch_and_go.lists import CLASSES, SOFT, assign_by_recording, find_touches, read_list, read_lists
from mvitac.datasets.touch_and_go.reader import TouchAndGoConfig, _columns, _spec
from mvitac.evaluation.leaks import Scored, source_of
from mvitac.evaluation.probe import split_rows
from mvitac.evaluation.retrieval import retrieved_rows
from mvitac.methods.mvitac import MViTacConfig
from mvitac.methods.supervised import SupervisedConfig
from support.videos import numbered, picture, read_number, write_video

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
LISTS, SAMPLE = SHARED / "touch_and_go_lists", SHARED / "touch_and_go_sample"
published = pytest.mark.skipif(not LISTS.is_dir(), reason="the published lists are not here")

NAMES = [f"202205{day:02d}_120000" for day in range(1, 9)]
NUM_FRAMES = 160
TOUCHES = {"train": (range(20, 30), range(130, 145)), "test": (range(70, 78),)}
"""Listed runs of frames of every recording but the last, which no list of categories names."""


def write_tree(root: Path, *, jpegs: bool = False) -> Path:
    """Eight recordings in the owners' layout. Recording r is of category 2 r and 2 r + 1; four are in the rough lists,
    two of them on the other side than in the category lists."""
    rows: dict[str, list[str]] = defaultdict(list)
    for place, name in enumerate(NAMES):
        folder = root / "dataset" / name
        for stem, stream in (("video", "vision"), ("gelsight", "touch")):
            if jpegs:
                (folder / f"{stem}_frame").mkdir(parents=True)
                for number in range(NUM_FRAMES):
                    image = Image.fromarray(numbered(number, stream))
                    image.save(folder / f"{stem}_frame" / f"{number:010d}.jpg", quality=95)
            else:
                write_video(folder / f"{stem}.mp4", NUM_FRAMES, lambda i, s=stream: numbered(i, s))
        for side, runs in TOUCHES.items():
            for touch, run in enumerate(runs):
                rows[side] += [f"{name}/{i:010d}.jpg,{(2 * place + touch) % 20}" for i in run if place < 7]
        rough = "train" if place < 2 or place == 7 else "test" if place < 4 else ""
        for number in (*range(70, 74), *range(130, 134)) if rough else ():
            rows[f"{rough}_rough"].append(f"{name}/{number:010d}.jpg,{int(number < 100)}")
    rng = np.random.default_rng(0)
    for name, lines in rows.items():  # the owners' are shuffled and end without a newline
        (root / f"{name}.txt").write_text("\n".join(lines[i] for i in rng.permutation(len(lines))))
    return root


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tree(tmp_path_factory.mktemp("tag"))


def packed(root: Path, out: Path, *, workers: int = 1, max_damaged: float = 0.0, **options: Any) -> Pack:
    config = TouchAndGoConfig(root=root, size=32, **options)
    return build(config.source(), out, size=32, workers=workers, max_damaged=max_damaged, quiet=True)


@pytest.fixture(scope="module")
def official(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return packed(tree, tmp_path_factory.mktemp("official") / "pack", split="official")


@published
def test_the_published_lists_parse_to_the_published_counts() -> None:
    counts = {}
    for name, num_classes in (("train", 20), ("test", 20), ("train_rough", 2), ("test_rough", 2)):
        rows = read_list(LISTS / f"{name}.txt", num_classes)
        counts[name] = (len(rows), len({recording for recording, _, _ in rows}))
        assert min(label for _, _, label in rows) >= 0
    rough = {"train_rough": (35_119, 19), "test_rough": (8_085, 4)}
    assert counts == {"train": (91_982, 120), "test": (29_879, 106), **rough}
    test = Counter(label for _, _, label in read_list(LISTS / "test.txt", 20))
    assert round(1 - sum(test[label] for label in SOFT) / test.total(), 3) == 0.680  # hard
    assert round(max(test.values()) / test.total(), 3) == 0.240 and 10 not in test


@published
def test_frames_that_only_the_rough_lists_name_are_hidden_from_all_else() -> None:
    """Retrieval has the owners' 29,879 test rows, not 50,614, and the supervised rough has the labels of its probe."""
    listed = read_lists(LISTS)
    find_touches(listed)
    lists.assign_official(listed, 0, 0)
    pack = object.__new__(Pack)  # the table alone
    pack.spec, pack.images = _spec(TouchAndGoConfig(split="official"), True, (), False), {}
    pack.table, pack.num = pa.Table.from_pylist([_columns(frame, pack.spec) for frame in listed]), len(listed)
    split, touch = pack.column("split"), pack.column("touch_group")
    named = np.array([frame.listed for frame in listed])
    assert (split == "test").sum() == 50_614 and len(set(touch[split == "test"]) & set(touch[split == "train"])) == 177
    test = retrieved_rows(pack, "test")
    assert len(test) == 29_879 and set(named[test]) == {"test"}
    assert not set(touch[test]) & set(touch[pack.rows("train")])
    assert pack.hidden.sum() == 20_735 and (pack.column("split_rough")[pack.hidden] == "train").sum() == 16_892
    rows = split_rows(pack, next(task for task in pack.spec.tasks if task.name == "rough"))
    assert (len(rows.fitted), len(rows.test)) == (35_119, 8_085)
    assert set(SupervisedConfig(tasks=("rough",)).training_rows(pack)) == set(rows.fitted)
    assert len(MViTacConfig().training_rows(pack)) == 91_982
    groups = pack.column("group")
    kept = ["id", "group", "split", "split_rough", "label_category", "label_soft", "label_rough"]
    pack.table = pack.table.select(kept)
    source, scored = source_of(pack, pack.rows("train")), Scored(pack)
    says = f"0 of 29879 test rows and 100 of {len(set(groups[test]))} test recordings were trained on"
    assert scored.leak([source], test) == f"{says} (touch-and-go (official))"


@published
def test_the_published_lists_make_one_index_and_its_leaks_are_said() -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # of the tests before it
    listed = read_lists(LISTS)
    assert len(listed) == 142_596 and len({frame.recording for frame in listed}) == 126
    assert lists.leaks(listed) == [
        "official split: 100 of 106 test recordings are also in train (other touches)",
        "official split: 3289 of 8085 rough/smooth test frames are in the pre-training list",
    ]
    find_touches(listed)
    sides = defaultdict(set)
    for frame in listed:
        sides[frame.recording, frame.touch].add(frame.listed)
    assert not any({"train", "test"} <= side for side in sides.values())  # the owners divide by touch
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 2e6  # kB


@published
def test_by_recording_gives_every_side_its_share_of_every_category() -> None:
    listed = read_lists(LISTS)
    assign_by_recording(listed, 0.25, 0.15, 0)
    dealt = {frame.recording: frame.split for frame in listed}
    assert all(dealt[frame.recording] == frame.split == frame.split_rough for frame in listed)
    total, rows, places = Counter(), Counter(), defaultdict(set)
    for frame in listed:
        for task in [f"c{frame.category}"] * (frame.category >= 0) + [f"r{frame.rough}"] * (frame.rough >= 0):
            total[task] += 1
            rows[task, frame.split] += 1
            places[task].add(frame.recording)
    assert len(total) == 19 + 2
    for task in total:
        for side, share in (("train", 0.6), ("val", 0.15), ("test", 0.25)):
            assert rows[task, side] > 0, (task, side)
            if len(places[task]) >= 10:
                assert abs(rows[task, side] / total[task] - share) < 0.13, (task, side)
    before = [frame.split for frame in listed]
    assign_by_recording(listed, 0.25, 0.15, 0)
    assert [frame.split for frame in listed] == before
    assign_by_recording(listed, 0.25, 0.15, 1)
    assert [frame.split for frame in listed] != before


@pytest.mark.parametrize("seed", range(5))
def test_stratify_reaches_the_best_where_it_can_be_counted(seed: int) -> None:
    kinds = np.repeat(np.array([[10, 0, 0], [0, 20, 0], [5, 5, 0]]), 8, axis=0)  # 8 alike groups of each of 3 kinds
    side = stratify(kinds, (0.5, 0.25, 0.25), seed)
    assert np.stack([np.bincount(side[8 * k : 8 * k + 8], minlength=3) for k in range(3)]).tolist() == [[4, 2, 2]] * 3


def check_pairs(pack: Pack) -> None:
    """Both images of every row say the number in its id, and are of the modality they stand under."""
    for row, name in enumerate(pack.column("id")):
        number = int(name.split("/")[1])
        assert number == pack.column("frame")[row]
        for modality in pack.spec.modalities:
            assert read_number(pack.images[modality][row]) == (number, modality)


def test_frame_137_pairs_with_frame_137(official: Pack) -> None:
    assert f"{NAMES[3]}/0000000137" in official.column("id")
    check_pairs(official)
    assert official.num == 7 * (10 + 15 + 8) + 8  # the last recording: eight frames of the rough lists alone


def test_jpegs_and_videos_give_the_same_pairs(official: Pack, tmp_path: Path) -> None:
    pack = packed(write_tree(tmp_path, jpegs=True), tmp_path / "pack", split="official")
    check_pairs(pack)
    pixels = ["crc_vision", "crc_touch"]  # which two codecs do not leave alike
    assert pack.table.drop_columns(pixels).equals(official.table.drop_columns(pixels))


def test_three_tasks_share_the_rows(official: Pack) -> None:
    category, soft, rough = (official.column(f"label_{task}") for task in ("category", "soft", "rough"))
    assert [task.classes for task in official.spec.tasks[1:]] == [("hard", "soft"), ("smooth", "rough")]
    assert official.spec.tasks[0].classes == CLASSES and len(CLASSES) == 20 and ((category < 0) == (soft < 0)).all()
    assert (soft[category >= 0] == np.isin(category[category >= 0], SOFT)).all()
    last = official.column("group") == NAMES[7]
    assert (category[last] == -1).all() and (rough[last] >= 0).all()
    assert (rough[rough >= 0] == (official.column("frame")[rough >= 0] < 100)).all()


def test_the_official_split_is_the_lists(official: Pack) -> None:
    category, rough = official.spec.tasks[0], official.spec.tasks[2]
    frame, place = official.column("frame"), np.array([NAMES.index(name) for name in official.column("group")])
    found = split_rows(official, category)
    assert set(frame[found.test]) == {*range(70, 78)}
    assert {*found.train, *found.val} == {*np.flatnonzero(((frame < 70) | (frame >= 130)) & (place < 7))}
    found = split_rows(official, rough)
    assert set(place[found.test]) == {2, 3} and set(place[[*found.train, *found.val]]) == {0, 1, 7}
    seen = official.rows("train", "unlabelled")  # pre-training sees the owners' list and nothing else
    assert len(seen) == 7 * 25 and set(frame[seen]) == {*range(20, 30), *range(130, 145)}
    # A method that learns from labels is not told those of the rough test list, whose frames it sees.
    assert (official.labels(rough.name, "train")[np.isin(place, (2, 3))] == -1).all()
    assert (official.column("label_rough")[seen][np.isin(place[seen], (2, 3))] >= 0).any()
    assert official.spec.notes[0] == "official split: 7 of 7 test recordings are also in train (other touches)"
    assert official.spec.notes[1] == "official split: 8 of 16 rough/smooth test frames are in the pre-training list"


def test_val_is_carved_from_train_by_recording(tree: Path, tmp_path: Path) -> None:
    pack = packed(tree, tmp_path / "pack", split="official", val_share=0.3, modalities="touch")
    group = pack.column("group")
    held, kept = set(group[pack.rows("val")]), set(group[pack.rows("train")])
    assert held and kept and not held & kept
    assert set(pack.column("frame")[pack.rows("val")]) == {*range(20, 30), *range(130, 145)}


def test_by_recording_shares_no_recording(tree: Path, tmp_path: Path) -> None:
    pack = packed(tree, tmp_path / "pack", modalities="touch")
    sides = [set(pack.column("group")[pack.rows(name)]) for name in ("train", "val", "test")]
    assert all(sides) and sum(map(len, sides)) == len(set().union(*sides)) == 8
    assert not pack.spec.notes and pack.spec.name == "touch-and-go (by-recording)"
    assert {task.split for task in pack.spec.tasks} == {"split"}


def test_runs_of_frames_are_touches(official: Pack) -> None:
    runs = defaultdict(list)
    for touch, frame in zip(official.column("touch_group"), official.column("frame"), strict=True):
        runs[touch].append(int(frame))
    assert len(runs) == 7 * 3 + 2
    for touch, members in runs.items():
        assert members == list(range(members[0], members[-1] + 1)) and touch.endswith(f"/{members[0]:010d}")


def test_a_frame_without_a_label_is_left_out(tree: Path, tmp_path: Path) -> None:
    root = shutil.copytree(tree, tmp_path / "tree")
    lines = (root / "train.txt").read_text().splitlines()
    lines[0] = lines[0].split(",")[0] + ",-1"  # inconclusive
    (root / "train.txt").write_text("\n".join(lines))
    assert packed(root, tmp_path / "none", modalities="touch").num == 7 * 33 + 8 - 1


def test_the_cache_knows_changed_jpegs(tmp_path: Path) -> None:
    for name, side in zip(NAMES[:2], ("train", "test"), strict=True):
        for task in ("", "_rough"):
            (tmp_path / f"{side}{task}.txt").write_text("\n".join(f"{name}/{i:010d}.jpg,{i % 2}" for i in range(6)))
    config = TouchAndGoConfig(root=tmp_path, size=16, workers=1, split="official")
    packs = []
    for level, when in ((40, 10), (200, 20)):
        for name in NAMES[:2]:
            for stem in ("video", "gelsight"):
                folder = tmp_path / "dataset" / name / f"{stem}_frame"
                for number in range(6):
                    os.utime(picture(folder / f"{number:010d}.jpg", level), (when, when))
        packs.append(config.open(quiet=True))
    assert [(pack.num, int(pack.images["touch"][0, 0, 0, 0])) for pack in packs] == [(12, 40), (12, 200)]
    assert packs[0].meta["fingerprint"] == packs[1].meta["fingerprint"]


def test_missing_recordings_are_named_and_may_be_left_out(tree: Path, tmp_path: Path) -> None:
    root = shutil.copytree(tree, tmp_path / "tree")
    shutil.rmtree(root / "dataset" / NAMES[1])
    (root / "dataset" / NAMES[4] / "video.mp4").unlink()
    (root / "dataset" / NAMES[5] / "video.mp4").write_bytes(b"")
    (root / "dataset" / NAMES[6]).rename(root / "dataset" / f"{NAMES[6]}_rock")
    with pytest.raises(ValueError, match=r"3 of 8 listed recordings .*: 20220505_120000 \(no video\.mp4\)") as told:
        TouchAndGoConfig(root=root).source()
    assert f"{NAMES[5]} (no video.mp4), {NAMES[1]} (no folder)" in str(told.value)
    pack = packed(root, tmp_path / "pack", partial=True)
    assert set(pack.column("group")) == set(NAMES) - {NAMES[1], NAMES[4], NAMES[5]}
    assert "3 of 8 listed recordings cannot be packed" in pack.spec.notes[-1]
    assert sorted(pack.meta["fingerprint"]["missing"]) == [NAMES[1], NAMES[4], NAMES[5]]
    touch = packed(root, tmp_path / "touch", partial=True, modalities="touch")
    assert set(touch.column("group")) == set(NAMES) - {NAMES[1]} and touch.spec.modalities == ("touch",)


def test_a_damaged_stretch_is_left_out_and_listed(tree: Path, tmp_path: Path) -> None:
    path = (root := shutil.copytree(tree, tmp_path / "tree")) / "dataset" / NAMES[2] / "gelsight.mp4"
    with av.open(str(path)) as container:
        at, size = next((p.pos, p.size) for i, p in enumerate(container.demux(video=0)) if i == 134)
    whole = bytearray(path.read_bytes())
    whole[at : at + size] = bytes(size)
    path.write_bytes(whole)
    with pytest.raises(ValueError, match=rf"10 of 239 samples .*, first {NAMES[2]}/0000000134: gelsight\.mp4"):
        packed(root, tmp_path / "strict")
    pack = packed(root, tmp_path / "pack", max_damaged=0.05)
    gone = [f"{NAMES[2]}/{number:010d}" for number in range(134, 144)]  # to the next key frame
    assert [name for name, _ in pack.meta["damaged"]] == gone
    assert not {*gone} & {*pack.column("id")} and pack.num == 239 - 10
    check_pairs(pack)


def test_jpegs_that_are_missing_or_cut_are_listed(tmp_path: Path) -> None:
    folder = (root := write_tree(tmp_path / "tree", jpegs=True)) / "dataset" / NAMES[0] / "video_frame"
    (folder / "0000000021.jpg").unlink()
    (folder / "0000000025.jpg").write_bytes((folder / "0000000025.jpg").read_bytes()[:300])
    pack = packed(root, tmp_path / "pack", max_damaged=0.05)
    assert [name for name, _ in pack.meta["damaged"]] == [f"{NAMES[0]}/0000000021", f"{NAMES[0]}/0000000025"]
    assert "No such file" in pack.meta["damaged"][0][1] and "cannot be read" in pack.meta["damaged"][1][1]


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("train.txt", "nonsense", "train.txt line 1 is 'nonsense': expected <recording>/<10 digits>.jpg,<label>"),
        ("train.txt", "a/0000000001.jpg,20", "train.txt line 1: label 20 is not in -1 to 19"),
        ("test.txt", f"\ufeff{NAMES[0]}/0000000020.jpg,1", "0000000020.jpg is listed twice"),
        ("train_rough.txt", None, "has no train_rough.txt: the lists are in https://github.com"),
    ],
)
def test_bad_lists_are_told(tree: Path, tmp_path: Path, name: str, text: str | None, expected: str) -> None:
    for file in tree.glob("*.txt"):
        shutil.copy(file, tmp_path)
    (tmp_path / name).unlink() if text is None else (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=r"\.txt") as told:
        TouchAndGoConfig(root=tree, lists=tmp_path).source()
    assert expected in str(told.value)


@pytest.mark.skipif(not SAMPLE.is_dir(), reason="the real recordings are not here")
def test_a_real_recording_without_its_camera_video(tmp_path: Path) -> None:
    options: dict[str, Any] = {"lists": LISTS, "split": "official", "partial": True}
    with pytest.raises(ValueError, match=r"20220319_002026 \(no video\.mp4\)"):
        TouchAndGoConfig(root=SAMPLE, **options).source()
    pack = packed(SAMPLE, tmp_path / "pack", modalities="touch", **options)
    assert [task.name for task in pack.spec.tasks] == ["category", "soft"]  # the rough lists name no frame of it
    assert pack.num == 76 and set(pack.column("label_category")) == {15}  # the folder's name ends in _rock
    shown = dict(frames(SAMPLE / "20220319_002026_rock" / "gelsight.mp4", pack.column("frame"), 32))
    assert all(np.array_equal(shown[n], pack.images["touch"][i]) for i, n in enumerate(pack.column("frame")))


def test_the_suite_of_the_bench_reads_both_splits(tree: Path, tmp_path: Path) -> None:
    (tmp_path / "touch_and_go").symlink_to(tree)
    sets = find_suite("tag-v1").sets
    small = [replace(one, forms=(replace(f := one.forms[0], data={**f.data, "size": 16}),)) for one in sets]
    by_recording, official = (open_set(one, tmp_path) for one in small)
    assert not isinstance(by_recording, str) and not isinstance(official, str)
    shared = []
    for opened in (by_recording, official):
        (pack,) = opened.packs
        assert [task.name for _, task in opened.tasks] == ["category", "soft", "rough"]
        sides = [set(pack.column("group")[pack.rows(side)].tolist()) for side in ("train", "test")]
        shared.append(len(sides[0] & sides[1]))
    assert shared[0] == 0 < shared[1]  # the owners' lists test recordings that are also in train
    assert by_recording.digests["rows"] != official.digests["rows"]
