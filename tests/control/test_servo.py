"""Following edges and surfaces: poses and corrections agree, results repeat, and changed results are refused."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mvitac.bench.encoder import About
from mvitac.bench.external import open_model
from mvitac.cli.main import main
from mvitac.control import result
from mvitac.control.result import find_suite
from mvitac.control.servo import TASKS, Edge, Surface, presses, task_of, textures
from mvitac.control.servo_rows import Condition, Episode, Servo
from mvitac.control.suite import Row, rows_of, score
from mvitac.system.files import digest
from support.forged_packs import changed, put

RANDOM = "external:timm/test_resnet,weights=random,size=32,seed={}"
KINDS = [kind for task in TASKS.values() for kind in task.kinds]


def begin(kind: str, number: int, condition: str = "known sensor") -> Episode:
    return find_suite("servo-v1").world(kind, condition, number)  # type: ignore[return-value]


@pytest.fixture(scope="module")
def small() -> Servo:
    few: Any = {"shapes": 2, "steps": 6, "settle": 2, "fit_shapes": 6, "fit_presses": 4, "fit_val": 2, "train_steps": 2}
    texts = tuple(map(RANDOM.format, range(2)))
    late = (Condition(name="known sensor"), Condition(name="late", latency_ms=50, new_sensor=True))
    return replace(find_suite("servo-v1"), name="small-v1", **few, untrained=texts, conditions=late)  # type: ignore[return-value]


@pytest.fixture(scope="module")
def done(small: Servo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return result.run_suite([RANDOM.format(5)], small, tmp_path_factory.mktemp("servo"), About(name="five"))


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch, small: Servo) -> None:
    monkeypatch.setattr(result, "find_suite", lambda name: small if name == small.name else find_suite(name))
    monkeypatch.setattr(result, "shipped", lambda: [small.name, "servo-v1"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_correction_changes_the_pose_by_itself(kind: str) -> None:
    task = task_of(kind)
    start = begin(kind, 1)
    change = np.array([0.1, 2.0, -3.0])[: len(task.names)]
    moved, still = (task.moved(start.shape, start.states[-1], c) for c in (change, 0 * change))
    difference = task.pose(start.shape, moved) - task.pose(start.shape, still)
    assert np.allclose(difference, change, atol=[0.02, *[0.3] * (len(change) - 1)])


def test_poses_mean_what_their_names_say() -> None:
    assert np.allclose(Edge.pose(begin("straight", 0).shape, np.array([7.0, 1.5, np.radians(-20)])), [1.5, 20])
    wavy = begin("surface", 0).shape
    at = Surface.state(wavy, np.array([0.4, 3.0, -2.0]), 12.0)
    assert np.allclose(Surface.pose(wavy, at), [0.4, 3.0, -2.0])
    step = np.array([1e-3, -1e-3])
    slope = np.diff(wavy.height(12 + step, np.zeros(2)))[0] / -2e-3  # the tilt is what the surface adds to the gel's
    assert np.degrees(np.arctan(slope) - np.arctan(at[2])) == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_true_pose_stays_on_and_no_touch_does_not(kind: str) -> None:
    for known in (True, False):
        errors = []
        for number in range(8):
            episode = begin(kind, number)
            for _ in range(60):
                episode.step(-0.5 * (episode.poses[-1] - task_of(kind).target) * known)
            errors.append(episode.error[0])
        assert (np.mean(errors) < 0.15) == known


@pytest.mark.parametrize("kind", KINDS)
def test_contact_is_lost_beyond_the_limit_and_stays_lost(kind: str) -> None:
    for part in (0.8, 1.3):
        limit = (episode := begin(kind, 1)).task.limit
        episode.step(episode.task.target + part * limit * (np.arange(len(limit)) == 0) - episode.poses[-1])
        there, mm, deg = episode.states[-1], *episode.error
        assert episode.lost == (part > 1) and (mm == limit[0]) == (part > 1)
        episode.step(episode.task.target - episode.poses[-1])
        assert (episode.states[-1] is there) == episode.lost == (part > 1)
        assert not episode.lost or episode.error == (mm, deg) == (limit[0], np.hypot.reduce(limit[1:]))


def test_pictures_show_the_pose_and_repeat() -> None:
    one, other, late = (begin("straight", 2, name) for name in ("known sensor", "new sensor", "50 ms"))
    assert np.array_equal(one.look("touch"), one.look("touch"))
    assert not np.array_equal(one.look("touch"), other.look("touch"))
    assert np.array_equal(one.states[0], other.states[0])
    before = one.look("touch")
    one.step(np.array([1.0, 0.0]))
    assert np.abs(one.look("touch").astype(float) - before).mean() > 1
    late.step(np.array([1.0, 0.0]))
    assert np.array_equal(late.look("touch"), before) and not np.array_equal(late.known, late.poses[-1])
    assert not set(textures(True)) & set(textures(False)) and textures(False)


def test_presses_cover_what_probes_need() -> None:
    for name, task in TASKS.items():
        poses = np.concatenate([presses(name, 0, 8, number)[1] for number in range(3)])
        assert (np.abs(poses - task.target) < 1.25 * task.reach).all() and (poses.std(0) > task.reach / 4).all()


def test_a_result_repeats(done: Path, small: Servo, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, value = result.read_control(done)
    torch.manual_seed(7)  # whatever was drawn before
    _, again = result.read_control(result.run_suite([RANDOM.format(5)], small, tmp_path, About(name="five")))
    assert value["digest"] == again["digest"]
    scores = result.scores([value])
    assert {"five", "true pose", "no touch", "pixels", "untrained", "end to end", "touch shuffled"} <= scores.keys()
    for key in scores["pixels"]:
        assert sum(scores["true pose"][key][0]["mm"]) < sum(scores["no touch"][key][0]["mm"])
    assert [cell["seed"] for cell in scores["untrained"]["surface", "late"]] == [0, 1]
    with pytest.raises(ValueError, match=r"is the result of .*, weights "):
        result.run_suite([RANDOM.format(6)], small, tmp_path, About(name="five"))
    assert main(["bench", "check", str(done)]) == 0
    assert main(["bench", "board", str(done), "--out", str(tmp_path / "board.html")]) == 0
    assert "true pose" in (text := (tmp_path / "board.html").read_text()) and "data:image/webp;base64," in text
    assert f"{len(value['rows'])} rows hold" in capsys.readouterr().out


def _late(value: dict[str, Any]) -> None:
    value["suite"]["conditions"][1]["latency_ms"] = 0
    value["suite_digest"] = digest(value["suite"])


def _twin(value: dict[str, Any]) -> None:
    first, second = (row for row in value["rows"] if row["source"] == "untrained")
    second["cells"] = first["cells"]


def _copied(value: dict[str, Any]) -> None:
    first, second = value["rows"][0]["cells"][:2]
    second |= {key: first[key] for key in ("mm", "deg", "lost")}


def _not_lost(value: dict[str, Any]) -> None:
    cell = value["rows"][BLIND]["cells"][0]
    limit, n = task_of(cell["task"]).limit, cell["n"][0]
    cell["mm"][0], cell["deg"][0] = n * limit[0], n * float(np.hypot.reduce(limit[1:]))


TRUE, BLIND = -3, -2  # places of the rows "true pose" and "no touch"
_PERFECT = {"mm": [0.0] * 2, "deg": [0.0] * 2, "lost": [0.0] * 2}
CHANGES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no episodes give": put("rows", 0, "cells", 0, "mm", 0, value=-1.0),
    "no touch, .* no episodes give": _not_lost,
    "the encoder, .* no episodes give": lambda value: value["rows"][0]["cells"][0].update(_PERFECT),
    "no digests of what": put("data", "edge", value=None),
    "other sums here": put("rows", TRUE, "cells", 3, "mm", 0, value=lambda mm: mm + 0.5),
    "the suite asks for": lambda value: value["rows"].pop(3),
    "not of this version's": _late,
    "other tasks": lambda value: value["rows"][0]["cells"].pop(),
    "this version reads 1": lambda value: value.update(format_version=2),
    "the name of a control": lambda value: value["encoder"].update(name="true pose"),
    "has the unknown field 'film'": put("film", value=1),
    "has the unknown field 'score'": put("rows", 0, "cells", 0, "score", value=1.0),
    "its sums are not of": lambda value: value["rows"][0]["cells"][0]["mm"].pop(),
    "the encoder, seed 5, .* has the sums of the encoder, seed 5": _copied,
    "no touch, .* sees nothing, and does otherwise": put("rows", BLIND, "cells", 1, "mm", 0, value=lambda mm: mm + 0.1),
    "a sum is no number": put("rows", 0, "cells", 0, "mm", 0, value="1.0"),
    "untrained, seed 1, .* has the sums of untrained, seed 0": _twin,
}


@pytest.mark.parametrize("why", CHANGES)
def test_changed_results_are_refused(done: Path, tmp_path: Path, why: str) -> None:
    with pytest.raises(ValueError, match=r"does not match its digest|this version reads 1"):
        result.read_control(changed(done, tmp_path / "changed.json", CHANGES[why], signed=False))
    with pytest.raises(ValueError, match=why):
        result.read_control(changed(done, tmp_path / "changed.json", CHANGES[why]))


def test_constant_features_are_no_copies(done: Path, tmp_path: Path) -> None:
    blind = json.loads(done.read_text())["rows"][BLIND]["cells"]
    path = changed(done, tmp_path / "constant.json", put("rows", 0, "cells", value=blind))
    assert result.read_control(path)[1] == json.loads(path.read_text())


def measured(name: str, *rows: tuple[str, int | None, float]) -> dict[str, Any]:
    cell = {"task": "straight", "condition": "late", "n": [4.0] * 8, "deg": [0.0] * 8, "lost": [0.0] * 8}
    cells = ({"source": s, "seed": k, "cells": [cell | {"mm": [4 * mm] * 8}]} for s, k, mm in rows)
    return {"rows": list(cells), "encoder": {"name": name}}


def test_a_star_is_over_shapes_and_seeds(small: Servo) -> None:
    """Untrained trunks that differ among themselves as much as from the row are no evidence, however alike their shapes."""

    def marked(untrained: tuple[float, float]) -> bool:
        rows = (("untrained", seed, mm) for seed, mm in enumerate(untrained))
        known = result.scores([measured("mine", ("pixels", None, 1.0), *rows)])
        return result._cell(small, known, "pixels", ("straight", "late")).endswith("*")

    assert marked((2.0, 2.02)) and not marked((2.0, 1.2))


def test_each_encoder_is_beside_the_controls_of_its_result(small: Servo) -> None:
    own, pixels = ("", 0, 1.0), ("pixels", None, 3.0)
    values = [measured(name, own, ("untrained", 0, mm), pixels) for name, mm in (("far", 2.0), ("level", 1.0))]
    for each in (values, values[::-1]):
        known = result.scores(each)
        texts = {name: result._cell(small, known, name, ("straight", "late")) for name in known}
        assert texts["far"].endswith("*") and not texts["level"].endswith("*")
        assert [name for name in known if ", with" in name] == [f"untrained, with {each[1]['encoder']['name']}"]


def first_look(suite: Servo, source: str, asked: float = 0.0) -> tuple[list[np.ndarray], list[dict[str, Any]]]:
    """What a row sees in the first step of straight edges, and the row's cells if it asks for ``asked`` everywhere."""
    seen: list[np.ndarray] = []

    def learn(images: dict[str, np.ndarray], poses: np.ndarray, num_val: int) -> Any:
        return lambda look: seen.append(look("touch")) or np.full(poses.shape[1], asked)

    cells = score(suite, Row(source, 0, learn))
    return list(seen[0]), cells


