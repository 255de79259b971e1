"""Small parts of ``benchmarks/faults.py`` and ``benchmarks/fuzz.py``: kills, single flipped bits, odd options."""

import json
import shutil
from pathlib import Path

import pytest
from benchmarks.faults import main
from benchmarks.fuzz import calls, fuzz

from mvitac.data.pack import Pack
from mvitac.system.files import read_json, write_json
from support.processes import begin, finish


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
    file.write_text(json.dumps({"steps": 4}))  # without a digest, as version 0.1.0 wrote
    assert read_json(file, "a record") == {"steps": 4}


def odd_calls(base: Path, said: Path) -> None:
    made = [one for name in ("data info", "data show") for one in calls(name, base, base)]
    said.write_text(json.dumps({"made": len(made), **fuzz(made[:: len(made) // 15], base, 20)}))


def test_odd_options_show_no_traceback(pack: Pack, tmp_path: Path) -> None:
    base, said = tmp_path / "base", tmp_path / "result"
    shutil.copytree(pack.path, base / "pack")
    (base / "here").mkdir()
    finish(begin(odd_calls, base, said, output=tmp_path / "said"), tmp_path / "said")
    found = json.loads(said.read_text())
    assert found["failed"] == [] and found["calls"] >= 15 and found["made"] > 300
    assert set(found["codes"]) <= {"0", "2"} and found["codes"]["2"] > 5, found["codes"]
