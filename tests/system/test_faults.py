"""A small part of ``benchmarks/faults.py``: kills between changes of the disk, and single flipped bits."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.faults import main

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