def test_a_row_sees_its_own_episode_and_the_shuffled_one_the_next(small: Servo) -> None:
    two = Condition(name="a"), Condition(name="b", new_sensor=True, noise=3.0)
    few = replace(small, steps=1, settle=0, conditions=two)
    plain, cells = first_look(few, "", 1e3)
    shuffled, _ = first_look(few, "touch shuffled")
    for number in range(4):
        episode = few.world("straight", "ab"[number // 2], number % 2)
        assert np.array_equal(plain[number], episode.look("touch"))
        assert np.array_equal(plain[number], shuffled[number ^ 1])
        before = episode.error[0]
        assert abs(cells[number // 2]["mm"][number % 2] - before) < 1.5 * few.most * Edge.limit[0]  # it was bounded


def test_rows(small: Servo) -> None:
    rows = rows_of(small, [open_model(RANDOM.format(seed)) for seed in (5, 6)])
    own = [("", 5), ("", 6), ("pixels", None), ("untrained", 0), ("untrained", 1), ("imagenet", None)]
    rest = [("touch shuffled", 5), ("true pose", None), ("no touch", None), ("end to end", None)]
    assert [(row.source, row.seed) for row in rows if row.source != "imagenet"] == own[:-1] + rest
    assert rows[-4].learn is rows[0].learn and rows[-3].learn is None
    targets = np.array([[1.0, 2.0], [3.0, 8.0]])
    assert rows[-2].learn({}, targets, 1)({}.__getitem__).tolist() == [2.0, 5.0]  # type: ignore[misc]


def test_the_suite_shows_what_was_measured() -> None:
    levels = {"straight": [87.89, 103.34], "curved": [86.86, 102.87]}
    levels |= {"corner": [104.79, 107.80], "surface": [133.27, 112.03]}
    for kind in KINDS:
        seen = [begin(kind, 0, name).look("touch").mean() for name in ("known sensor", "new sensor")]
        assert seen == pytest.approx(levels[kind], abs=0.05)
    images, poses = presses("edge", 0, 2, 0)
    assert images.mean() == pytest.approx(102.91, abs=0.05)
    assert np.allclose(poses, [[-3.011, -14.194], [-1.259, -3.834]], atol=1e-3)
