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
from mvitac.datasets.pack import PackConfig
from mvitac.datasets.simulated import Grasps, GraspsConfig
from mvitac.model import fresh
from mvitac.recipes import recipe
from support.examples import load_example

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
        columns = {
            "id": f"{thing}-{index}",
            "group": f"thing {thing}",
            "touch_group": f"{thing}-{index}",
            "split": split,
        }
        columns |= {"label_success": held, "phase": "during", "contact_left": rng.random(), "contact_right": 0.0}
        return [Sample(vision=vision.astype(np.uint8), touch=touch.astype(np.uint8), columns=columns)]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Encoders as a run's folder holds them; nothing here depends on their training."""
    folder = tmp_path_factory.mktemp("felt")
    pack = build(Felt(), folder / "pack", size=16, quiet=True)
    (folder / "run").mkdir()
    fresh(recipe("smoke", PackConfig(path=pack.path)), pack.spec, pack.size).save(folder / "run" / "model.safetensors")
    return folder / "run"


def test_what_is_lifted() -> None:
    """The first that convinces; if none does, the most promising of those tried."""
    p = np.array([[0.6, 0.9, 0.1], [0.2, 0.5, 0.9], [0.1, 0.4, 0.3]])
    lifted, tried = regrasp.decide(p)
    assert lifted.tolist() == [0, 1, 1] and tried.tolist() == [1, 2, 3]
    lifted, tried = regrasp.decide(p, regrasp.NEVER)
    assert lifted.tolist() == [1, 2, 1] and tried.tolist() == [3, 3, 3]
    y, objects = np.array([0, 1, 1, 0, 0, 0]), np.array([0, 0, 1, 1, 2, 2])
    hands = np.array([[0, 1], [2, 3], [4, 5]])  # lifts are counted by object
    found = regrasp.play(y.astype(float), y, objects, hands, 0.5)
    assert found == {"group_sizes": [1, 1, 1], "group_correct": [1, 1, 0], "tried": 5 / 3}
    assert regrasp.play(np.ones(6), y, objects, hands, 0.5)["group_correct"] == [0, 1, 0]


def test_hands_are_of_one_object_and_use_no_grasp_twice() -> None:
    objects = np.array([0] * 7 + [1] * 4 + [2] * 3)
    hands = regrasp.episodes(objects, 3, seed=0)
    assert hands.shape == (4, 3) and len(set(hands.ravel())) == 12
    assert (objects[hands] == objects[hands[:, :1]]).all()
    assert np.array_equal(hands, regrasp.episodes(objects, 3, 0))
    assert not np.array_equal(hands, regrasp.episodes(objects, 3, 1))
    with pytest.raises(ValueError, match="an object has 3 grasps, fewer than 4 candidates"):
        regrasp.episodes(objects, 4, 0)


def test_touch_that_knows_the_outcome_lifts_like_the_oracle(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
