"""The generic reader: right pixels beside right labels, honest splits, and every mistake named before work begins."""

import csv
import json
import os
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.checks.examine import examine_source
from mvitac.data.images import decode, fit, shrink
from mvitac.data.pack import Pack
from mvitac.data.spec import UNGROUPED
from mvitac.datasets.folder import FolderConfig
from mvitac.datasets.table.columns import Condition
from mvitac.datasets.table.image_refs import ImageRef, span_of
from mvitac.datasets.table.manifest import Manifest, read_manifest
from mvitac.datasets.table.splits import assign_splits
from mvitac.datasets.table.table import Rows
from mvitac.system.files import cache_dir
from support.videos import film, picture

NUM = 24
Table = list[dict[str, Any]]


def colour(row: int, which: int) -> tuple[int, int, int]:
    return (10 * row, 80 * which, 255 - 5 * row)


def make_rows(root: Path) -> Table:
    """24 rows of plain pictures: 8 objects x 3 touches, 2 materials, one object unlabelled, three image columns."""
    rows: Table = []
    for i in range(NUM):
        images = {name: f"{name}/{i:02d}.png" for name in ("vision", "left", "right")}
        for which, path in enumerate(images.values()):
            picture(root / path, colour(i, which), (20, 16))
        place = i // 3
        side = "train" if place < 4 or place == 7 else "val" if place == 4 else "test"
        about = {"material": ("wood", "metal")[place % 2] if place < 7 else "", "stiffness": (place * 2) % 12}
        about |= {"object": f"{place:03d}", "seq": i % 3, "width": 1.5 * i, "side": side}
        rows.append(images | about)
    return rows


def write(rows: Table, file: Path) -> Path:
    if file.suffix == ".csv":
        with file.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]) if rows else ["vision", "touch"])
            writer.writeheader()
            writer.writerows(rows)
    elif file.suffix == ".jsonl":
        file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    else:
        pq.write_table(pa.Table.from_pylist(rows), file)
    return file


@pytest.fixture
def rows(tmp_path: Path) -> Table:
    return make_rows(tmp_path)


def config(path: Path, **options: Any) -> FolderConfig:
    return FolderConfig(**{"labels": ("material",), "group": "object", "size": 16, "path": path, **options})


def packed(options: FolderConfig, out: Path, *, workers: int = 1) -> Pack:
    return build(options.source(), out, size=options.size, workers=workers, quiet=True)


@pytest.mark.parametrize("options", [{"split": "side"}, {}, {"only": ("seq>=1",)}, {"only": ("object!=002", "seq=1")}])
def test_every_image_stands_beside_its_own_row(tmp_path: Path, rows: Table, options: dict[str, Any]) -> None:
    pack = packed(config(write(rows, tmp_path / "manifest.csv"), **options), tmp_path / "pack")
    assert pack.spec.touch_channels == 6 and pack.spec.vision_channels == 3
    for i, row in enumerate(pack.column("id").astype(int) - 1):
        assert (pack.images["vision"][i] == colour(row, 0)).all()
        assert (pack.images["touch"][i] == (*colour(row, 1), *colour(row, 2))).all()  # left first, then right
        assert pack.column("object")[i] == rows[row]["object"] == pack.column("group")[i]
        assert ("metal", "wood", "")[pack.column("label_material")[i]] == rows[row]["material"]


def test_csv_parquet_and_jsonl_give_one_pack(tmp_path: Path) -> None:
    digests, options = set(), {"split": "side", "controls": ("width=width", "which=object"), "labels": ("stiffness",)}
    for suffix in ("csv", "parquet", "jsonl"):
        folder = tmp_path / suffix
        file = write(make_rows(folder), folder / f"manifest.{suffix}")
        digests.add(packed(config(file, **options), folder / "p").digest)
    assert len(digests) == 1
    stamps = pa.array([10**18 + 999 * i for i in range(NUM)], pa.timestamp("ns"))
    pq.write_table(pq.read_table(file := tmp_path / "parquet/manifest.parquet").append_column("at", stamps), file)
    assert read_manifest(file).rows[2]["at"] == "2001-09-09 01:46:40.000001"


def test_two_workers_give_the_pack_of_one(tmp_path: Path, rows: Table, monkeypatch: pytest.MonkeyPatch) -> None:
    options = config(write([row for row in rows for _ in range(6)], tmp_path / "manifest.csv"))
    one = packed(options, tmp_path / "one")
    sent: list[Rows] = []
    monkeypatch.setattr(Rows, "__getstate__", lambda self: sent.append(self) or self.__dict__, raising=False)
    assert packed(options, tmp_path / "two", workers=2).digest == one.digest
    assert len(sent) <= 2  # to each worker once, not with each of five parts


