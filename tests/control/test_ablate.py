"""A policy that needs touch, one that ignores it, and one that only reacts to it are told apart."""

import copy
import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mvitac.cli.main import main
from mvitac.control.ablate import (
    Recorded,
    ablate,
    act,
    open_policy,
    read_episodes,
    replacement,
    suite_episodes,
    suite_policy,
)
from mvitac.control.result import find_suite
from mvitac.control.video import film, webp
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Target, ValueTask
from support.toy import with_columns

STEPS = 24


@dataclass
class Presses(Source):
    """Episodes in which a gel brightens with a force that changes slowly; the action is that force. Vision is a lamp."""

    num: int = 8

    def spec(self) -> DataSpec:
        names = {"action": ["force", "turn"], "state": ["clock"]}
        targets = {task: tuple(Target(name=column, unit="1") for column in names[task]) for task in names}
        values = tuple(ValueTask(name=task, targets=each) for task, each in targets.items())
        about: Any = {"vision_channels": 3, "touch_channels": 3, "tasks": (), "group_by": "episode"}
        return DataSpec(name="presses", values=values, licence="none", source="this test", **about)

    def items(self) -> list[str]:
        return [str(i) for i in range(self.num)]

    def fingerprint(self) -> dict[str, Any]:
        return {"presses": self.num}

    def samples_per_item(self) -> list[int]:
        return [STEPS] * self.num

    def read(self, item: int) -> list[Sample]:
        rng = np.random.default_rng(item)
        force = 60 * (1 + np.sin(np.arange(STEPS) / 3 + 2 * item)) * (np.arange(STEPS) > 5)
        made = []
        for step in range(STEPS):
            images = [np.clip(rng.normal(v, 2, (16, 16, 3)), 0, 255).astype("u1") for v in (90, 60 + force[step])]
            columns = {"id": f"{item}-{step:02d}", "group": f"{item}", "touch_group": f"{item}", "split": "test"}
            columns |= {"frame": step, "force": force[step], "turn": float(step), "clock": step}
            made.append(Sample(vision=images[0], touch=images[1], columns=columns))
        return made


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return build(Presses(), tmp_path_factory.mktemp("episodes") / "pack", size=16, quiet=True)


def needs(observation: dict[str, Any]) -> list[float]:
    return [observation["touch"].mean() - 60.0, float(observation["state"][0])]


def ignores(observation: dict[str, Any]) -> list[float]:
    return [60.0, float(observation["step"])]


def wrong(observation: dict[str, Any]) -> list[float]:
    """Touch misleads it, so any replacement makes it better."""
    return [200 - observation["touch"].mean(), float(observation["state"][0])]


class Fickle:
    """Its action changes with touch at random, without any use; it counts its episodes."""

    episodes = 0

    def reset(self) -> None:
        self.episodes += 1

    def __call__(self, observation: dict[str, Any]) -> list[float]:
        coin = np.random.default_rng(list(observation["touch"].tobytes()[:64])).normal()
        return [60.0 + 20 * coin, float(observation["step"])]


@pytest.mark.parametrize(
    ("policy", "touch", "vision"),
    [
        (needs, "The policy uses", "The policy does not use"),
        (ignores, "The policy does not use", "The policy does not use"),
        (wrong, "Cannot tell", "The policy does not use"),
        (Fickle(), "Cannot tell", "The policy does not use"),
    ],
)
def test_verdicts(pack: Pack, policy: Any, touch: str, vision: str) -> None:
    result = ablate(policy, read_episodes(pack))
    assert result["verdicts"]["touch"].startswith(touch) and result["verdicts"]["vision"].startswith(vision)
    if isinstance(policy, Fickle):
        assert policy.episodes == 8 * 10  # as it is twice


