"""Train the model that the package brings (``mvitac.load("base")``), and write it into the package.

    python -m benchmarks.base train --seed 0 --out runs/base     # hours on one core; goes on where it stopped
    python -m benchmarks.base write runs/base/seed0              # makes src/mvitac/weights/base, in fp16

Vision is EfficientNet-Lite0 with ImageNet's weights, locked. Touch is a ResNet-10 from random weights, trained on simulated
presses: 400 random sensors, the two real gels of ``taxim`` and the four known sensors, two per press with the sensor term.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from mvitac.datasets.simulated import MaterialsConfig
from mvitac.deploy.publish import publish
from mvitac.recipes import recipe
from mvitac.run import Run
from mvitac.shipped import BASE
from mvitac.training.loop import train

MAKES = ("gelsight", "gelsight_mini", "mini", "mini_dots", "classic", "digit")


def base(seed: int, steps: int, num: int = 12000, sensors: int = 400) -> Run:
    """Recipe `locked` with larger images, more sensors and more steps."""
    run = recipe("locked", MaterialsConfig(num=num, size=96, sensors=sensors, makes=MAKES, sensors_per_press=2))
    touch = replace(run.augment.touch, size=64, whole=96)
    return replace(
        run,
        method=replace(run.method, lambda_sensor=1.0, lambda_inter=1.0),
        augment=replace(run.augment, touch=touch),
        optim=replace(run.optim, lr=2e-3),
        batch_size=64,
        steps=steps,
        seed=seed,
        eval_every=1500,
        checkpoint_every=100,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    training, writing = commands.add_parser("train"), commands.add_parser("write")
    training.add_argument("--seed", type=int, default=0)
    training.add_argument("--steps", type=int, default=4500)
    training.add_argument("--num", type=int, default=12000, help="presses, each by two sensors")
    training.add_argument("--sensors", type=int, default=400, help="random sensors beside the six")
    training.add_argument("--out", type=Path, default=Path("runs/base"))
    writing.add_argument("run", type=Path)
    asked = parser.parse_args()
    if asked.command == "train":
        train(base(asked.seed, asked.steps, asked.num, asked.sensors), asked.out / f"seed{asked.seed}", resume=True)
    else:
        # The probes are fitted on the demo's pairs: the same instances, split alike, on the four known sensors.
        publish(asked.run, BASE, MaterialsConfig().open(), half=True)


if __name__ == "__main__":
    main()
