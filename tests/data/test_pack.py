"""The pack: whole or not there, resumable to the same bytes, and never mistaken for something else."""

import contextlib
import errno
import fcntl
import io
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from filelock import FileLock

from mvitac.data import build as packing
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.read_samples import read_parts
from mvitac.data.source import Lost, Sample, Source
from mvitac.datasets.pack import ON_VAL, PackConfig
from mvitac.datasets.table.manifest import read_manifest
from mvitac.evaluation.retrieval import retrieved_rows
from mvitac.system import locks
from mvitac.system.files import cache_dir
from support.toy import Counting, Toy, threads_of, toy_pack, with_columns

FILES = ("pack.json", "samples.parquet", "vision.npy", "touch.npy")


def contents(path: Path) -> dict[str, bytes]:
    assert {file.name for file in path.iterdir()} == {*FILES, "provenance.json"}
    return {name: (path / name).read_bytes() for name in FILES}


def test_a_folder_that_is_called_as_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pyarrow takes a relative ~ for it. In MVITAC_CACHE, which no shell may have read, it is."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert toy_pack(Path("~/pack")).table == Pack("~/pack").table and (tmp_path / "~/pack").exists()
    assert len(read_manifest(Path("~/pack/samples.parquet")).rows) == 120
    os.truncate("~/pack/touch.npy", 1 << 40)  # takes no disk, and hours to hash
    with pytest.raises(
        ValueError, match=r"touch\.npy cannot be mapped \(it has \d+ bytes beside its images, not 128\)"
    ):
        Pack("~/pack")
    monkeypatch.setenv("MVITAC_CACHE", "~/kept")
    assert cache_dir() == tmp_path / "home/kept"


@pytest.mark.parametrize("store", ["raw", "jpeg"])
def test_two_processes_give_the_bytes_of_one(tmp_path: Path, store: Any) -> None:
    one, two = (build(Toy(), tmp_path / str(n), size=32, workers=n, store=store, quiet=True) for n in (1, 2))
    assert one.digest == two.digest


def test_a_packing_process_has_one_thread(monkeypatch: Any) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    # 16 processes of 16 threads each took four times as long per image on a machine with a GPU.
    assert set(chain(*read_parts(threads_of, [(0, 1), (1, 2)], workers=2))) == {1}
    monkeypatch.setattr("tempfile.NamedTemporaryFile", lambda **_: io.FileIO("/dev/full", "w"))
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        [*read_parts(threads_of, [(0, 1), (1, 2)], workers=2)]


