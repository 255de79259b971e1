"""Images inside something else: LeRobot datasets, parquet of the hub; each pixel beside its own row."""

import io
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.datasets.folder import FolderConfig
from mvitac.datasets.lerobot import LeRobotConfig, choose
from mvitac.datasets.table.table import RowsConfig
from support.forged_packs import refuse_pipe
from support.videos import film, level, shade


def packed(config: RowsConfig, out: Path) -> Pack:
    return build(config.source(), out, size=config.size, quiet=True)


def png(value: int, size: tuple[int, int] = (20, 16)) -> bytes:
    Image.new("RGB", size, (value, value, value)).save(buffer := io.BytesIO(), "PNG")
    return buffer.getvalue()


FRONT, GEL = "observation.images.front", "observation.images.gelsight"
LENGTHS = (12, 8, 10)


def make_lerobot(root: Path, *, gel_rate: int = 10, version: str = "v3.0") -> Path:
    """Three episodes at 10 Hz: front embedded in two data files, the gel in two videos of ``gel_rate``."""
    info = {
        "codebase_version": version,
        "fps": 10,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": {
            FRONT: {"dtype": "image", "shape": [16, 20, 3]},
            GEL: {"dtype": "video", "shape": [48, 64, 3]},
            "kind": {"dtype": "int64", "shape": [1]},
            "observation.state": {"dtype": "float32", "shape": [2]},
            **{n: {"dtype": "int64", "shape": [1]} for n in ("frame_index", "episode_index", "index", "task_index")},
            "timestamp": {"dtype": "float32", "shape": [1]},
        },
    }
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    index = "__index_level_0__"
    pq.write_table(pa.table({"task_index": [0, 1], index: ["press", "slide"]}), root / "meta/tasks.parquet")
    factor = gel_rate // 10
    film(root / f"videos/{GEL}/chunk-000/file-000.mp4", 20 * factor, which=1, rate=gel_rate)
    film(root / f"videos/{GEL}/chunk-000/file-001.mp4", 10 * factor, which=2, rate=gel_rate)
    key, at = f"videos/{GEL}", ((0, 0.0, 1.2), (0, 1.2, 2.0), (1, 0.0, 1.0))
    names = ("file_index", "from_timestamp", "to_timestamp")
    places = [{f"{key}/{n}": v for n, v in zip(names, values, strict=True)} for values in at]
    episodes = [{"episode_index": e, f"{key}/chunk_index": 0, **place} for e, place in enumerate(places)]
    pq.write_table(pa.Table.from_pylist(episodes), root / "meta/episodes/chunk-000/file-000.parquet")
    rows: list[dict[str, Any]] = []
    for e, length in enumerate(LENGTHS):
        for i in range(length):
            row = {"frame_index": i, "episode_index": e, "index": len(rows), "task_index": e % 2, "kind": e % 2}
            image = {"bytes": png(10 * e + i), "path": None}
            rows.append({FRONT: image, "timestamp": i / 10, "observation.state": [len(rows) / 4, 2.0], **row})
    for file, part in enumerate((rows[:12], rows[12:])):
        (path := root / f"data/chunk-000/file-{file:03d}.parquet").parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(part), path, row_group_size=5)
    return root


def refused(root: Path, says: str, **options: Any) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        LeRobotConfig(**{"path": root, "labels": ("kind",), **options}).source()
    assert "\n" not in str(caught.value)


