"""Calandra's shards, built here in the owners' structure: nothing is lost, mixed up or leaked on the way to a table."""

import io
import os
import random
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mvitac.bench.suite import find_suite, open_set
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.spec import PHASES
from mvitac.datasets.calandra import AUTHORS_TEST, AUTHORS_TRAIN, Calandra, CalandraConfig, list_grasps, owners_shuffle
from mvitac.datasets.simulated import GraspsConfig
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.evaluation.probe import split_rows
from mvitac.report.tables import print_summary
from mvitac.training.loop import train
from support.forged_packs import refuse_pipe
from support.training_runs import smoke

GEL, KINECT = (24, 32, 3), (54, 96, 3)
OBJECTS = ("lemon", "lime", "potato", "onion", "soft_zebra", "metal_can", "some_other_thing")


def write_shard(
    folder: Path, shard: int, objects: Sequence[bytes | str | None], *, leak: bool = False, grip: Any = None
) -> Path:
    """One shard in the owners' structure: /data/iN with nine images each, name and outcome as attributes of iN.
    ``leak``: the image 'after' shows the outcome and the others do not. ``grip`` replaces the outcome (None = i %
    2)."""
    path = folder / f"calandra_corl2017_{shard:03d}.h5"
    rng = np.random.default_rng(shard)
    with h5py.File(path, "w") as file:
        for index, name in enumerate(objects):
            group = file.create_group(f"data/i{index}")
            gripping = bool(rng.integers(2)) if leak else bool(index % 2)
            for s, (sensor, shape) in enumerate((("gelsightA", GEL), ("gelsightB", GEL), ("kinectA_rgb", KINECT))):
                for p, phase in enumerate(PHASES):
                    image = rng.integers(0, 256, shape, np.uint8)
                    image[0, 0] = (shard * 97 + index * 9 + s * 3 + p) % 256
                    if leak and phase == "after":
                        image[:] = 220 if gripping else 30
                    group.create_dataset(f"{sensor}_{phase}", data=image, compression="gzip", compression_opts=1)
            if name is not None:
                group.attrs["object_name"] = np.bytes_(name) if isinstance(name, bytes) else name
            group.attrs["is_gripping"] = np.bool_(gripping) if grip is None else grip
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shards of 14 and 12 grasps; the second begins with i10 and i9 out of alphabetical order."""
    path = tmp_path_factory.mktemp("calandra")
    write_shard(path, 0, [OBJECTS[i % 7].encode() for i in range(14)])
    write_shard(path, 2, [OBJECTS[i % 6].encode() for i in range(12)])
    (path / "notes.txt").write_text("not a shard")
    return path


def test_every_image_is_in_its_place(folder: Path, tmp_path: Path) -> None:
    source = CalandraConfig(path=folder, split="object").source()
    assert source.items()[:3] == [f"calandra_corl2017_000.h5 i{i}" for i in range(3)]
    assert source.items()[14:] == [f"calandra_corl2017_002.h5 i{i}" for i in range(12)]  # i10 after i9, not after i1
    for item, (shard, index) in ((13, (0, 13)), (25, (2, 11))):
        with h5py.File(folder / f"calandra_corl2017_{shard:03d}.h5") as file:
            raw = {name: file[f"data/i{index}/{name}"][()] for name in file[f"data/i{index}"]}
        samples = source.read(item)
        assert [sample.columns["phase"] for sample in samples] == list(PHASES)
        for phase, sample in zip(PHASES, samples, strict=True):
            both = np.concatenate([raw[f"gelsightA_{phase}"], raw[f"gelsightB_{phase}"]], axis=2)
            assert np.array_equal(sample.touch, both) and np.array_equal(sample.vision, raw[f"kinectA_rgb_{phase}"])
            assert sample.columns["outcome"] == index % 2
            assert sample.columns["touch_group"] == f"{shard:03d}-{index:03d}"
    packed = build(CalandraConfig(path=folder, size=24).source(), tmp_path / "p", size=24, quiet=True)
    assert packed.num == 3 * 24  # two of the 26 grasps are of an object outside the 40


def test_a_pack_depends_on_what_the_shards_hold_and_when_they_were_written(folder: Path, tmp_path: Path) -> None:
    root = shutil.copytree(folder, tmp_path / "elsewhere")
    one, other = CalandraConfig(path=folder), CalandraConfig(path=root, workers=3)
    assert one.source().fingerprint() == other.source().fingerprint()
    assert one.source().fingerprint() != replace(one, split="object").source().fingerprint()
    before = other.source()
    os.utime(root / "calandra_corl2017_000.h5", (10, 10))
    after = other.source()
    assert before.fingerprint() == after.fingerprint()
    for name, old, new in zip(before.items(), before.stamps() or (), after.stamps() or (), strict=True):
        assert (old != new) == name.startswith("calandra_corl2017_000")


def test_object_names_are_repaired(tmp_path: Path) -> None:
    path = write_shard(tmp_path, 0, [b"plastic_duc", b"plastic_duck", b" lemon\0", "lime", b"hair_dryer_"])
    source = Calandra(CalandraConfig(path=tmp_path, split="object"))
    names = [source.read(i)[0].columns["group"] for i in range(5)]
    assert names == ["plastic_duck", "plastic_duck", "lemon", "lime", "hair_dryer_spiky_nozzle"]
    with h5py.File(path, "a") as file:
        file["data/i1"].attrs.create("object_name", b"\xff", dtype=h5py.string_dtype())
    assert [bool(grasp.damage) for grasp in list_grasps(path)] == [False, True, False, False, False]


def test_outcome_as_pytables_stores_it(tmp_path: Path) -> None:
    """deepdish wrote through PyTables, whose bool attributes are 8-bit bit fields, not HDF5 enums."""
    with h5py.File(write_shard(tmp_path, 0, [b"lemon", b"lime"]), "a") as file:
        attributes = file["data/i0"].attrs
        del attributes["is_gripping"]
        made = h5py.h5a.create(attributes._id, b"is_gripping", h5py.h5t.NATIVE_B8, h5py.h5s.create(h5py.h5s.SCALAR))
        made.write(np.array(1, np.uint8), mtype=h5py.h5t.NATIVE_B8)
    assert CalandraConfig(path=tmp_path, split="object").source().read(0)[0].columns["outcome"] == 1


def test_damaged_grasps_are_listed_and_the_rest_is_read(tmp_path: Path) -> None:
    """A missing attribute, a missing image, a chunk that does not inflate, a wrong outcome, gels of another size or kind."""
    path = write_shard(tmp_path, 0, [b"lemon", None, *[b"lime", b"potato"] * 4])
    with h5py.File(path, "a") as file:
        del file["data/i2/gelsightB_during"]
        file["data/i4"].attrs["is_gripping"] = np.array([0, 1])
        for i, gel in ((8, np.zeros((12, 16, 3), np.uint8)), (9, np.zeros((24, 32, 3), np.float32))):
            del file[f"data/i{i}/gelsightB_before"]
            file[f"data/i{i}/gelsightB_before"] = gel
        chunk = file["data/i3/kinectA_rgb_before"].id.get_chunk_info(0)
    damaged = bytearray(path.read_bytes())
    damaged[chunk.byte_offset + 2 : chunk.byte_offset + chunk.size] = b"\xff" * (chunk.size - 2)
    path.write_bytes(damaged)
    source = CalandraConfig(path=tmp_path, size=24).source()
    with pytest.raises(ValueError, match=r"6 of 10 items cannot be read, first .*_000\.h5 i1: .*object_name"):
        build(source, tmp_path / "strict", size=24, quiet=True)
    pack = build(source, tmp_path / "lenient", size=24, max_damaged=0.6, quiet=True)
    assert pack.num == 3 * 4
    reasons = dict(pack.meta["damaged"])
    assert "gelsightB_during" in reasons["calandra_corl2017_000.h5 i2"]
    assert "kinectA_rgb_before" in reasons["calandra_corl2017_000.h5 i3"]
    assert [name[-2:] for name in reasons] == ["i1", "i2", "i3", "i4", "i8", "i9"]


IMAGES: dict[str, tuple[Any, str]] = {
    "a link": (h5py.SoftLink("/data/i2/gelsightA_during"), "data/i1/gelsightA_during is a link"),
    "a link to another file": (h5py.ExternalLink("other.h5", "/x"), "data/i1/gelsightA_during is a link"),
    "other bytes": (np.full(GEL, -5, np.int8), "it is int8 .*, not uint8"),
    "nothing": (h5py.Empty("u1"), "it is uint8 None, not uint8"),
    "no pixels but a group": ({}, "it is None None, not uint8"),
    "external": ({"external": [("raw.bin", 0, 12288)]}, "shows the content of other files"),
    "billions of pixels": ({"shape": (99_999, 99_999, 3), "chunks": (999, 999, 3)}, "9,999,800,001 pixels: at most"),
}


@pytest.mark.parametrize("kind", IMAGES)
def test_an_image_is_what_it_should_be_and_in_its_own_file(kind: str, tmp_path: Path) -> None:
    value, says = IMAGES[kind]
    with h5py.File(write_shard(tmp_path, 0, [b"lemon"] * 3), "a") as file:
        grasp: Any = file["data/i1"]
        del grasp["gelsightA_during"]
        if isinstance(value, dict) and value:
            grasp.create_dataset("gelsightA_during", **{"shape": GEL, "dtype": "u1", **value})
        elif isinstance(value, dict):
            grasp.create_group("gelsightA_during")
        else:
            grasp["gelsightA_during"] = value
    with pytest.raises(ValueError, match=f"data/i1/gelsightA_during cannot be read .*{says}"):
        CalandraConfig(path=tmp_path, split="object").source().read(1)


@pytest.mark.parametrize("outcome", [np.nan, "False", -1, 2, h5py.Empty("f")])
def test_an_outcome_is_a_bool(outcome: Any, tmp_path: Path) -> None:
    write_shard(tmp_path, 0, [b"lemon"], grip=outcome)
    with pytest.raises(ValueError, match="holds no grasp that can be read"):
        CalandraConfig(path=tmp_path, split="object").source()


def test_a_grasp_or_a_shard_that_is_no_file_of_this_folder(tmp_path: Path) -> None:
    with h5py.File(write_shard(tmp_path, 0, [b"lemon", b"lime"]), "a") as file:
        del file["data/i1"]
        file["data/i1"] = h5py.ExternalLink("other.h5", "/x")
    with pytest.raises(ValueError, match="data/i1 is a link"):
        CalandraConfig(path=tmp_path).source().read(1)
    says = r"_001\.h5 cannot be read .*neither a file nor a folder"
    refuse_pipe(tmp_path / "calandra_corl2017_001.h5", CalandraConfig(path=tmp_path).source, says)


def test_a_truncated_shard_is_named(folder: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(folder, tmp_path / "d")) / "calandra_corl2017_000.h5"
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(ValueError, match=r"_000\.h5 cannot be read .*: download it again, or remove it"):
        CalandraConfig(path=path.parent).source()


def test_missing_data_is_said(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="OPARA"):
        CalandraConfig(path=tmp_path).source()
    write_shard(tmp_path, 0, [b"some_other_thing"])
    with pytest.raises(ValueError, match="none of the authors' 40"):
        CalandraConfig(path=tmp_path).source()


def splits_of(config: CalandraConfig) -> dict[str, str]:
    source = config.source()
    return {c["group"]: c["split"] for i in range(len(source.items())) for c in [source.read(i)[0].columns]}


@pytest.fixture(scope="module")
def forty_four(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("objects")
    others = ["some_other_thing", "hair_dryer_", "beans_in_pa", "yellow_bulb"]
    write_shard(path, 0, [name.encode() for name in (*AUTHORS_TRAIN, *AUTHORS_TEST, *others)])
    return path


def test_the_authors_split(forty_four: Path) -> None:
    splits = splits_of(CalandraConfig(path=forty_four))
    assert {name for name, split in splits.items() if split == "test"} == set(AUTHORS_TEST)
    assert {name for name, split in splits.items() if split in ("train", "val")} == set(AUTHORS_TRAIN)
    assert sum(split == "val" for split in splits.values()) == round(0.15 * 32)
    assert Counter(splits_of(CalandraConfig(path=forty_four, val_share=0.0)).values()) == {"train": 32, "test": 8}


def test_the_owners_split(forty_four: Path) -> None:
    splits = splits_of(CalandraConfig(path=forty_four, split="object", val_share=0.0))
    assert Counter(splits.values()) == {"train": 33, "test": 11}
    assert splits_of(CalandraConfig(path=forty_four, split="object", split_seed=1, val_share=0.0)) != splits
    carved = splits_of(CalandraConfig(path=forty_four, split="object"))
    assert Counter(carved.values()) == {"train": 28, "val": 5, "test": 11}
    assert {n for n, s in carved.items() if s == "test"} == {n for n, s in splits.items() if s == "test"}


def test_the_owners_order_is_python_2s_shuffle() -> None:
    """random.Random's own floats are those of Python 2; its shuffle(x, random) was j = int(random() * (i + 1))."""
    names = [f"o{i:02d}" for i in range(20)]
    expected, generator = list(names), random.Random(3)
    for i, value in zip(range(19, 0, -1), [generator.random() for _ in range(19)], strict=True):
        j = int(value * (i + 1))
        expected[i], expected[j] = expected[j], expected[i]
    assert owners_shuffle(names[::-1], 3) == expected and sorted(expected) == names != expected


