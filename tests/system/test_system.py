"""Files, locks, threads and progress: complete or not at all, the same side by side, and nothing goes unnoticed."""

import json
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from benchmarks.faults import main
from benchmarks.fuzz import calls, fuzz
from filelock import FileLock

from mvitac.data.pack import Pack
from mvitac.deploy.export import export
from mvitac.deploy.publish import publish
from mvitac.evaluation.classifiers import one_blas_thread
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.model import load
from mvitac.system import progress
from mvitac.system.files import check_place, read_json, write_json
from mvitac.system.locks import Busy, new_folder
from mvitac.system.progress import say, shown, tick, work
from mvitac.system.threads import in_threads
from support.forged_packs import refuse_pipe
from support.processes import begin, finish

COMMANDS = {
    "publish": lambda run, pack, out: publish(run, out, pack),
    "export": lambda run, pack, out: export(load(run), pack, out),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_another_process_writes_is_left_to_it(name: str, smoke_run: Path, pack: Pack, tmp_path: Path) -> None:
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / "theirs").touch()
    with FileLock(tmp_path / "out.lock"), pytest.raises(Busy, match="is being written by another process"):
        COMMANDS[name](smoke_run, pack, tmp_path / "out")
    assert (tmp_path / "out.partial" / "theirs").exists() and not (tmp_path / "out").exists()


def test_a_new_folder_is_complete_or_not_there(tmp_path: Path) -> None:
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / "of a killed process").touch()
    with pytest.raises(ValueError, match=r"out\.partial already exists"), new_folder(tmp_path / "out"):
        pass  # it may be anybody's
    (tmp_path / "out.lock").touch()
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / "out") as partial:
        (partial / f"{1 / len(list(partial.iterdir()))}").touch()  # it is empty
    assert not list(tmp_path.iterdir())
    with new_folder(tmp_path / "out") as partial:
        (partial / "file").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "file"]
    (tmp_path / "out.lock").touch()  # of a process that was killed at its very end
    with pytest.raises(ValueError, match="already exists"), new_folder(tmp_path / "out"):
        pass
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "file"]


def test_links_stay_and_devices_are_refused(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "target")
    write_json(tmp_path / "link", [1])
    assert (tmp_path / "link").is_symlink() and json.loads((tmp_path / "target").read_text()) == [1]
    pipe, says = tmp_path / "pipe", "pipe is neither a file nor a folder"
    refuse_pipe(pipe, lambda: check_place(pipe), says)
    refuse_pipe(pipe, lambda: read_json(pipe, "a record"), says)
    check_place(Path("/"))  # it is there


def test_nothing_is_shown_unasked(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_Bar", None)  # calling it would raise
    with work("drawing", 2, "sections") as advance, shown(quiet=True), work("drawing"):
        advance()
        tick("probes")
        say("drawn")
    assert capsys.readouterr() == ("", "")


def test_several_at_a_time_in_order_and_the_threads_come_back(two_threads: None) -> None:
    met = threading.Barrier(2, timeout=30)  # passes only if two run at the same time

    def work(item: int) -> tuple[int, int]:
        met.wait()
        return 36 // item, torch.get_num_threads()

    with one_blas_thread():  # as probes are fitted
        assert in_threads(work, range(1, 5)) == [(36, 1), (18, 1), (12, 1), (9, 1)]
    with pytest.raises(ZeroDivisionError):
        in_threads(work, range(2))
    assert torch.get_num_threads() == 2


def test_probes_do_not_depend_on_it(
    two_threads: None, smoke_run: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs and their controls, probed together and one after the other, each time from an empty cache."""

    def scores(threads: int) -> object:
        torch.set_num_threads(threads)
        monkeypatch.setenv("MVITAC_CACHE", str(tmp_path / str(threads)))
        model = load(smoke_run)
        model.run = replace(model.run, seed=1)
        (other := tmp_path / str(threads) / "other").mkdir(parents=True)
        model.save(other / "model.safetensors")
        return probe_runs([smoke_run, other], ProbeConfig(tasks=("bright",), modalities=("both",)), pack)["summary"]

    assert scores(2) == scores(1)


@pytest.mark.slow
def test_nothing_is_lost_or_goes_unnoticed(tmp_path: Path) -> None:
    argv = ["kills", "flips", "--commands", "pretrain", "--points", "2", "--num", "5"]
    finish(begin(main, argv, output=tmp_path / "said"), tmp_path / "said")
    found = json.loads((tmp_path / "said").read_text())
    killed = found.pop("pretrain")
    assert killed.pop("changes of the disk") > 2 and killed == {"finished": 2, "failed": []}
    assert len(found) == 5 and all(each in ({"refused": 5}, {"made again": 5}) for each in found.values()), found


def test_any_change_of_a_sealed_file_is_told(tmp_path: Path) -> None:
    file, value = tmp_path / "run.json", {"steps": 3, "losses": (1.5, 1e-9), "names": {"b": None, "a": "\u00df"}}
    write_json(file, value, sealed=True)
    whole = file.read_bytes()
    assert read_json(file, "a record") == {**value, "losses": [1.5, 1e-9]}
    silent = []
    for bit in range(0, 8 * len(whole), 5):
        file.write_bytes(whole[: bit // 8] + bytes([whole[bit // 8] ^ 1 << bit % 8]) + whole[bit // 8 + 1 :])
        try:
            found = read_json(file, "a record")
        except ValueError:
            continue
        if {name: found.get(name) for name in value} != {**value, "losses": [1.5, 1e-9]}:
            silent.append(bit)
    assert not silent
    file.write_bytes(whole.replace(b"3", b"4", 1))
    with pytest.raises(ValueError, match=r"a record was damaged or edited.*delete the entry"):
        read_json(file, "a record")


def odd_calls(base: Path, said: Path) -> None:
    made = [*calls("data info", base, base), *calls("data check", base, base)]
    said.write_text(json.dumps({"made": len(made), **fuzz(made[:: len(made) // 15], base, 20)}))


def test_odd_options_show_no_traceback(pack: Pack, tmp_path: Path) -> None:
    base, said = tmp_path / "base", tmp_path / "result"
    shutil.copytree(pack.path, base / "pack")
    (base / "here").mkdir()
    finish(begin(odd_calls, base, said, output=tmp_path / "said"), tmp_path / "said")
    found = json.loads(said.read_text())
    assert found["failed"] == [] and found["calls"] >= 15 and found["made"] > 300
    assert set(found["codes"]) <= {"0", "2"} and found["codes"]["2"] > 5, found["codes"]
