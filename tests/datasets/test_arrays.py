"""HDF5 files as people write them: one group or one per demonstration; each pixel and number beside its own row."""

import io
import json
import os
import pickle
import re
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import zarr
from PIL import Image

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.datasets.folder import FolderConfig
from mvitac.datasets.table.arrays import read_arrays
from support.forged_packs import refuse_pipe


def grays(*levels: int, channels: int = 3, side: int = 16) -> np.ndarray:
    """Images of one gray level each, uint8 [N, side, side + 4, channels]."""
    return np.broadcast_to(np.array(levels, np.uint8)[:, None, None, None], (len(levels), side, side + 4, channels))


def write(path: Path, content: Mapping[str, Any], attributes: Mapping[str, Any] | None = None) -> Path:
    """An HDF5 file of datasets, and attributes as "group@name"; images are compressed, two to a chunk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, value in content.items():
            images = np.ndim(value) == 4 and len(value) > 0
            chunks: dict[str, Any] = {"chunks": (2, *np.shape(value)[1:]), "compression": "gzip"} if images else {}
            file.create_dataset(name, data=value, **chunks)
        for name, value in (attributes or {}).items():
            group, _, attribute = name.partition("@")
            file.require_group(group or "/").attrs[attribute] = value
    return path


def flat(**changes: Any) -> dict[str, Any]:
    """20 rows of 5 objects: camera 0 to 19, gel 100 to 119 (gray, one channel); None removes a dataset."""
    n = np.arange(20)
    content: dict[str, Any] = {
        "camera": grays(*n.tolist()),
        "gel": grays(*(100 + n).tolist(), channels=1),
        "force_n": (n / 4).astype(np.float32),
        "pose": np.stack([n, n * 2.0, np.where(n == 3, np.nan, n / 8)], axis=1),
        "depth": n[:, None] / 2,
        "object": [f"objet é{i // 4}" for i in n],
        "held": n % 3 == 0,
        "notes": np.zeros((3, 2)),
    } | changes
    return {name: value for name, value in content.items() if value is not None}


FLAT: dict[str, Any] = {"vision": "camera", "touch": ("gel",), "group": "object", "size": 16}
LENGTHS = (3, 5, 4, 6)


def demos(root: Path, name: str = "demos.hdf5", **changes: Any) -> Path:
    """robomimic's layout, 4 demonstrations: images of row i of demonstration k are 50 k + i (camera) and 20 + that."""
    content: dict[str, Any] = {"mask/train": np.array([b"demo_0"])}
    attributes: dict[str, Any] = {"@robot": "arm", "data@total": 18, "data@env_args": "{}" * 200}
    for k, length in enumerate(LENGTHS):
        demo, i = f"data/demo_{k}", np.arange(length)
        for part, plus in (("obs", 0), ("next_obs", 1)):
            content[f"{demo}/{part}/camera"] = grays(*(50 * k + i + plus).tolist())
            content[f"{demo}/{part}/gel"] = grays(*(50 * k + 20 + i + plus).tolist())
        content |= {f"{demo}/force": 10 * k + i, f"{demo}/obs/state": np.stack([i, i + k], axis=1)}
        attributes |= {f"{demo}@object": np.bytes_(f"cup{k % 2}"), f"{demo}@weight": np.array([k / 2])}
        attributes[f"{demo}@origin"] = np.array([k, 7.5])
    attributes["data/demo_2@robot"] = "hand"  # the nearest counts
    content |= changes
    return write(root / name, {name: value for name, value in content.items() if value is not None}, attributes)


DEMOS: dict[str, Any] = {"vision": "obs/camera", "touch": ("obs/gel",), "size": 16}


def packed(config: FolderConfig, out: Path) -> Pack:
    return build(config.source(), out, size=config.size, quiet=True)


def levels(pack: Pack, modality: str) -> list[int]:
    images = pack.images[modality]
    assert all((image == image[0, 0, 0]).all() for image in images)
    return [int(image[0, 0, 0]) for image in images]


