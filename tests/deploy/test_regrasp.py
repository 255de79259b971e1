"""The re-grasping example: what is lifted, by arithmetic; and the whole of it on grasps that only touch can tell apart."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvitac.data.build import build
from mvitac.data.source import Sample
from mvitac.data.spec import DataSpec
from mvitac.datasets.simulated import Grasps, GraspsConfig
from mvitac.model import fresh
from support.examples import load_example
from support.training_runs import smoke

regrasp = load_example("regrasp")
THINGS, EACH = 40, 5


class Felt(Grasps):
    """Five grasps each of 40 of the simulator's objects; the gels are bright where a grasp holds, the camera sees noise."""

    def __init__(self) -> None:
        super().__init__(GraspsConfig(num=THINGS * EACH, size=16))

    def spec(self) -> DataSpec:
        return replace(super().spec(), values=())

    def read(self, item: int) -> list[Sample]:
        thing, index = item % THINGS, item // THINGS
        rng = np.random.default_rng([5, thing, index])
        held = int(rng.random() < 0.5)
        vision, touch = rng.integers(0, 256, (16, 16, 3)), rng.integers(0, 60, (16, 16, 6)) + 120 * held
        split = ("train", "test", "val", "train")[thing % 4]
        name = f"{thing}-{index}"
        columns = {"id": name, "group": f"thing {thing}", "touch_group": name, "split": split}
        columns |= {"label_success": held, "phase": "during", "contact_left": rng.random(), "contact_right": 0.0}
        return [Sample(vision=vision.astype(np.uint8), touch=touch.astype(np.uint8), columns=columns)]


def test_touch_that_knows_lifts_like_the_oracle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pack = build(Felt(), tmp_path / "pack", size=16, quiet=True)
    (run := tmp_path / "run").mkdir()
    fresh(smoke(pack), pack.spec, pack.size).save(run / "model.safetensors")
    regrasp.main([str(run), "--seeds", "2", "--candidates", "2", "--json", str(tmp_path / "found.json")])
    found: dict[str, Any] = json.loads((tmp_path / "found.json").read_text())
    success = {name: rules["again"]["mean"] for name, rules in found["success"].items()}
    assert found["objects"] == 10 and found["episodes"] == 20  # two hands of two, one grasp left over
    assert success["touch"] == success["both"] == success["oracle"] > success["first grasp"] + 0.1
    assert success["vision"] < success["oracle"] - 0.1 and success["contact only"] < success["oracle"] - 0.1
    assert found["success"]["oracle"]["best"]["mean"] == success["oracle"]
    assert found["gain"]["both - vision"]["mean"] == pytest.approx(success["both"] - success["vision"])
    assert found["success"]["first grasp"]["again"]["tried"] == 1
    shown = capsys.readouterr().out
    assert "10 test objects" in shown and f"{100 * success['vision']:.1f}" in shown
