"""One process of tests/test_distributed.py under torchrun's variables: ``step DIR METHOD``, ``train PACK OUT DIE_AFTER``."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed as dist
from test_distributed import build, gradients, run_of, views
from test_step import split

from mvitac import batches
from mvitac.datasets.packed import PackConfig
from mvitac.datasets.stream import StreamConfig
from mvitac.distributed import join, synchronise_norms
from mvitac.recipes import recipe
from mvitac.step import Step
from mvitac.train import train as pretrain


def step(folder: Path, name: str) -> None:
    """Two steps on this process's part of the joint batch."""
    world, method = join(), build(name)
    synchronise_norms(method, world)
    take = Step(run_of(name), method, torch.device("cpu"), world)
    part = split(views(), len(views().rows) // world.size)[world.rank]
    losses = take([part], lr=1e-3, seed=0, progress=0.5)
    result = {"gradients": gradients(method), "losses": losses}
    take([part], lr=1e-3, seed=0, progress=0.5)
    torch.save({**result, "weights": method.state_dict()}, folder / f"rank{world.rank}.pt")


def train(pack: Path, out: Path, die_after: int) -> None:
    """The whole loop; every process dies after its ``die_after``-th batch, and notes the rows it saw."""
    shards = StreamConfig(url=str(pack), cache=pack.with_name("cache"), cache_gb=1e-3, window=2)
    data = shards if pack.name == "shards" else PackConfig(path=pack)
    run = replace(recipe("smoke", data), steps=4, checkpoint_every=2, log_every=1)
    real, seen = batches.make_views, []

    def watched(*args: object) -> object:
        if len(seen) == die_after:
            raise RuntimeError("power cut")
        seen.append(args[2].tolist())  # type: ignore[attr-defined]
        return real(*args)  # type: ignore[arg-type]

    batches.make_views = watched  # type: ignore[assignment]
    pretrain(run, out, resume=True, quiet=True)
    torch.save(seen, out.with_name(f"{out.name}-rows{join().rank}.pt"))


if __name__ == "__main__":
    torch.set_num_threads(1)
    kind, *given = sys.argv[1:]
    step(Path(given[0]), given[1]) if kind == "step" else train(Path(given[0]), Path(given[1]), int(given[2]))
    dist.destroy_process_group()