def test_one_row_per_entry_of_the_first_axis(tmp_path: Path) -> None:
    values = ("force_n:N", "pose=pose[2]:mm,pose[1]:deg", "depth:mm")
    kind = np.array([i % 2 for i in range(20)], h5py.enum_dtype({"wood": 1, "metal": 0}, basetype="i"))
    file = write(tmp_path / "a.h5", flat(kind=kind))
    pack = packed(FolderConfig(path=file, values=values, labels=("held", "kind"), **FLAT), tmp_path / "pack")
    assert [pack.spec.tasks[1].classes[i] for i in pack.column("label_kind")[:2]] == ["metal", "wood"]
    rows = np.array(levels(pack, "vision"))
    assert sorted(rows) == list(range(20)) and levels(pack, "touch") == (100 + rows).tolist()
    force, pose, depth = (pack.values(task) for task in pack.spec.values)
    assert np.allclose(force[:, 0], rows / 4) and np.allclose(depth[:, 0], rows / 2)
    assert np.allclose(pose, np.stack([np.where(rows == 3, np.nan, rows / 8), rows * 2.0], axis=1), equal_nan=True)
    assert pack.column("group").tolist() == [f"objet é{i // 4}" for i in rows]
    assert [pack.spec.tasks[0].classes[i] for i in pack.column("label_held")] == [str(i % 3 == 0) for i in rows]
    assert pack.column("frame").astype(int).tolist() == rows.tolist() and set(pack.column("demo")) == {"a"}


def test_a_group_is_a_demonstration(tmp_path: Path) -> None:
    options: dict[str, Any] = {"values": ("force:N", "obs/state[1]:mm", "origin[1]:m"), "labels": ("object",)}
    with pytest.raises(ValueError, match=r"column 'origin\[1\]' has fewer than two different values"):
        FolderConfig(path=demos(tmp_path), **options, **DEMOS).source()
    with pytest.raises(ValueError, match=r"every is not for tables, HDF5 and zarr, whose rows are all used"):
        FolderConfig(path=tmp_path / "demos.hdf5", every=5, **DEMOS).source()
    options["values"] = ("force:N", "obs/state[1]:mm", "origin[0]:m")
    pack = packed(FolderConfig(path=tmp_path / "demos.hdf5", **options, **DEMOS), tmp_path / "pack")
    expected = {(f"data/demo_{k}", i): 50 * k + i for k, length in enumerate(LENGTHS) for i in range(length)}
    at = list(zip(pack.column("demo"), pack.column("frame").astype(int), strict=True))
    assert dict(zip(at, levels(pack, "vision"), strict=True)) == expected and pack.num == len(expected)
    assert levels(pack, "touch") == [expected[place] + 20 for place in at]
    number, frame = np.array([(int(demo[-1]), i) for demo, i in at]).T
    force, state, origin = (pack.values(task)[:, 0] for task in pack.spec.values)
    assert (force == 10 * number + frame).all() and (state == frame + number).all() and (origin == number).all()
    assert pack.spec.group_by == "demo" and (pack.column("group") == pack.column("demo")).all()
    assert pack.column("object").tolist() == [f"cup{k % 2}" for k in number]
    assert pack.column("robot").tolist() == ["hand" if k == 2 else "arm" for k in number]
    assert set(pack.column("weight")) == {"0", "0.5", "1", "1.5"} and set(pack.column("total")) == {"18"}
    assert pack.column("id")[0] == "data/demo_0/0" and "env_args" not in pack.table.column_names
    touched = packed(FolderConfig(path=tmp_path / "demos.hdf5", group="object", **DEMOS), tmp_path / "t")
    assert set(touched.column("touch_group")) == {f"cup{k % 2}/data/demo_{k}" for k in range(4)}