def test_paths_are_relative_to_the_manifest_and_the_fingerprint_to_nothing(tmp_path: Path) -> None:
    prints = []
    for place in ("here/set", "there/below/set"):
        write(make_rows(tmp_path / place), tmp_path / place / "manifest.csv")
        prints.append(config(tmp_path / place).source().fingerprint())
    assert prints[0] == prints[1] and str(tmp_path) not in json.dumps(prints[0])
    assert config(tmp_path / place, split_seed=1).source().fingerprint() != prints[0]


def write_plain(folder: Path, level: int, when: int) -> FolderConfig:
    for name in (names := [f"{i}.bmp" for i in range(40)]):
        os.utime(picture(folder / name, level), (when, when))
    rows = [{"touch": name, "split": "train" if i < 20 else "test"} for i, name in enumerate(names)]
    return FolderConfig(path=write(rows, folder / "manifest.csv"), size=16, workers=1)


def test_the_cache_knows_changed_files_of_the_same_size(tmp_path: Path) -> None:
    sets = [("x", 40, 10), ("y", 200, 20), ("x", 90, 30), ("x", 90, 30)]  # two of one name, one written over, unchanged
    packs = [write_plain(tmp_path / name / "session", level, when).open(quiet=True) for name, level, when in sets]
    assert [int(pack.images["touch"][0, 0, 0, 0]) for pack in packs] == [40, 200, 90, 90]
    assert packs[2].path == packs[3].path and len({pack.path for pack in packs}) == 3
    assert packs[0].meta["fingerprint"] == packs[1].meta["fingerprint"], "when files were written is not told"


def test_a_repaired_image_has_another_stamp(tmp_path: Path) -> None:
    before = (config := write_plain(tmp_path / "set", 200, 10)).source().stamps()
    os.utime(tmp_path / "set" / "35.bmp", (20, 20))
    assert np.flatnonzero(np.array(config.source().stamps()) != before).tolist() == [35]


def test_classes_sort_by_name_or_by_number_and_pandas_gaps_do_not_matter(tmp_path: Path, rows: Table) -> None:
    floats = [{**row, "stiffness": float(row["stiffness"]) if row["stiffness"] else float("nan")} for row in rows]
    for suffix in ("csv", "parquet", "jsonl"):
        file = write(floats, tmp_path / f"{suffix}.{suffix}")
        spec = config(file, labels=("stiffness", "material"), split="side", allow_leak=True).source().spec()
        assert [t.classes for t in spec.tasks] == [("2", "4", "6", "8", "10"), ("metal", "wood")]


def test_two_ways_to_type_a_name_are_one(tmp_path: Path, rows: Table) -> None:
    """Unicode forms and blanks; a class "Nan" is a name, as no program writes a missing number so."""
    names = {
        "wood": ("Nan", " Nan ", "Nan\u00a0"),
        "metal": ("caf\u00e9 au  lait", "cafe\u0301 au lait", "caf\u00e9 au\tlait"),
    }
    objects = ("tasse {}", " tasse\u00a0 {}", "tasse  {} ")
    same = [dict(row) for row in rows]
    for i, (row, clean) in enumerate(zip(rows, same, strict=True)):
        clean["object"] = objects[0].format(row["object"])
        row["object"] = objects[i % 3].format(row["object"])
        if row["material"]:
            clean["material"], row["material"] = names[row["material"]][0], names[row["material"]][i % 3]
            clean["material"] = clean["material"].replace("  ", " ")
    pack = packed(config(write(rows, tmp_path / "typed.csv"), only=("object!=tasse   002",)), tmp_path / "typed")
    other = packed(config(write(same, tmp_path / "same.csv"), only=("object!=tasse 002",)), tmp_path / "same")
    assert pack.spec.tasks[0].classes == ("Nan", "caf\u00e9 au lait") == other.spec.tasks[0].classes
    assert set(pack.column("group")) == {f"tasse {i:03d}" for i in (0, 1, 3, 4, 5, 6, 7)}
    assert pack.digest == other.digest


