"""Packs in shards: the rows of the pack they were made of, each once per epoch, through a cache that keeps its bound."""

from __future__ import annotations

import io
import json
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import torch

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.sharding import assign_rows, write_shards
from mvitac.data.streaming import Cache, StreamedPack
from mvitac.datasets.pack import StreamConfig
from mvitac.evaluation.pack_features import pack_features
from mvitac.model_files import fresh
from mvitac.recipes import recipe
from mvitac.run import Run
from mvitac.system.distributed import World
from mvitac.training import validation
from mvitac.training.loop import train
from mvitac.training.sampler import batches, epoch_order, mix, partners, shard_order
from support.forged_packs import seal
from support.toy import Toy
from support.training_runs import assert_equal_weights, power_cut, smoke

SHARD_MB = 0.05
"""Eight of the toy's pairs: 120 are 15 shards, 9 of them of its 72 training rows."""
FILE = 128 + 8 * 32 * 32 * 3
LIMIT = 9 * FILE
"""Two windows of two shards, and a file."""


@pytest.fixture(scope="module")
def shards(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stream") / "shards"
    write_shards(pack, str(path), shard_mb=SHARD_MB, quiet=True)
    return path


def opened(url: str | Path, cache: Path, *, limit: int = LIMIT, window: int = 2) -> StreamedPack:
    return StreamedPack(str(url), cache, limit=limit, window=window)


def stream(shards: Path, cache: Path, **changes: Any) -> Run:
    config = StreamConfig(url=str(shards), cache=cache, cache_gb=LIMIT / 1e9, window=2)
    return replace(recipe("smoke", config), **changes)


# -- what the shards hold ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("store", ["raw", "jpeg"])
@pytest.mark.parametrize("place", ["folder", "file://", "memory://"])
def test_a_row_is_the_pack_s_row(tmp_path: Path, store: Any, place: str) -> None:
    pack = build(Toy(num=40, touch_channels=6), tmp_path / "p", size=32, quiet=True, store=store)
    url = {"folder": str(tmp_path / "s"), "file://": f"file://{tmp_path}/s", "memory://": f"memory://{store}"}[place]
    assert write_shards(pack, url, shard_mb=SHARD_MB, quiet=True) > 3
    found = opened(url, tmp_path / "cache", limit=10**6)
    rows = [pack.column("id").tolist().index(one) for one in found.column("id")]
    assert sorted(rows) == [*range(40)] and rows != [*range(40)]
    for name in pack.table.column_names:
        assert found.column(name).tolist() == pack.column(name)[rows].tolist()
    for modality in ("vision", "touch"):
        expected = pack.images[modality][np.array(rows)]
        assert np.array_equal(found.images[modality][:], expected)
        assert np.array_equal(found.images[modality][np.array([39, 0, 5])], expected[[39, 0, 5]])
    sizes = sum(fsspec.url_to_fs(url)[0].sizes(sorted(fsspec.url_to_fs(url)[0].glob(f"{url}/shard-*"))))
    assert found.fetched == sizes and (found.spec, found.store) == (pack.spec, pack.store)


def test_the_same_seed_gives_the_same_shards(pack: Pack, shards: Path, tmp_path: Path) -> None:
    for seed, same in ((0, True), (1, False)):
        write_shards(pack, str(tmp_path / str(seed)), shard_mb=SHARD_MB, seed=seed, quiet=True)
        files = sorted(p.name for p in shards.iterdir())
        assert sorted(p.name for p in (tmp_path / str(seed)).iterdir()) == files
        equal = [(tmp_path / str(seed) / name).read_bytes() == (shards / name).read_bytes() for name in files]
        assert all(equal) == same


def test_training_reads_shards_of_its_own_and_a_touch_lies_in_one(shards: Path, tmp_path: Path) -> None:
    found = opened(shards, tmp_path)
    for number in range(15):
        assert len({*found.column("split")[found.shards == number]} - {"train"}) in (0, 1)
        assert ("train" in found.column("split")[found.shards == number]) == (number < 9)
    for touch in range(found.touch_groups.max() + 1):
        assert len({*found.shards[found.rows_of(touch)]}) == 1


def test_what_is_larger_than_a_shard_is_cut(pack: Pack) -> None:
    row = 2 * 32 * 32 * 3
    assert [len(rows) for rows in assign_rows(pack, row - 1, 0)] == [1] * 120
    parts = assign_rows(pack, 7 * row, 0)
    assert sorted(np.concatenate(parts)) == [*range(120)] and max(map(len, parts)) == 6  # touches of two stay whole


def test_partners_stay_in_the_shard(pack: Pack, tmp_path: Path) -> None:
    write_shards(pack, str(tmp_path / "s"), shard_mb=0.007, quiet=True)  # one row each: a touch of two is cut
    found, rows = opened(tmp_path / "s", tmp_path / "c"), np.arange(72)
    assert np.array_equal(partners(found, rows, torch.Generator().manual_seed(0)), rows)
    whole = partners(pack, smoke(pack).method.training_rows(pack), torch.Generator().manual_seed(0))
    assert (whole != smoke(pack).method.training_rows(pack)).all()


# -- the order --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_lanes", [1, 2, 3])
@pytest.mark.parametrize("window", [1, 3, 100])
def test_every_row_once_and_few_shards_at_a_time(num_lanes: int, window: int) -> None:
    shards = np.repeat(np.arange(20), np.random.default_rng(0).integers(5, 12, 20))
    num = len(shards) // 6 * 6
    lanes = shard_order(shards, None, window, num_lanes, num, seed=3)
    assert lanes.shape == (num_lanes, num // num_lanes) and len(set(lanes.ravel().tolist())) == num
    read = [set(shards[lane]) for lane in lanes]
    assert sum(map(len, read)) <= 20 + num_lanes - 1  # a shard is read twice only where it is cut
    for lane in lanes:
        first, last = ({s: i for i, s in list(enumerate(shards[lane]))[::way]} for way in (-1, 1))
        held = [sum(first[s] <= i <= last[s] for s in first) for i in range(len(lane))]
        assert max(held) <= window
        if window > 1:
            assert len(set(shards[lane[:12]])) > 1 < len(set(shards[lane[-12:]]))  # mixed from end to end
    assert not np.array_equal(lanes, shard_order(shards, None, window, num_lanes, num, seed=4))
    assert np.array_equal(lanes, shard_order(shards, None, window, num_lanes, num, seed=3))


def test_touches_keep_apart_in_a_batch(shards: Path, tmp_path: Path) -> None:
    found = opened(shards, tmp_path / "c", limit=10**6, window=9)
    run = replace(stream(shards, tmp_path / "c"), sampler="one-per-touch", batch_size=12)
    for rows in batches(run, found, run.method.training_rows(found), 0, 12):
        assert len(set(found.touch_groups[rows])) == 12


def test_processes_read_what_one_epoch_has(shards: Path, tmp_path: Path) -> None:
    found = opened(shards, tmp_path / "c")
    run, rows = (
        stream(shards, tmp_path / "c", batch_size=12),
        stream(shards, tmp_path / "c").method.training_rows(found),
    )
    for epoch in range(2):
        order = list(batches(run, found, rows, 6 * epoch, 6 * epoch + 6, World(0, 2)))
        assert sorted(np.concatenate(order)) == rows.tolist()
        own = [set(found.shards[np.concatenate([np.split(b, 2)[rank] for b in order])]) for rank in (0, 1)]
        assert len(own[0] & own[1]) <= 1
    told: list[np.ndarray] = []
    resumed = list(batches(run, found, rows, 9, 12, World(1, 2), told.append))
    assert np.array_equal(resumed, order[3:])
    own = [batch[6:] for batch in resumed]
    assert all(np.array_equal(rows, np.concatenate(own[i:])) for i, rows in enumerate(told[:3]))
    assert not len(told[3]) and len(told) == 4


@pytest.mark.parametrize("sampler", ["shuffle", "one-per-touch"])
def test_the_order_of_a_pack_on_the_disk_is_what_it_was(pack: Pack, sampler: Any) -> None:
    run, rows = smoke(pack, sampler=sampler), smoke(pack).method.training_rows(pack)
    groups = None if sampler == "shuffle" else pack.touch_groups[rows]
    expected = rows[epoch_order(len(rows), groups, mix(run.seed, 1, 0))][: 4 * 16].reshape(4, 16)
    for size in (1, 2):
        assert np.array_equal(list(batches(run, pack, rows, 0, 4, World(0, size))), expected)


# -- training ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def straight(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("run")
    return train(stream(shards, place / "cache", batch_size=12), place / "straight", quiet=True)


@pytest.mark.parametrize("stop_after", [1, 5])
def test_stopped_and_resumed_equals_straight(shards: Path, straight: Path, tmp_path: Path, stop_after: int) -> None:
    """Also from a cache that is cold or larger."""
    run = stream(shards, tmp_path / "a", batch_size=12, checkpoint_every=2)
    with power_cut(stop_after), pytest.raises(RuntimeError, match="power cut"):
        train(run, tmp_path / "r", quiet=True)
    elsewhere = replace(run, data=replace(run.data, cache=tmp_path / "b", cache_gb=1.0))  # type: ignore[call-arg]
    train(elsewhere, tmp_path / "r", resume=True, quiet=True)
    assert_equal_weights(straight, tmp_path / "r")


def test_another_window_is_another_run(shards: Path, tmp_path: Path) -> None:
    run = stream(shards, tmp_path)
    assert run.digest() != replace(run, data=replace(run.data, window=3)).digest()  # type: ignore[call-arg]
    assert run.digest() == replace(run, data=replace(run.data, cache=None, cache_gb=3.0)).digest()  # type: ignore[call-arg]


def test_the_command_line(pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, shards = str(tmp_path / "run"), f"file://{tmp_path}/shards"
    assert main(["data", "shard", str(pack.path), shards, "--shard-mb", str(SHARD_MB), "--quiet"]) == 0
    assert "120 samples in 15 shards" in capsys.readouterr().out
    data = f"--data stream --data.url {shards} --data.cache {tmp_path / 'cache'} --data.cache-gb 0.01".split()
    assert main(["pretrain", "--recipe", "smoke", *data, "--steps", "2", "--out", out, "--quiet"]) == 0
    assert main(["probe", out]) == 0
    assert json.loads((tmp_path / "run" / "run.json").read_text())["run"]["data"]["url"] == shards


def test_features_are_those_of_the_pack(pack: Pack, shards: Path, tmp_path: Path) -> None:
    found = opened(shards, tmp_path)
    model = fresh(smoke(pack), pack.spec, pack.size)
    rows = np.array([pack.column("id").tolist().index(one) for one in found.column("id")])
    for modality in ("vision", "touch"):
        features = pack_features(model, found, modality, np.arange(120))
        assert torch.equal(features, pack_features(model, pack, modality, rows))
    assert found.fetched == 30 * FILE


# -- the cache --------------------------------------------------------------------------------------------------------


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Files that were fetched, with the bytes of shards in the cache's folder as each had come."""
    seen: list[tuple[str, int]] = []
    real = StreamedPack._fetch

    def size(file: Path) -> int:
        try:
            return file.stat().st_size
        except FileNotFoundError:  # just deleted
            return 0

    def fetch(self: StreamedPack, name: str, path: Path, **missing: str) -> None:
        real(self, name, path, **missing)
        if name.startswith("shard"):
            seen.append((name, sum(size(file) for file in path.parent.glob("shard-*"))))

    monkeypatch.setattr(StreamedPack, "_fetch", fetch)
    return seen


def epoch(pack: StreamedPack, run: Run, start: int, end: int) -> None:
    for rows in batches(run, pack, run.method.training_rows(pack), start, end, expect=pack.expect):
        for modality in pack.spec.modalities:
            pack.images[modality][rows]


def test_an_epoch_fetches_every_file_once_and_keeps_the_bound(
    shards: Path, tmp_path: Path, watched: list[tuple[str, int]]
) -> None:
    found, run = opened(shards, tmp_path), stream(shards, tmp_path, batch_size=12)
    epoch(found, run, 0, 6)
    names = [name for name, _ in watched]
    assert len(names) == len(set(names)) == 18  # nine shards of training rows
    assert max(size for _, size in watched) <= LIMIT
    epoch(found, run, 6, 30)
    assert max(size for _, size in watched) <= LIMIT
    assert len(watched) <= 5 * 18 and found.fetched == len(watched) * FILE


def test_what_fits_is_fetched_once_ever(shards: Path, tmp_path: Path, watched: list[tuple[str, int]]) -> None:
    run = stream(shards, tmp_path)
    epoch(opened(shards, tmp_path, limit=10**6), run, 0, 12)
    again = opened(shards, tmp_path, limit=10**6)
    epoch(again, run, 12, 16)
    assert len(watched) == 18


def test_what_an_earlier_process_left_counts(shards: Path, tmp_path: Path) -> None:
    opened(shards, tmp_path, limit=10**6).images["touch"][:]
    found = opened(shards, tmp_path)
    assert [*found.path.glob("shard-*")] and sum(f.stat().st_size for f in found.path.glob("shard-*")) <= LIMIT


def test_what_is_expected_stays(tmp_path: Path) -> None:
    names = [f"f{i}" for i in range(9)]
    loaded: list[str] = []
    cache = Cache(tmp_path, dict.fromkeys(names, 10), 50, lambda name: loaded.append(name) or np.zeros(1))
    cache.expect(names[:4])
    for name in [*names[4:], *names[:4]]:
        cache.get(name)
    assert sorted(loaded) == names


def test_a_cache_of_something_else_is_cleared(pack: Pack, shards: Path, tmp_path: Path) -> None:
    first = opened(shards, tmp_path / "c", limit=10**6)
    first.images["touch"][:]
    folder = first.path
    del first
    write_shards(pack, str(tmp_path / "other"), shard_mb=SHARD_MB, seed=1, quiet=True)
    other = opened(tmp_path / "other", tmp_path / "c", limit=10**6)
    assert other.path in (folder, folder.with_name("process-1"))
    other.images["vision"][0]
    assert len([*other.path.glob("shard-*")]) == 1


def test_two_at_once_have_folders_of_their_own(shards: Path, tmp_path: Path) -> None:
    first, second = opened(shards, tmp_path), opened(shards, tmp_path)
    assert first.path != second.path
    assert np.array_equal(first.images["touch"][:], second.images["touch"][:])


def test_a_damaged_file_in_the_cache_is_fetched_anew(shards: Path, tmp_path: Path) -> None:
    folder = tmp_path / "process-0"
    folder.mkdir()
    for name in ("pack.json", "samples.parquet"):
        (folder / name).write_bytes((shards / name).read_bytes())
    (folder / "shard-00000.touch.npy").write_bytes((shards / "shard-00000.touch.npy").read_bytes()[:-9])
    (folder / "shard-00001.touch.npy.part").write_bytes(b"cut")
    found = opened(shards, tmp_path)
    assert found.path == folder and not [*folder.glob("*.part")]
    assert found.images["touch"][:8].any() and found.fetched == FILE


@pytest.fixture
def came(monkeypatch: pytest.MonkeyPatch) -> list[threading.Event]:
    """Whether the touch of each shard was fetched."""
    events = [threading.Event() for _ in range(15)]
    real = StreamedPack._fetch

    def fetch(self: StreamedPack, name: str, path: Path, **missing: str) -> None:
        real(self, name, path, **missing)
        if name.endswith("touch.npy"):
            events[int(name[6:11])].set()

    monkeypatch.setattr(StreamedPack, "_fetch", fetch)
    return events


def test_what_is_expected_comes_before_it_is_read(shards: Path, tmp_path: Path, came: list[threading.Event]) -> None:
    found = opened(shards, tmp_path)
    found.expect(np.array([25, 70, 24, 5, 71, 40, 3, 100, 90]))
    assert all(came[number].wait(10) for number in (3, 8, 0, 5))
    assert not came[12].is_set()  # there is no room for a fifth
    assert (found.images["touch"][[25, 70, 5, 40]].any((1, 2, 3))).all()
    for _ in range(1000):  # vision's file of the last shard may still be on its way
        if found.fetched == 8 * FILE:
            break
        time.sleep(0.01)
    assert found.fetched == 8 * FILE


def test_evaluation_reads_few_shards(shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "NUM_EVAL_TRAIN", 8)
    monkeypatch.setattr(validation, "NUM_EVAL_VAL", 8)
    found, run = opened(shards, tmp_path), stream(shards, tmp_path)
    values, _ = validation.validate(fresh(run, found.spec, found.size), found, run)
    assert values["touch/rankme"] > 0 and found.fetched == 4 * FILE  # one shard of train, one of val


def test_reading_in_sequence_reads_ahead(shards: Path, tmp_path: Path, came: list[threading.Event]) -> None:
    found = opened(shards, tmp_path)
    found.images["touch"][:8]
    found.images["touch"][8:16]
    assert came[2].wait(10)
    assert not any(event.is_set() for event in came[3:])
    for start in range(16, 120, 8):
        found.images["touch"][start : start + 8]
    assert found.fetched == 15 * FILE


def test_a_reader_waits_for_what_another_thread_no_longer_expects(tmp_path: Path) -> None:
    gate, names = threading.Event(), [f"f{i}" for i in range(6)]

    def load(name: str) -> np.ndarray:
        assert gate.wait(10)
        return np.full(1, int(name[1]))

    cache = Cache(tmp_path, dict.fromkeys(names, 10), 100, load)
    cache.expect(names)
    with ThreadPoolExecutor(1) as pool:
        last = pool.submit(cache.get, "f5")  # behind four that are on their way
        while cache._next != "f5":
            pass
        cache.expect([])
        gate.set()
        assert last.result(10) == 5


# -- what is refused --------------------------------------------------------------------------------------------------


def copy(shards: Path, to: Path) -> Path:
    to.mkdir()
    for file in shards.iterdir():
        (to / file.name).write_bytes(file.read_bytes())
    return to


def spoil_row(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[128 + 3 * 32 * 32 * 3] ^= 1  # row 3 of the shard
    file.write_bytes(data)


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1])


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (spoil_row, r"does not match its digest in 1 of 8 rows, first row 19 \(id '\d{4}'\)"),
        (cut, r"does not match its digest \(its rows are 16 to 23, it has 24703 bytes\)"),
        (Path.unlink, "no shard-00002.touch.npy at .*damaged"),
    ],
)
def test_a_damaged_shard_is_named(shards: Path, tmp_path: Path, spoil: Callable[[Path], None], says: str) -> None:
    place = copy(shards, tmp_path / "s")
    spoil(place / "shard-00002.touch.npy")
    found = opened(place, tmp_path / "c")
    assert found.images["touch"][15].any() and found.images["vision"][:].any()
    for _ in range(2):
        with pytest.raises(ValueError, match=says):
            found.images["touch"][20]
    (place / "shard-00002.touch.npy").write_bytes((shards / "shard-00002.touch.npy").read_bytes())
    assert found.images["touch"][20].any()  # mended


