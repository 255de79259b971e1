"""What one process of test_distributed.py does: main("step", DIR), main("train", DATA, OUT, DIE_AFTER, METHOD)."""

from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist

from mvitac.datasets.mix import MixConfig
from mvitac.datasets.pack import PackConfig
from mvitac.methods.base import Method
from mvitac.system.distributed import join
from mvitac.training.loop import train as pretrain
from mvitac.training.step import Step
from mvitac.training.views import StepViews
from support.distributed_steps import METHODS, build, loop_run, run_of, third_step, three_steps
from support.small_steps import split, views


def step(folder: Path) -> None:
    """Of every method three steps on this process's part of the joint batch, and the third from one process's checkpoint."""
    world = join()
    part = split(views(), len(views().rows) // world.size)[world.rank]

    def start(name: str) -> tuple[Method, Step]:
        method = build(name)
        return method, Step(run_of(name), method, torch.device("cpu"), world)

    for name in METHODS:
        run, here = run_of(name), folder / name
        made = three_steps(partial(start, name), [part], run, here / "two.pt", world)
        resumed = third_step(partial(start, name), [part], run, here / "one.pt")
        torch.save({**made, "resumed": resumed}, here / f"rank{world.rank}.pt")


def train(place: str, out: Path, die_after: int, name: str) -> None:
    """The whole loop; every process dies after its ``die_after``-th batch, and notes the rows it saw.

    ``place`` is a pack, or the parts of a mix with batches of one part.
    """
    mixed = "=" in place
    data = MixConfig(parts=tuple(place.split()), batches="one-part") if mixed else PackConfig(path=Path(place))
    real, seen = StepViews.make, []

    def watched(self: StepViews, rows: np.ndarray, seed: int) -> object:
        if len(seen) == die_after:
            raise RuntimeError("power cut")
        seen.append(rows.tolist())
        return real(self, rows, seed)

    StepViews.make = watched  # type: ignore[assignment]
    pretrain(loop_run(data, name), out, resume=True, quiet=True)
    torch.save(seen, out.with_name(f"{out.name}-rows{join().rank}.pt"))


def main(kind: str, *given: str) -> None:
    step(Path(given[0])) if kind == "step" else train(given[0], Path(given[1]), int(given[2]), given[3])
    dist.destroy_process_group()