def test_a_folder_of_files(tmp_path: Path) -> None:
    for k in range(3):
        content = {"observations/images/top": grays(k, k), "observations/images/gel": grays(9, 9)}
        write(tmp_path / f"set/episode_{k}.HDF5", content | {"action": np.zeros((2, 7))}, {"@sim": k == 1})
    names: dict[str, Any] = {"vision": "observations/images/top", "touch": ("observations/images/gel",), "size": 16}
    pack = packed(FolderConfig(path=tmp_path / "set", labels=("sim",), test_share=0.4, **names), tmp_path / "pack")
    assert pack.column("demo").tolist() == [f"episode_{k}" for k in levels(pack, "vision")] and pack.num == 6
    demos(tmp_path / "two", "a.h5"), demos(tmp_path / "two", "b.h5")
    table = FolderConfig(path=tmp_path / "two", **DEMOS).manifest()
    assert len({row["demo"] for row in table.rows}) == 8 and table.rows[-1]["demo"] == "b/data/demo_3"


def test_usual_names_need_no_option(tmp_path: Path) -> None:
    content = {f"{demo}/{name}": grays(1, 2) for demo in ("x", "y") for name in ("vision", "left", "right")}
    pack = packed(FolderConfig(path=write(tmp_path / "a.h5", content), size=16), tmp_path / "pack")
    assert (pack.spec.vision_channels, pack.spec.touch_channels) == (3, 6)
    empty = {"touch": grays(180, 190), "background": grays(100, 110), "left": np.zeros((2, 5))}
    config = FolderConfig(path=write(tmp_path / "b.h5", empty), size=16, difference=True)
    assert levels(packed(config, tmp_path / "difference"), "touch") == [168, 168]


def test_groups_inside_each_other(tmp_path: Path) -> None:
    """Links are not followed, a second name is not a second recording, and 3,000 levels are read in seconds."""
    with h5py.File(tmp_path / "deep.h5", "w") as file:
        group = file
        for _ in range(3000):
            group = group.create_group("g")
        group["touch"] = np.zeros((4, 8, 8, 3), np.uint8)
        group["up"], group["same"], file["second"] = file, h5py.SoftLink("nowhere"), group
        file["a"] = h5py.ExternalLink(str(write(tmp_path / "other.h5", {"touch": grays(1, 2)})), "/")
    start = time.monotonic()
    table = read_arrays(tmp_path / "deep.h5", [tmp_path / "deep.h5"], (), ())
    assert [row["demo"] for row in table.rows] == ["/".join(["g"] * 3000)] * 4 and time.monotonic() - start < 10


def test_columns_of_episodes_are_ours(tmp_path: Path) -> None:
    """A dataset that is called demo must not split demonstrations over train and test."""
    path = demos(tmp_path, **{"data/demo_1/demo": np.arange(5), "data/lost/force": np.arange(5)})
    with h5py.File(path, "a") as file:
        file.attrs["note"] = np.bytes_(b"caf\xe9")  # no UTF-8, and of no use
    table = read_arrays(path, [path], ("obs/camera",), ())
    assert {row["demo"] for row in table.rows} == {f"data/demo_{k}" for k in range(4)}
    lost = "demos.hdf5: data/lost is left out: it has no images"
    assert table.notes == (lost, "demo of demos.hdf5 is left out, ours has this name")


def test_what_a_demonstration_lacks(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"obs and next_obs of data/demo_0 hold the same images: name them obs/"):
        FolderConfig(path=demos(tmp_path), **DEMOS | {"touch": ("gel",)}).source()
    path = demos(tmp_path, **{"data/demo_1/force": None, "data/demo_3/obs/gel": None})
    with pytest.raises(ValueError, match=r"row 13 \(data/demo_3/0\) has no obs/gel path: .*--data\.allow-missing"):
        FolderConfig(path=path, **DEMOS).source()
    config = FolderConfig(path=path, values=("force:N",), allow_missing=True, split_seed=1, **DEMOS)
    pack = packed(config, tmp_path / "pack")
    number = np.array([int(demo[-1]) for demo in pack.column("demo")])
    assert (pack.has("touch") == (number != 3)).all()
    assert (np.isnan(pack.values(pack.spec.values[0])[:, 0]) == (number == 1)).all()


