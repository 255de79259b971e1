"""Speed of small convolutions as matrix products (``nn/small_conv.py``), in a step of recipe `demo`.

    python -m benchmarks.small_maps [--threads 1 2] [--rounds 9] [--json FILE]

The other variant runs them as convolutions. The two are interleaved. Views are noise, so only the networks, losses and
optimiser are timed.
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
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="numbers of CPU threads to measure")
    parser.add_argument("--rounds", type=int, default=9, help="measurements per variant")
    parser.add_argument("--json", type=Path, help="write the results to this file")
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
            speeds = ", ".join(f"{name} {value:.0f} pairs/s" for name, value in pace.items())
            print(f"{threads} threads, {precision}: {speeds}, ratio {ratio:.2f}", flush=True)
    if options.json:
        write_json(options.json, {"found": found, **provenance()})


def variants(precision: str) -> dict:
    """Return functions that take one step, one with convolutions only and one with matrix products."""
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
