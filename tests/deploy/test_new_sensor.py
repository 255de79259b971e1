"""An export for a touch sensor that the model never met: in live, its answers are those of the probe in known colours."""

from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.several import JoinedPack
from mvitac.datasets.simulated import Materials, MaterialsConfig
from mvitac.deploy.engine import Engine, about_sensor
from mvitac.deploy.publish import with_probes
from mvitac.evaluation.sensors import RecolouredPack, learn_looks, touch_features, unlabelled_rows
from mvitac.live.cameras import Ended, Source
from mvitac.live.contact import LiveConfig
from mvitac.live.predictor import Live
from mvitac.live.recorder import Recorder
from mvitac.live.streams import Stream
from mvitac.model import Model, load
from mvitac.sim import materials
from mvitac.sim.sensors import SENSORS
from mvitac.training.loop import train
from support.faults import Clock
from support.toy import altered
from support.training_runs import smoke

pytestmark = pytest.mark.slow
OPTION = "--new-sensor"


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    config = MaterialsConfig(num=200, touches=1, size=32, makes=("mini", "digit"))
    return build(Materials(config), tmp_path_factory.mktemp("old") / "pack", size=32, quiet=True)


@pytest.fixture(scope="module")
def new(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    """Simulated touches, of which only those of test keep their split."""
    config, splits = MaterialsConfig(num=100, touches=1, size=32, held_out_sensor=True), {"test": "test"}
    source = altered(Materials(config), lambda s, _: {"split": splits.get(s.columns["split"], "unlabelled")})
    return build(source, tmp_path_factory.mktemp("new") / "pack", size=32, quiet=True)


@pytest.fixture(scope="module")
def run(old: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(smoke(old, steps=4, eval_every=0), tmp_path_factory.mktemp("run") / "run", quiet=True, validate=False)


@pytest.fixture(scope="module")
def model(run: Path, old: Pack) -> Model:
    return with_probes(load(run), old)


@pytest.fixture(scope="module")
def engine(run: Path, old: Pack, new: Pack, tmp_path_factory: pytest.TempPathFactory) -> Engine:
    out = tmp_path_factory.mktemp("export") / "slim"
    assert main(["export", str(run), "--out", str(out), "--on", str(old.path), OPTION, str(new.path)]) == 0
    return Engine(out, threads=1)


def by_the_probe(model: Model, both: Pack, rows: np.ndarray) -> dict[str, np.ndarray]:
    """The answers of the probes on both modalities, on features of ``probe --standardise colours``."""
    z = [touch_features(model, both, m, rows, ("colours",)) for m in ("vision", "touch")]
    x = torch.from_numpy(np.concatenate(z, axis=1))
    return {probe.info.task: probe(x).numpy() for probe in model.probes.values() if probe.info.modality == "both"}


class Played(Source):
    """Frames given beforehand."""

    def __init__(self, frames: list[np.ndarray]) -> None:
        self.left = deque(frames)

    def open(self) -> None:
        pass

    def read(self) -> np.ndarray:
        if not self.left:
            raise Ended
        return self.left.popleft()


def play(engine: Engine, pack: Pack, rows: np.ndarray, **options: Any) -> list[dict[str, np.ndarray]]:
    """The answers of ``Live`` on touch after touch, four frames each, with the free gel between."""
    free = materials.touch(0, 0, 0, 0, size=32, sensors=(SENSORS["slim"],), background=True)["background"]
    given: dict[str, list[np.ndarray]] = {"vision": [], "touch": []}
    for row in rows:
        given["touch"] += [free] * 6 + [pack.images["touch"][row]] * 4
        given["vision"] += [pack.images["vision"][row]] * 10
    clock = Clock()
    streams = {m: [Stream(m, Played(frames), clock=clock)] for m, frames in given.items()}
    live = Live(engine, streams, LiveConfig(calibration=6), clock=clock, **options)
    answers, last = [], None
    while not all(stream.ended for stream in live.all):
        clock.now += 0.1
        for stream in live.all:
            stream.pump()
        live.tick()
        if live.touch is None and live.last is not None and live.last is not last:
            last = live.last
            answers.append({task: total / last.num_frames for task, total in last.totals.items()} | last.values)
    return answers


def test_live_answers_as_the_probe_in_known_colours(engine: Engine, model: Model, old: Pack, new: Pack) -> None:
    both = RecolouredPack(old, new)
    rows = both.rows("test")
    expected = by_the_probe(model, both, rows)
    one_more = np.concatenate([new.rows("test"), new.rows("test")[:1]])  # the last touch never ends
    found = play(engine, new, one_more)[: len(rows)]
    assert len(found) == len(rows) == 20
    assert found[0].keys() == expected.keys() == {"category", "soft", "rough", "force"}
    for task, wanted in expected.items():
        np.testing.assert_allclose([answers[task] for answers in found], wanted, atol=2e-3)
    plain = by_the_probe(model, JoinedPack(old, new), rows)  # as it is: another model
    assert np.abs(plain["rough"] - expected["rough"]).max() > 0.02


def test_a_recording_gives_one_image_of_each_touch(engine: Engine, old: Pack, new: Pack, tmp_path: Path) -> None:
    """Frames of one touch are near-copies: they would make the sign look sure. The colours are those of the images."""
    rows = unlabelled_rows(new, 0, 400)
    recorder = Recorder(tmp_path / "slim", fps=100.0, sensor="slim")
    play(engine, new, rows, record=recorder)
    assert recorder.close() == 10 * len(rows)
    recording = Pack(tmp_path / "slim")
    assert recording.sensor_names == ("slim",)
    found, wanted = (learn_looks(old, pack, OPTION) for pack in (recording, new))
    assert found.about() == wanted.about()
    np.testing.assert_array_equal(found.source.colours, wanted.source.colours)
    images = new.images["touch"][new.rows("test")]
    for one, other in zip(found(images), wanted(images), strict=True):
        np.testing.assert_array_equal(one, other)


def test_live_says_which_sensor_is_new(engine: Engine) -> None:
    def said(name: str, **about: Any) -> str:
        given = {"inputs": engine.inputs, "sensors": ["digit", "mini"], "new_sensor": None}
        return about_sensor(SimpleNamespace(**{**given, **about}), name)

    assert "slim is new to the model, which knows digit, mini: nothing is done" in said("slim")
    assert "which knows none by name" in said("slim", sensors=[])
    assert said("mini") == said("") == said("slim", inputs={"vision": (32, 32, 3)}) == ""
    for name in ("", "slim"):
        assert "slim is new to the model: it is shown in the colours of" in about_sensor(engine, name)
    assert "export the model again for mini" in about_sensor(engine, "mini")