@contextmanager
def stop(after: int, error: BaseException) -> Iterator[None]:
    """``error`` in the middle of the ``after``-th write to a file of the unfinished pack."""
    left, real = iter(range(after)), packing._append

    def stopping(path: Path, data: bytes) -> None:
        if next(left, None) is None:
            real(path, data[: len(data) // 2])
            raise error
        real(path, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(packing, "_append", stopping)
        yield


@pytest.mark.parametrize("store", ["raw", "jpeg"])
@pytest.mark.parametrize("writes_before_the_kill", [0, 1, 2, 3, 10, 11])
def test_interrupted_build_resumes_to_the_same_bytes(
    pack: Pack, tmp_path: Path, writes_before_the_kill: int, store: Any
) -> None:
    """A part of 32 rows is three writes: vision, touch, list."""
    options: dict[str, Any] = {"size": 32, "quiet": True, "store": store}
    with pytest.raises(KeyboardInterrupt), stop(writes_before_the_kill, KeyboardInterrupt()):
        build(Toy(), tmp_path / "p", **options)
    assert not (tmp_path / "p").exists()
    again = build(source := Counting(), tmp_path / "p", **options)
    assert source.seen == list(range(writes_before_the_kill // 3 * 32, 120)), "what was done is not read again"
    if store == "jpeg":
        assert again.digest == build(Toy(), tmp_path / "straight", **options).digest
        return
    assert contents(tmp_path / "p") == contents(pack.path)
    assert not (tmp_path / "p.partial").exists()


class Held(Counting):
    """Reads no second item before ``go``."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.go = threading.Event(), threading.Event()

    def read(self, item: int) -> list[Sample]:
        self.begun.set()
        assert self.go.wait(60)
        return super().read(item)


@pytest.mark.parametrize("fails", [False, True])
def test_one_process_packs_and_the_others_wait(
    pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], fails: bool
) -> None:
    waits = threading.Event()

    class Lock(FileLock):
        def acquire(self, *args: Any, blocking: bool = True, **options: Any) -> Any:
            if blocking:
                waits.set()
            return super().acquire(*args, blocking=blocking, **options)

    monkeypatch.setattr(locks, "FileLock", Lock)
    first, second = Held(), Counting()
    with ThreadPoolExecutor(2) as threads:
        one = threads.submit(build, first, tmp_path / "p", size=32, quiet=True)
        assert first.begun.wait(60)
        other = threads.submit(build, second, tmp_path / "p", size=32, exist_ok=True)
        assert waits.wait(60) and not other.done()
        if fails:
            first.damaged = (100,)
        first.go.set()
        if fails:
            with pytest.raises(ValueError, match="item 100 is damaged on purpose"):
                one.result()
        else:
            assert one.result().digest == pack.digest
        assert other.result().digest == pack.digest
    assert second.seen == (list(range(96, 120)) if fails else []), "what the first one did is not done again"
    assert contents(tmp_path / "p") == contents(pack.path)
    assert [path.name for path in tmp_path.iterdir()] == ["p"], "no lock, no unfinished pack"
    assert "is being packed by another process: waiting for it" in " ".join(capsys.readouterr().out.split())
    assert build(Toy(), tmp_path / "p", size=32, exist_ok=True).digest == pack.digest


def test_packs_where_files_cannot_be_locked(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(errno.ENOSYS, "Function not implemented")))
    assert toy_pack(tmp_path / "p").digest == pack.digest and [path.name for path in tmp_path.iterdir()] == ["p"]


def almost_finished(path: Path, source: Source) -> Path:
    """What is left of packing ``source`` if the build is killed after the last part."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(packing._Partial, "finish", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            build(source, path, size=32, quiet=True)
    return path.with_name(path.name + ".partial")


def test_what_is_not_ours_is_left(tmp_path: Path) -> None:
    (tmp_path / "p.partial" / "pack").mkdir(parents=True)
    (tmp_path / "q").symlink_to(tmp_path / "nowhere")
    for name, says in {"p": r"p\.partial is no unfinished pack", "q": "q already exists"}.items():
        with pytest.raises(ValueError, match=says):
            build(Toy(), tmp_path / name, size=32, quiet=True)
    (tmp_path / "p.partial" / "pack").rmdir()  # now it is as a full disk leaves it
    assert build(Toy(), tmp_path / "p", size=32, quiet=True).num and not (tmp_path / "p.partial").exists()


@pytest.mark.parametrize("lost", ["row", "end of the images", "list", "half of the list", "end of a line", "a stamp"])
def test_what_lost_power_took_is_read_again(pack: Pack, tmp_path: Path, lost: str) -> None:
    partial = almost_finished(tmp_path / "p", Toy())
    images, parts = partial / "pack" / "touch.npy", partial / "parts.jsonl"
    lines = parts.read_bytes().splitlines(keepends=True)
    if lost == "row":
        with images.open("r+b") as file:
            file.seek(128 + 40 * 32 * 32 * 3)
            file.write(bytes(32 * 32 * 3))
    elif lost == "end of the images":
        os.truncate(images, 128 + 40 * 32 * 32 * 3)
    elif lost == "half of the list":
        parts.write_bytes(lines[0] + lines[1][:500])
    elif lost == "end of a line":
        parts.write_bytes(lines[0] + lines[1][:-1])
    elif lost == "a stamp":
        parts.write_bytes(lines[0] + lines[1].replace(b'"stamp": null', b'"stamp": "x"'))
    else:
        parts.unlink()
    build(source := Counting(), tmp_path / "p", size=32, quiet=True)
    assert source.seen == list(range(0 if lost == "list" else 32, 120))
    assert contents(tmp_path / "p") == contents(pack.path)


@dataclass
class Stamped(Counting):
    """The toy as if read from a file per item."""

    changed: tuple[int, ...] = ()

    def stamps(self) -> list[int]:
        return [int(item in self.changed) for item in range(self.num)]


def test_killed_while_it_is_finished(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the headers were written for fewer rows than were expected."""
    options: dict[str, Any] = {"size": 32, "max_damaged": 0.05, "quiet": True}
    with monkeypatch.context() as patch:
        patch.setattr(packing, "digest_file", Mock(side_effect=KeyboardInterrupt))
        for name in ("p", "q"):
            with pytest.raises(KeyboardInterrupt):
                build(Stamped(damaged=(3, 40)), tmp_path / name, **options)
    build(again := Stamped(damaged=(3, 40)), tmp_path / "p", **options)
    assert not again.seen
    assert contents(tmp_path / "p") == contents(build(Toy(damaged=(3, 40)), tmp_path / "straight", **options).path)
    build(Stamped(changed=(3, 40)), tmp_path / "q", **options)  # repaired
    assert contents(tmp_path / "q") == contents(pack.path)


def test_an_unfinished_pack_is_continued_by_its_own_data_and_no_leftovers_get_in(pack: Pack, tmp_path: Path) -> None:
    partial = almost_finished(tmp_path / "p", Toy())
    with pytest.raises(ValueError, match="unfinished pack of something else"):
        toy_pack(tmp_path / "p", num=60)
    for name in ("pack/pack.json", "pack/.pack.json.1.tmp", "pack/vision.npy"):
        (partial / name).write_bytes(b"of old")
    toy_pack(tmp_path / "p")
    assert contents(tmp_path / "p") == contents(pack.path)


def test_parts_are_made_again_from_the_first_whose_files_have_changed(pack: Pack, tmp_path: Path) -> None:
    partial = almost_finished(tmp_path / "p", Stamped())
    build(source := Stamped(changed=(40, 119)), tmp_path / "p", size=32, quiet=True)
    assert source.seen == list(range(32, 120)) and not partial.exists()
    assert contents(tmp_path / "p") == contents(pack.path), "no pack tells when its files were written"


def test_damaged_items_stop_or_are_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = Toy(damaged=(3, 40))
    with pytest.raises(ValueError, match=r"2 of 120 items cannot be read, first item 3: item 3 is damaged.*repair it"):
        build(source, tmp_path / "strict", size=32, quiet=True)
    lenient = build(source, tmp_path / "lenient", size=32, max_damaged=0.05, quiet=True)
    assert lenient.num == 118 and [name for name, _ in lenient.meta["damaged"]] == ["item 3", "item 40"]
    assert "0003" not in lenient.column("id")
    check_images(lenient, [item for item in range(120) if item not in (3, 40)])
    monkeypatch.setattr(Toy, "read", lambda self, item: [()][item + 1])  # an array that is shorter than the rows say
    with pytest.raises(ValueError, match="120 of 120 items cannot be read, first item 0: list index out of range"):
        build(Toy(), tmp_path / "short", size=32, quiet=True)


def check_images(pack: Pack, items: list[int]) -> None:
    samples = [Toy().read(item)[0] for item in items]
    assert pack.column("id").tolist() == [sample.columns["id"] for sample in samples]
    for modality in ("vision", "touch"):
        np.save(file := io.BytesIO(), np.stack([getattr(s, modality) for s in samples]))
        assert (pack.path / f"{modality}.npy").read_bytes() == file.getvalue(), modality
    Pack(pack.path)  # the digests agree


class Strings(Toy):
    """The toy in items of seven samples, of which a few are lost; the last item has one less than it says."""

    def items(self) -> list[str]:
        return [f"string {i}" for i in range(6)]

    def samples_per_item(self) -> list[int]:
        return [7] * 6

    def read(self, item: int) -> list[Sample | Lost]:  # type: ignore[override]
        numbers = range(7 * item, 41 if item == 5 else 7 * item + 7)
        lost = (0, 20, 21, 22, 33)
        return [Lost(f"sample {i}", "torn") if i in lost else super(Strings, self).read(i)[0] for i in numbers]


@pytest.mark.parametrize("part", [1, 2, 32])
def test_lost_samples_leave_no_hole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int) -> None:
    monkeypatch.setattr(packing, "NUM_PART_ROWS", 7 * part)
    found = build(Strings(), tmp_path / "p", size=32, max_damaged=0.2, quiet=True)
    check_images(found, [i for i in range(41) if i not in (0, 20, 21, 22, 33)])
    assert found.meta["damaged"] == [[f"sample {i}", "torn"] for i in (0, 20, 21, 22, 33)]


def test_a_script_without_a_main_guard_is_told(tmp_path: Path) -> None:
    """Each of its packing processes would run it again and wait for the first. The source is more than a pipe holds."""
    script = tmp_path / "script.py"
    call = f"build(Toy(extra={{'long': 'x' * 200_000}}), {str(tmp_path / 'p')!r}, size=32, workers=2)"
    script.write_text(f"from mvitac.data.build import build\nfrom support.toy import Toy\n{call}\n")
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, script], env=env, capture_output=True, timeout=60)
    assert b"ValueError: a packing process died: out of memory, or a script without `if __name__" in done.stderr
    assert done.stderr.count(b"Traceback") == 1


def free(monkeypatch: pytest.MonkeyPatch, num_bytes: int) -> None:
    monkeypatch.setattr(packing.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(1, 1, num_bytes))  # type: ignore[attr-defined]


@pytest.mark.parametrize("store", ["raw", "jpeg"])
def test_disk_is_asked_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: Any) -> None:
    """For one copy of the images (a third as JPEG), less what an interrupted build has written of it."""
    need = 2 * (128 + 120 * 32 * 32 * 3) if store == "raw" else 2 * 120 * 32 * 32
    options: dict[str, Any] = {"size": 32, "quiet": True, "store": store}
    free(monkeypatch, need - 1)
    with pytest.raises(ValueError, match="packing needs about"):
        build(Toy(), tmp_path / "p", **options)
    assert not list(tmp_path.iterdir())
    free(monkeypatch, need)
    if store == "raw":
        almost_finished(tmp_path / "p", Toy())
        free(monkeypatch, 1000)
    build(Toy(), tmp_path / "p", **options)


def test_scoring_on_val_hides_test(pack: Pack) -> None:
    whole = PackConfig(path=pack.path).open()
    choosing = PackConfig(path=pack.path, score_on="val").open()
    assert len(whole.rows("val")) and len(whole.rows("test"))
    np.testing.assert_array_equal(choosing.rows("test"), whole.rows("val"))
    np.testing.assert_array_equal(choosing.rows("train", "unlabelled"), whole.rows("train", "unlabelled"))
    assert not len(choosing.rows("val")) and choosing.spec.notes == (*whole.spec.notes, ON_VAL)
    assert (choosing.labels(whole.spec.tasks[0].name, "train", "val", "test")[whole.rows("test")] == -1).all()


def test_rows_of_one_task_alone_are_hidden_from_all_else(pack: Pack) -> None:
    """A task with a split of its own may score rows that no other task labels. Nothing else may count them as test."""
    first, second = pack.spec.tasks
    alone = np.isin(pack.column("split"), ("test", "train")) & (np.arange(pack.num) % 2 == 0)
    label = np.where(alone, -1, pack.column("label_pattern"))
    columns = {"label_pattern": label, "split_bright": ["train", "test"] * (pack.num // 2)}
    other = with_columns(pack, spec=replace(pack.spec, tasks=(first, replace(second, split="split_bright"))), **columns)
    hidden = set(np.flatnonzero(alone & (pack.column("split") == "test")))
    assert hidden and set(pack.rows("test")) - set(other.rows("test")) == hidden == set(np.flatnonzero(other.hidden))
    assert set(other.rows("train")) == set(pack.rows("train"))  # without a label, but for pre-training
    assert set(other.rows("train", by="split_bright")) == set(range(0, pack.num, 2))  # its own split has them
    assert not {*retrieved_rows(other, "test")} & hidden and hidden < {*retrieved_rows(pack, "test")}
    assert not with_columns(pack, **columns).hidden.any()  # one split for all tasks: nobody else may see them


SLOW = """
import os, signal, sys, time
from mvitac.data.build import build
from support.toy import Toy

class Slow(Toy):
    def read(self, item):
        os.write(1, b"it reads\\n")
        time.sleep(600)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN if sys.argv[1:] else signal.default_int_handler)
    try:
        build(Slow(), "p", size=32, workers=2, quiet=True)
    except KeyboardInterrupt:
        pass
else:
    os.write(1, b"a worker starts\\n")  # at once, or the lines of two would mix
    time.sleep(1)
"""


@pytest.mark.parametrize("how", ["killed", "Ctrl-C at the start", "Ctrl-C ignored"])
def test_workers_end_with_the_process_that_packs(how: str, tmp_path: Path) -> None:
    """They hold its stdout: whoever reads it would wait for ever. Where it ignores Ctrl-C, so do they."""
    kind = signal.SIGKILL if how == "killed" else signal.SIGINT
    line, more = "a worker starts" if "start" in how else "it reads", ["ignore"] * ("ignored" in how)
    (tmp_path / "pack.py").write_text(SLOW)
    about: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "start_new_session": True, "text": True}
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "pack.py", *more], cwd=tmp_path, env=env, **about) as packing:
        assert packing.stdout and line in map(str.strip, packing.stdout)
        (os.kill if kind == signal.SIGKILL else os.killpg)(packing.pid, kind)
        try:
            said = packing.communicate(timeout=2 if more else 60)[1]
            assert not more, said
        except subprocess.TimeoutExpired:
            assert more
            said = ""
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(packing.pid, signal.SIGKILL)
    assert "Traceback" not in said