def test_a_damaged_jpeg_is_named(tmp_path: Path) -> None:
    pack = build(Toy(num=24), tmp_path / "p", size=32, quiet=True, store="jpeg")
    write_shards(pack, str(tmp_path / "s"), shard_mb=0.02, quiet=True)
    file = tmp_path / "s" / "shard-00001.touch.jpegs"
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    found = opened(tmp_path / "s", tmp_path / "c", limit=10**6)
    last = np.flatnonzero(found.shards == 1)[-1]
    with pytest.raises(ValueError, match=rf"shard-00001.touch.jpegs does not match .* first row {last} \(id"):
        found.images["touch"][last]


def edit(**changes: Any) -> Callable[[Path], None]:
    def change(place: Path) -> None:
        meta = json.loads((place / "pack.json").read_text())
        (place / "pack.json").write_text(json.dumps({**meta, **changes}))
        seal(place)

    return change


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda place: (place / "pack.json").unlink(), "no pack.json at .*mvitac data shard"),
        (lambda place: (place / "pack.json").write_text("{"), "not valid JSON"),
        (lambda place: (place / "samples.parquet").unlink(), "no samples.parquet at .*damaged"),
        (lambda place: cut(place / "samples.parquet"), "samples.parquet does not match its digest"),
        (edit(shards=[8] * 14), "shards: expected numbers of rows, 120 in all"),
        (edit(shards=[8.5] * 15), "shards: expected int"),
        (edit(format="mvitac-pack"), "does not describe a pack"),
    ],
)
def test_a_damaged_description(shards: Path, tmp_path: Path, spoil: Callable[[Path], object], says: str) -> None:
    place = copy(shards, tmp_path / "s")
    spoil(place)
    with pytest.raises(ValueError, match=says) as error:
        opened(place, tmp_path / "c")
    text = str(error.value)
    del error  # it holds what was opened, and so the folder
    assert str(place) in text and str(tmp_path / "c") not in text
    for name in ("pack.json", "samples.parquet"):
        (place / name).write_bytes((shards / name).read_bytes())
    assert opened(place, tmp_path / "c").num == 120  # mended


