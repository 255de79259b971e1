"""Inserting a peg needs both senses, the camera never shows the peg, and rows score what they say."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from mvitac.control.insert import Insert, Insertion
from mvitac.control.learn import ridge
from mvitac.control.result import find_suite
from mvitac.control.suite import Row, score

RANDOM = "external:timm/test_resnet,weights=random,size=32,seed={}"
WHOLE: Any = find_suite("insert-v1")


@pytest.fixture(scope="module")
def small() -> Insert:
    few: Any = {"episodes": 3, "demonstrations": (3, 5), "train_steps": 2, "untrained": (RANDOM.format(0),)}
    return replace(find_suite("insert-v1"), name="small-v1", **few)  # type: ignore[return-value]


def ends(known: Any, num: int = 8) -> np.ndarray:
    """Success, mm and degrees of episodes in which the hand goes where ``known`` says."""
    found = []
    for number in range(num):
        world = Insertion(WHOLE, number)
        while not world.over:
            world.step(known(world))
        found.append(world.result())
    return np.array(found, float)


def test_the_expert_succeeds_and_half_of_its_knowledge_does_not() -> None:
    assert ends(lambda world: world.known)[:, 0].all()
    assert ends(lambda world: np.array([world.slot_mm, 0.0]))[:, 0].mean() < 0.3
    assert ends(lambda world: world.known - [world.slot_mm, 0.0])[:, 0].mean() < 0.3


def test_criteria_are_those_of_the_suite() -> None:
    world = Insertion(WHOLE, 1)
    while not world.over:
        world.step(world.known + np.array([0.5, 0.0]))
    success, mm, deg = world.result()
    assert success and 0.05 < mm < 0.7
    for criteria, holds in (
        ({"success_mm": mm / 2}, False),
        ({"success_depth": 1.2}, False),
        ({"success_deg": deg / 2}, False),
        ({"success_deg": deg + 1e-6}, True),
    ):
        world.suite = replace(WHOLE, **criteria)
        assert world.result()[0] == holds


def test_only_the_camera_shows_the_slot_and_only_the_gel_the_peg() -> None:
    world = Insertion(WHOLE, 3)
    before, peg = world.look("vision"), world.model.geom("peg").id
    world.model.geom_size[peg] *= 2
    mujoco.mj_forward(world.model, world.data)
    assert np.array_equal(world.look("vision"), before)
    world.model.geom_pos[world.model.geom("block0").id, 0] += 0.004
    mujoco.mj_forward(world.model, world.data)
    assert np.abs(world.look("vision").astype(int) - before).mean() > 1
    other = Insertion(WHOLE, 4)
    assert np.abs(other.look("touch").astype(int) - world.look("touch")).mean() > 1
    other.step(other.known)
    assert np.array_equal(other.look("touch"), Insertion(WHOLE, 4).look("touch"))


def test_demonstrations_are_other_grasps_and_go_astray(small: Insert) -> None:
    images, actions = small.shown
    wanted = actions.reshape(5, -1, 2)
    assert np.ptp(wanted, axis=1).max() == 0  # the set point does not change within an episode
    for number in range(5):
        assert np.abs(wanted[:, 0] - Insertion(WHOLE, number).known).max(1).min() > 0.01
    world = Insertion(WHOLE, 0, trained=True)
    assert all(np.array_equal(images[sense][0], world.look(sense)) for sense in ("vision", "touch"))
    for _ in range(4):
        world.step(world.known)
    assert np.abs(images["vision"][4].astype(int) - world.look("vision")).mean() > 1


def test_the_suite_shows_what_was_measured() -> None:
    """Mean levels: another processor rounds a pixel otherwise, another scene does not come near."""
    worlds = [Insertion(WHOLE, 1, trained=trained) for trained in (True, False)]
    assert [world.look("vision").mean() for world in worlds] == pytest.approx([171.35, 176.50], abs=0.05)
    assert [world.look("touch").mean() for world in worlds] == pytest.approx([140.716, 140.725], abs=0.004)


def test_gymnasium_environment() -> None:
    gymnasium = pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    import mvitac.control.env

    env = gymnasium.make("mvitac/Insert-v1", render_mode="rgb_array").unwrapped
    check_env(env)
    for action in (0.0, [0.0], [0.0, np.nan], [0.0] * 3):
        with pytest.raises(ValueError, match="give 2 numbers, each from -1 to 1"):
            env.step(action)
    for wrong in ({"task": "corner"}, {"condition": "x"}):
        with pytest.raises(ValueError, match="unknown task and condition of insert-v1"):
            gymnasium.make("mvitac/Insert-v1", **wrong)
    seen, info = env.reset(seed=1)
    over, total = False, 0.0
    while not over:
        seen, reward, over, _, info = env.step((info["known"] / env.world.most).astype(np.float32))
        total += reward
    assert total == 1 and seen["vision"].shape == seen["touch"].shape and mvitac.control.env.LoopEnv


def test_a_result_that_no_episodes_give_is_refused(small: Insert) -> None:
    """Cells that a row has, and sums of three episodes: success, mm, degrees."""
    assert ("vision", "3") not in small.cells("touch shuffled") and len(small.cells("expert")) == 2
    one = np.ones(3)
    good = np.array([[1.0, 1.0, 0.0], [0.4, 1.0, 9.0], [0.1, 3.0, 2.0]])
    assert not small.impossible("both", one, good)
    for place, value in (((0, 0), 0.5), ((1, 0), 1.5), ((2, 1), 3.1), ((1, 2), -1.0), ((2, 2), 181.0)):
        bad = good.copy()
        bad[place] = value
        assert small.impossible("both", one, bad)
    assert small.impossible("both", one, 0 * good)
    cell = {"success": [1.0] * 3, "n": [1.0] * 3, "mm": [0.1] * 3, "deg": [0.1] * 3, "seed": None}
    assert "100 [100" not in small.text([cell])  # 3 of 3 say little


def test_regression_finds_what_pictures_show(small: Insert) -> None:
    """From images that are the answer itself, the clone is the expert; shuffled touch takes its half of it away."""
    images, actions = (few := replace(small, episodes=4, demonstrations=(6,))).shown
    known = {images[sense][row].tobytes(): actions[row] for sense in images for row in range(len(actions))}

    def oracle(modality: str, pictures: np.ndarray) -> np.ndarray:
        worlds = {Insertion(WHOLE, n).look("touch").tobytes(): Insertion(WHOLE, n).known for n in range(4)}
        return np.stack([known.get(p.tobytes(), worlds.get(p.tobytes(), np.zeros(2))) for p in pictures])

    cells = {cell["task"]: cell for cell in score(few, Row("", 0, ridge(oracle)))}
    assert all(cells["touch"]["success"]) and not all(cells["vision"]["success"])
    shuffled = {cell["task"]: cell for cell in score(few, Row("touch shuffled", 0, ridge(oracle)))}
    assert not any(shuffled["touch"]["success"])
    looks: list[Callable[[str], np.ndarray]] = []
    for source in ("", "touch shuffled"):
        score(few, Row(source, 0, lambda *_: lambda look: looks.append(look) or np.zeros(2)))
    for sense, other in (("vision", 0), ("touch", 1)):
        plain, given = (look(sense) for look in (looks[0], looks[-1]))
        assert np.array_equal(given, np.roll(plain, other, axis=0)) and not np.array_equal(plain, np.roll(plain, 1, 0))
