"""Peak memory and time per pair of one training step, measured in a separate process.

    python -m benchmarks.memory '{"batch": 256, "chunk": 32, "size": 224, "trunk": "resnet18", "device": "cpu"}'

Memory is what the step needs in addition to the loaded libraries and the data: resident memory on a CPU, allocated
memory on a GPU. ``chunk`` 0 means no gradient caching. The result is printed as JSON.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from benchmarks.floor import clock
from mvitac.data.spec import DataSpec
from mvitac.methods.base import Views
from mvitac.nn.encoders import SCRATCH, Encoders
from mvitac.recipes import recipe
from mvitac.training.step import Step
from mvitac.transforms.random_views import ViewAugment, apply, draw


def main() -> None:
    given = json.loads(sys.argv[1])
    device, batch, part = torch.device(given["device"]), given["batch"], given["chunk"] or given["batch"]
    base = recipe("paper")
    encoder = Encoders().changed(trunk=given["trunk"], weights=SCRATCH)
    run = replace(base, encoder=encoder, batch_size=batch, chunk=given["chunk"], precision="bf16")
    shape = {"vision_channels": 3, "touch_channels": 3, "tasks": (), "group_by": "row"}
    spec = DataSpec(name="noise", licence="none", source="noise", **shape)
    method = run.method.build(spec, run.encoder).to(device)
    method.to(memory_format=torch.channels_last)
    step = Step(run, method.train(), device)
    raw = torch.randint(0, 255, (part, 256, 256, 3), dtype=torch.uint8, device=device).permute(0, 3, 1, 2)

    def views(number: int) -> Views:
        generator = torch.Generator().manual_seed(number)
        drawn = [draw(ViewAugment(), part, 256, generator) for _ in range(4)]
        made = [apply(raw, each, given["size"], torch.bfloat16) for each in drawn]
        images = {"vision": made[:2], "touch": made[2:]}
        return Views(images=images, labels={}, rows=torch.arange(part, device=device))

    parts = [partial(views, number) for number in range(batch // part)]
    before = peak_resident()
    seconds = min(clock(lambda: step(parts, lr=1e-3, seed=0, progress=0.5), device) for _ in range(2))
    if device.type == "cuda":
        peak = torch.cuda.max_memory_allocated() / 2**30
    else:
        peak = peak_resident() - before
    print(json.dumps({"peak_gib": peak, "ms_per_pair": 1000 * seconds / batch}))


def peak_resident() -> float:
    """Return the peak resident memory of this process in GiB (Linux).

    ru_maxrss of getrusage is not usable here: a child process starts with the value of its parent.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 2**20


if __name__ == "__main__":
    main()