def test_a_blank_is_part_of_a_files_name_where_one_has_it(tmp_path: Path) -> None:
    for name, level in {" a": 40, "a": 200, "b": 90}.items():
        Image.new("RGB", (20, 20), (level,) * 3).save(tmp_path / f"{name}.png")
    typed = [{"touch": cell} for cell in (" a.png", "a.png", " b.png ")]
    for path in (tmp_path, write(typed, tmp_path / "typed.csv"), write(typed, tmp_path / "typed.jsonl")):
        pack = packed(config(path, allow_leak=True, labels=(), group=None), tmp_path / f"{path.name}-pack")
        assert [int(image.mean()) for image in pack.images["touch"]] == [40, 200, 90], path


@pytest.mark.parametrize(("cell", "wanted"), [("0.10", "0.1"), ("10.0", "10"), ("True", "true"), ("2", "2")])
def test_equal_numbers_and_truths_are_equal(cell: str, wanted: str) -> None:
    assert Condition.parse(f"a={wanted}").holds({"a": cell}) and not Condition.parse(f"a!={wanted}").holds({"a": cell})
    assert Condition.parse("a!=07").holds({"a": "7"})  # names of objects


def test_unlabelled_rows_are_kept_for_pre_training_only(tmp_path: Path, rows: Table) -> None:
    pack = packed(config(write(rows, tmp_path / "m.csv"), label_only=("seq<=1",)), tmp_path / "pack")
    labels = pack.column("label_material")
    assert pack.num == NUM and (labels[pack.column("seq").astype(int) == 2] == -1).all()
    assert set(pack.column("split")[pack.column("group") == "007"]) == {"unlabelled"}  # no label at all
    assert (labels[pack.rows("unlabelled")] == -1).all()


def test_controls_are_numbers(tmp_path: Path, rows: Table) -> None:
    file = write(rows, tmp_path / "m.csv")
    pack = packed(config(file, controls=("how wide=width", "both=width,seq")), tmp_path / "pack")
    assert pack.spec.controls == {"how wide": ("width",), "both": ("width", "seq")}
    assert pack.column("width").tolist() == [row["width"] for row in rows]
    for cell in ("train", "1e200"):
        write([{**row, "side": cell} for row in rows], file)
        with pytest.raises(ValueError, match=rf"row 1 .*control column 'side' is '{cell}', not a number"):
            config(file, controls=("x=side",)).source()


def test_has_touch_is_seen_not_believed(tmp_path: Path, rows: Table) -> None:
    rows = [{**row, "has_touch": "True", "has_vision": ""} for row in rows]
    pack = packed(config(write(rows, tmp_path / "m.csv")), tmp_path / "pack")
    assert pack.has("touch").all() and not {"has_touch", "has_vision"} & set(pack.table.column_names)