TRAIN = ["pretrain", "--recipe", "smoke", "--data", "stream", "--data.cache", "{tmp}/c", "--out", "{tmp}/out"]


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ([*TRAIN, "--data.url", "{tmp}/nothing"], "no pack.json at {tmp}/nothing: make one with `mvitac data shard"),
        ([*TRAIN, "--data.url", "memory://nothing"], "no pack.json at memory://nothing"),
        ([*TRAIN, "--data.url", "odd://place"], "odd://place cannot be opened (Protocol not known: odd"),
        ([*TRAIN, "--data.url", "s3://bucket/place"], "pip install -e '.[s3]'"),
        ([*TRAIN, "--data.url", "{shards}", "--data.cache-gb", "0.0001"], "give --data.cache-gb 0.001 per process"),
        ([*TRAIN, "--data.window", "0"], "window 0: give"),
        ([*TRAIN, "--data.cache-gb", "-1"], "cache_gb -1.0: give"),
        (
            ["pretrain", "--data", "pack", "--data.path", "{shards}", "--out", "{tmp}/o"],
            "--data stream --data.url {shards}",
        ),
        (["data", "shard", "{pack}", "{shards}"], "{shards} holds a pack already"),
        (["data", "shard", "{pack}", "{tmp}/new", "--shard-mb", "0"], "shard_mb 0.0: give"),
        (["data", "shard", "{pack}", "{tmp}/new", "--shard-mb", "inf"], "shard_mb inf: give"),
        (["data", "shard", "{pack}", "odd://place"], "odd://place cannot be opened"),
        (["data", "pack", "--data", "stream", "--out", "{tmp}/o"], "--data stream reads packs"),
    ],
)
def test_refused_in_one_line(
    pack: Pack,
    shards: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    command: list[str],
    says: str,
) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)  # as where it is not installed

    def named(text: str) -> str:
        return text.replace("{tmp}", str(tmp_path)).replace("{shards}", str(shards)).replace("{pack}", str(pack.path))

    assert main([named(word) for word in command]) == 2
    error = capsys.readouterr().err
    assert named(says) in error and error.count("\n") == 1, error
    assert not (tmp_path / "out").exists()


