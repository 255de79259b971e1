"""Latency of one pair, from uint8 images to embeddings and probabilities, by engine and precision.

    python -m benchmarks.latency --threads 2 --out FILE.json

ResNet-18 at 224 px for vision and for touch, batch 1, random weights (speed does not depend on them). The cosine is
between a variant's embeddings and those of eager mode, on simulated pairs. Variants are interleaved, so that other load
affects all of them. CPU time is printed next to wall-clock time, because it depends little on other programs.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.deploy.engine import Call, Engine, Runtime, cosines
from mvitac.deploy.export import export
from mvitac.deploy.export_config import ExportConfig, Precision
from mvitac.deploy.export_module import ExportModule
from mvitac.model import fresh
from mvitac.nn.encoders import Encoders
from mvitac.recipes import recipe
from mvitac.system.provenance import provenance

VARIANTS: dict[str, tuple[Precision, Runtime]] = {
    "ONNX Runtime fp32": ("fp32", "onnxruntime"),
    "ONNX Runtime int8": ("int8", "onnxruntime"),
    "OpenVINO fp32": ("fp32", "openvino"),
    "OpenVINO bf16": ("bf16", "openvino"),
    "OpenVINO int8": ("int8", "openvino"),
}
ANY = ExportConfig(min_cosine=0.5, accuracy_loss=100.0, value_loss=100.0, num_rows=64)
"""The benchmark reports the loss of precision, so every export is accepted."""


def in_torch(module: Any) -> Call:
    def call(arrays: list[np.ndarray]) -> list[np.ndarray]:
        with torch.inference_mode():
            return [x.numpy() for x in module(*(torch.tensor(a) for a in arrays))]

    return call


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of each engine")
    parser.add_argument("--rounds", type=int, default=20, help="turns per variant")
    parser.add_argument("--calls", type=int, default=10, help="calls per turn")
    parser.add_argument("--size", type=int, default=224, help="image side in pixels")
    parser.add_argument("--trunk", default="resnet18.tv_in1k", help="timm model")
    parser.add_argument("--work", type=Path, help="keep the exports in this folder and reuse them")
    parser.add_argument("--no-compile", action="store_true", help="skip torch.compile, which takes minutes to compile")
    parser.add_argument("--out", type=Path, help="write the results to this JSON file")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    folder = options.work or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)

    config = MaterialsConfig(num=400, touches=1, size=options.size, workers=1)
    there = folder / "pack"
    pack = Pack(there) if there.exists() else build(config.source(), there, size=options.size, quiet=True)
    base = recipe("paper", config)
    run = replace(
        base,
        encoder=Encoders().changed(trunk=options.trunk, weights="scratch"),
        augment=replace(base.augment, size=options.size),
    )
    model = fresh(run, pack.spec, options.size)
    from mvitac.deploy.publish import with_probes  # imported after the number of threads is set

    graph = ExportModule(with_probes(model, pack))
    calls: dict[str, Call] = {"eager": in_torch(graph)}
    if not options.no_compile:
        calls["torch.compile"] = in_torch(torch.compile(graph, dynamic=False))
    sizes = {"eager": sum(p.numel() * 4 for p in graph.parameters()) / 1e6}
    for name, (precision, runtime) in VARIANTS.items():
        out = folder / precision
        if not out.exists():
            report = export(model, pack, out, replace(ANY, threads=options.threads, precision=precision))
            print(precision, "exported:", json.dumps(report["cosine"]), file=sys.stderr)
        engine = Engine(out, engine=runtime, threads=options.threads)
        sizes[name] = engine.meta["report"]["size_mb"]
        calls[name] = engine._call

    rows = pack.rows("test")
    pairs = [[pack.images[m][r : r + 1].copy() for m in graph.modalities] for r in rows[:8]]
    wanted = [calls["eager"](pair) for pair in pairs]
    result = {}
    for name, call in calls.items():
        found = [call(pair) for pair in pairs]  # also warms up
        least = min(cosines(w[i], f[i]).min() for w, f in zip(wanted, found, strict=True) for i in (0, 1))
        result[name] = {"size_mb": round(sizes.get(name, sizes["eager"]), 1), "min_cosine": float(least)}
    wall: dict[str, list[float]] = {name: [] for name in calls}
    cpu: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(options.rounds):
        for name, call in calls.items():
            call(pairs[0])
            for i in range(options.calls):
                before, busy = time.perf_counter(), time.process_time()
                call(pairs[(turn + i) % len(pairs)])
                cpu[name].append(1000 * (time.process_time() - busy))
                wall[name].append(1000 * (time.perf_counter() - before))
    print(f"{'':20} {'p50 ms':>8} {'p99 ms':>8} {'cpu ms':>8} {'x eager':>8} {'MB':>7} {'min cosine':>11}")
    for name in calls:
        p50, p99 = np.percentile(wall[name], [50, 99])
        busy = float(np.median(cpu[name]))
        ratio = float(np.median(wall["eager"]) / p50)
        result[name] |= {"p50_ms": float(p50), "p99_ms": float(p99), "cpu_ms": busy, "speedup": ratio}
        r = result[name]
        print(f"{name:20} {p50:8.1f} {p99:8.1f} {busy:8.1f} {ratio:8.2f} {r['size_mb']:7.1f} {r['min_cosine']:11.5f}")
    load = os.getloadavg()[0]
    print(f"{options.threads} threads, {options.rounds * options.calls} calls each, load average {load:.1f}")
    if options.out:
        options.out.write_text(
            json.dumps({"threads": options.threads, "load": load, "variants": result, **provenance()}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