def test_each_replacement_gives_what_it_says(pack: Pack) -> None:
    episodes = read_episodes(pack)
    assert episodes.actions is not None
    force = episodes.actions[:, 0].reshape(-1, STEPS)
    kinds = ("", "mean frame", "another episode", "10 frames ago", "noise")
    felt = {k: act(needs, episodes, "touch" * bool(k), k)[0][:, 0].reshape(-1, STEPS) for k in kinds}
    assert np.abs(felt[""] - force).max() < 1.5 and np.allclose(felt["mean frame"], force.mean(), atol=1.5)
    assert np.abs(felt["another episode"] - np.roll(force, -1, axis=0)).max() < 1.5
    assert np.abs(felt["10 frames ago"][:, 10:] - force[:, :-10]).max() < 1.5
    assert np.abs(felt["10 frames ago"][:, :11] - force[:, :1]).max() < 1.5
    assert felt["noise"].std() < force.std() / 5 and np.abs(felt["noise"].mean() - force.mean()) < 15  # it is cut at 0


def test_mean_and_noise_are_of_all_frames() -> None:
    images, rows = np.zeros((400, 8, 8, 3), np.uint8), [np.arange(200), np.arange(200, 400)]
    images[::2] = 200  # as a lamp that flickers
    given = [replacement(kind, images, rows)(0, 0, images[0]) for kind in ("mean frame", "noise")]
    assert (given[0] == 100).all() and 80 < given[1].std() < 100


def test_a_policy_may_change_its_images_in_place_and_fill_one_action() -> None:
    episodes = suite_episodes(replace(find_suite("insert-v1"), episodes=3), ("touch", "30"))

    def inverted(o: dict[str, Any]) -> np.ndarray:
        np.subtract(255, o["touch"], out=o["touch"])
        return np.array([o["touch"].mean() / 100, 0.0])

    def reused(o: dict[str, Any]) -> np.ndarray:
        out[0] = (255 - o["touch"]).mean() / 100
        return out

    out, clean = np.zeros(2), ablate(lambda o: [(255 - o["touch"]).mean() / 100, 0.0], replace(episodes))
    assert all(ablate(policy, replace(episodes))["rows"] == clean["rows"] for policy in (inverted, reused))


class Way:
    """Four millimetres at the pace that the gel shows; the loss is the number of steps. It fills one image, and actions."""

    senses, most, over = ("touch",), (4.0,), property(lambda self: self.mm >= 4)
    shown = np.zeros((2, 2, 3), np.uint8)

    def __init__(self, pace: int) -> None:
        self.pace, self.mm, self.loss = pace, 0.0, 0.0

    def look(self, sense: str) -> np.ndarray:
        self.shown[:] = self.pace
        return self.shown

    def step(self, action: np.ndarray) -> None:
        self.mm, self.loss = self.mm + max(1.0, action[0]), self.loss + 1
        action[:] = 0


def test_episodes_may_end_when_the_policy_is_done() -> None:
    """Two and four steps in turn, or with the gel of the next episode four and two: changes of +2 and -2."""
    made = suite_episodes(replace(find_suite("insert-v1"), episodes=3), ("touch", "30"))
    own = replace(made, begin=[partial(Way, pace) for pace in [1, 2] * 3], senses=("touch",), unit="steps")
    ablate(lambda o: [1.0], own)  # whose images are not those of the next
    found = ablate(lambda o: [o["touch"].mean()], own)
    rows = {row["kind"]: row for row in found["rows"]}
    assert found["error"][0] == 3 and rows["another episode"]["error"][0] == 0 == rows["10 frames ago"]["error"][0]
    assert found["verdicts"]["touch"] == "Cannot tell whether the policy uses touch: 6 episodes are too few."
    assert rows["mean frame"]["error"][0] == 1 and rows["mean frame"]["change"][0] > 0  # four steps in each episode
    for loss, says in ((0.0, "episode 2 has no step"), (np.nan, "episode 2 has a loss of nan")):
        odd = Way(1)
        odd.loss, odd.mm = loss, 0.0 if loss else 4.0
        with pytest.raises(ValueError, match=says):
            ablate(lambda o: [1.0], replace(own, begin=[partial(Way, 1), lambda odd=odd: odd]))