def test_lerobot_of_version_2_has_a_file_per_episode(tmp_path: Path) -> None:
    """The layout that lerobot 0.3.3 wrote."""
    root, features = tmp_path / "set", {FRONT: "video", GEL: "video", "force": "float32", "task_index": "int64"}
    info = {
        "codebase_version": "v2.1",
        "chunks_size": 2,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": {name: {"dtype": kind, "shape": [1]} for name, kind in features.items()},
    }
    (root / "meta").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    tasks = [json.dumps({"task_index": k, "task": name}) for k, name in enumerate(("press", "slide"))]
    (root / "meta/tasks.jsonl").write_text("\n".join(tasks))
    lengths = [json.dumps({"episode_index": e, "length": 8}) for e in range(4)]
    (root / "meta/episodes.jsonl").write_text("\n".join(lengths))
    for e in range(4):
        chunk, name = f"chunk-{e // 2:03d}", f"episode_{e:06d}"
        for which, key in enumerate((FRONT, GEL)):
            film(root / f"videos/{chunk}/{key}/{name}.mp4", 8, which=e + which, rate=10)
        known = {"episode_index": e, "task_index": e % 2}
        rows = [{"timestamp": i / 10, "frame_index": i, "index": 8 * e + i, "force": i / 2, **known} for i in range(8)]
        (root / f"data/{chunk}").mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(rows), root / f"data/{chunk}/{name}.parquet")
    config = LeRobotConfig(path=root, size=16, labels=("task",), values=("force:N",))
    by_task = packed(replace(config, group="task", labels=(), values=()), tmp_path / "by-task")
    assert [len({*by_task.column(name)}) for name in ("group", "touch_group")] == [2, 4]  # no window crosses episodes
    pack = packed(config, tmp_path / "pack")
    episode, frame = pack.column("episode").astype(int), pack.column("frame").astype(int)
    assert pack.num == 32 and (pack.values(pack.spec.values[0])[:, 0] == frame / 2).all()
    named = [pack.spec.tasks[0].classes[k] for k in pack.column("label_task")]
    assert named == [("press", "slide")[e % 2] for e in episode]
    for i in range(32):
        assert abs(level(pack.images["vision"][i]) - shade(frame[i], episode[i])) < 6
        assert abs(level(pack.images["touch"][i]) - shade(frame[i], episode[i] + 1)) < 6
    (root / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "a"}\n{"task_')
    refused(root, r"tasks\.jsonl cannot be read \(line 2: .*: fetch it again", labels=("task",))


@pytest.mark.parametrize("gel_rate", [10, 30])
def test_lerobot_pairs_by_time(tmp_path: Path, gel_rate: int) -> None:
    root = make_lerobot(tmp_path / "set", gel_rate=gel_rate)
    (root / "data/chunk-000/._file-000.parquet").touch()  # as other systems leave beside a file
    pack = packed(LeRobotConfig(path=root, size=16, labels=("kind",), tolerance=0.01), tmp_path / "pack")
    assert pack.num == sum(LENGTHS)
    for i in range(pack.num):
        e, frame = int(pack.column("episode")[i]), int(pack.column("frame")[i])
        assert (pack.images["vision"][i] == 10 * e + frame).all()
        at, which = ((frame, 1), (12 + frame, 1), (frame, 2))[e]
        assert abs(level(pack.images["touch"][i]) - shade(at * gel_rate // 10, which)) < 6
        assert pack.column("task")[i] == ("press", "slide")[e % 2]
    assert pack.spec.group_by == "episode"


def test_lerobot_beyond_the_tolerance(tmp_path: Path) -> None:
    root = make_lerobot(tmp_path / "set")
    film(root / f"videos/{GEL}/chunk-000/file-001.mp4", 6, which=2, rate=10)  # the third episode's touch ends early
    says = r"no frame within 0\.04 s of 0\.600 s \(episode 2, the nearest is 0\.100 s"
    refused(root, says, size=16, split="by-group")
    pack = packed(LeRobotConfig(path=root, size=16, labels=("kind",), allow_missing=True), tmp_path / "pack")
    late = (pack.column("episode") == "2") & (pack.column("frame").astype(int) > 5)
    assert (pack.has("touch") == ~late).all() and late.sum() == 4


def test_lerobot_takes_no_frame_of_another_episode(tmp_path: Path) -> None:
    file = (root := make_lerobot(tmp_path / "set")) / "meta/episodes/chunk-000/file-000.parquet"
    episodes = pq.read_table(file).to_pylist()
    episodes[0][f"videos/{GEL}/to_timestamp"] = 1.1  # the frame at 1.1 s, which row 11 would want, is the next one's
    pq.write_table(pa.Table.from_pylist(episodes), file)
    refused(root, r"no frame within 0\.04 s of 1\.100 s \(episode 0, the nearest is 0\.100 s", size=16)


def test_cameras_are_chosen_or_guessed() -> None:
    where, three = Path("set"), ["cam.front", "cam.tactile_l", "cam.tactile_r"]
    assert choose(three, None, (), where) == {"left": "cam.tactile_l", "right": "cam.tactile_r", "vision": "cam.front"}
    assert choose(three, "", ("cam.front",), where) == {"cam.front": "cam.front"}
    assert choose(["a", "b"], "b", ("a",), where) == {"a": "a", "b": "b"}
    found = choose(["front", "finger_cam", "gel"], "finger_cam", (), where)
    assert found == {"touch": "gel", "finger_cam": "finger_cam"}
    assert choose(["front", "finger_cam"], "finger_cam", (), where) == {"finger_cam": "finger_cam"}  # never both senses
    found = choose(["digital_front", "digit_left"], None, (), where)
    assert found == {"touch": "digit_left", "vision": "digital_front"}
    for vision, touch, says in (("cam.frnt", (), "did you mean 'cam.front'"), (None, ("x",), "unknown camera 'x'")):
        with pytest.raises(ValueError, match=says):
            choose(three, vision, touch, where)
    with pytest.raises(ValueError, match="3 cameras that may be touch"):
        choose(["touch1", "touch2", "touch3"], None, (), where)


def test_lerobot_says_what_is_missing(tmp_path: Path) -> None:
    refused(tmp_path / "nowhere", r"info\.json does not exist")
    refused(make_lerobot(tmp_path / "old", version="v1.6"), r"version v1\.6: v2 and v3 are read")
    root = make_lerobot(tmp_path / "set")
    about = (file := root / "meta/info.json").read_text()
    for place in (f"{tmp_path}/old/videos/", "../old/videos/"):
        file.write_text(about.replace('"videos/', f'"{place}'))
        refused(root, "video_path leads out of the dataset, to ")
    for field in ("{video_key:>9000}", "{video_key.__class__}", "{video_key!r:>9}"):
        file.write_text(about.replace("{video_key}", field))
        refused(root, r"video_path is .*, not of fields such as \{file_index:03d\}")
    file.write_text(about)
    for size in (0, '"x"'):
        file.write_text(about.replace("{", f'{{"chunks_size": {size}, ', 1))
        refused(root, "(ZeroDivision|Type)Error")
    file.write_text(about)
    (root / f"videos/{GEL}/chunk-000/file-001.mp4").unlink()
    refused(root, r"file-001\.mp4 is missing: fetch the videos too")
    (root / "data/chunk-000/file-001.parquet").write_text("no")
    refused(root, r"file-001\.parquet cannot be read as a table")
    pq.write_table(pa.table({"touch": [png(1)], "a": ["b"]}), file := tmp_path / "n.parquet")
    file.write_bytes(file.read_bytes().replace(b"touch", b"touc\xc7"))
    with pytest.raises(ValueError, match=r"n\.parquet cannot be read as a table: 'utf-8'"):
        FolderConfig(path=file).source()


def changed(root: Path, change: Callable[[dict[str, Any]], Any], file: str = "data/chunk-000/file-000") -> Path:
    path = root / f"{file}.parquet"
    pq.write_table(pa.Table.from_pylist([change(row) for row in pq.read_table(path).to_pylist()]), path)
    return root


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"timestamp": 0.0}, r"episode 0, frame 1: timestamp 0\S* does not rise"),
        ({"timestamp": float("nan")}, r"data: timestamp of row 1 is ''"),
        ({"frame_index": 3}, r"episode 0, frame 3: frame_index 3 does not rise"),
        ({"episode_index": 7}, r"episode 7 has 12 rows, meta/episodes says nothing"),
        ({"episode_index": 2}, r"episode 2, frame 0: frame_index 0 does not rise"),
        ({"task_index": 5}, r"meta/tasks has no task_index 5"),
    ],
)
def test_lerobot_refuses_rows_that_contradict_its_info(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    """A constant clock paired every row with the first image; a cut table made a smaller pack."""
    refused(changed(make_lerobot(tmp_path / "set"), lambda row: row | change), says)


def test_lerobot_names_the_file_that_lacks_a_column(tmp_path: Path) -> None:
    root = changed(make_lerobot(tmp_path / "set"), lambda row: row)
    refused(root, "interpolate has no effect, --data", interpolate="nearest")
    file = next((root / "data").glob("*/*.parquet"))
    pq.write_table(pq.read_table(file).drop_columns(["task_index"]), file.with_name("file-009.parquet"))
    refused(root, r"file-009\.parquet has no column 'task_index': fetch the whole dataset")


def test_lerobot_says_when_there_is_less_than_was_recorded(tmp_path: Path) -> None:
    root = make_lerobot(tmp_path / "set")
    (file := root / "meta/info.json").write_text(json.dumps(json.loads(file.read_text()) | {"total_frames": 30}))
    changed(root, lambda row: row | {"length": LENGTHS[row["episode_index"]]}, "meta/episodes/chunk-000/file-000")
    assert not LeRobotConfig(path=root, labels=("kind",)).manifest().notes
    table = root / "data/chunk-000/file-001.parquet"
    rows = pq.read_table(table).to_pylist()
    pq.write_table(pa.Table.from_pylist(rows[:-2]), table)
    refused(root, "episode 2 has 8 rows, meta/episodes says 10")
    pq.write_table(pa.Table.from_pylist(rows[:8]), table)  # a dataset that was fetched in part
    spec = packed(LeRobotConfig(path=root, size=16), tmp_path / "pack").spec
    assert "meta/info.json counts 30 frames, 20 are here" in spec.notes
    changed(root, lambda row: row | {"task_index": 0}, "meta/tasks")
    refused(root, "a task_index with two texts")
    for texts in ({}, {"task": ["press", None]}):
        pq.write_table(pa.table({"task_index": [0, 1], **texts}), root / "meta/tasks.parquet")
        refused(root, r"tasks\.parquet is damaged")


@pytest.mark.parametrize("name", ["a.parquet", "a.h5"])
def test_a_pipe_is_no_table(name: str, tmp_path: Path) -> None:
    refuse_pipe(tmp_path / name, FolderConfig(path=tmp_path / name).source, f"{name} .*neither a file nor a folder")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"from_timestamp": 0.0, "to_timestamp": 1.2, "file_index": 0}, r"\d and \d share frames of .*file-000\.mp4"),
        ({"from_timestamp": "soon"}, r"meta/episodes, observation\.images\.gelsight in episode 0, is damaged"),
        ({"from_timestamp": np.nan}, r"meta/episodes, observation\.images\.gelsight in episode 0, begins at nan s"),
        ({"file_index": None}, r"meta/episodes, observation\.images\.gelsight in episode 0, is damaged"),
    ],
)
def test_lerobot_checks_the_places_of_episodes(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    change = {f"videos/{GEL}/{name}": value for name, value in change.items()}
    root = changed(make_lerobot(tmp_path / "set"), lambda row: row | change, "meta/episodes/chunk-000/file-000")
    refused(root, says, size=16, labels=())


def measured(pack: Pack) -> tuple[np.ndarray, np.ndarray]:
    """The targets of the only task with values, [N, T], and the rows' images in the order they were made [N]."""
    (task,) = pack.spec.values
    return pack.values(task), np.array([level(image) for image in pack.images["vision"]])


def test_lerobot_reads_values_and_elements_of_vectors(tmp_path: Path) -> None:
    root = make_lerobot(tmp_path / "set")
    plain = LeRobotConfig(path=root, size=16).source()
    config = LeRobotConfig(path=root, size=16, values=("pose=observation.state[0]:mm,timestamp:s",))
    pack = packed(config, tmp_path / "pack")
    assert {t.name: t.unit for t in pack.spec.values[0].targets} == {"observation.state[0]": "mm", "timestamp": "s"}
    at = np.array([e * 100 + i for e, length in enumerate(LENGTHS) for i in range(length)])
    assert (pack.column("episode").astype(int) * 100 + pack.column("frame").astype(int) == at).all()
    values, _ = measured(pack)
    assert np.allclose(values, np.stack([np.arange(30) / 4, at % 100 / 10], axis=1))
    assert "observation.state" not in str(plain.read(0))  # without such values, nothing changes
    says = r"state\[2\] does not exist: observation.state has 2 numbers"
    refused(root, says, size=16, labels=(), values=("observation.state[2]:mm",))


def test_hub_and_manifests_read_values(tmp_path: Path) -> None:
    hub = FolderConfig(path=make_hub(tmp_path / "hub"), size=16, vision="photo", values=("both=depth:mm,pose[2]:deg",))
    values, shown = measured(packed(hub, tmp_path / "h"))
    number = np.where(shown == 104, np.nan, shown - 100)
    assert np.array_equal(values, np.stack([number / 8, number / 4], axis=1), equal_nan=True)
    for value, why in (("pose[1]:mm", "has fewer than two different"), ("pose:mm", r"an element, such as pose\[0")):
        with pytest.raises(ValueError, match=why):
            FolderConfig(path=tmp_path / "hub", size=16, vision="photo", values=(value,)).source()

    rows = [{"vision": f"{i}.png", "pose": [i / 2, None, -i / 4]} for i in range(12)]
    for i in range(12):
        (tmp_path / f"{i}.png").write_bytes(png(i))
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "m.parquet")
    (tmp_path / "m.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
    lines = [f'{row["vision"]},"{json.dumps(row["pose"])}"' for row in rows]
    (tmp_path / "m.csv").write_text("\n".join(["vision,pose", *lines]).replace("null", "NaN"))
    for kind in ("parquet", "jsonl", "csv"):
        config = FolderConfig(path=tmp_path / f"m.{kind}", size=16, values=("p=pose[0]:mm,pose[2]:mm",))
        values, shown = measured(packed(config, tmp_path / kind))
        assert np.array_equal(values, np.stack([shown / 2, -shown / 4], axis=1)), kind


def make_hub(root: Path) -> Path:
    """Two train files and one test file, class numbers whose names stand in the metadata, one image beside the file."""
    features = {"kind": {"names": ["wood", "metal"], "_type": "ClassLabel"}, "touch": {"_type": "Image"}}
    note = {b"huggingface": json.dumps({"info": {"features": features}}).encode()}
    root.mkdir(parents=True)
    for file, name in enumerate(("train-00000-of-00002", "train-00001-of-00002", "test-00000-of-00001")):
        rows: list[dict[str, Any]] = []
        for i in range(10 * file, 10 * file + 10):
            image: dict[str, Any] = {"bytes": png(i), "path": f"{i}.png"}
            if i == 13:
                (root / "13.png").write_bytes(png(13))
                image["bytes"] = None
            rows.append(
                {"touch": image, "photo": png(100 + i), "kind": -1 if i == 4 else i // 2 % 2, "thing": f"t{i // 2}"}
                | {"depth": None if i == 4 else i / 8, "pose": None if i == 4 else [1.0, float("nan"), i / 4]}
            )
        table = pa.Table.from_pylist(rows)
        pq.write_table(table.replace_schema_metadata(note), root / f"{name}.parquet", row_group_size=4)
    return root


def test_image_parquet_of_the_hub(tmp_path: Path) -> None:
    root = make_hub(tmp_path / "data")
    config = FolderConfig(path=root, size=16, labels=("kind",), group="thing", vision="photo")
    pack = packed(config, tmp_path / "pack")
    assert pack.num == 30 and pack.spec.tasks[0].classes == ("metal", "wood")
    for row, i in enumerate(int(level(image)) for image in pack.images["touch"]):
        assert (pack.images["vision"][row] == 100 + i).all()
        assert pack.column("label_kind")[row] == (-1 if i == 4 else (1, 0)[i // 2 % 2])
        assert pack.column("group")[row] == f"t{i // 2}"
        assert pack.column("split")[row] == ("test" if i >= 20 else "train")
    assert len({level(image) for image in pack.images["touch"]}) == 30
    file = (root / "train-00001-of-00002.parquet").rename(tmp_path / "elsewhere")
    assert "1 of the 2 files train-* are here" in config.manifest().notes
    file.rename(root / "train-00001-of-00002.parquet")
    for file in [*root.glob("*.parquet"), root / "13.png"]:  # as the Hub converts a dataset
        os.renames(file, root / ("eval" if file.stem[:4] == "test" else "training") / file.name.split("-", 1)[-1])
    assert sorted(packed(config, tmp_path / "again").column("split")) == ["test"] * 10 + ["train"] * 20


def test_a_table_shows_no_image_of_other_folders(tmp_path: Path) -> None:
    secret, link = tmp_path / "secret.png", tmp_path / "data" / "link.png"
    link.parent.mkdir()
    secret.write_bytes(png(9))
    link.symlink_to(secret)
    for name in (str(secret), "../secret.png", "link.png"):
        rows = [{"touch": {"bytes": None if i == 3 else png(i), "path": name}, "kind": i % 2} for i in range(20)]
        pq.write_table(pa.Table.from_pylist(rows), link.parent / "d.parquet")
        with pytest.raises(ValueError, match=r"1 of 20 samples .*row 3 touch holds no image"):
            packed(FolderConfig(path=link.parent / "d.parquet", labels=("kind",), size=16), tmp_path / "pack")


def test_hub_parquet_with_gaps(tmp_path: Path) -> None:
    images = [None if i == 3 else {"bytes": png(i), "path": None} for i in range(20)]
    rows = [{"obs.touch": image, "photo": png(i), "kind": i % 2} for i, image in enumerate(images)]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "gaps.parquet")
    options: dict[str, Any] = {"labels": ("kind",), "vision": "photo", "touch": ("obs.touch",), "size": 16}
    with pytest.raises(ValueError, match=r"row 4 has no obs\.touch path"):
        FolderConfig(path=tmp_path / "gaps.parquet", **options).source()
    pack = packed(FolderConfig(path=tmp_path / "gaps.parquet", allow_missing=True, **options), tmp_path / "pack")
    assert (~pack.has("touch")).sum() == 1 and level(pack.images["vision"][~pack.has("touch")]) == 3
