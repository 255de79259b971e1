"""What a table of samples may hold beyond one file per image: videos, gaps, backgrounds, sensors, plain class folders."""

import csv
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from mvitac.data import video
from mvitac.data.build import build
from mvitac.data.checks.examine import examine_source
from mvitac.data.images import difference
from mvitac.data.pack import Pack
from mvitac.data.source import Sample
from mvitac.datasets.folder import FolderConfig
from mvitac.datasets.table import table as rows_module
from support.videos import film, level, picture, shade

Table = list[dict[str, Any]]


def table(file: Path, rows: Table) -> Path:
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return file


def packed(path: Path, out: Path, *, workers: int = 1, **options: Any) -> Pack:
    return build(FolderConfig(path=path, size=16, **options).source(), out, size=16, workers=workers, quiet=True)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("films")
    for k in range(4):
        film(root / f"{k}/camera.mp4", 40, which=k)
        film(root / f"{k}/gel.avi", 40, which=k + 1, size=(96, 64))
    return root


def film_rows() -> Table:
    order = np.random.default_rng(0).permutation(40).tolist()
    films = [{"vision": f"{k}/camera.mp4", "touch": f"{k}/gel.avi", "take": k, "label": "ab"[k % 2]} for k in range(4)]
    return [{**film, "frame": i, "touch_frame": (i + 3) % 40} for film in films for i in order[:12]]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_video_and_a_frame_number_give_that_very_frame(films: Path, tmp_path: Path, workers: int) -> None:
    rows = film_rows()
    file = table(films / f"table{workers}.csv", rows)
    pack = packed(file, tmp_path / "pack", workers=workers, labels=("label",), group="take")
    assert pack.num == len(rows)
    for i, number in enumerate(pack.column("id").astype(int)):
        row = rows[number - 1]
        k, frame = row["take"], row["frame"]
        assert abs(level(pack.images["vision"][i]) - shade(frame, k)) < 6
        assert abs(level(pack.images["touch"][i]) - shade(row["touch_frame"], k + 1)) < 6