def test_changes_of_the_file_are_noticed(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", flat())
    config = FolderConfig(path=path, values=("force_n:N",), **FLAT)
    places, fingerprints = [config.place()], [config.source().fingerprint()]
    assert config.place() == places[0]
    for name in ("gel", "force_n"):
        before = os.stat(path)
        with h5py.File(path, "r+") as file:
            file[name][4] = 7
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 10**9))
        places.append(config.place())
        fingerprints.append(config.source().fingerprint())
    assert len(set(places)) == 3
    assert fingerprints[0] != fingerprints[2]  # numbers are in the fingerprint itself; of images, the file's size


def test_a_damaged_chunk_costs_its_own_rows(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", flat(gel=np.random.default_rng(0).integers(0, 256, (20, 16, 16, 3), np.uint8)))
    with h5py.File(path) as file:
        chunk = file["gel"].id.get_chunk_info(3)  # rows 7 and 8
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    path.write_bytes(data)
    source = pickle.loads(pickle.dumps(FolderConfig(path=path, **FLAT).source()))  # as a worker gets it
    with pytest.raises(ValueError, match=r"2 of 20 samples cannot be read, first row 7: .*a\.h5 /gel row 6 cannot be"):
        build(source, tmp_path / "none", size=16, quiet=True)
    pack = build(source, tmp_path / "pack", size=16, quiet=True, max_damaged=0.1)
    assert levels(pack, "vision") == [i for i in range(20) if i not in (6, 7)]


@pytest.mark.parametrize("kind", ["v2", "v3", "zip"])
def test_a_replay_buffer_in_zarr(tmp_path: Path, kind: str) -> None:
    """As diffusion policy writes it: all episodes in one group, their ends in meta/episode_ends."""
    path: Any = tmp_path / ("b.zarr.zip" if kind == "zip" else "b.zarr")
    with zarr.storage.ZipStore(path, mode="w") if kind == "zip" else nullcontext(str(path)) as store:
        root = zarr.open_group(store, mode="w", zarr_format=3 if kind == "v3" else 2)
        content = {"data/camera": grays(*range(20)), "data/gel": grays(*range(100, 120))}
        content |= {"data/force": np.arange(20) / 4, "data/state": np.arange(40).reshape(20, 2)}
        content["meta/episode_ends"] = np.array([4, 9, 14, 20])
        root.create_group("data", attributes={"robot": "arm"})
        for name, value in content.items():
            root.create_array(name, data=value)
    config = FolderConfig(path=path, vision="camera", touch=("gel",), values=("force:N", "state[1]:m"), size=16)
    pack = packed(config, tmp_path / "pack")
    rows = np.array(levels(pack, "vision"))
    assert sorted(rows) == list(range(20)) and levels(pack, "touch") == (100 + rows).tolist()
    assert (pack.values(pack.spec.values[0])[:, 0] == rows / 4).all()
    assert (pack.values(pack.spec.values[1])[:, 0] == 2 * rows + 1).all() and set(pack.column("robot")) == {"arm"}
    episode = np.searchsorted([4, 9, 14, 20], rows, side="right")
    assert pack.column("group").tolist() == [f"data/{k}" for k in episode] and pack.spec.group_by == "demo"
    assert (pack.column("frame").astype(int) == rows - np.array([0, 4, 9, 14])[episode]).all()
    if kind == "v2":
        before = config.source().stamps()
        gel: Any = zarr.open_group(str(path), mode="r+")["data/gel"]
        gel[3] = 7
        assert config.source().stamps() != before
        whole = (chunk := path / "data/force/0").read_bytes()
        chunk.write_bytes(whole[:-1])  # numcodecs would read on behind it
        with pytest.raises(ValueError, match="data/force/0 is cut off"):
            config.source()
        chunk.write_bytes(whole)
        root["meta/episode_ends"][3] = 19
        with pytest.raises(ValueError, match=r"meta/episode_ends does not rise to 20"):
            config.source()
        (path / "data" / "gel" / "more").symlink_to(tmp_path)
        with pytest.raises(ValueError, match=r"more is a link: copy what it shows into .*b\.zarr"):
            config.source()
        refuse_pipe(path / "data" / "gel" / "more", config.source, "more is neither a file nor a folder")


@pytest.mark.parametrize("kind", ["zarr", "hdf5", "never written"])
def test_parts_that_are_not_there_are_noted(tmp_path: Path, kind: str) -> None:
    """An incomplete copy of a zarr, and HDF5 datasets that nobody filled, read as zeros."""
    path = tmp_path / ("a.zarr" if kind == "zarr" else "a.h5")
    create = "create_array" if kind == "zarr" else "create_dataset"
    with nullcontext(zarr.open_group(path, mode="w")) if kind == "zarr" else h5py.File(path, "w") as file:
        more = {"chunks": (5, 24, 32, 3)} if kind == "zarr" else {}
        for name, level in (("camera", 0), ("gel", 100)):
            data = grays(*range(level + 1, level + 21))
            made: Any = getattr(file, create)(name, shape=data.shape, dtype=data.dtype, **more)
            made[:] = data
        chunks = {} if kind == "never written" else {"chunks": (5,)}
        force: Any = getattr(file, create)("force_n", shape=(20,), dtype="f4", **chunks)
        if kind != "never written":
            force[:10] = force[15:] = 1.0
    config = FolderConfig(path=path, vision="camera", touch=("gel",))
    num = 1 if kind == "never written" else 4
    note = f"{path.name}: 1 of {num} chunks of /force_n are not there and read as its fill value"
    assert config.source().spec().notes[0] == note


@pytest.mark.parametrize("kind", ["list", "padded", "opaque"])
def test_jpegs_in_hdf5(tmp_path: Path, kind: str) -> None:
    """As lists of bytes, as rows that end in zeros (ALOHA) and as opaque bytes; and blue first, as OpenCV writes RGB."""
    files = [cv2.imencode(".jpg", np.full((24, 32, 3), (5 * i, 100, 200), np.uint8))[1].ravel() for i in range(20)]
    longest = max(map(len, files))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if kind == "list":
            gel: Any = file.create_dataset("gel", (20,), h5py.vlen_dtype(np.uint8))
            for i, one in enumerate(files):
                gel[i] = one
        else:
            rows = np.stack([np.pad(one, (0, longest - len(one))) for one in files])
            file["gel"] = rows if kind == "padded" else rows.view(f"V{longest}").ravel()
        file["force_n"] = np.arange(20)
    for bgr in (False, True):
        config = FolderConfig(path=tmp_path / "a.h5", touch=("gel",), size=16, bgr=bgr, group="frame")
        images = packed(config, tmp_path / f"{bgr}").images["touch"][:, 8, 8].astype(int)
        blue = images[:, 0 if bgr else 2]
        assert (abs(blue - 5 * np.arange(20)) <= 3).all() and (abs(images[:, 2 if bgr else 0] - 200) <= 3).all()


def test_numbers_of_more_than_8_bits(tmp_path: Path) -> None:
    """Floats from 0 to 1 are images; other ranges are said, by who packs them and then by the pack."""
    deep = np.linspace(0, 1, 20, dtype=np.float32)[:, None, None, None] * np.ones((1, 16, 16, 3), np.float32)
    write(tmp_path / "a.h5", {"touch": deep, "vision": (2000 * deep[..., :1]).astype(np.uint16)})
    options: dict[str, Any] = {"path": tmp_path / "a.h5", "size": 16, "group": "frame"}
    pack = packed(FolderConfig(**options), tmp_path / "p")
    assert levels(pack, "touch") == np.rint(deep[:, 0, 0, 0] * 255).tolist() and max(levels(pack, "vision")) == 8
    said = "vision has more than 8 bits: 0 is black, 65535 white touch has more than 8 bits: 0 is black, 1 white"
    assert said in " ".join(pack.spec.notes)
    pack = packed(FolderConfig(**options, range=("vision=0:2000",)), tmp_path / "q")
    assert max(levels(pack, "vision")) == 255 and "0 is black, 2000 white" in " ".join(pack.spec.notes)
    write(tmp_path / "b.h5", {"touch": grays(*range(20)).astype(np.int64), "vision": (300 * deep[..., :1]).astype(int)})
    pack = packed(FolderConfig(**(options | {"path": tmp_path / "b.h5"}), vision=""), tmp_path / "i")
    assert levels(pack, "touch") == list(range(20))  # 8 bits, however they are stored
    broken = np.where(np.arange(20) == 5, np.nan, 0.5)[:, None, None, None] * np.ones((1, 16, 16, 3), np.float32)
    write(tmp_path / "nan.h5", {"touch": broken})
    with pytest.raises(ValueError, match=r"nan\.h5 /touch row 5: it has values that are NaN or infinite"):
        packed(FolderConfig(path=tmp_path / "nan.h5", size=16, allow_leak=True), tmp_path / "nan")
    with pytest.raises(ValueError, match=r"its values lie in 268 to 268, not 0 to 255: --data\.range"):
        packed(FolderConfig(**(options | {"path": tmp_path / "b.h5"})), tmp_path / "j")
    rows = []
    for i in range(20):  # a field of deformation in mm
        np.save(tmp_path / f"{i}.npy", np.full((16, 16, 2), 0.1 * i - 1, np.float32))
        Image.fromarray(np.full((16, 16), 100 * i, np.uint16)).save(tmp_path / f"{i}.png")
        rows.append(f"{i}.npy,{i}.png,{i}")
    (tmp_path / "m.csv").write_text("touch,vision,take\n" + "\n".join(rows))
    with pytest.raises(ValueError, match=r"its values lie in -1 to -1, not 0 to 1: --data\.range"):
        packed(FolderConfig(path=tmp_path / "m.csv", size=16, group="take"), tmp_path / "no")
    config = FolderConfig(path=tmp_path / "m.csv", size=16, group="take", range=("touch=-1:1", "vision=0:1900"))
    pack = packed(config, tmp_path / "r")
    assert (abs(pack.images["vision"][:, 0, 0, 0] - (np.arange(20) * 255 / 19)) <= 0.51).all()
    assert (abs(pack.images["touch"][:, 0, 0, :2] - np.arange(20)[:, None] * 12.75) <= 0.51).all()
    assert not pack.images["touch"][..., 2].any()


def test_a_crop_is_cut_out_of_images_and_backgrounds(tmp_path: Path) -> None:
    """Two sensors in one picture, each with a mirror strip that is left out."""
    for i in range(12):
        sheet = np.zeros((20, 40, 3), np.uint8)
        sheet[4:, :20], sheet[4:, 20:] = 10 * i, 100 + 10 * i
        Image.fromarray(sheet).save(tmp_path / f"{i}.png")
    rows = "\n".join(f"{i}.png,{i}.png,0.png,0.png,{i}" for i in range(12))
    (tmp_path / "m.csv").write_text("left,right,a,b,take\n" + rows)
    crops = ("left=0:4:20:16", "right=20:4:20:16")
    options: dict[str, Any] = {"path": tmp_path / "m.csv", "size": 16, "group": "take"}
    pack = packed(FolderConfig(**options, crop=crops), tmp_path / "p")
    assert (pack.images["touch"][..., 0] == 10 * np.arange(12)[:, None, None]).all()
    assert (pack.images["touch"][..., 3] == 100 + 10 * np.arange(12)[:, None, None]).all()
    assert pack.spec.crop == {"touch": "0:4:20:16, 20:4:20:16"}
    assert pack.spec.notes[0] == "left=0:4:20:16 is the part of the images that is used, squeezed to a square"
    flat = packed(FolderConfig(**options, crop=crops, difference=True, background=("a", "b")), tmp_path / "d")
    assert (flat.images["touch"] == 128 + 5 * np.arange(12)[:, None, None, None]).all()
    with pytest.raises(ValueError, match=r"0\.png is 40 x 20: crop 21:4:20:16 is larger"):
        packed(FolderConfig(**options, crop=("left=0:4:20:16", "right=21:4:20:16")), tmp_path / "no")
    for wrong in ("left", "left=1:2:3", "left=0:0:0:4", "left=-1:0:4:4", "left=0:0:.5:5"):
        with pytest.raises(ValueError, match=f"'{wrong}': write COLUMN=x:y:width:height"):
            FolderConfig(**options, crop=(wrong,))


BAD: dict[str, tuple[dict[str, Any], dict[str, str], str]] = {
    "dataset missing": (flat(gel=None), {}, r"has no image dataset 'gel' \(it has camera \[20, 16, 20, 3\]\)"),
    "lengths of images": (flat(gel=grays(1, 2)), {}, "/gel has 2 rows, /camera has 20"),
    "length of a number": (flat(force_n=np.arange(9)), {}, r"force_n is int64 \[9\] in a: .*for each of the 20 images"),
    "channels first": (flat(gel=np.zeros((20, 3, 16, 16), np.uint8)), {}, r"/gel is uint8 \[20, 3, 16, 16\], not"),
    "text for a number": (flat(force_n=["1", "2 N"] * 10), {}, r"row 2 \(a/1\): force_n is '2 N': give a finite"),
    "not UTF-8": (flat(force_n=np.array([b"\xff"] * 20)), {}, "force_n is not UTF-8 text in a"),
    "a whole vector": (flat(), {"values": "pose:mm"}, r"pose is '\[0\.0, .*give an element, such as pose\[0\]"),
    "past the vector": (flat(), {"values": "pose[3]:mm"}, r"pose\[3\] does not exist: pose has 3 numbers"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_named_in_one_line(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    content, options, says = BAD[name]
    write(tmp_path / "a.h5", content)
    refused(tmp_path / "a.h5", options, says, capsys)


def sparse(file: h5py.File, name: str, shape: tuple[int, ...], kind: str = "u1") -> None:
    del file[name]
    file.create_dataset(name, shape, kind, chunks=tuple(min(n, 64) for n in shape))


def elsewhere(file: h5py.File, name: str, *, virtual: bool) -> None:
    shape, kind = file[name].shape, file[name].dtype
    del file[name]
    if virtual:
        layout = h5py.VirtualLayout(shape, kind)
        layout[:] = h5py.VirtualSource("/etc/secret.h5", "x", shape=shape)
        file.create_virtual_dataset(name, layout)
    else:
        file.create_dataset(name, shape, kind, external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


TRAPS: dict[str, tuple[Callable[[h5py.File], None], str]] = {
    "external images": (lambda f: elsewhere(f, "camera", virtual=False), "camera shows the content of other files"),
    "external numbers": (lambda f: elsewhere(f, "force_n", virtual=False), "force_n shows the content of other files"),
    "virtual images": (lambda f: elsewhere(f, "gel", virtual=True), "gel shows the content of other files: copy it"),
    "a huge image": (lambda f: sparse(f, "camera", (20, 60_000, 60_000, 3)), "have 3,600,000,000 pixels: at most"),
    "no end of rows": (
        lambda f: [sparse(f, name, (200_000_000, 4, 4, 3)) for name in ("camera", "gel")] and None,
        "camera has 200,000,000 rows: at most 3,000,000 are read at once",
    ),
    "no end of numbers": (lambda f: sparse(f, "pose", (20, 10**9), "f8"), r"pose has 20,000,000,000 numbers: a column"),
}


@pytest.mark.parametrize("name", TRAPS)
def test_files_that_show_others_or_fill_memory(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with h5py.File(path := write(tmp_path / "a.h5", flat()), "a") as file:
        TRAPS[name][0](file)
    refused(path, {"values": "pose[0]:mm"} if "numbers" in name else {}, TRAPS[name][1], capsys)


@pytest.mark.parametrize("keep", [0, 3000, -1])
def test_truncated_files(tmp_path: Path, keep: int, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "a.h5", flat())
    path.write_bytes(path.read_bytes()[:keep])
    refused(path, {}, r"a\.h5 cannot be read as HDF5 \(.*\): is it complete", capsys)


def claimed(name: str, **about: Any) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        file = path / name / ".zarray"
        file.write_text(json.dumps(json.loads(file.read_text()) | about))

    return change


ENDS, TO_20 = "meta/episode_ends", "data: meta/episode_ends does not rise to 20"
ZARR: dict[str, tuple[Callable[[Path], object], str]] = {
    "no JSON": (lambda path: (path / "data/gel/.zarray").write_text("{"), "cannot be read as zarr .*double quotes"),
    "unknown codec": (claimed("data/gel", compressor={"id": "nosuch"}), "cannot be read as zarr .*nosuch"),
    "pickles": (claimed("data/gel", dtype="|O", filters=[{"id": "pickle"}]), "cannot be read as zarr .*pickle"),
    "chunks of nothing": (claimed("data/gel", chunks=[0, 16, 16, 3]), "/data/gel row 0 cannot be read .*by zero"),
    "no end of ends": (claimed(ENDS, shape=[10**12], chunks=[10**12]), TO_20),
    "ends of ends": (claimed(ENDS, shape=[2, 1], chunks=[2, 1]), TO_20),
    "a negative end": (lambda path: zarr.open_group(path)[ENDS].__setitem__(0, -8), TO_20),
}


@pytest.mark.parametrize("name", ZARR)
def test_what_zarr_says_is_not_believed(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    buffer = zarr.open_group(path := tmp_path / "a.zarr", mode="w", zarr_format=2)
    content = {"data/camera": grays(*range(20)), "data/gel": grays(*range(20)), ENDS: np.array([8, 20])}
    for dataset, value in content.items():
        buffer.create_array(dataset, data=value, chunks=value.shape)
    ZARR[name][0](path)
    refused(path, {"values": "", "group": ""}, f"a.zarr.*{ZARR[name][1]}", capsys)


def shaped(shape: tuple[int, ...], kind: str) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
    return file.getvalue()


NPY: dict[str, tuple[bytes, str]] = {
    "no end of pixels": (shaped((10**6, 10**6), "|u1"), "cannot be read as an array"),
    "a side below 0": (shaped((-4, 40, 3), "|u1"), "cannot be read as an array"),
    "no whole side": (shaped((True, 40), "|u1"), "cannot be read as an array"),
    "nothing": (shaped((0, 0, 3), "|u1"), "has 0 pixels"),
    "text": (shaped((1, 1), "<U1") + b"a\0\0\0", r"is <U1 \[1, 1\]: give numbers"),
    "complex": (shaped((1, 1), "<c8") + bytes(8), r"is complex64 \[1, 1\]: give numbers"),
    "objects": (shaped((1, 1), "|O") + pickle.dumps([1]), "cannot be read as an array"),
}


@pytest.mark.parametrize("name", NPY)
def test_npy_files_that_are_no_images(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    for i in range(12):
        np.save(tmp_path / f"{i}.npy", grays(i)[0])
    (tmp_path / "3.npy").write_bytes(NPY[name][0])
    (tmp_path / "m.csv").write_text("camera,gel\n" + "\n".join(f"{i}.npy,{(i + 1) % 12}.npy" for i in range(12)))
    refused(tmp_path / "m.csv", {"values": "", "group": ""}, rf"3\.npy {NPY[name][1]}", capsys)


def refused(path: Path, options: dict[str, str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = path.parent / "out"
    given = {"vision": "camera", "touch": "gel", "values": "force_n:N", "group": "object"} | options
    words = [word for name, value in given.items() if value for word in (f"--{name}", value)]
    assert main(["data", "pack", "--data", "folder", "--path", str(path), "--out", str(out), *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("mvitac: error: ") and error.count("\n") == 1 and re.search(says, error), error
    assert not out.exists()