@pytest.fixture(scope="module")
def leaking(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """240 grasps of 8 objects, in which the image 'after' gives the outcome away and the others are noise."""
    path = tmp_path_factory.mktemp("leaking")
    objects = [*AUTHORS_TRAIN[:6], *AUTHORS_TEST[:2]]
    write_shard(path, 0, [objects[i % 8].encode() for i in range(240)], leak=True)
    return path


def leaking_pack(leaking: Path, out: Path, **options: Any) -> Pack:
    return build(CalandraConfig(path=leaking, size=32, **options).source(), out, size=32, quiet=True)


def test_after_has_no_label(leaking: Path, tmp_path: Path) -> None:
    pack = leaking_pack(leaking, tmp_path / "p")
    assert [task.name for task in pack.spec.tasks] == ["success"]
    assert set(pack.column("phase")[pack.column("label_success") >= 0]) == {"during"}
    rows = split_rows(pack, pack.spec.tasks[0])
    for part in (rows.train, rows.val, rows.test):
        assert len(part) and set(pack.column("phase")[part]) == {"during"}


def test_after_reaches_no_probe_unless_named_and_then_every_table_says_so(leaking: Path, tmp_path: Path) -> None:
    """The same road on both packs: what 'during' does not show is at chance, what 'after' shows is not."""
    shown = {}
    for ask in (("during",), ("after",)):
        run = smoke(leaking_pack(leaking, tmp_path / ask[0], ask=ask), steps=2, eval_every=1)
        session = ProbeConfig(probes=("linear", "knn"), modalities=("touch",))
        result = probe_runs([train(run, tmp_path / f"run-{ask[0]}", quiet=True)], session)
        print_summary(result, file := io.StringIO())
        shown[ask[0]] = result["summary"], file.getvalue(), (tmp_path / f"run-{ask[0]}" / "log.jsonl").read_text()
    honest, leaked = shown["during"], shown["after"]
    assert set(honest[0]) == {"success"} and "after" not in honest[1] and "after" not in honest[2]
    assert honest[0]["success"]["touch"]["pixels"]["mean"] < 0.75
    assert leaked[0]["success_after_leaks"]["touch"]["pixels"]["mean"] == 1.0
    assert leaked[1].count("success_after_leaks") == 1 and "success_after_leaks" in leaked[2]


def test_the_authors_protocol_is_named_too(leaking: Path, tmp_path: Path) -> None:
    task = (pack := leaking_pack(leaking, tmp_path / "p", ask=("during", "authors"))).spec.tasks[1]
    rows = split_rows(pack, task)
    assert "after" in task.name and set(pack.column("phase")[rows.train]) == set(PHASES)
    assert set(pack.column("phase")[rows.val]) == set(pack.column("phase")[rows.test]) == {"during"}


def test_labels_are_only_of_rows_the_task_is_about(tmp_path: Path) -> None:
    """Simulated grasps carry the outcome in all three phases: neither the supervised baseline nor kNN may see them."""
    pack = build(GraspsConfig(num=24, size=16).source(), tmp_path / "p", size=16, quiet=True)
    about = pack.column("phase") == "during"
    assert (pack.column("label_success") >= 0).all() and np.array_equal(pack.labels("success") >= 0, about)


def test_the_suite_of_the_bench_tests_every_object_in_one_fold(forty_four: Path, tmp_path: Path) -> None:
    (tmp_path / "calandra").symlink_to(forty_four)
    (one,) = find_suite("calandra-v1").sets
    opened = open_set(replace(one, forms=(replace(one.forms[0], data={**one.forms[0].data, "size": 16}),)), tmp_path)
    assert not isinstance(opened, str) and len(opened.packs) == 10
    tested = [view.column("group")[view.rows("test")].tolist() for view in opened.packs]
    assert sorted(name for fold in tested for name in fold) == sorted(set(opened.packs[0].column("group").tolist()))
    assert set(opened.packs[0].column("phase")) == {"during"} and opened.packs[0].spec.touch_channels == 6
