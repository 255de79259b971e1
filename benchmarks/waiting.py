"""Effect of OpenMP's spin-waiting on the time of a step, alone and next to a busy program.

    python -m benchmarks.waiting [--rounds 3] [--json FILE]

Each value is a step of recipe `paper` (ResNet-10, 48 px, batch 64, bf16, all cores) in a separate process
(``benchmarks.memory``). Variants are interleaved. `mvitac` sets GOMP_SPINCOUNT=10000 (``cli/main.py``); libgomp's
default is 300,000.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

from mvitac.system.files import write_json
from mvitac.system.provenance import provenance

VARIANTS = {
    "as libgomp does": {},
    "10,000 spins": {"GOMP_SPINCOUNT": "10000"},
    "passive": {"OMP_WAIT_POLICY": "PASSIVE"},
    "one thread": {"OMP_NUM_THREADS": "1"},
}
STEP = {"batch": 64, "chunk": 0, "size": 48, "trunk": "resnet10t", "device": "cpu"}


def ms_per_pair(variables: dict[str, str]) -> float:
    """Measure one step in a new process with these environment variables. Return ms per pair."""
    clean = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_NUM_THREADS")}
    command = [sys.executable, "-m", "benchmarks.memory", json.dumps(STEP)]
    out = subprocess.run(command, env=clean | variables, capture_output=True, text=True, check=True).stdout
    return json.loads(out)["ms_per_pair"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3, help="measurements per variant")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    medians: dict[str, dict[str, float]] = {}
    for others in (0, 1):
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(others)]
        try:
            rounds = [{name: ms_per_pair(v) for name, v in VARIANTS.items()} for _ in range(options.rounds)]
        finally:
            for program in busy:
                program.kill()
        for name in VARIANTS:
            median = statistics.median(found[name] for found in rounds)
            medians.setdefault(name, {})[f"beside {others}"] = median
            print(f"{name:16} with {others} busy programs: {median:7.2f} ms per pair", flush=True)
    if options.json:
        write_json(options.json, {"ms_per_pair": medians, "step": STEP, **provenance()})


if __name__ == "__main__":
    main()
