"""Latency of windows of 1, 2 and 4 touch frames, from uint8 images to embeddings.

    python -m benchmarks.window_latency --threads 1 --out FILE.json

ResNet-18 at 224 px for vision and for touch, ONNX Runtime fp32, batch 1, random weights (speed does not depend on them).
Frames are stacked on channels (stack), or the trunk sees them one by one (mean). Vision is a single frame. Variants are
interleaved, so that other load affects all of them; CPU time depends little on other programs.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch

from mvitac.data.build import build
from mvitac.data.spec import Window
from mvitac.data.windows import windowed
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.deploy.engine import Engine
from mvitac.deploy.export import ExportConfig, export
from mvitac.model_files import fresh
from mvitac.nn.encoders import EncoderConfig
from mvitac.recipes import recipe
from mvitac.system.provenance import provenance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of each engine")
    parser.add_argument("--rounds", type=int, default=20, help="turns per variant")
    parser.add_argument("--calls", type=int, default=5, help="calls per turn")
    parser.add_argument("--size", type=int, default=224, help="image side in pixels")
    parser.add_argument("--trunk", default="resnet18.tv_in1k", help="timm model")
    parser.add_argument("--out", type=Path, help="write the results to this JSON file")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = MaterialsConfig(num=480, touches=4, size=options.size, workers=1)
        pack = build(config.source(), folder / "pack", size=options.size, quiet=True)
        frame = np.concatenate([np.arange((pack.touch_groups == g).sum()) for g in range(pack.touch_groups.max() + 1)])
        order = np.argsort(np.argsort(pack.touch_groups, kind="stable"))
        pack.table = pack.table.append_column("frame", pa.array(frame[order]))
        base = recipe("paper", config)
        base = replace(base, augment=replace(base.augment, size=options.size))
        engines, images = {}, {}
        for frames, temporal in ((1, "stack"), (2, "stack"), (4, "stack"), (2, "mean"), (4, "mean")):
            encoder = EncoderConfig(trunk=options.trunk, weights="scratch", temporal=temporal)
            shown = windowed(pack, Window(frames=frames))
            model = fresh(replace(base, encoder=encoder), shown.spec, options.size)
            out = folder / f"{frames}{temporal}"
            accepted = ExportConfig(min_cosine=0.5, accuracy_loss=100.0, value_loss=100.0, num_rows=16)
            export(model, shown, out, replace(accepted, threads=options.threads))
            label = f"{frames} frames, {temporal}" if frames > 1 else "1 frame"
            engines[label] = Engine(out, threads=options.threads)
            images[label] = {m: shown.images[m][np.array([0])] for m in engines[label].inputs}
        wall: dict[str, list[float]] = {label: [] for label in engines}
        cpu: dict[str, list[float]] = {label: [] for label in engines}
        for _ in range(options.rounds):
            for label, engine in engines.items():
                engine(**images[label])  # warms up
                for _ in range(options.calls):
                    before, busy = time.perf_counter(), time.process_time()
                    engine(**images[label])
                    cpu[label].append(1000 * (time.process_time() - busy))
                    wall[label].append(1000 * (time.perf_counter() - before))
    result = {}
    for label in engines:
        p50, p99 = (float(np.percentile(wall[label], q)) for q in (50, 99))
        result[label] = {"p50_ms": p50, "p99_ms": p99, "cpu_ms": float(np.median(cpu[label]))}
        print(f"{label:16} p50 {p50:7.1f}  p99 {p99:7.1f}  cpu {result[label]['cpu_ms']:7.1f} ms")
    load = os.getloadavg()[0]
    print(f"{options.threads} threads, {options.rounds * options.calls} calls each, load average {load:.1f}")
    if options.out:
        about = {"threads": options.threads, "load": load, "size": options.size, "trunk": options.trunk}
        options.out.write_text(json.dumps({**about, "variants": result, **provenance()}, indent=1) + "\n")


if __name__ == "__main__":
    main()
