"""Cost of distributed training: time of a step in a process group, divided by its time alone.

Each process has the same number of pairs in both cases, and all measure at the same time.

torchrun --nproc-per-node 2 -m benchmarks.scaling [--batch 32] [--size 224]
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import torch
import torch.distributed as dist

from benchmarks.speed import Scale, interleave, our_run
from mvitac.data.spec import DataSpec
from mvitac.methods.base import Views
from mvitac.system.device import pick_device
from mvitac.system.distributed import World, join, local_device
from mvitac.training.step import Step


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=32, help="pairs per process")
    parser.add_argument("--size", type=int, default=224, help="image side in pixels")
    parser.add_argument("--trunk", default="resnet18", help="timm model")
    parser.add_argument("--rounds", type=int, default=5, help="measurements per variant")
    options = parser.parse_args()
    world = join()
    device = pick_device(local_device("auto"))
    scale = Scale(trunk=options.trunk, size=options.size, batch=options.batch)
    spec = DataSpec(
        name="noise", vision_channels=3, touch_channels=3, tasks=(), group_by="row", licence="none", source="noise"
    )
    shape = (options.batch, 3, options.size, options.size)
    images = [torch.randn(shape, device=device).to(torch.bfloat16, memory_format=torch.channels_last) for _ in range(4)]
    batch = Views(
        images={"vision": images[:2], "touch": images[2:]}, labels={}, rows=torch.arange(options.batch, device=device)
    )
    variants = {}
    for name, size in (("alone", World()), ("together", world)):
        run = replace(our_run(scale, "bf16"), batch_size=options.batch * size.size)
        method = run.method.build(spec, run.encoder).to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        step = Step(run, method.train(), device, size)  # type: ignore[arg-type]
        variants[name] = lambda step=step: step([lambda: batch], lr=1e-3, seed=0, progress=0.5)
    seconds = interleave(variants, options.rounds, device)
    if world.is_main:
        print(
            f"{world.size} processes, {options.batch} pairs each:"
            f" a step takes {seconds['together'] / seconds['alone']:.2f} times as long as alone"
        )
    if world.size > 1:
        dist.destroy_process_group()


if __name__ == "__main__":
    main()
