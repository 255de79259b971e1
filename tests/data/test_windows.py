"""Windows: several frames of a touch as one row, by index, never across its edge."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.data.source import Sample, Source
from mvitac.data.spec import DataSpec, Task, Window
from mvitac.data.windows import windowed
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.methods.ssvtp import SSVTPConfig
from mvitac.model import load
from mvitac.nn.encoders import PerFrame
from mvitac.recipes import recipe
from mvitac.training.loop import train
from mvitac.training.sampler import draw_positives
from mvitac.transforms.random_views import Augment
from support.toy import with_columns
from support.training_runs import train_twice

TOUCHES, LENGTH = 8, 6


class Presses(Source):
    """Touch t has six frames, in mixed order; frame f is gray level 10 + 20 t + 2 f. Frame 3 of touch 1 is missing."""

    order: tuple[int, ...] = (3, 0, 5, 1, 4, 2)

    def spec(self) -> DataSpec:
        known: Any = {"vision_channels": 3, "touch_channels": 3, "group_by": "object", "licence": "", "source": ""}
        return DataSpec(name="presses", tasks=(Task(name="late", classes=("early", "late")),), **known)

    def items(self) -> list[str]:
        return [f"{t}-{f}" for f in self.order for t in range(TOUCHES) if (t, f) != (1, 3)]

    def fingerprint(self) -> dict[str, Any]:
        return {"presses": 1}

    def read(self, item: int) -> list[Sample]:
        name = self.items()[item]
        touch, frame = map(int, name.split("-"))
        image = np.full((16, 16, 3), 10 + 20 * touch + 2 * frame, np.uint8)
        split = ("train", "train", "val", "test")[touch % 4]
        columns = {"id": name, "group": f"o{touch}", "touch_group": f"t{touch}", "split": split, "frame": frame}
        return [Sample(vision=image, touch=image, columns={**columns, "label_late": int(frame >= 3)})]


@pytest.fixture(scope="module")
def presses(tmp_path_factory: pytest.TempPathFactory) -> Pack:
    return build(Presses(), tmp_path_factory.mktemp("presses") / "pack", size=16, workers=1, quiet=True)


def shown(pack: Pack, touch: int, frame: int, modality: str = "touch") -> list[int]:
    (row,) = np.flatnonzero((pack.column("touch_group") == f"t{touch}") & (pack.column("frame") == frame))
    return ((pack.images[modality][row][0, 0, ::3].astype(int) - 10 - 20 * touch) // 2).tolist()


def test_a_window_shows_this_frame_and_earlier_ones_of_the_same_touch(presses: Pack) -> None:
    pack = windowed(presses, Window(frames=3))
    assert shown(pack, 2, 5) == [5, 4, 3] and shown(pack, 2, 1) == [1, 0, 0]  # the first repeats
    assert shown(pack, 1, 5) == [5, 4, 2]  # frame 3 is missing: the one before it
    assert shown(pack, 2, 5, "vision") == [5]
    assert shown(windowed(presses, Window(frames=3, stride=2)), 4, 5) == [5, 3, 1]
    assert pack.images["touch"].shape == (presses.num, 16, 16, 9)
    assert pack.spec.channels("touch") == 9 and pack.spec.channels("vision") == 3
    rows = np.random.default_rng(0).permutation(presses.num)  # frames are found by their place, not by their row
    assert np.array_equal(pack.images["touch"][rows], [pack.images["touch"][int(row)] for row in rows])


def test_rows_at_the_start_can_be_left_out_and_the_first_frame_subtracted(presses: Pack) -> None:
    pack = windowed(presses, Window(frames=3, short="leave-out"))
    assert sorted(set(pack.column("frame")[pack.rows("train", "val", "test")].tolist())) == [2, 3, 4, 5]
    assert len(windowed(presses, Window(frames=3)).rows("train", "val", "test")) == presses.num
    pack = windowed(presses, Window(frames=2, minus_first=True))
    for row in range(presses.num):
        assert (pack.images["touch"][row][..., :3] == 128 + int(pack.column("frame")[row])).all()


def test_other_windows_are_other_data_and_single_frames_are_the_pack_itself(presses: Pack) -> None:
    digests = {windowed(presses, Window(frames=f, stride=s)).digest for f, s in ((1, 1), (2, 1), (3, 1), (3, 2))}
    digests.add(windowed(presses, Window(frames=2, short="leave-out")).digest)
    assert len(digests) == 5 and presses.digest in digests and windowed(presses, Window()) is presses
    ordered = windowed(presses, Window(order="label_late"))  # kept for positives
    assert ordered.spec.window.order == "label_late" and ordered.digest == presses.digest


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 3, "stride": 4.0}, "longer than every touch"),
        ({"frames": 3, "stride": 0.5}, "give more, or another"),
        ({"frames": 2, "order": "split"}, "not a number in row 0"),
        ({"frames": 2, "order": "label_late"}, "two rows of touch"),
        ({"order": "frame", "minus_first": True}, "every touch has one row, its own first"),
    ],
)
def test_windows_that_cannot_be_made(presses: Pack, options: dict[str, Any], message: str) -> None:
    if "minus_first" in options:
        presses = with_columns(presses, touch_group=[*map(str, range(presses.num))])
    with pytest.raises(ValueError, match=message):
        windowed(presses, Window(**options))


@pytest.mark.parametrize("temporal", ["stack", "mean"])
def test_a_window_trains_probes_and_reloads(presses: Pack, tmp_path: Path, temporal: str) -> None:
    run = recipe("smoke", PackConfig(path=presses.path, num_frames=2))
    run = replace(run, steps=2, batch_size=8, eval_every=0, augment=Augment(size=16))
    run = replace(run, encoder=run.encoder.changed(temporal=temporal))
    model = load(out := train(run, tmp_path / "run", quiet=True))
    assert model.spec.frames("touch") == 2 and model.spec.frames("vision") == 1
    result = probe_runs([out], ProbeConfig(controls=False))
    assert {record["modality"] for record in result["records"]} == {"touch", "vision", "both"}
    on = probe_runs([out], ProbeConfig(controls=False), Pack(presses.path), allow_leak=True)  # --on: the run's windows
    assert on["pack"] == result["pack"] and on["records"] == result["records"]
    embedded = tmp_path / "touch.parquet"
    assert main(["embed", str(presses.path), "--model", str(out), "--out", str(embedded)]) == 0
    found = np.stack(pq.read_table(embedded).column("touch").to_numpy())
    assert found.shape == (presses.num, model.encoders["touch"].num_features)
    assert not isinstance(model.encoders["vision"], PerFrame)
    assert isinstance(model.encoders["touch"], PerFrame) == (temporal != "stack")


def test_positives_can_be_near_in_time(presses: Pack, tmp_path: Path) -> None:
    rows = np.repeat(np.arange(presses.num), 30)
    found = draw_positives(presses, rows, torch.Generator().manual_seed(0), within=2)
    away = (presses.column("frame")[found] - presses.column("frame")[rows]).astype(int)
    assert np.array_equal(presses.touch_groups[found], presses.touch_groups[rows])
    assert set(away[presses.column("frame")[rows] == 0].tolist()) == {1, 2} and set(away.tolist()) == {-2, -1, 1, 2}
    assert (np.abs(draw_positives(presses, rows, torch.Generator().manual_seed(0)) - rows) > 0).all()
    alone = draw_positives(presses, rows, torch.Generator().manual_seed(0), within=0.5)
    assert np.array_equal(alone, rows)  # no frame is as near

    run = recipe("smoke", PackConfig(path=presses.path, num_frames=2))
    run = replace(run, steps=6, batch_size=8, eval_every=0, augment=Augment(size=16), checkpoint_every=2)
    near = replace(run, positives="same-touch", positives_within=1.0)
    assert near.digest() != run.digest()
    train_twice(near, tmp_path, cut=3)


def test_frames_without_an_order_are_refused_and_positives_near_in_time_that_cannot_be(
    presses: Pack, pack: Pack, tmp_path: Path
) -> None:
    for order, says in ((None, "frame, seq, time"), ("frame", "frame"), ("fram", "fram")):
        with pytest.raises(ValueError, match=f"{pack.path} has no {says} to order frames: name another"):
            windowed(pack, Window(frames=2, order=order))
    run = recipe("smoke", PackConfig(path=presses.path))
    with pytest.raises(ValueError, match="no effect on same-image positives"):
        replace(run, positives="same-image", positives_within=2.0)
    unordered = replace(run, data=PackConfig(path=pack.path), positives="same-touch", positives_within=2.0)
    of_one = replace(unordered, data=run.data, method=SSVTPConfig(), augment=Augment(size=16))
    with pytest.raises(ValueError, match="no effect on method ssvtp, one view of each"):
        train(of_one, tmp_path / "run", quiet=True)
    with pytest.raises(ValueError, match="has no frame, seq, time to order frames"):
        train(unordered, tmp_path / "run", quiet=True)
    two = with_columns(presses, frame=[0] * presses.num)  # two recordings in one touch
    with pytest.raises(ValueError, match=r"two rows of touch .* are at 0: pack with --touch-group"):
        train(unordered, tmp_path / "run", quiet=True, pack=two)
    assert not (tmp_path / "run" / "run.json").exists()
