"""Simulated grasps: repeatable, physically sane, and 'before' shows nothing."""

import dataclasses
import hashlib

import numpy as np
import pytest

from mvitac.datasets.simulated import GraspsConfig
from mvitac.sim import grasps, objects, physics, skin
from mvitac.sim.sensors import SENSORS

SIZE = 40


def digest(rows: list[dict]) -> str:
    state = hashlib.sha256()
    for row in rows:
        for key in sorted(row):
            value = row[key]
            state.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return state.hexdigest()


def thing(name: str = "box") -> objects.Thing:
    return objects.make_thing(0, objects.KINDS.index(name))


def plan(**change) -> physics.Plan:
    firm = physics.Plan(force_n=6.0, offset_m=(0.0, 0.0, 0.0), yaw=0.0, lift_m=0.05, friction=0.6)
    return dataclasses.replace(firm, **change)


def outcome(some: objects.Thing, some_plan: physics.Plan) -> physics.Moment:
    return list(physics.Bench(some).moments(some_plan))[-1]


def test_a_grasp_repeats_whatever_was_simulated_before_it():
    first = digest(grasps.grasp(3, 5, 7, size=SIZE))
    grasps.grasp(3, 5, 8, size=SIZE)
    grasps.grasp(3, 6, 7, size=SIZE)
    assert digest(grasps.grasp(3, 5, 7, size=SIZE)) == first


def test_every_kind_of_thing_rests_still_before_the_grip():
    for index in range(2 * len(objects.KINDS)):
        bench = physics.Bench(objects.make_thing(1, index))
        before = next(bench.moments(plan()))
        assert np.abs(bench.data.qvel).max() < 0.2, bench.thing.name
        assert not before.unstable


def test_sensors_are_drawn_from_one_side_and_leave_physics_and_camera_alone():
    usual, held_out = (grasps.grasp(0, 8, 2, size=SIZE, held_out_sensor=h) for h in (False, True))
    assert not SENSORS[usual[0]["sensor"]].held_out and SENSORS[held_out[0]["sensor"]].held_out
    assert [row["phase"] for row in usual] == ["before", "during", "after"]
    assert len({row["success"] for row in usual}) == 1
    assert usual[0]["contact_left"] == usual[0]["contact_right"] == 0 < usual[1]["contact_left"]
    for a, b in zip(usual, held_out, strict=True):
        np.testing.assert_array_equal(a["vision"], b["vision"])
        assert (a["success"], a["lift_mm"], a["force_n"]) == (b["success"], b["lift_mm"], b["force_n"])


@pytest.mark.parametrize("kind", ["box", "can", "rod", "capsule", "mug"])
def test_a_firm_centred_grip_holds_and_a_heavy_or_slippery_thing_slips(kind):
    some = thing(kind)
    centred = (0.0, float(some.center_of_mass[1] - np.mean(some.bounds, axis=0)[1]), 0.0)
    assert outcome(some, plan(force_n=10.0, offset_m=centred)).success == 1
    heavy = dataclasses.replace(some, density=some.density * 12 / (some.mass * 9.81))
    assert outcome(heavy, plan(force_n=10.0, offset_m=centred)).success == 0
    assert outcome(some, plan(force_n=0.5 * some.mass * 9.81, offset_m=centred, friction=0.15)).success == 0


def test_forces_balance():
    """Both fingers press with the set force; held, the two gels together carry the weight."""
    some = thing("box")
    # A Bench reuses its state, but what a Moment holds of forces is its own.
    _, during, after = physics.Bench(some).moments(plan(force_n=5.0))
    for touch in (during.left, during.right):
        assert touch.normal_n == pytest.approx(5.0, rel=0.1)
    assert during.left.normal_n == pytest.approx(during.right.normal_n, rel=0.1) and after.success == 1
    carried = after.left.shear_n[1] + after.right.shear_n[1]  # picture rows run downwards
    assert carried == pytest.approx(some.mass * 9.81, rel=0.1) and after.rise_m == pytest.approx(0.05, abs=0.006)


def test_measured_contacts_are_of_each_gel_and_change_no_picture():
    plain, measured = GraspsConfig(num=2, size=32), GraspsConfig(num=2, size=32, contact=True)
    rows = {sample.columns["phase"]: sample for sample in measured.source().read(0)}
    during = rows["during"].columns
    targets = [target for task in measured.source().spec().values for target in task.targets]
    assert all(np.isfinite(during[target.name]) for target in targets)
    assert {target.unit for target in targets} == {"N", "mm", "mm2"} and len(targets) == 14
    for side in ("left", "right"):
        assert 0 < during[f"depth_{side}_mm"] < 3 and 0 < during[f"patch_{side}_mm2"] < grasps.FIELD_MM**2
        assert rows["before"].columns[f"patch_{side}_mm2"] == 0
    for one, other in zip(plain.source().read(0), measured.source().read(0), strict=True):
        assert np.array_equal(one.touch, other.touch) and np.array_equal(one.vision, other.vision)


def test_outcomes_are_mixed_and_the_solver_is_stable():
    results = []
    for index in range(40):
        bench = physics.Bench(objects.make_thing(0, index))
        for i in range(3):
            rng = np.random.default_rng([99, index, i])
            results.append(list(bench.moments(grasps.draw_plan(bench.thing, skin.draw_patch(rng), rng)))[-1])
    assert 0.4 < np.mean([r.success for r in results]) < 0.75 and np.mean([r.unstable for r in results]) < 0.02


def test_peaks_and_pits_differ_in_the_sign_of_their_skewness_and_nothing_else():
    """Heights over a flank: one is the other upside down, so spread is equal and skewness opposite."""
    points = np.stack([np.zeros(4000), *np.random.default_rng(1).uniform(-40, 40, (2, 4000))], 1)
    for draw in range(12):
        patch = dataclasses.replace(skin.draw_patch(np.random.default_rng(draw)), peaks=True)
        peaks, pits = patch.relief_mm(points), dataclasses.replace(patch, peaks=False).relief_mm(points)
        assert np.array_equal(peaks, -pits) and np.mean((peaks - peaks.mean()) ** 3) > 0.2 * peaks.std() ** 3


def test_the_camera_does_not_see_what_the_fingers_slide_on(monkeypatch):
    """Before the fingers close, the picture is the same whether the patch grips or slides."""
    some, seen = skin.draw_patch(np.random.default_rng(0)), {}
    for peaks in (True, False):
        patch = dataclasses.replace(some, peaks=peaks, friction=0.85 if peaks else 0.3)
        monkeypatch.setattr(skin, "draw_patch", lambda rng, patch=patch: patch)
        seen[peaks] = grasps.grasp(0, 2, 0, size=SIZE)
    assert np.array_equal(seen[True][0]["vision"], seen[False][0]["vision"])
    assert not np.array_equal(seen[True][1]["touch_left"], seen[False][1]["touch_left"])


def test_a_lost_solver_is_a_failed_grasp_and_leaves_no_nan():
    bench = physics.Bench(thing("can"))
    bench.model.opt.gravity[2] = -1e6
    last = list(bench.moments(plan()))[-1]
    assert last.unstable == 1 and last.success == 0 and np.isfinite(bench.data.qpos).all()
