"""Record episodes of servo-v1 with a controller that knows the true pose, as a pack for `mvitac ablate` or a policy.

    python examples/record_servo.py --kind curved --episodes 20 --out packs/servo

Rows: touch, the action (the correction of the pose that the controller gave), the hand's way; groups are the episodes.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.control.result import find_suite
from mvitac.control.servo import SIZE, STEP_MM, task_of
from mvitac.data.build import build
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Target, ValueTask

STEPS, GAIN = 40, 0.5


@dataclass
class Recorded(Source):
    """Episodes ``first`` and later, which are others than the 8 of the suite."""

    kind: str
    episodes: int
    first: int = 100

    def spec(self) -> DataSpec:
        targets = tuple(Target(name=name, unit=name.rpartition("_")[2]) for name in task_of(self.kind).names)
        about: Any = {"vision_channels": 0, "touch_channels": 3, "tasks": (), "licence": "Apache-2.0"}
        action = ValueTask(name="action", targets=targets)
        state = ValueTask(name="state", targets=(Target(name="along_mm", unit="mm"),))
        return DataSpec(
            name=f"servo {self.kind}", values=(action, state), group_by="episode", source="simulated", **about
        )

    def items(self) -> list[str]:
        return [f"{self.first + number:04d}" for number in range(self.episodes)]

    def fingerprint(self) -> dict[str, Any]:
        return {"record_servo": [self.kind, self.episodes, self.first, STEPS]}

    def samples_per_item(self) -> list[int]:
        return [STEPS] * self.episodes

    def read(self, item: int) -> list[Sample]:
        name, rng, made = self.items()[item], np.random.default_rng(item), []
        episode = find_suite("servo-v1").world(self.kind, "known sensor", int(name))
        task, split = episode.task, "train" if item % 5 else "test"
        for frame in range(STEPS):
            action = -GAIN * (episode.known - task.target)
            columns = {"id": f"{name}-{frame:03d}", "group": name, "touch_group": name, "split": split, "frame": frame}
            columns |= {"contact": not episode.lost, "along_mm": STEP_MM * frame} | dict(
                zip(task.names, action.tolist(), strict=True)
            )
            made.append(Sample(vision=None, touch=episode.look("touch"), columns=columns))
            episode.step(action + 0.1 * task.start * rng.standard_normal(len(action)))  # corrections are shown, too
        return made


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", default="straight", choices=("straight", "curved", "corner", "surface"))
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    if options.episodes < 1:
        parser.error(f"--episodes {options.episodes}: give 1 or more")
    print(build(Recorded(options.kind, options.episodes), options.out, size=SIZE, workers=0, quiet=True))