def test_every_video_is_decoded_once(films: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = Mock(wraps=video.frames)
    monkeypatch.setattr(video, "frames", frames)
    packed(table(films / "once.csv", film_rows()), tmp_path / "p", labels=("label",), group="take")
    asked = [call.args for call in frames.call_args_list]
    assert len(asked) == 8 == len({path for path, _ in asked})
    assert all(indices == sorted(set(indices)) and len(indices) == 12 for _, indices in asked)
    monkeypatch.setattr(rows_module, "MAX_TOGETHER", 5)  # what is too much for the memory is read in turns
    frames.reset_mock()
    packed(table(films / "once.csv", film_rows()), tmp_path / "q", labels=("label",), group="take")
    assert frames.call_count == 3 * 8 and Pack(tmp_path / "q").digest == Pack(tmp_path / "p").digest
    monkeypatch.setattr(rows_module, "MAX_TOGETHER_BYTES", 4 * 16 * 16 * 6)  # four rows of two images
    source = FolderConfig(path=films / "once.csv", size=16, labels=("label",), group="take").source()
    assert list(source.samples_per_item()) == [4, 4, 4] * 4


def test_no_video_is_split_where_no_group_is_given(films: Path, tmp_path: Path) -> None:
    rows = [{"touch": f"{k}/gel.avi", "frame": i, "label": "ab"[k % 2]} for k in range(4) for i in range(12)]
    rows += [{"touch": picture(films / "alone.png", 200).name, "frame": "", "label": "a"}]
    pack = packed(table(films / "loose.csv", rows), tmp_path / "pack", labels=("label",), val_share=0.0)
    videos = [rows[int(name) - 1]["touch"] for name in pack.column("id")]
    assert len(set(zip(videos, pack.column("split"), strict=True))) == len(set(videos)) == 5
    assert set(pack.column("group")) == {f"{k}/gel.avi" for k in range(4)} | {"000049"}
    assert pack.spec.group_by == "video" and "frames of one video are one group" in pack.spec.notes[0]


def test_videos_that_a_row_shows_side_by_side_are_one_group(films: Path) -> None:
    camera, gel = "{}/camera.mp4", "{}/gel.avi"
    pairs = [(camera.format(a), gel.format(b)) for a, b in ((0, 0), (1, 1), (0, 2), (3, 3))]
    rows = [{"vision": v, "touch": t, "frame": i} for v, t in pairs for i in (1, 2)]
    source = FolderConfig(path=table(films / "chain.csv", rows), size=16).source()
    groups = {s.columns["id"]: s.columns["group"] for i in range(4) for s in source.read(i) if isinstance(s, Sample)}
    assert len(set(groups.values())) == 3 and groups["000001"] == groups["000005"]  # both seen by camera 0


def test_a_split_that_cuts_a_video_is_refused_and_seen_by_the_doctor(films: Path) -> None:
    frames = [(k, i) for k in range(4) for i in range(12)]
    rows = [{"touch": f"{k}/gel.avi", "frame": i, "split": "test" if i > 8 else "train"} for k, i in frames]
    config = FolderConfig(path=table(films / "cut.csv", rows), size=16)
    with pytest.raises(ValueError, match=r"4 of 4 groups \(video\) are in more than one split, e\.g\. '0/gel\.avi'"):
        config.source()
    findings = examine_source(replace(config, allow_leak=True).source(), size=16, quiet=True)
    (found,) = [finding for finding in findings if finding.item == "groups across splits"]
    assert found.verdict == "broken" and "group (video): 4 of 4 in more than one split" in found.evidence
    findings = examine_source(replace(config, split="by-group").source(), size=16, quiet=True)
    assert [finding.verdict for finding in findings if finding.item == "groups across splits"] == ["ok"]


@pytest.mark.parametrize(
    ("cells", "says"),
    [
        ({"frame": ""}, r"row 2: 0/camera\.mp4 is a video, frame '': give the frame"),
        ({"touch_frame": "1.5"}, r"row 2: 0/gel\.avi .* touch_frame '1\.5'"),
    ],
)
def test_bad_frames_are_named(films: Path, tmp_path: Path, cells: dict[str, Any], says: str) -> None:
    (rows := film_rows())[1].update(cells)
    with pytest.raises(ValueError, match=says) as caught:
        packed(table(films / "bad.csv", rows), tmp_path / "pack", labels=("label",), group="take", split="by-group")
    assert "\n" not in str(caught.value)


def test_a_bad_frame_costs_its_own_row_only(films: Path, tmp_path: Path) -> None:
    """And it is said that the number is wrong, not the file, though the decoder has run through all of it."""
    rows = film_rows()
    rows[1]["frame"] = 40
    rows[30]["touch"] = "text.mp4"
    (films / "text.mp4").write_text("no video")
    config = FolderConfig(path=table(films / "few.csv", rows), size=16, labels=("label",), group="take")
    with pytest.raises(ValueError, match=r"first row 31: .*text\.mp4 cannot be read as a video"):
        build(config.source(), tmp_path / "none", size=16, quiet=True)
    pack = build(config.source(), tmp_path / "pack", size=16, quiet=True, max_damaged=0.3)
    assert pack.num == 46
    (whole, _), (one, why) = pack.meta["damaged"]
    assert (whole, one) == ("row 31", "row 2")
    assert re.search(r"0/camera\.mp4: frame 40 is wanted, the video ends after frame 39", why)
    for i, name in enumerate(pack.column("id")):
        row = rows[int(name) - 1]
        assert abs(level(pack.images["vision"][i]) - shade(row["frame"], row["take"])) < 6
        assert abs(level(pack.images["touch"][i]) - shade(row["touch_frame"], row["take"] + 1)) < 6


def gappy(root: Path) -> Table:
    rows: Table = []
    for i in range(24):
        row = {
            "vision": f"v/{picture(root / f'v/{i}.png', 10 + i).name}",
            "left": f"l/{picture(root / f'l/{i}.png', 100 + i).name}",
            "right": f"r/{picture(root / f'r/{i}.png', 200 + i).name}",
            "label": "ab"[i // 2 % 2],
            "object": i // 2,
        }
        if i % 6 == 1:
            row["vision"] = ""
        if i % 6 == 2:
            row["left"] = row["right"] = ""
        rows.append(row)
    return rows


def test_a_row_may_lack_a_modality(tmp_path: Path) -> None:
    file = table(tmp_path / "m.csv", gappy(tmp_path))
    with pytest.raises(ValueError, match=r"row 2 .*has no vision path: .*allow-missing"):
        packed(file, tmp_path / "no", labels=("label",), group="object")
    first, *others = gappy(tmp_path)
    half = table(tmp_path / "half.csv", [{**first, "left": ""}, *others])
    with pytest.raises(ValueError, match=r"row 1 .*has no left path: stacked sensors need both images"):
        packed(half, tmp_path / "no", labels=("label",), group="object", allow_missing=True)
    pack = packed(file, tmp_path / "pack", labels=("label",), group="object", allow_missing=True)
    numbers = pack.column("id").astype(int) - 1
    assert (pack.has("vision") == (numbers % 6 != 1)).all() and (pack.has("touch") == (numbers % 6 != 2)).all()
    for i, number in enumerate(numbers):
        assert (pack.images["vision"][i] == (10 + number) * pack.has("vision")[i]).all()
        assert (pack.images["touch"][i, :, :, 3:] == (200 + number) * pack.has("touch")[i]).all()


def test_differences_are_halved_around_the_middle() -> None:
    values = np.arange(256, dtype=np.uint8)
    image, background = (np.repeat(v.reshape(256, 256, 1), 3, 2) for v in np.meshgrid(values, values))
    exact = (image.astype(float) - background) / 2 + 127.5
    found = difference(image, background)
    assert (np.abs(found - exact) <= 0.5).all() and (found[image == background] == 128).all()
    assert found.min() == 0 and found.max() == 255


def pressed(root: Path) -> Table:
    """Two sensors with another background each; rows 1, 2 and 13, 14 show no contact."""
    rows: Table = []
    for i in range(24):
        base, empty = (60, 180)[i // 12], i % 12 < 2
        value = base + (2 * (i % 12) - 1 if empty else 5 * (i % 12) - 40)
        images = {"touch": picture(root / f"{i}.png", value), "background": picture(root / f"own{i}.png", 50 + i)}
        row = {column: file.name for column, file in images.items()} | {"sensor": ("digit", "mini")[i // 12]}
        rows.append(row | {"phase": "empty" if empty else "press", "label": "ab"[i % 2], "value": value})
    return rows


def test_backgrounds_by_row(tmp_path: Path) -> None:
    rows = pressed(tmp_path)
    for free in (50, 20):  # of files that change
        for i in range(24):
            picture(tmp_path / f"own{i}.png", free + i)
        pack = packed(table(tmp_path / "m.csv", rows), tmp_path / f"p{free}", labels=("label",), difference=True)
        assert pack.spec.difference
        for i, number in enumerate(pack.column("id").astype(int) - 1):
            assert (pack.images["touch"][i] == (rows[number]["value"] - free - number + 256) // 2).all()


def test_backgrounds_by_sensor(tmp_path: Path) -> None:
    rows = pressed(tmp_path)
    options: dict[str, Any] = {"labels": ("label",), "difference": True, "no_contact": ("phase=empty",)}
    pack = packed(table(tmp_path / "m.csv", rows), tmp_path / "p", **options)
    assert pack.num == 20 and set(pack.column("sensor")) == {"digit", "mini"}
    for i, number in enumerate(pack.column("id").astype(int) - 1):
        base = (60, 180)[number // 12]  # the mean of base - 1 and base + 1
        assert (pack.images["touch"][i] == (rows[number]["value"] - base + 256) // 2).all()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"background": ("background",)}, "only used with subtract-background"),
        ({"difference": True, "background": ("a",), "no_contact": ("phase=empty",)}, "give only one of them"),
        ({"difference": True, "no_contact": ("phase=none",)}, r"no row of sensor 'digit' is without contact"),
    ],
)
def test_backgrounds_that_cannot_be(tmp_path: Path, options: dict[str, Any], says: str) -> None:
    file = table(tmp_path / "m.csv", pressed(tmp_path))
    with pytest.raises(ValueError, match=says):
        packed(file, tmp_path / "p", labels=("label",), **options)


def test_a_background_that_is_damaged(tmp_path: Path) -> None:
    file = table(tmp_path / "m.csv", pressed(tmp_path))
    (tmp_path / "own4.png").write_text("no picture")
    with pytest.raises(ValueError, match=r"first row 5: .*own4\.png cannot be read as an image"):
        packed(file, tmp_path / "p", labels=("label",), difference=True)
