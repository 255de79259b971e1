"""The doctor on values: a healthy recording is called healthy, and each fault by its name and nothing else."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvitac.data.build import build
from mvitac.data.checks import value_checks
from mvitac.data.checks.examine import examine
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Target, ValueTask
from support.toy import with_columns

NUM, LENGTH = 16, 40
TEST = (3, 7, 11, 15)


@dataclass
class Recordings(Source):
    """16 objects, each pressed for 40 frames at 10 Hz: force rises to some 3 N and falls. ``fault`` breaks one thing."""

    fault: str = ""

    def spec(self) -> DataSpec:
        force = ValueTask(name="force", targets=(Target(name="force_n", unit="N"),))
        tilt = ValueTask(name="pose", targets=(Target(name="tilt", unit="rad"),))
        about: Any = {"group_by": "object", "licence": "none", "source": "tests/data/checks/test_value_checks.py"}
        channels: Any = {"vision_channels": 0, "touch_channels": 3}
        return DataSpec(name="recordings", tasks=(), values=(force, tilt), **channels, **about)

    def items(self) -> list[str]:
        return [f"{k} {i}" for k in range(NUM) for i in range(LENGTH)]

    def fingerprint(self) -> dict[str, Any]:
        return {"recordings": self.fault}

    def read(self, item: int) -> list[Sample]:
        (k, i), fault = divmod(item, LENGTH), self.fault
        rng = np.random.default_rng([11, item])
        force = 0.2 + (2.5 + 0.1 * (k // 2 % 4)) * np.sin(np.pi * i / LENGTH) + 0.01 * rng.normal()
        tilt = 0.3 * np.sin(k + i / 5)
        if "placeholder" in fault and i % 8 == 5:
            force = -1.0 if item > 5 or fault == "placeholder" else -999.0
        if fault == "outlier" and i == 5:
            force = -999.0
        if fault == "stuck" and k == 4 and 10 <= i < 24:
            force = 2.0
        if fault == "outside" and k == 7:
            force += 2
        if (fault == "missing" and i % 4 == 0) or (fault == "no test" and k in TEST):
            force = float("nan")
        columns = {"id": f"{k:02d}-{i:02d}", "group": str(k), "touch_group": str(k), "seq": i}
        columns |= {"split": "test" if k in TEST else "train", "force_n": force, "tilt": tilt}
        return [Sample(vision=None, touch=rng.integers(0, 255, (16, 16, 3), np.uint8), columns=columns)]


def packed(path: Path, fault: str = "") -> Pack:
    return build(Recordings(fault), path, size=16, workers=1, quiet=True)


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return packed(tmp_path_factory.mktemp("healthy") / "pack")


def test_healthy_values(healthy: Pack) -> None:
    found = {finding.item: finding for finding in examine(healthy)}
    values = found["values of force"], found["values of pose"]
    assert all(finding.verdict == "ok" for finding in values), values
    assert "640 rows, 0.1" in values[0].evidence and " N, median" in values[0].evidence
    few = np.random.default_rng(0).normal(size=(2, 15))  # of which some lag would fit by chance
    assert not value_checks._shift(*few, np.arange(15))[1].any()


@pytest.mark.parametrize(
    ("fault", "item", "says", "rows"),
    [
        ("outlier", "values of force", "16 outliers, e.g. -999 in row 00-05 ", [5, 45]),
        ("placeholder", "values of force", "80 of 640 (12.5 %) rows have -1 exactly", [5, 13]),
        ("stuck", "values of force", "1 constant stretches, the longest 14 frames of 2 from row 04-10", [170]),
        ("outside", "values of force", "test rows are outside train (0.1", []),
    ],
)
def test_each_fault_is_found_and_no_other(tmp_path: Path, fault: str, item: str, says: str, rows: list[int]) -> None:
    found = {finding.item: finding for finding in value_checks.values(packed(tmp_path / "pack", fault))}
    assert found[item].verdict == "look" and says in found[item].evidence, found[item]
    assert set(rows) <= set(found[item].rows) and [f.item for f in found.values() if f.verdict != "ok"] == [item]
    assert ";" not in found[item].advice  # one thing to do


def test_an_outlier_hides_no_placeholder(tmp_path: Path) -> None:
    (force, _) = value_checks.values(packed(tmp_path / "pack", "placeholder, outlier"))
    assert "1 outliers, e.g. -999" in force.evidence and "79 of 639 (12.4 %) rows have -1 exactly" in force.evidence


def test_two_recordings_in_one_touch_hide_no_stuck_sensor_of_another(tmp_path: Path) -> None:
    pack = packed(tmp_path / "pack", "stuck")
    together = ["0" if name == "1" else name for name in pack.column("touch_group")]
    assert "1 constant stretches" in value_checks.values(with_columns(pack, touch_group=together))[0].evidence


def test_val_is_not_train(tmp_path: Path) -> None:
    pack = packed(tmp_path / "pack", "outside")
    halved = ["val" if split == "test" and i % 2 else split for i, split in enumerate(pack.column("split"))]
    assert "test rows are outside train (0.1" in value_checks.values(with_columns(pack, split=halved))[0].evidence


def test_missing_values(tmp_path: Path) -> None:
    (force, _) = value_checks.values(packed(tmp_path / "a", "missing"))
    assert force.verdict == "ok" and "160 of 640 (25.0 %) rows of train, val and test have none" in force.evidence
    (force, _) = value_checks.values(packed(tmp_path / "b", "no test"))
    assert force.verdict == "broken" and "no row of test has a value" in force.evidence
    scored = with_columns(pack := packed(tmp_path / "c", "missing"), split=["test"] * pack.num)  # to be scored alone
    assert value_checks.values(scored)[0].verdict == "look"


def test_a_stretch_of_zeros_is_no_contact(healthy: Pack) -> None:
    force = healthy.column("force_n")
    for value in (0, 1):
        force[:15] = value
        found = value_checks.values(with_columns(healthy, force_n=force.copy()))[0]
        assert ("constant" in found.evidence) == bool(value)
