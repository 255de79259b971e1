"""Two processes (gloo) against one on the joint batch: gradients, weights, statistics, files, resuming."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from itertools import chain
from pathlib import Path

import pytest
import safetensors.torch
import torch
from test_methods import small
from test_step import assert_close, gradients, views
from test_step import build as build_from

from mvitac.distributed import World
from mvitac.methods.base import Method
from mvitac.methods.mvitac import MViTacConfig
from mvitac.pack import Pack
from mvitac.recipes import recipe
from mvitac.run import Optim, Run
from mvitac.sharding import write_shards
from mvitac.step import Step

RUN = replace(
    recipe("smoke"), optim=Optim(lr=1e-3), method=MViTacConfig(hidden=24, out=12, head_norm=True), batch_size=12
)
HERE = Path(__file__).parent
WORKER = str(HERE / "worker_distributed.py")


def run_of(method: str) -> Run:
    return RUN if method == "mvitac" else replace(RUN, method=small(method))


def build(method: str = "mvitac") -> Method:
    return build_from(run_of(method))


def together(command: list[str], num: int = 2, fails: bool = False) -> None:
    """Run ``command`` in ``num`` processes that find each other as torchrun's would."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": str(num), "OMP_NUM_THREADS": "1"}
    shared["PYTHONPATH"] = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    processes = []
    for rank in map(str, range(num)):
        environment = {**os.environ, **shared, "RANK": rank, "LOCAL_RANK": rank}
        processes.append(
            subprocess.Popen(
                [sys.executable, *command], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
        )
    for process in processes:
        errors = process.communicate(timeout=120)[1].decode()
        assert (process.returncode != 0) == fails, errors


@pytest.mark.parametrize("method", ["mvitac", "cmc"])
def test_two_processes_equal_one_on_the_joint_batch(tmp_path: Path, method: str) -> None:
    """Synchronised BatchNorm in trunks and heads, gathered negatives, summed gradients: one process's to rounding. So are
    CMC's banks, which every process holds whole and moves alike."""
    together([WORKER, "step", str(tmp_path), method])
    first, second = (torch.load(tmp_path / f"rank{r}.pt", weights_only=True) for r in (0, 1))
    alone = build(method)
    step = Step(run_of(method), alone, torch.device("cpu"))
    losses = step([views], lr=1e-3, seed=0, progress=0.5)
    assert_close(losses, first["losses"], 1e-5)
    assert_close(gradients(alone), first["gradients"], 1e-3)
    step([views], lr=1e-3, seed=0, progress=0.5)
    assert_close(alone.state_dict(), first["weights"], 5e-3)  # Adam magnifies the smallest gradients
    for name, value in first["weights"].items():
        assert torch.equal(value, second["weights"][name]), name


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pack", "shards"])
def test_the_loop_shares_rows_writes_once_and_resumes_bit_for_bit(pack: Pack, tmp_path: Path, kind: str) -> None:
    if kind == "shards":
        write_shards(pack, str(tmp_path / "shards"), shard_mb=0.05, quiet=True)
    data = str(pack.path if kind == "pack" else tmp_path / "shards")
    straight, cut = tmp_path / "straight", tmp_path / "cut"
    together([WORKER, "train", data, str(straight), "99"])
    together([WORKER, "train", data, str(cut), "3"], fails=True)
    assert not (cut / "model.safetensors").exists()
    together([WORKER, "train", data, str(cut), "99"])
    a, b = (safetensors.torch.load_file(path / "model.safetensors") for path in (straight, cut))
    assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
    for path in (straight, cut):
        lines = [json.loads(line) for line in (path / "log.jsonl").read_text().splitlines()]
        assert [line["step"] for line in lines if "loss" in line] == [1, 2, 3, 4]
    first, second = (torch.load(tmp_path / f"straight-rows{r}.pt") for r in (0, 1))
    epoch = [[*chain(*rows)] for rows in (first[:3], second[:3])]  # 60 training rows: three batches of 16 per epoch
    assert len(set(epoch[0])) == len(set(epoch[1])) == 24 and not set(epoch[0]) & set(epoch[1])


def test_a_batch_that_does_not_divide_is_named(pack: Pack, tmp_path: Path) -> None:
    from mvitac.train import _check_world

    with pytest.raises(ValueError, match="batch_size 16 is not the same whole number of pairs for each of 3 processes"):
        _check_world(recipe("smoke"), World(0, 3))


def test_a_world_of_one_does_nothing() -> None:
    z = torch.randn(4, 3)
    world = World()
    assert world.gather(z) is z and torch.equal(world.own(z, 4), z)
    assert world.writes and world.anyone(True) and not world.anyone(False)