def test_numbers_that_would_be_wrong(pack: Pack) -> None:
    """Values named as a sense never hide a replacement; a component that never changes counts as 0, whatever is given."""
    episodes = read_episodes(pack)
    still = np.full((pack.num, 1), 0.1)
    assert episodes.actions is not None
    clock = pack.values(next(task for task in pack.spec.values if task.name == "state"))
    begin = [partial(Recorded, pack, rows, {"touch": still, "state": clock}) for rows in episodes.rows]
    named = replace(episodes, actions=np.hstack([episodes.actions, still]), begin=begin)
    result = ablate(lambda o: [*needs(o), 0.1 + 1e-9 * o["touch"].mean()], named)
    plain = ablate(needs, episodes)
    for row, other in zip(result["rows"], plain["rows"], strict=True):
        assert row["change"][0] == pytest.approx(other["change"][0] * 2 / 3)
    assert result["rows"][0]["change"][0] > 0.1
    worse = next(r["parts"] for r in plain["rows"] if r["sense"] == "touch" and r["kind"] == "another episode")
    assert worse["in contact"][0] > 3 * abs(worse["no contact"][0])
    assert worse["last"][0] > worse["first third"][0]


@pytest.mark.parametrize("cells", [["False", "True"], [False, True], [0, 1], [0.0, 1.0], ["no", "Yes"]])
def test_contact_is_the_column_where_there_is_one(pack: Pack, cells: list[Any]) -> None:
    asked = np.arange(pack.num) % 3 > 0
    made = with_columns(pack, contact=[cells[one] for one in asked.astype(int)])
    assert np.array_equal(read_episodes(made).touched, asked)
    assert not np.array_equal(read_episodes(pack).touched, asked)


def test_a_file_without_its_function_is_no_encoder() -> None:
    with pytest.raises(ValueError, match=r"'mine.py' is no policy: give FILE.py:function"):
        suite_policy(find_suite("servo-v1"), ("corner", "known sensor"), "mine.py")