@pytest.mark.parametrize("name", ["group", "id", "touch_group", "crc_vision", "label_material"])
@pytest.mark.parametrize("given", [{"values": ("{}:N",)}, {"controls": ("which={}",)}])
def test_numbers_do_not_take_a_columns_place(tmp_path: Path, rows: Table, given: dict[str, Any], name: str) -> None:
    rows = [{**row, name: i // (1 if name == "id" else 3)} for i, row in enumerate(rows)]
    ((option, (text,)),) = given.items()
    with pytest.raises(ValueError, match=rf"column '{name}' has a name of the pack itself: copy it"):
        config(write(rows, tmp_path / "m.csv"), labels=("material",), **{option: (text.format(name),)}).source()


@pytest.mark.parametrize("kind", ["pairs", "a gap", "plain"])
def test_class_folders_pair_by_name(tmp_path: Path, kind: str) -> None:
    for i in range(12):
        label = ("brick", "moss")[i % 2]
        picture(tmp_path / ("" if kind == "plain" else "vision") / label / f"{i}.png", i)
        if kind == "pairs" or (kind == "a gap" and i != 5):
            picture(tmp_path / f"touch/{label}/{i}.bmp", 100 + i)
    picture(tmp_path / ("" if kind == "plain" else "vision") / ".thumbnails/7.png")
    config = FolderConfig(path=tmp_path, size=16, pictures="vision")
    if kind == "a gap":
        with pytest.raises(ValueError, match=r"\(vision/moss/5\.png\) has no touch path: .*allow-missing"):
            config.source()
        config = replace(config, allow_missing=True)
    seen = (pack := packed(config, tmp_path / "pack")).images["vision"][:, 0, 0, 0]
    assert pack.spec.tasks[0].classes == ("brick", "moss") and sorted(seen) == list(range(12))
    assert (pack.column("label_label") == seen % 2).all()
    if kind != "plain":
        assert (pack.images["touch"][:, 0, 0, 0] == (seen + 100) * pack.has("touch")).all()
        assert seen[~pack.has("touch")].tolist() == [5] * (kind == "a gap")
    assert pack.spec.group_by == "row" and any(UNGROUPED in note for note in pack.spec.notes)


def test_class_folders_may_be_grouped_and_split(tmp_path: Path) -> None:
    for split in ("train", "test"):
        for i in range(8):
            for gel in ("left", "right"):
                picture(tmp_path / split / gel / ("soft", "hard")[i % 2] / f"{split}{i // 4}" / f"{i}.png")
    pack = packed(FolderConfig(path=tmp_path, size=16), tmp_path / "pack")
    assert pack.spec.touch_channels == 6 and pack.spec.group_by == "group"
    expected = {f"{kind}/{split}{g}" for kind in ("soft", "hard") for split in ("train", "test") for g in "01"}
    assert set(pack.column("group")) == expected
    assert all(split in group for split, group in zip(pack.column("split"), pack.column("group"), strict=True))


def test_sixteen_bits_are_scaled_not_clipped(tmp_path: Path) -> None:
    values = np.arange(0, 65536, 257, dtype=np.uint16).reshape(16, 16)
    Image.fromarray(values).save(tmp_path / "deep.png")
    Image.fromarray(values).save(tmp_path / "deep.tif")
    for name in ("deep.png", "deep.tif"):
        image = np.asarray(decode(tmp_path / name, span=()))
        assert image.dtype == np.uint8 and image.shape == (16, 16, 3) and (image[..., 1] == image[..., 2]).all()
        assert (image[..., 0].ravel() == np.arange(256)).all()
        with pytest.raises(ValueError, match="the model does not know how they were scaled"):
            decode(tmp_path / name)
    Image.fromarray(values / np.float32(65535)).save(tmp_path / "float.tif")
    assert (np.asarray(decode(tmp_path / "float.tif", span=()))[..., 0].ravel() == np.arange(256)).all()
    assert [span_of(ImageRef(str(tmp_path / name))) for name in ("float.tif", "deep.png")] == [(0, 1), (0, 65535)]
    Image.fromarray(np.zeros((9, 9, 3), np.uint8)).save(tmp_path / "rgb.png")
    with pytest.raises(ValueError, match="read as RGB of 8 bits"):
        decode(tmp_path / "rgb.png", span=(0, 2040))
    head = struct.pack(">IIBBBBB", 2, 2, 16, 2, 0, 0, 0)
    parts = (b"IHDR", head), (b"IDAT", zlib.compress(bytes(26))), (b"IEND", b"")
    chunks = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in parts)
    (tmp_path / "deep.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    (tmp_path / "deep.ppm").write_bytes(b"P6 2 2 1023\n" + bytes(24))
    for name in ("deep.png", "deep.ppm"):
        with pytest.raises(ValueError, match="16 bits a colour"):
            decode(tmp_path / name)


def test_gray_palette_bilevel_and_alpha_become_rgb(tmp_path: Path) -> None:
    rgb = Image.fromarray(np.random.default_rng(0).integers(0, 4, (12, 10, 3), np.uint8) * 80)
    gray = rgb.convert("L")
    gray.save(tmp_path / "gray.png")
    assert (np.asarray(decode(tmp_path / "gray.png")) == np.asarray(gray)[..., None]).all()
    palette = rgb.quantize(256)
    palette.save(tmp_path / "palette.png")
    assert decode(tmp_path / "palette.png") == palette.convert("RGB")
    gray.point(lambda v: 255 * (v > 99)).convert("1").save(tmp_path / "bits.png")
    assert set(np.unique(decode(tmp_path / "bits.png"))) == {0, 255}
    alpha = np.dstack([np.asarray(rgb), np.full((12, 10), 255, np.uint8)])
    alpha[0, :, 3] = 0
    Image.fromarray(alpha).save(tmp_path / "alpha.png")
    seen = np.asarray(decode(tmp_path / "alpha.png"))
    assert (seen[0] == 0).all() and (seen[1:] == np.asarray(rgb)[1:]).all()


@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_exif_rotation_is_applied(tmp_path: Path, mode: str) -> None:
    upright = Image.new(mode, (30, 20))
    upright.paste(255 if mode == "L" else (255, 255, 255), (0, 0, 30, 5))  # a bright top edge
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was turned: rotate by 90 degrees clockwise to see it upright
    upright.transpose(Image.Transpose.ROTATE_90).save(tmp_path / "turned.png", exif=exif)
    seen = np.asarray(decode(tmp_path / "turned.png"))
    assert seen.shape == (20, 30, 3) and (seen[:5] == 255).all() and (seen[5:] == 0).all()


def test_shrunk_without_its_array_it_has_the_same_pixels(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (60, 90, 3), np.uint8)
    for mode, name in [("RGB", "a.jpg"), ("RGB", "a.png"), ("L", "l.jpg"), ("CMYK", "c.jpg"), ("RGBA", "a.webp")]:
        Image.fromarray(pixels).convert(mode).save(tmp_path / name)
        array = np.asarray(decode(tmp_path / name))
        for size in (16, 60, 75, 90, 128):
            assert (shrink(decode(tmp_path / name), size) == fit(array, size)).all(), (name, size)
    Image.fromarray(pixels[:, :60]).save(tmp_path / "square.png")
    assert (shrink(decode(tmp_path / "square.png"), 60) == pixels[:, :60]).all()


BLACK, WHITE = (Image.new("L", (16, 16), shade) for shade in (0, 255))
DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "broken png": (lambda path: path.write_bytes(path.read_bytes()[:30] + bytes(60)), "cannot"),
    "animation": (lambda path: BLACK.save(path, "GIF", save_all=True, append_images=[WHITE]), "2 frames"),
    "float": (lambda path: Image.fromarray(np.full((8, 8), 1.5, np.float32)).save(path, "TIFF"), "not 0 to 1"),
    "32 bit": (lambda path: Image.fromarray(np.full((8, 8), 70000, np.int32)).save(path, "TIFF"), "not 0 to 65535"),
    "gone": (lambda path: path.unlink(), "No such file"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_image_is_named_or_counted(tmp_path: Path, rows: Table, kind: str) -> None:
    damage, says = DAMAGE[kind]
    source = config(write(rows, tmp_path / "m.csv")).source()
    damage(tmp_path / "left" / "04.png")
    with pytest.raises(ValueError, match=rf"first row 5: .*04\.png .*{says}") as caught:
        build(source, tmp_path / "pack", size=16, quiet=True)
    assert "\n" not in str(caught.value) and not (tmp_path / "pack").exists()
    pack = build(source, tmp_path / "pack", size=16, quiet=True, max_damaged=0.1)
    assert pack.num == NUM - 1 and pack.meta["damaged"][0][0] == "row 5"


def test_dealt_splits_never_share_a_group() -> None:
    rng = np.random.default_rng(0)
    for trial in range(300):
        num_groups, num_classes = int(rng.integers(2, 60)), int(rng.integers(1, 8))
        groups = [f"g{g}" for g in rng.integers(0, num_groups, int(rng.integers(num_groups, 400)))]
        target = rng.integers(-1, num_classes, len(groups)).tolist()
        test, val = rng.uniform(0.1, 0.4), rng.uniform(0, 0.4)
        splits = assign_splits(groups, [target], test, val, trial)
        home = dict(zip(groups, splits, strict=True))
        assert all(home[group] == split for group, split in zip(groups, splits, strict=True))
        order = rng.permutation(len(groups))
        again = assign_splits([groups[i] for i in order], [[target[i] for i in order]], test, val, trial)
        assert again == [splits[i] for i in order]  # rows may come in any order
        unlabelled = {g for g in home if all(t < 0 for t, h in zip(target, groups, strict=True) if h == g)}
        assert {g for g, split in home.items() if split == "unlabelled"} == unlabelled
        num = len(home) - len(unlabelled)
        dealt = [split for split in home.values() if split != "unlabelled"]
        assert dealt.count("test") <= np.ceil(num * test) and dealt.count("val") <= np.ceil(num * val)


def test_dealing_is_stratified_and_the_shares_are_kept() -> None:
    groups = [f"{g:03d}" for g in range(200)]
    target = [g % 4 for g in range(200)]
    for seed in range(5):
        splits = np.array(assign_splits(groups, [target], 0.25, 0.15, seed))
        assert (splits == "test").sum() in range(48, 53) and (splits == "val").sum() in range(28, 33)
        for kind in range(4):
            assert (splits[np.array(target) == kind] == "test").sum() in range(11, 15)
    assert assign_splits(groups, [target], 0.25, 0.15, 0) != assign_splits(groups, [target], 0.25, 0.15, 1)


def test_a_leaking_split_is_refused_unless_allowed(tmp_path: Path, rows: Table) -> None:
    rows[0]["side"] = "test"
    file = write(rows, tmp_path / "m.csv")
    with pytest.raises(ValueError, match=r"leaks: 1 of 8 groups \(object\).*'000' in test and train.*by-group"):
        config(file, split="side").source()
    assert config(file, split="side", allow_leak=True).source().items() and config(file).source().items()


def test_another_way_to_write_a_path_hides_no_leak(tmp_path: Path, rows: Table) -> None:
    other = next(row for row in rows if row["side"] == "test")
    other["left"] = f"./left/../{next(row['left'] for row in rows if row['side'] == 'train')}"
    with pytest.raises(ValueError, match="leaks: 1 of 47 left and right images are in more than one split"):
        config(write(rows, tmp_path / "m.csv"), split="side").source()


def test_train_and_unlabelled_are_one_side(tmp_path: Path, rows: Table) -> None:
    rows[0]["side"] = "unlabelled"
    assert config(write(rows, tmp_path / "m.csv"), split="side").source().items()


Change = Callable[[Table], object]


def each(**cells: Any) -> Change:
    return lambda rows: [row.update(cells) for row in rows]


def one(number: int, **cells: Any) -> Change:
    return lambda rows: rows[number - 1].update(cells)


def numbered(**patterns: str) -> Change:
    return lambda rows: [row.update({k: v.format(i) for k, v in patterns.items()}) for i, row in enumerate(rows)]


BAD: dict[str, tuple[Change | None, dict[str, Any], str]] = {
    "unknown label": (None, {"labels": ("materials",)}, r"unknown column 'materials'.*did you mean 'material'"),
    "missing file": (one(7, left="left/none.png"), {}, r"1 of 72 image files .*row 7 left left/none\.png"),
    "many missing files": (numbered(vision="no/{}.png"), {}, r"24 of 72 .*row 1 vision .*row 3"),
    "empty path": (one(3, right=""), {}, r"row 3 .*has no right path"),
    "one class": (each(material="wood"), {}, r"'material' has only the class 'wood' in 24 rows"),
    "NaN labels": (each(material=float("nan")), {}, r"'material' has no labels"),
    "label like a name": (numbered(material="m{}"), {}, r"'material' has another value in each of its 24 rows"),
    "empty group": (one(9, object=""), {}, r"row 9 .*column 'object' \(group\) is empty"),
    "empty split": (one(5, side=""), {"split": "side"}, r"row 5 .*'side' \(split\) is empty"),
    "validation": (one(13, side="validation"), {"split": "side"}, r"unknown split in column 'side' 'validation': "),
    "control character": (one(13, object="a\x93"), {}, r"control character in a name, .*a\\x93"),
    "escape": (one(13, material="\x1b[2J"), {}, r"row 13, column 'material': control character in a name, .*x1b"),
    "escape in a column": (each(**{"a\x1b": "b"}), {"labels": ("a\x1b",)}, r"in the name of column 'a.x1b'"),
    "leak of a touch": (each(seq=0), {"touch_group": "seq"}, r"1 of 1 touch groups are.*give the group"),
    "leak of an image": (each(vision="vision/00.png"), {}, r"1 of 1 vision images are in more than one split"),
    "nothing to train on": (each(side="test"), {"split": "side"}, r"'side' gives no rows of train"),
    "nothing to test": (
        each(side="train"),
        {"split": "side"},
        r"'side' gives 'material' no rows in test: --data.split by-group",
    ),
    "one group": (each(object="a"), {}, r"assigning 1 groups gives 'material' no rows in test"),
    "control with gaps": (one(4, width=""), {"controls": ("w=width",)}, r"row 4 .*control column 'width' is ''"),
    "id twice": (each(id="a"), {}, r"id 'a' occurs in several rows"),
    "vision is touch": (None, {"touch": ("vision",)}, r"column .vision. would be both vision and touch"),
    "vision is touch in one row": (one(4, left="./vision/03.png"), {}, r"row 4 .*has one image in two of the columns"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_manifests_are_named_before_anything_is_written(tmp_path: Path, rows: Table, name: str) -> None:
    change, options, says = BAD[name]
    if change:
        change(rows)
    file = write(rows, tmp_path / "m.csv")
    before = set(cache_dir().glob("packs/*"))
    with pytest.raises(ValueError, match=says) as caught:
        config(file, **options).open(quiet=True)
    assert "\n" not in str(caught.value) and set(cache_dir().glob("packs/*")) == before


BAD_OPTIONS: dict[str, tuple[dict[str, Any], str]] = {
    "shares": ({"test_share": 0.6, "val_share": 0.4}, "leave nothing to train on"),
    "control named like ours": ({"controls": ("border=width",)}, "'border' is always computed"),
    "mean": ({"controls": ("mean=width",)}, "'mean' is always computed"),
    "condition": ({"only": ("seq",)}, "condition 'seq': write column=value"),
}


@pytest.mark.parametrize(("options", "says"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_bad_options_are_named_at_once(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        FolderConfig(**options)


BAD_FILES: dict[str, tuple[str, bytes, str]] = {
    "ragged": ("m.csv", b"vision,touch\na,b\na,b,c\n", "row 2 has 3 cells for 2 columns"),
    "open quote": ("m.csv", b'vision,touch\na,b\na,"b\na,b\n', "unexpected end of data"),
    "two open quotes": ("m.csv", b'vision,touch\na,b\na,"b\na,"b\n', "expected after"),
    "swallowed row": ("m.csv", b'vision,touch\na,"b\na,b"\n', "row 1 has a line break in a cell"),
    "header twice": ("m.csv", b"vision,vision\na,b\n", "two columns of one name"),
    "key twice": ("m.jsonl", b'{"vision": "a", "touch": "b", "touch": "c"}', "line 1: two entries of one name"),
    "broken line": ("m.jsonl", b'{"touch": "b"}\n\n{"touch": "b",}', "line 3: Expecting property name"),
    "latin-1": ("m.csv", "vision,touch\nMöbel,b\n".encode("latin-1"), "cannot be read as a table: 'utf-8' codec"),
}


@pytest.mark.parametrize(("file", "content", "says"), BAD_FILES.values(), ids=BAD_FILES)
def test_bad_files_are_named(tmp_path: Path, file: str, content: bytes, says: str) -> None:
    (tmp_path / file).write_bytes(content)
    with pytest.raises(ValueError, match=says) as caught:
        FolderConfig(path=tmp_path / file).source()
    assert "\n" not in str(caught.value) and file in str(caught.value)


def test_bad_folders_are_named(tmp_path: Path, rows: Table) -> None:
    for suffix in ("csv", "jsonl"):
        write(rows, tmp_path / f"manifest.{suffix}")
    latin = [f"touch/{label}/{i}.png" for label in ("a", "b\udcff") for i in range(9)]  # a name that is not UTF-8
    lonely = r"row 2 \(touch/b/1\.png\) has no vision path: .*allow-missing"
    for folder, names, says in (
        ("", [], "manifest.csv and manifest.jsonl"),
        ("lonely", ["vision/a/1.png", "touch/b/1.png"], lonely),
        ("half flat", ["touch/1.png", "touch/a/2.png"], r"1\.\* is not in a class folder"),
        ("sides", ["touch/train/a/1.png", "touch/test/b/2.png"], "its classes are named like splits"),
        ("twins", ["touch/a/1.png", "touch/a/1.bmp"], "differ in their suffix only"),
        ("beside", ["train/a/1.png", "test/b/2.png", "validation/a/3.png"], "images in validation beside train, test:"),
        ("latin", latin, "row 10, column 'touch': control character in a name, "),
    ):
        for name in names:
            picture(tmp_path / folder / name)
        with pytest.raises(ValueError, match=says):
            FolderConfig(path=tmp_path / folder).source()
    (tmp_path / "half flat/touch/1.png").unlink()
    (tmp_path / "half flat/touch/a/1.png").symlink_to("not fetched")
    (tmp_path / "half flat/touch/.cache").symlink_to(tmp_path / "lonely")  # nothing hidden is read
    with pytest.raises(ValueError, match=r"1 of 2 image files are missing or empty, e.g. row 1 touch touch/a/1\.png"):
        FolderConfig(path=tmp_path / "half flat").source()
    with pytest.raises(ValueError, match="column 'touch' has 1 images for 2 rows"):
        Manifest.of(tmp_path, [{"a": "0"}, {"a": "1"}], {"touch": [None]})
    assert Manifest.of(tmp_path, ({"a": cell} for cell in (1, "2.0", None))).rows == [{"a": "1"}, {"a": "2"}, {"a": ""}]
    (tmp_path / "same.csv").write_text("touch,split,n\na.png,train,1\nb.png,test,2\n")
    picture(tmp_path / "a.png")
    (tmp_path / "b.png").symlink_to("a.png")
    with pytest.raises(ValueError, match="1 of 1 touch images are in more than one split"):
        FolderConfig(path=tmp_path / "same.csv").source()
    (tmp_path / "lonely/touch/b/pairs.csv").touch()
    note = "images are read without pairs.csv: if it is their table, give it as --path"
    assert note in FolderConfig(path=tmp_path / "lonely/touch/b", pictures="touch").manifest().notes
    with pytest.raises(ValueError, match=f"^{tmp_path / 'same.csv'}: every touch has one row"):
        FolderConfig(path=tmp_path / "same.csv", allow_leak=True, order="n", minus_first=True, size=16).open(quiet=True)
    with (  # may not be read: root may
        patch.object(os, "scandir", side_effect=PermissionError(13, "Permission denied", "b")),
        pytest.raises(PermissionError, match="'b'"),
    ):
        FolderConfig(path=tmp_path / "lonely").source()
    (tmp_path / "half flat/touch/b").symlink_to(tmp_path / "lonely")
    film(tmp_path / "rec/mon/gel.mp4", 10)
    (tmp_path / "rec/tue").symlink_to(tmp_path / "lonely")
    with pytest.raises(ValueError, match="rec/tue is a link to a folder"):
        FolderConfig(path=tmp_path / "rec", touch=("gel",)).source()
    with pytest.raises(ValueError, match="touch/b is a link to a folder: put the folder in its place"):
        FolderConfig(path=tmp_path / "half flat").source()


def test_commands_say_what_a_group_is(tmp_path: Path, rows: Table, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(rows, tmp_path / "m.csv")
    words = ["data", "pack", "--data", "folder", "--path", str(file), "--size", "16", "--quiet", "--labels", "material"]
    assert main([*words, "--out", str(tmp_path / "grouped"), "--group", "object"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "groups: 8, one per object, of 3 rows each. Each is one touch group, too" in shown
    assert "no --group" not in shown and main([*words, "--out", str(tmp_path / "forgotten")]) == 0
    for packed_now in (True, False):
        shown = " ".join(capsys.readouterr().out.split())
        assert "groups: 24, one per row, of 1 row each. A split takes whole groups, and intervals are over" in shown
        assert "note: no --group was given, so every row is its own group" in shown
        assert shown.endswith("intervals too narrow (of those in test, also in train: object 4 of 4)")
        if packed_now:
            assert main(["data", "info", str(tmp_path / "forgotten")]) == 0
    assert main(["data", "info", str(tmp_path / "grouped"), "--json", "-"]) == 0
    assert json.loads((said := capsys.readouterr()).out)["groups"] == 8 and "one per object" in said.err
    named = write([{"camera": row["vision"], "label": row["material"]} for row in rows], tmp_path / "named.csv")
    for command, prefix in (("data pack", "--"), ("data check", "--"), ("pretrain", "--data.")):
        words = [*command.split(), "--data", "folder", f"{prefix}path", str(named)]
        assert main([*words, *(["--out", str(tmp_path / "no")] if command != "data check" else [])]) == 2
        assert f"name the image columns, {prefix}vision COLUMN {prefix}touch COLUMN" in capsys.readouterr().err


def test_rows_that_share_something_are_told_where_no_group_is_given(tmp_path: Path, rows: Table) -> None:
    """File names up to their last number, and columns of text, but not numbers."""
    given = []
    for i, row in enumerate(rows):
        names = {m: f"{m}/rec-{i // 6}_{i:03d}b.png" for m in ("vision", "left", "right")}
        for m, name in names.items():
            (tmp_path / str(row[m])).rename(tmp_path / name)
        given.append({**names, "material": row["material"], "seq": row["seq"], "press": f"press {i // 2}", "shot": i})
    file = write(given, tmp_path / "m.csv")
    (note,) = FolderConfig(path=file, labels=("material",), split_seed=1).source().spec().notes
    assert re.search(r"also in train: press \d of \d, names of vision files 4 of 4\)$", note)
    assert not FolderConfig(path=file, labels=("material",), group="press").source().spec().notes
    (note,) = FolderConfig(path=file, labels=("material",), group="shot", split_seed=1).source().spec().notes
    said = "column shot has another value in each row, so every row is its own group"
    assert note.startswith(said) and "press" in note
    findings = examine_source(FolderConfig(path=file, labels=("material",), size=16).source(), quiet=True)
    assert [(f.verdict, f.item) for f in findings if "vision files" in f.evidence] == [("look", "groups")]
