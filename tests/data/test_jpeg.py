"""Packs that store JPEG: what Pillow would decode, resumable to the same bytes, refused where damaged, and trained on."""

import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from PIL import Image, JpegImagePlugin

from mvitac.cli.main import main
from mvitac.data import jpeg
from mvitac.data.build import build
from mvitac.data.jpeg import Jpegs, decode, encode
from mvitac.data.pack import Pack
from mvitac.data.source import Source
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.run import Run
from mvitac.training.loop import train
from mvitac.training.sampler import Batches
from mvitac.training.views import StepViews
from support.forged_packs import described, seal
from support.toy import Holes, Toy, altered
from support.training_runs import assert_equal_weights, smoke

FILES = ("pack.json", "samples.parquet", "vision.jpegs", "touch.jpegs")


def jpeg_pack(path: Path, source: Source | None = None, **options: Any) -> Pack:
    return build(source or Toy(), path, size=32, quiet=True, store="jpeg", **options)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return jpeg_pack(tmp_path_factory.mktemp("jpeg") / "pack")


def test_rows_are_what_pillow_decodes(pack: Pack, small: Pack, tmp_path: Path) -> None:
    assert (small.meta["store"], small.meta["quality"], pack.meta["store"]) == ("jpeg", 95, "raw")
    assert {p.name for p in small.path.iterdir()} == {*FILES, "provenance.json"}
    for modality in ("vision", "touch"):
        images, raw = small.images[modality], pack.images[modality]
        ends = np.cumsum(small.column(f"bytes_{modality}").astype(int))
        blob = (small.path / f"{modality}.jpegs").read_bytes()
        assert len(blob) == ends[-1] < raw.nbytes
        for row in (0, 17, 119):
            (tmp_path / "one.jpg").write_bytes(blob[ends[row - 1] if row else 0 : ends[row]])
            with Image.open(tmp_path / "one.jpg") as image:
                assert JpegImagePlugin.get_sampling(image) == 0  # 4:4:4
                assert np.array_equal(images[row], np.asarray(image))
        assert 0 < np.abs(images[:].astype(int) - raw).mean() < 4  # of noise with a spread of 8
    for name in pack.table.column_names:
        if not name.startswith("crc_"):
            assert small.column(name).tolist() == pack.column(name).tolist()


INDICES: list[Any] = [3, -1, slice(5, 40, 3), slice(100, 500), np.array([5, 1, 5, 119]), np.zeros(0, int)]
INDICES += [np.arange(120) % 7 == 0, np.array([[1, 2], [3, 4]]), (slice(3, 90), slice(None, None, 2), slice(5), 1)]


@pytest.mark.parametrize("index", INDICES, ids=str)
@pytest.mark.parametrize("num_threads", [1, 3])
def test_indexed_like_its_array(small: Pack, monkeypatch: pytest.MonkeyPatch, index: Any, num_threads: int) -> None:
    images = small.images["touch"]
    whole = np.stack([images[row] for row in range(120)])
    with ThreadPoolExecutor(num_threads) as pool:
        monkeypatch.setattr(jpeg, "_num_threads", lambda: num_threads)
        monkeypatch.setattr(jpeg, "_threads", lambda: pool)
        found = images[index]
    assert found.dtype == np.uint8 and np.array_equal(found, whole[index]) and found.shape == whole[index].shape
    assert (len(images), images.shape, images.dtype, images.nbytes) == (120, whole.shape, whole.dtype, whole.nbytes)


def test_two_sensors_keep_apart(tmp_path: Path) -> None:
    """At a side of whole blocks nothing of one sensor gets into the other; each is what it is alone."""
    source = Toy(num=24, touch_channels=6)
    two, raw = jpeg_pack(tmp_path / "two", source), build(source, tmp_path / "raw", size=32, quiet=True)
    assert two.images["touch"].shape == (24, 32, 32, 6)
    for row in (0, 23):
        for sensor in (slice(0, 3), slice(3, 6)):
            alone = raw.images["touch"][row, :, :, sensor]
            assert np.array_equal(two.images["touch"][row][:, :, sensor], decode(encode(alone, 95), (32, 32, 3)))


def test_a_missing_image_has_no_bytes(tmp_path: Path) -> None:
    found = jpeg_pack(tmp_path / "p", Holes(num=12), quality=3)
    assert ((found.column("bytes_touch") == 0) == ~found.has("touch")).all()
    assert ((found.images["touch"][:] == 0).all((1, 2, 3)) == ~found.has("touch")).all()