def test_an_episode_is_one_recording_of_a_group(pack: Pack) -> None:
    made = with_columns(pack, group=["one object"] * pack.num)
    for own, theirs in zip(read_episodes(made).rows, read_episodes(pack).rows, strict=True):
        assert np.array_equal(own, theirs)
    with pytest.raises(ValueError, match=r"two rows of touch .* are at \d+: pack with"):
        read_episodes(with_columns(made, frame=np.arange(pack.num) // 2))


def test_episodes_that_say_nothing(pack: Pack) -> None:
    for word in ("maybe", "nan"):
        with pytest.raises(ValueError, match=f"column contact has '{word}': give yes or no"):
            read_episodes(with_columns(pack, contact=["no"] * (pack.num - 1) + [word]))
    with pytest.raises(ValueError, match="5 rows have no touch"):
        read_episodes(with_columns(pack, has_touch=np.arange(pack.num) > 4))
    for value in (np.nan, 3.0):
        made = copy.copy(pack)
        made.values = lambda task, value=value: np.full((pack.num, 2), value)  # type: ignore[method-assign,misc]
        with pytest.raises(ValueError, match="values action never change"):
            read_episodes(made)


def test_in_a_closed_loop_success_is_the_measure() -> None:
    """A policy that knows each episode by its gel needs it; one that knows nothing of it does not use it."""
    suite = replace(find_suite("insert-v1"), episodes=8)
    known = {w.look("touch").tobytes(): w.known for w in (suite.world("both", "30", n) for n in range(suite.num))}
    felt = ablate(lambda o: known.get(o["touch"].tobytes(), np.zeros(2)), suite_episodes(suite, ("both", "30")))
    assert felt["verdicts"]["touch"].startswith("The policy uses touch")
    assert felt["verdicts"]["vision"].startswith("The policy does not use vision")
    changes = {row["kind"]: row["error"][0] for row in felt["rows"] if row["sense"] == "touch"}
    assert felt["error"][0] == 0 and changes["10 frames ago"] == 0  # the grasp does not change
    assert all(changes[kind] > 0.6 for kind in ("another episode", "mean frame", "noise"))
    blind = ablate(lambda o: [5.0 + o["state"][0], 0.0], suite_episodes(suite, ("both", "30")))
    assert blind["verdicts"]["touch"].startswith("The policy does not use touch") and blind["error"][0] > 0.8
    assert felt["error"][1] == 0 < felt["error"][2] < 1 and blind["error"][1] > 0 and blind["error"][2] <= 1


def test_a_film_without_touch_comes_after_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = replace(find_suite("insert-v1"), episodes=3, demonstrations=(4,))
    monkeypatch.setattr("mvitac.cli.ablate.find_suite", lambda name: suite)
    (policy := tmp_path / "still.py").write_text("act = lambda given: [0.0, 0.0]")
    command = ["ablate", f"{policy}:act", "--data", "insert-v1/vision/4", "--out"]
    assert main([*command, str(tmp_path / "film.png")]) == 2 and "name of a .webp" in capsys.readouterr().err
    film = tmp_path / "new" / "film.webp"
    assert main([*command, str(film)]) == 0 and capsys.readouterr().out.endswith(f"written: {film}\n")
    with Image.open(film) as made:
        assert made.n_frames == 18


def test_film_and_learned_policy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    suite = replace(find_suite("insert-v1"), episodes=3, demonstrations=(4,))
    episodes = suite_episodes(suite, ("touch", "4"))
    result = ablate(suite_policy(suite, ("touch", "4"), "pixels"), episodes)
    assert [row["sense"] for row in result["rows"]] == ["touch"] * 4 and result["unit"] == "failures"
    pictures = film(episodes, [("expert", None, ""), ("none", lambda o: [0.0, 0.0], "mean frame")])
    (tmp_path / "a.webp").write_bytes(webp(pictures))
    with Image.open(tmp_path / "a.webp") as made:
        assert made.n_frames == 18 and made.size == (288, 288)
    for text, out, why in (
        ("insert-v2/touch/30", "b.webp", "--data insert-v2/touch/30 is neither a pack's folder, nor a suite"),
        ("insert-v1/touch/31", "b.webp", "unknown task and condition"),
        (".", "b.webp", "--out is a film of a suite"),
        ("insert-v1/touch/30", "a.webp/b.webp", "cannot be written"),
    ):
        assert main(["ablate", "pixels", "--data", text, "--out", str(tmp_path / out)]) == 2
        assert why in capsys.readouterr().err


def test_command(pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def policy(o):\n    return [o['touch'].mean() - 60, o['step']]\n")
    assert main(["ablate", f"{file}:policy", "--data", str(pack.path), "--json", str(tmp_path / "a.json")]) == 0
    printed = capsys.readouterr().out
    assert "The policy uses touch" in printed and re.search(r"\+0\.00 +\+0\.00 *\n", printed)  # of the camera
    assert '"verdicts"' in (tmp_path / "a.json").read_text()
    for code, says in (
        ("return [0.0]", "gives 1 numbers"),
        ("return [np.nan, 0]", "gives [nan 0.] in step 0 of episode 1"),
        ("return [0, -1e308]", "in step 0 of episode 1: give finite numbers below 1e+60"),
        ("seen.append(0)\n    return [1e-4 * len(seen), o['step']]", "acts differently on the same episodes"),
        ("sys.exit(0)", "fails (SystemExit: 0)"),
        ("...\npolicy.reset = lambda: 1 / 0", "(ZeroDivisionError: division by zero) when reset before episode 1"),
    ):
        file.write_text(f"import sys, numpy as np\nseen = []\ndef policy(o):\n    {code}\n")
        assert main(["ablate", f"{file}:policy", "--data", str(pack.path)]) == 2 and says in capsys.readouterr().err
    file.write_text("import nothing_such\n")
    with pytest.raises(ValueError, match=r"mine.py:policy cannot be imported \(ModuleNotFoundError: .*nothing_such"):
        open_policy(f"{file}:policy")
    file.write_text("def policy(o): ...\n")
    with pytest.raises(ValueError, match="has no function 'other'"):
        open_policy(f"{file}:other")
