"""Two processes (gloo) against one on the joint batch: gradients, weights, statistics, files, resuming."""

import socket
from functools import partial
from itertools import chain
from pathlib import Path

import pytest
import timm
import torch

from mvitac.data.pack import Pack
from mvitac.methods.base import Method
from mvitac.system.distributed import World
from mvitac.training.step import Step
from support.distributed_steps import METHODS, build, main, run_of, third_step, three_steps
from support.processes import begin
from support.small_steps import assert_close, views
from support.training_runs import assert_equal_weights, log_of

pytestmark = pytest.mark.slow


def together(folder: Path, *words: str, num: int = 2, fails: bool = False) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    processes, said = [], [folder / f"rank{rank}.txt" for rank in range(num)]
    for rank, output in enumerate(said):
        place = {"WORLD_SIZE": str(num), "RANK": str(rank), "LOCAL_RANK": str(rank)}
        processes.append(begin(main, *words, output=output, MASTER_ADDR="127.0.0.1", MASTER_PORT=port, **place))
    for process, output in zip(processes, said, strict=True):
        process.join(120)
        assert process.exitcode is not None and (process.exitcode != 0) == fails, output.read_text()


def alone(name: str) -> tuple[Method, Step]:
    method = build(name)
    return method, Step(run_of(name), method, torch.device("cpu"))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of every method a folder: what one process makes (alone.pt) and what two make (rank0.pt, rank1.pt)."""
    folder = tmp_path_factory.mktemp("pair")
    for name in METHODS:
        (folder / name).mkdir()
        made = three_steps(partial(alone, name), [views], run_of(name), folder / name / "one.pt")
        torch.save(made, folder / name / "alone.pt")
    together(folder, "step", str(folder))
    return folder


@pytest.mark.parametrize("method", METHODS)
def test_two_processes_equal_one_on_the_joint_batch(pair: Path, method: str) -> None:
    """Gathered negatives, summed gradients, CMC's banks and Z: one process's to rounding, on a trunk without BatchNorm."""
    one, first, second = (torch.load(pair / method / f"{name}.pt") for name in ("alone", "rank0", "rank1"))
    assert_close(one["losses"], first["losses"], 1e-5)
    assert_close(first["losses"], second["losses"], 0)
    assert_close(one["gradients"], first["gradients"], 1e-3)
    assert bool(one["memory"]) == method.startswith("cmc")
    torch.testing.assert_close(first["memory"], one["memory"], rtol=1e-4, atol=1e-5)
    assert_close(one["last"], first["last"], 1e-3)
    assert_close(one["weights"], first["weights"], 1e-3)
    assert_close(first["weights"], second["weights"], 0)
    # One process goes on where two stopped, and two where one did.
    assert_close(one["weights"], first["resumed"], 1e-3)
    resumed = third_step(partial(alone, method), [views], run_of(method), pair / method / "two.pt")
    assert_close(resumed, first["weights"], 1e-3)


def test_the_loop_shares_rows_writes_once_and_resumes_bit_for_bit(pack: Pack, tmp_path: Path) -> None:
    straight, cut = tmp_path / "straight", tmp_path / "cut"
    together(tmp_path, "train", str(pack.path), str(straight), "99")
    together(tmp_path, "train", str(pack.path), str(cut), "3", fails=True)
    assert not (cut / "model.safetensors").exists()
    together(tmp_path, "train", str(pack.path), str(cut), "99")
    assert_equal_weights(straight, cut)
    for path in (straight, cut):
        assert [line["step"] for line in log_of(path) if "loss" in line] == [1, 2, 3, 4]
    first, second = (torch.load(tmp_path / f"straight-rows{r}.pt") for r in (0, 1))
    epoch = [[*chain(*rows)] for rows in (first[:3], second[:3])]  # 60 training rows: three batches of 16 per epoch
    assert len(set(epoch[0])) == len(set(epoch[1])) == 24 and not set(epoch[0]) & set(epoch[1])


def test_batchnorm_over_gpus_keeps_the_activation_that_timm_puts_into_it() -> None:
    method, images = build(), torch.rand(2, 3, 32, 32)
    trunk = timm.create_model("tf_efficientnet_lite0", num_classes=0).eval()
    method.encoders()["touch"].add_module("inner", trunk)
    before = trunk(images)
    Step(run_of("mvitac"), method, torch.device("cuda"), World(0, 2))  # what it converts stays on the CPU here
    assert any(isinstance(layer, torch.nn.SyncBatchNorm) for layer in trunk.modules())
    assert torch.equal(trunk(images), before)
