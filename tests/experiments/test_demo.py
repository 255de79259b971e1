"""What a demo says of a sensor that its encoder never saw."""

from dataclasses import replace
from pathlib import Path

import pytest

from mvitac.datasets.simulated import GraspsConfig, MaterialsConfig
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.experiments.demo import scores_on_new_sensor
from mvitac.recipes import recipe
from mvitac.report.report import write_report
from mvitac.training.loop import train


@pytest.mark.parametrize("images", ["enough", "too few"])
def test_a_new_sensor_stands_beside_the_known_ones(tmp_path: Path, images: str) -> None:
    data = MaterialsConfig(num=160, touches=1, makes=("mini",), size=32, workers=1)
    other = data.on_new_sensor()
    assert other and other.on_new_sensor() is None and GraspsConfig().on_new_sensor() is None
    assert (
        few := MaterialsConfig(num=300).on_new_sensor()
    ) and few.num == 60  # as many instances, or no test instance would be left
    if images == "too few":
        other = replace(other, num=60)
    known, new = data.open(quiet=True), other.open(quiet=True)
    assert new.sensor_names == ("slim",) and "slim" not in known.sensor_names
    run = replace(recipe("smoke", data), steps=1, eval_every=0)
    path = train(replace(run, augment=replace(run.augment, size=16)), tmp_path / "run", quiet=True)
    result = probe_runs([path], ProbeConfig(tasks=("category", "soft"), controls=False), known)
    found = scores_on_new_sensor([path], known, new, result)
    touch = found["summary"]["soft"]["touch"]
    assert touch["known sensors"]["mean"] == result["summary"]["soft"]["touch"]["mvitac"]["mean"]
    seen = ["known sensors", "new sensor, as it is", "new sensor, in known colours"]
    assert list(touch) == (seen if images == "enough" else seen[:2])
    assert bool(found["notes"]) == (images == "too few")
    page = write_report([path], tmp_path / "report", result={**result, "new sensor": found}, pack=known, quiet=True)
    assert "A sensor it never saw" in page.read_text() and ("in known colours: " in page.read_text()) == bool(
        found["notes"]
    )
