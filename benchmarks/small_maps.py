"""A step of the demo recipe with its small convolutions as products and as convolutions (``nn/small_conv.py``), in turn.

    python -m benchmarks.small_maps [--threads 1 2] [--rounds 9] [--json FILE]

Views are noise, so what is timed is the networks, losses and optimiser.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.speed import interleave
from mvitac.data.spec import DataSpec
from mvitac.methods.base import Views
from mvitac.nn import small_conv
from mvitac.recipes import recipe
from mvitac.system.files import write_json
from mvitac.system.malloc import keep_freed_memory
from mvitac.system.provenance import provenance
from mvitac.training.step import Step

CPU = torch.device("cpu")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    keep_freed_memory()
    found = {}
    for threads in options.threads:
        torch.set_num_threads(threads)
        for precision in ("fp32", "bf16"):
            seconds = interleave(variants(precision), options.rounds, CPU)
            pace = {name: recipe("demo").batch_size / value for name, value in seconds.items()}
            ratio = seconds["convolutions"] / seconds["products"]
            found[f"{threads} threads, {precision}"] = {"pairs_per_s": pace, "ratio": ratio}
            told = ", ".join(f"{name} {value:.0f} pairs/s" for name, value in pace.items())
            print(f"{threads} threads, {precision}: {told}: {ratio:.2f}x", flush=True)
    if options.json:
        write_json(options.json, {"found": found, **provenance()})


def variants(precision: str) -> dict:
    run = replace(recipe("demo"), precision=precision)
    spec = DataSpec(
        name="noise", vision_channels=3, touch_channels=3, tasks=(), group_by="row", licence="none", source="noise"
    )
    size = run.augment.size
    images = [torch.randn(run.batch_size, 3, size, size).to(memory_format=torch.channels_last) for _ in range(4)]
    batch = Views(images={"vision": images[:2], "touch": images[2:]}, labels={}, rows=torch.arange(run.batch_size))
    method = run.method.build(spec, run.encoder).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    step = Step(run, method.train(), CPU)

    def take(most: int) -> None:
        small_conv.MAX_PIXELS = most
        step([lambda: batch], lr=1e-4, seed=0, progress=0.5)

    as_shipped = small_conv.MAX_PIXELS
    return {"convolutions": lambda: take(0), "products": lambda: take(as_shipped)}


if __name__ == "__main__":
    main()
