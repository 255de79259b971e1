"""Small parts of ``benchmarks/faults.py`` and ``benchmarks/fuzz.py``: kills, single flipped bits, odd options."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from benchmarks.faults import main
from benchmarks.fuzz import calls, fuzz

from mvitac.data.pack import Pack
from support.processes import begin, finish


@pytest.mark.parametrize(
    ("argv", "counts"),
    [
        (["kills", "--commands", "pretrain", "--points", "2"], {"finished": 2}),
        (["flips", "--num", "5"], {"refused": 5, "made again": 5}),
    ],
)
def test_nothing_is_lost_or_goes_unnoticed(argv: list[str], counts: dict[str, int], tmp_path: Path) -> None:
    finish(begin(main, argv, output=tmp_path / "said"), tmp_path / "said")
    for name, found in json.loads((tmp_path / "said").read_text()).items():
        kinds = {kind: num for kind, num in found.items() if kind not in ("failed", "changes of the disk")}
        assert sum(kinds.values()) == int(argv[-1]) and kinds.items() <= counts.items(), (name, found)


def odd_calls(base: Path, said: Path) -> None:
    made = [one for name in ("data info", "data show", "data shard", "completion") for one in calls(name, base, base)]
    said.write_text(json.dumps({"made": len(made), **fuzz(made[:: len(made) // 15], base, 20)}))


def test_odd_options_show_no_traceback(pack: Pack, tmp_path: Path) -> None:
    base, said = tmp_path / "base", tmp_path / "result"
    shutil.copytree(pack.path, base / "pack")
    (base / "here").mkdir()
    finish(begin(odd_calls, base, said, output=tmp_path / "said"), tmp_path / "said")
    found = json.loads(said.read_text())
    assert found["failed"] == [] and found["calls"] >= 15 and found["made"] > 300
    assert set(found["codes"]) <= {"0", "2"} and found["codes"]["2"] > 5, found["codes"]
