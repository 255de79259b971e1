"""What one process and each of two do alike: three steps, the third resumed, and the whole loop.

A process of test_distributed.py does ``main("step", DIR)`` or ``main("train", PACK, OUT, DIE_AFTER)``.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from mvitac.datasets.pack import PackConfig
from mvitac.methods.base import Method, MethodConfig
from mvitac.methods.cmc import CMCConfig
from mvitac.methods.ijepa import IJEPAConfig
from mvitac.methods.mae import MAEConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.recipes import recipe
from mvitac.run import Optim, Run
from mvitac.system.distributed import World, join
from mvitac.training import checkpoint
from mvitac.training.loop import train as pretrain
from mvitac.training.step import Chunk, Step
from mvitac.training.views import StepViews
from support.small_methods import TINY_VIT
from support.small_steps import build as build_from
from support.small_steps import gradients, split, views
from support.training_runs import power_cut

RUN = replace(recipe("smoke"), optim=Optim(name="sgd"), method=MViTacConfig(hidden=24, out=12), batch_size=12)
METHODS: dict[str, MethodConfig] = {
    "mvitac": RUN.method,
    "cmc": CMCConfig(out=12, num_negatives=1500),
    "cmc softmax": CMCConfig(out=12, num_negatives=1500, softmax=True),
    "cmc softmax, 2 negatives": CMCConfig(out=12, num_negatives=2, softmax=True),
    "mae": MAEConfig(),
    "ijepa": IJEPAConfig(),
}
NUM_ROWS = 601


def run_of(method: str) -> Run:
    config = METHODS[method]
    return replace(RUN, method=config, encoder=TINY_VIT if config.needs_vit else RUN.encoder)


def build(method: str = "mvitac") -> Method:
    """Without BatchNorm, which has the statistics of each process, and smooth throughout: where a ReLU or a maximum
    switches, a difference of 1e-7 grows to per cents in three steps."""
    built = build_from(run_of(method), num_rows=NUM_ROWS)
    for parent in list(built.modules()):
        for name, layer in parent.named_children():
            if isinstance(layer, (nn.BatchNorm1d, nn.BatchNorm2d)):
                setattr(parent, name, nn.GroupNorm(1, layer.num_features))
            elif isinstance(layer, nn.ReLU):
                setattr(parent, name, nn.GELU())
            elif isinstance(layer, nn.MaxPool2d):
                setattr(parent, name, nn.AvgPool2d(layer.kernel_size, layer.stride, layer.padding))
    return built


def three_steps(
    start: Callable[[], tuple[Method, Step]], parts: list[Chunk], run: Run, to: Path, world: World | None = None
) -> dict[str, Any]:
    """What three steps on ``parts`` make, with a checkpoint ``to`` after the second."""
    method, step = start()
    result = {"losses": step(parts, lr=5e-3, seed=0, progress=0.5), "gradients": gradients(method)}
    result["memory"] = {k: v.clone() for k, v in method.state_dict().items() if k.startswith(("banks.", "z_norm"))}
    step(parts, lr=5e-3, seed=1, progress=0.5)
    if world is None or world.is_main:
        checkpoint.save(to, run, method, step.optimiser, 2, {})
    result["last"] = step(parts, lr=5e-3, seed=2, progress=0.5)
    return {**result, "weights": method.state_dict()}


def third_step(start: Callable[[], tuple[Method, Step]], parts: list[Chunk], run: Run, of: Path) -> dict[str, Tensor]:
    """The weights after the last of these, begun from the checkpoint ``of``."""
    method, step = start()
    assert checkpoint.restore(of, run, method, step.optimiser, 2) == (2, {})
    step(parts, lr=5e-3, seed=2, progress=0.5)
    return method.state_dict()


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


def train(place: str, out: Path, die_after: int) -> None:
    """The whole loop on a pack; every process dies after its ``die_after``-th batch, and notes the rows it saw."""
    real, seen = StepViews.make, []
    StepViews.make = lambda self, rows, seed: seen.append(rows.tolist()) or real(self, rows, seed)  # type: ignore
    run = replace(recipe("smoke", PackConfig(path=Path(place))), steps=4, checkpoint_every=2, log_every=1)
    with power_cut(die_after):
        pretrain(run, out, resume=True, quiet=True)
    torch.save(seen, out.with_name(f"{out.name}-rows{join().rank}.pt"))


def main(kind: str, *given: str) -> None:
    step(Path(given[0])) if kind == "step" else train(given[0], Path(given[1]), int(given[2]))
    dist.destroy_process_group()