def test_the_command_line_and_the_cache(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["data", "pack", "--data", "materials", "--num", "20", "--size", "16", "--workers", "1", "--quiet"]
    assert main([*words, "--store", "jpeg", "--out", str(tmp_path / "p")]) == 0
    assert main(["data", "info", str(tmp_path / "p")]) == 0
    assert "JPEG of quality 95" in " ".join(capsys.readouterr().out.split())
    config = MaterialsConfig(num=20, size=16, workers=1, store="jpeg")
    assert config.source().fingerprint() == replace(config, store="raw").source().fingerprint()
    kept = [replace(config, **changes).open(quiet=True) for changes in ({}, {"store": "raw"}, {"quality": 81})]  # type: ignore[arg-type]
    assert kept[0].digest == Pack(tmp_path / "p").digest and len({pack.path for pack in kept}) == 3
    assert isinstance(kept[0].images["touch"], Jpegs) and isinstance(kept[1].images["touch"], np.ndarray)


def lengths(change: Callable[[np.ndarray], np.ndarray | None]) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        table = pq.read_table(path / "samples.parquet")
        new = change(table.column("bytes_touch").to_numpy())
        table = table.drop_columns("bytes_touch")
        pq.write_table(table if new is None else table.append_column("bytes_touch", [new]), path / "samples.parquet")
        seal(path)

    return spoil


def flip(path: Path) -> None:
    data = bytearray((path / "touch.jpegs").read_bytes())
    data[-9] ^= 1
    (path / "touch.jpegs").write_bytes(data)


DAMAGES: dict[str, tuple[Callable[[Path], None], str]] = {
    "bit": (flip, r"touch\.jpegs does not match its digest: the pack is damaged, make it again"),
    "offsets": (
        lengths(lambda sizes: sizes + (np.arange(120) == 7)),
        r"touch\.jpegs .*holds \d+ bytes, its table promises \d+\): .*damaged",
    ),
    "no-offsets": (lengths(lambda _: None), r"unknown column 'bytes_touch'"),
    "called-png": (described("store", value="png"), r"pack\.json is damaged .*png"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_named(small: Pack, tmp_path: Path, name: str) -> None:
    spoil, says = DAMAGES[name]
    spoil(Path(shutil.copytree(small.path, tmp_path / "p")))
    with pytest.raises(ValueError, match=says) as raised:
        Pack(tmp_path / "p")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", ["garbage", "other size", "gray"])
def test_a_row_that_cannot_be_decoded_is_named(small: Pack, tmp_path: Path, kind: str) -> None:
    """Where nothing was verified, or a pack was sealed by someone else."""
    path = Path(shutil.copytree(small.path, tmp_path / "p"))
    ends = np.cumsum(small.column("bytes_touch").astype(int))
    data, row = bytearray((path / "touch.jpegs").read_bytes()), slice(ends[4], ends[5])
    one = bytes(data[row])
    if kind == "garbage":
        new = bytes(range(256)) * 10
    else:
        shape = (16, 64, 3) if kind == "other size" else (32, 32)  # as many pixels
        Image.fromarray(np.full(shape, 9, np.uint8)).save(tmp_path / "x.jpg", quality=20)
        new = (tmp_path / "x.jpg").read_bytes()
    data[row] = new[: len(one)] + bytes(max(0, len(one) - len(new)))
    (path / "touch.jpegs").write_bytes(data)
    found = Pack(path, verify=False)
    with pytest.raises(ValueError, match=r"touch\.jpegs: row 5 cannot be decoded \(.*\): pack again") as raised:
        found.images["touch"][np.arange(20)]
    assert "\n" not in str(raised.value) and found.images["touch"][6].any()
    with pytest.raises(ValueError, match="Premature end of JPEG file"):
        decode(one[: len(one) // 2], (32, 32, 3))


@pytest.fixture(scope="module")
def decoded(small: Pack, tmp_path_factory: pytest.TempPathFactory) -> Pack:
    decoded = altered(Toy(), lambda _, item: {m: small.images[m][item] for m in ("vision", "touch")})
    return build(decoded, tmp_path_factory.mktemp("decoded") / "pack", size=32, quiet=True)


def run_on(pack: Pack, **changes: Any) -> Run:
    return smoke(pack, **{"steps": 4, "eval_every": 4, **changes})


def test_trains_as_on_the_same_pixels_raw(small: Pack, decoded: Pack, tmp_path: Path) -> None:
    packs = {"jpeg": small, "raw": decoded}
    assert_equal_weights(*(train(run_on(pack), tmp_path / name, quiet=True) for name, pack in packs.items()))


def test_decoding_runs_ahead_of_the_step(small: Pack, decoded: Pack, monkeypatch: pytest.MonkeyPatch) -> None:
    makers: list[str] = []
    real = StepViews.make
    monkeypatch.setattr(StepViews, "make", lambda *args: makers.append(threading.current_thread().name) or real(*args))
    for pack, name in ((small, "prefetch"), (decoded, "MainThread")):
        makers.clear()
        run, rows = run_on(pack), pack.rows("train")
        for parts in StepViews(run, pack, 2, torch.device("cpu")).iterate(Batches(run, pack, rows), 0, 3):
            assert len(parts[0]().rows) == run.batch_size
        assert len(makers) == 3 and all(maker.startswith(name) for maker in makers)