# -- an object store --------------------------------------------------------------------------------------------------


def test_s3(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against moto's server, where moto[server] and s3fs are installed (docs/scaling.md says how)."""
    pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        for name, value in (
            ("ACCESS_KEY_ID", "k"),
            ("SECRET_ACCESS_KEY", "s"),
            ("ENDPOINT_URL", f"http://{host}:{port}"),
        ):
            monkeypatch.setenv(f"AWS_{name}", value)
        with pytest.raises(ValueError, match=r"no pack.json at s3://bucket/some/place"):
            opened("s3://bucket/some/place", tmp_path / "c")
        fsspec.filesystem("s3").mkdir("bucket")
        write_shards(pack, "s3://bucket/some/place", shard_mb=SHARD_MB, quiet=True)
        run = stream(Path("s3"), tmp_path / "c", steps=3)
        run = replace(run, data=replace(run.data, url="s3://bucket/some/place"))  # type: ignore[call-arg]
        train(run, tmp_path / "s3", quiet=True)
        fsspec.filesystem("s3").pipe_file("bucket/some/place/shard-00000.touch.npy", io.BytesIO().getvalue())
        with pytest.raises(ValueError, match=r"shard-00000.touch.npy does not match"):
            opened("s3://bucket/some/place", tmp_path / "other").images["touch"][0]
    finally:
        server.stop()
