"""benchmarks/gpu.sh: a rehearsal on a CPU, and its time limit."""

import json
import shlex
import sys
import time
from functools import partial
from typing import Any

import pytest
from benchmarks import floor, gpu, speed

from mvitac.cli.main import main as mvitac


@pytest.fixture
def commands(monkeypatch):
    """The commands of the script, which run in this process: four new ones would import torch for 25 s."""
    ran: list[list[str]] = []

    def here(self: gpu.Session, name: str, command: list[str], seconds: float, tick: Any = lambda: None) -> int:
        ran.append(command)
        module, *rest = command
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", command)
            speed.main() if module == "benchmarks.speed" else mvitac(rest)
        tick()
        return 0

    monkeypatch.setattr(gpu.Session, "child", here)
    monkeypatch.setenv("MVITAC_CACHE", "")  # the script sets it
    return ran


@pytest.mark.slow
def test_a_rehearsal_measures_all_and_goes_on_elsewhere(commands, tmp_path, monkeypatch):
    def call(out: str, work: str, *more: str) -> dict[str, Any]:
        gpu.main(["--smoke", "--device", "cpu", "--out", str(tmp_path / out), "--work", str(tmp_path / work), *more])
        return json.loads((tmp_path / out / "gpu.json").read_text())

    monkeypatch.setattr(floor, "best", partial(floor.best, num=1))  # bf16 is slow where a CPU has none
    whole = gpu.plan
    monkeypatch.setattr(gpu, "plan", lambda size: {**whole(size), "tasks": ["soft"], "modalities": ["touch"]})
    first = call("first", "first-work", "--minutes", "0.3")  # too short for anything
    assert not first["speed"] and not first["data"] and not commands
    first = call("first", "first-work", "--minutes", "10")
    steps = first["speed"]["4"]["batch 4"]["step"]
    assert first["speed"]["4"]["finished"] and not steps["lost"]
    assert {"typical fp32", "floor bf16", "ours fp32", "ours bf16"} <= steps["variants"].keys()
    rows = [row["label"] for row in gpu.plan(gpu.SMOKE)["rows"]]
    assert first["table"]["rows"] == rows and not first["table"]["unfinished"] and len(first["runs"]) == len(rows)
    assert {"untrained", *rows} <= {cell["row"] for cell in first["table"]["cells"]}
    assert [module for module, *_ in commands] == ["mvitac", "benchmarks.speed"]

    commands.clear()
    again = call("again", "again-work", "--minutes", "10", "--resume", str(tmp_path / "first"))
    assert [module for module, *_ in commands] == ["mvitac"] and again["table"] == first["table"]
    assert again["data"]["digest"] == first["data"]["digest"] and len(again["sessions"]) == 3
    assert not list(tmp_path.glob("again-work/table/runs/*/*/model.safetensors"))  # nothing was trained again

    monkeypatch.setattr(gpu, "SMOKE", gpu.Size())
    with pytest.raises(ValueError, match="measured with other settings: give another --out"):
        call("again", "again-work")


def test_a_part_is_stopped_at_its_limit(tmp_path):
    options = {"out": tmp_path / "out", "work": tmp_path / "work", "device": "cpu", "minutes": 1.0}
    session = gpu.Session(gpu.argparse.Namespace(**options, smoke=True, resume=None, commit="abc"))
    assert session.child("quick", ["timeit", "-n1", "-r1", "pass"], 60) == 0
    assert session.child("wrong", ["timeit", "-n1", "-r1", "nothing"], 60) == 1
    start = time.monotonic()
    assert session.child("slow", ["timeit", "-n1", "-r1", "-s", "import time", "time.sleep(60)"], 0.5) is None
    assert time.monotonic() - start < gpu.GRACE and "NameError" in (tmp_path / "out" / "log").read_text()
    assert session.found["sessions"][-1]["commit"] == "abc"


def test_every_call_of_speed_is_valid(monkeypatch):
    asked = []
    monkeypatch.setattr(speed, "measure", lambda options, scale, batches, save: asked.append((options, batches)))
    monkeypatch.setattr(speed, "keep_freed_memory", lambda: None)
    for _, given in gpu.Size().speed:
        monkeypatch.setattr(sys, "argv", ["speed", "--device", "cuda", *shlex.split(given)])
        speed.main()
    batches = {"step": set(), "compiled": set()}
    for options, sizes in asked:
        for section in batches.keys() & set(options.sections):
            batches[section] |= set(sizes)
    assert batches == {"step": {64, 256, 1024}, "compiled": {256}}
