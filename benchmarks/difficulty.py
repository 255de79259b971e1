"""Check the design rule of the simulator (docs/simulator.md) with the library's own training and probe.

On every task, with touch and vision together and on unseen groups, a supervised reference must be at least 20 points
above the features of an untrained trunk, and below 97 %. No self-supervised method is used.

    python -m benchmarks.difficulty materials|grasps [--world SEED] [--seeds N] [--steps N] [--json FILE]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from mvitac.datasets.simulated import SimulatedConfig
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.methods.supervised import SupervisedConfig
from mvitac.recipes import recipe
from mvitac.registry import default
from mvitac.report.tables import print_summary
from mvitac.run import Optim
from mvitac.system.files import write_json
from mvitac.system.provenance import provenance
from mvitac.training.loop import train

MARGIN, CEILING = 0.20, 0.97


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", choices=("materials", "grasps"), help="simulated dataset")
    parser.add_argument("--world", type=int, default=0, help="seed of the simulated world")
    parser.add_argument("--seeds", type=int, default=1, help="number of training seeds")
    parser.add_argument("--steps", type=int, default=600, help="training steps")
    parser.add_argument("--out", type=Path, default=Path("runs/difficulty"), help="folder for the runs")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    run = replace(
        recipe("quick", replace(default(SimulatedConfig, options.data), seed=options.world)),
        method=SupervisedConfig(),
        optim=Optim(name="adamw", lr=1e-3, eps=1e-8, weight_decay=0.05, schedule="cosine", warmup=0.05),
        batch_size=128,
        steps=options.steps,
        eval_every=0,
    )
    paths = [
        train(replace(run, seed=seed), options.out / f"{options.data}-{options.world}-{seed}", resume=True)
        for seed in range(options.seeds)
    ]
    result = probe_runs(paths, ProbeConfig())
    print_summary(result)
    verdicts = {}
    for task, by_modality in result["summary"].items():
        supervised, untrained = by_modality["both"]["supervised"]["mean"], by_modality["both"]["untrained"]["mean"]
        verdicts[task] = {
            "supervised": supervised,
            "untrained": untrained,
            "holds": supervised - untrained >= MARGIN and supervised < CEILING,
        }
        scores = f"supervised {100 * supervised:.1f}, untrained {100 * untrained:.1f}"
        print(f"{task}: {scores}; the rule {'holds' if verdicts[task]['holds'] else 'DOES NOT HOLD'}")
    if options.json:
        write_json(
            options.json,
            {
                "rule": verdicts,
                "summary": result["summary"],
                "steps": options.steps,
                "world": options.world,
                **provenance(),
            },
        )


if __name__ == "__main__":
    main()
