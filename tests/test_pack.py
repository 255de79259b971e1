"""The pack: whole or not there, resumable to the same bytes, and never mistaken for something else."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from toy import Toy, toy_pack

from mvitac import packing
from mvitac.datasets.packed import PackConfig
from mvitac.pack import Pack
from mvitac.packing import build

FILES = ("pack.json", "samples.parquet", "vision.npy", "touch.npy")


def contents(path: Path) -> dict[str, bytes]:
    return {name: (path / name).read_bytes() for name in FILES}


def test_rows_and_images_belong_together(pack: Pack) -> None:
    source = Toy()
    for row in (0, 17, 119):
        sample = source.read(row)[0]
        assert pack.column("id")[row] == sample.columns["id"]
        for modality in ("vision", "touch"):
            assert np.array_equal(pack.images[modality][row], getattr(sample, modality))


def test_splits_share_no_group(pack: Pack) -> None:
    groups = {split: set(pack.column("group")[pack.rows(split)]) for split in ("train", "val", "test")}
    assert all(groups.values())
    assert not groups["train"] & groups["test"] and not groups["val"] & (groups["train"] | groups["test"])


def test_two_processes_give_the_bytes_of_one(pack: Pack, tmp_path: Path) -> None:
    build(Toy(), tmp_path / "two", size=32, workers=2, quiet=True)
    assert contents(tmp_path / "two") == contents(pack.path)


@pytest.mark.parametrize("parts_before_the_kill", [0, 1, 3])
def test_interrupted_build_resumes_to_the_same_bytes(
    pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parts_before_the_kill: int
) -> None:
    real, calls = packing._write_part, []

    def dying(job: object) -> range:
        if len(calls) == parts_before_the_kill:
            raise KeyboardInterrupt
        calls.append(job)
        return real(job)  # type: ignore[arg-type]

    monkeypatch.setattr(packing, "_write_part", dying)
    with pytest.raises(KeyboardInterrupt):
        toy_pack(tmp_path / "p")
    assert not (tmp_path / "p").exists()
    monkeypatch.setattr(packing, "_write_part", real)
    toy_pack(tmp_path / "p")
    assert contents(tmp_path / "p") == contents(pack.path)
    assert not (tmp_path / "p.partial").exists()


def test_unfinished_pack_of_something_else_is_not_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def die(job: object) -> range:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(packing, "_write_part", die)
        with pytest.raises(KeyboardInterrupt):
            toy_pack(tmp_path / "p")
    with pytest.raises(ValueError, match="unfinished pack of something else"):
        toy_pack(tmp_path / "p", num=60)


def test_damaged_items_stop_or_are_listed(tmp_path: Path) -> None:
    source = Toy(damaged=(3, 40))
    with pytest.raises(ValueError, match=r"2 of 120 items cannot be read, first item 3: item 3 is damaged"):
        build(source, tmp_path / "strict", size=32, quiet=True)
    lenient = build(source, tmp_path / "lenient", size=32, max_damaged=0.05, quiet=True)
    assert lenient.num == 118
    assert [name for name, _ in lenient.meta["damaged"]] == ["item 3", "item 40"]
    assert "0003" not in lenient.column("id")


def test_repaired_items_are_read_on_the_next_try(pack: Pack, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be read"):
        build(Toy(damaged=(3,)), tmp_path / "p", size=32, quiet=True)
    build(Toy(), tmp_path / "p", size=32, quiet=True)
    assert contents(tmp_path / "p") == contents(pack.path)


def copy_of(pack: Pack, path: Path) -> Path:
    shutil.copytree(pack.path, path)
    return path


def test_one_flipped_bit_is_noticed(pack: Pack, tmp_path: Path) -> None:
    path = copy_of(pack, tmp_path / "p") / "touch.npy"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(
        ValueError, match=r"touch\.npy does not match its digest in 1 of 120 rows, first row 119 .*0119"
    ):
        Pack(path.parent)


@pytest.mark.parametrize("name", FILES)
def test_missing_and_truncated_files(pack: Pack, tmp_path: Path, name: str) -> None:
    path = copy_of(pack, tmp_path / "p") / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ValueError, match=r"damaged|digest"):
        Pack(path.parent)
    path.unlink()
    with pytest.raises(ValueError, match="missing"):
        Pack(path.parent)


def test_foreign_folders(pack: Pack, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no pack at"):
        Pack(tmp_path / "nowhere")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "pack.json").write_text('{"name": "an npm package"}')
    with pytest.raises(ValueError, match="does not describe a pack"):
        Pack(tmp_path / "other")
    path = copy_of(pack, tmp_path / "p")
    meta = json.loads((path / "pack.json").read_text())
    (path / "pack.json").write_text(json.dumps({**meta, "format_version": 99}))
    with pytest.raises(ValueError, match="pack format 99"):
        Pack(path)


def test_never_overwrites(pack: Pack) -> None:
    with pytest.raises(ValueError, match="already exists"):
        toy_pack(pack.path)


def test_disk_is_asked_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packing.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(1, 1, 1000))  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="packing needs about"):
        toy_pack(tmp_path / "p")
    assert not list(tmp_path.iterdir())


def test_full_disk_leaves_no_half_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(OSError, match="No space"):
            toy_pack(tmp_path / "p")
    assert [p.name for p in (tmp_path / "p.partial").iterdir()] == ["request.json"]
    toy_pack(tmp_path / "p")


def test_scoring_on_val_hides_test(pack: Pack) -> None:
    whole = PackConfig(path=pack.path).open()
    choosing = PackConfig(path=pack.path, score_on="val").open()
    assert len(whole.rows("val")) and len(whole.rows("test"))
    np.testing.assert_array_equal(choosing.rows("test"), whole.rows("val"))
    np.testing.assert_array_equal(choosing.rows("train", "unlabelled"), whole.rows("train", "unlabelled"))
    assert not len(choosing.rows("val"))
    task = whole.spec.tasks[0].name
    unseen = whole.rows("test")
    assert (choosing.labels(task, "train", "val", "test")[unseen] == -1).all()
