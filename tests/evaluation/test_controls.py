"""The parts that controls and probes are made of, against arithmetic."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mvitac.data.spec import DataSpec
from mvitac.evaluation.classifiers import fit_knn, fit_linear
from mvitac.evaluation.controls import borders, controls_of, frozen_trunks, imagenet_trunk, starts_of, thumbnails
from mvitac.methods.supervised import SupervisedConfig
from mvitac.model_files import fresh
from mvitac.nn.encoders import SCRATCH, EncoderConfig, Encoders
from mvitac.recipes import recipe, with_method
from mvitac.run import Run
from mvitac.transforms.random_views import ViewAugment
from support.toy import Toy, toy_pack


def pictures(*images: np.ndarray) -> Any:
    return SimpleNamespace(images={"touch": np.stack(images)})


def test_a_thumbnail_is_the_mean_of_its_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 255, (32, 32, 6), np.uint8)
    found = thumbnails(pictures(image), "touch", np.array([0]), side=8)
    blocks = image.reshape(8, 4, 8, 4, 6).mean((1, 3)) / 255
    assert np.allclose(found[0], blocks.transpose(2, 0, 1).ravel(), atol=1e-6)


def test_the_border_sees_nothing_of_the_middle() -> None:
    """Two of sixteen thumbnails deep: the outer four of 32 pixels."""
    plain = np.full((32, 32, 3), 7, np.uint8)
    middle, edge = plain.copy(), plain.copy()
    middle[4:-4, 4:-4] = 200
    edge[16, 3] = 200
    found = borders(pictures(plain, middle, edge), "touch", np.arange(3))
    assert found.shape == (3, 3 * (16 * 16 - 12 * 12))
    assert np.array_equal(found[0], found[1]) and not np.array_equal(found[0], found[2])


def test_frozen_trunks_are_imagenet_and_files_that_runs_started_from() -> None:
    run = replace(recipe("smoke"), encoder=Encoders.both(trunk="mvitac_tiny", weights=SCRATCH))
    started = replace(run, encoder=run.encoder.changed(weights="b.pth"))
    found = frozen_trunks([run, started, started])
    assert [name for name, _ in found] == ["imagenet", "start"] and found[1][1].encoder == started.encoder
    large = replace(started, augment=replace(run.augment, whole=48))
    assert frozen_trunks([run, large])[1][1].augment.whole_of("touch") == 48  # as that run saw them
    (_, control), *rest = frozen_trunks([run])
    assert not rest and {control.encoder[m].trunk for m in ("vision", "touch")} == {"tf_efficientnet_lite0"}
    assert {control.augment.whole_of(m) for m in ("vision", "touch")} == {128}


def test_the_features_of_a_locked_tower_are_kept_once_for_the_run_and_its_control() -> None:
    base = recipe("smoke")
    locked = EncoderConfig(trunk="tf_efficientnet_lite0", locked=True)
    fixed = ViewAugment(scale=(1.0, 1.0), flip=0.0, grayscale=0.0, size=128)
    run = replace(
        base, encoder=replace(base.encoder, vision=locked), augment=replace(base.augment, size=32, vision=fixed)
    )
    spec = Toy(4).spec()
    model, control = (fresh(each, spec, 40) for each in (run, frozen_trunks([run])[0][1]))
    keys = {m: {each.features_key(m) for each in (model, control)} for m in ("vision", "touch")}
    assert len(keys["vision"]) == 1 and len(keys["touch"]) == 2


def test_the_runs_own_trunk_is_the_imagenet_control_where_its_weights_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvitac.nn.imagenet.source", lambda trunk: "cache" if trunk == "resnet18" else "")
    found = imagenet_trunk(EncoderConfig(trunk="resnet18", weights=SCRATCH, locked=True))
    assert found == EncoderConfig(trunk="resnet18")
    assert imagenet_trunk(EncoderConfig(trunk="mvitac_tiny", weights=SCRATCH)) is None


def test_neighbours_are_by_cosine_and_vote_in_shares() -> None:
    x, y = np.array([[1.0, 0.0], [0.0, 10.0]]), np.array([0, 2])
    shares = fit_knn(x, y, 3)(np.array([[3.0, 4.0]]))[0]  # nearer to the first, but turned towards the second
    assert shares[2] / shares[0] == pytest.approx(np.exp((0.8 - 0.6) / 0.07), rel=1e-4)
    assert shares.sum() == pytest.approx(1) and shares[1] == 0


def test_classes_never_seen_get_probability_zero() -> None:
    x, y = np.array([[-1.0], [-0.9], [0.9], [1.0]]), np.array([0, 0, 2, 2])
    found = fit_linear(x, y, x, y, 4)[0](np.array([[1.0]]))[0]
    assert found[2] > found[0] > 0 and found[[1, 3]].tolist() == [0, 0] and found.sum() == pytest.approx(1)


def modalities_of(runs: list[Run], spec: DataSpec) -> list[tuple[str, int]]:
    return [(run.method.name, run.seed) for run, _ in starts_of(runs, [spec] * len(runs))]


def test_an_untrained_trunk_stands_beside_every_modality_and_search() -> None:
    """Whatever the order of the runs, the control is of one that has all the others have."""
    base = replace(recipe("smoke"), encoder=Encoders.both(trunk="mvitac_tiny", weights=SCRATCH))
    spec, again = Toy().spec(), replace(base, seed=1)
    touch, vision = (replace(base, method=SupervisedConfig(modalities=(m,))) for m in ("touch", "vision"))
    apart = with_method(base, "simclr")  # both modalities, no space that they share
    for runs in ([touch, apart, base], [base, apart, touch], [apart, touch, base]):
        assert modalities_of(runs, spec) == [("mvitac", 0)]
    assert modalities_of([base, again, touch], spec) == [("mvitac", 0), ("mvitac", 1)]
    assert [run for run, _ in starts_of([touch, vision, touch], [spec] * 3)] == [touch, vision]


def test_the_untrained_trunk_is_of_the_runs_own_data(tmp_path: Path) -> None:
    """A classifier of ``bright`` and a method of pairs, probed on touch alone without that label."""
    pack = toy_pack(tmp_path / "p", num=60, vision_channels=0)
    base = replace(recipe("smoke"), encoder=Encoders.both(trunk="mvitac_tiny", weights=SCRATCH))
    runs = [replace(base, method=SupervisedConfig(tasks=("bright",))), with_method(replace(base, seed=1), "ssvtp")]
    pack.spec, own = replace(pack.spec, tasks=pack.spec.tasks[:1]), Toy().spec()
    records, retrieval = controls_of(runs, pack, pack.spec.tasks, ["touch"], ["knn"], specs=[own, own])
    assert {r["seed"] for r in records if r["source"] == "untrained"} == {0, 1} and not retrieval
