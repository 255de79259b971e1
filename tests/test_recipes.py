"""The recipes are what the paper and the released code say, and every run survives its own record."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from mvitac.data.pack import Pack
from mvitac.data.spec import DataSpec, Task
from mvitac.datasets.pack import PackConfig
from mvitac.datasets.simulated import GraspsConfig, MaterialsConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.recipes import RECIPES, recipe, with_method
from mvitac.registry import from_json, to_json
from mvitac.run import Run


def test_paper_constants() -> None:
    """Appendix A and B as printed."""
    run = recipe("paper")
    assert (run.batch_size, run.epochs, run.augment.size) == (256, 240, 224)
    assert (run.optim.name, run.optim.lr, run.optim.betas, run.optim.eps) == ("adam", 0.03, (0.9, 0.999), 1e-7)
    assert (run.optim.weight_decay, run.optim.schedule) == (0, "constant")
    assert (run.encoder.trunk, run.encoder.weights) == ("resnet18.tv_in1k", "imagenet")
    method = run.method
    assert isinstance(method, MViTacConfig)
    assert (method.temperature, method.out, method.dropout, method.head_norm) == (0.07, 128, 0, False)
    for view in (run.augment.vision, run.augment.touch):
        assert (view.scale, view.flip, view.grayscale, view.jitter) == ((0.2, 1.0), 0.5, 0.2, 0)


def test_no_grayscale_for_grasping() -> None:
    grasping = recipe("paper", GraspsConfig()).augment
    assert grasping.touch.grayscale == grasping.vision.grayscale == 0


def test_authors_constants() -> None:
    """https://github.com/ligerfotis/mvitac at commit a5b572d."""
    run = recipe("authors", GraspsConfig())
    method = run.method
    assert isinstance(method, MViTacConfig)
    assert (method.momentum, method.lambda_inter, method.hidden, method.dropout) == (0.99, 1, 2048, 0.5)
    assert (run.optim.lr, run.optim.weight_decay, run.optim.eps, run.optim.schedule) == (1e-3, 1e-6, 1e-8, "late-step")
    assert (run.encoder.stem, run.augment.eval_size, run.optim.decay_norms) == ("random", 256, True)
    assert run.augment.touch.independent_sensors and run.augment.touch.flip == 0.25
    assert run.augment.touch.grayscale == 0.2
    assert (run.batch_size, run.epochs) == (256, 240)


@pytest.mark.parametrize("name", RECIPES)
@pytest.mark.parametrize("data", [MaterialsConfig(num=7), GraspsConfig(seed=3)])
def test_every_recipe_survives_its_record(name: str, data: MaterialsConfig) -> None:
    run = recipe(name, data)
    assert run.recipe == name
    again = Run.load(json.loads(json.dumps(to_json(run))))
    assert again == run
    assert again.digest() == run.digest()
    assert run.__doc__ and RECIPES[name].__doc__


def test_data_is_chosen_by_a_recipe_never_by_the_run_itself() -> None:
    with pytest.raises(TypeError, match="data"):
        Run()  # pyright: ignore[reportCallIssue]
    value = to_json(recipe("smoke"))
    del value["data"]
    with pytest.raises(ValueError, match="field 'data' is missing"):
        Run.load(value)


def test_records_hold_every_setting_digests_only_what_was_there_before() -> None:
    run = recipe("paper")
    assert to_json(run)["augment"]["gel_flip"] == "plain" and to_json(run)["method"]["pairs"] == "crossed"
    value = to_json(run, for_digest=True)
    assert not {"gel_flip"} & value["augment"].keys() and "pairs" not in value["method"]
    assert "noise" not in value["augment"]["vision"] and "noise" in to_json(run)["augment"]["touch"]


def test_digest_is_of_the_outcome() -> None:
    run = recipe("demo")
    assert replace(run, log_every=3, device="cpu").digest() == run.digest()
    assert replace(run, data=replace(run.data, workers=7)).digest() == run.digest()
    assert replace(run, data=replace(run.data, quality=50)).digest() == run.digest()  # raw pixels have no quality
    jpeg = replace(run.data, store="jpeg")
    digests = {replace(run, data=d).digest() for d in (run.data, jpeg, replace(jpeg, quality=50))}
    assert len(digests) == 3
    assert replace(run, seed=5).digest() != run.digest()
    assert replace(run, augment=replace(run.augment, gel_flip="colour")).digest() != run.digest()
    noisy = replace(run.augment.touch, noise=5.0)
    assert replace(run, augment=replace(run.augment, touch=noisy)).digest() != run.digest()
    crossed, paired = (replace(run, method=MViTacConfig(symmetric=True, pairs=pairs)) for pairs in ("crossed", "all"))
    assert crossed.digest() != paired.digest()


def test_spec_survives_its_record() -> None:
    spec = DataSpec(
        name="x",
        vision_channels=3,
        touch_channels=6,
        tasks=(Task(name="t", classes=("a", "b"), only={"phase": "during"}),),
        group_by="object",
        controls={"width": ("width_mm",)},
        licence="none",
        source="here",
    )
    assert from_json(DataSpec, json.loads(json.dumps(to_json(spec)))) == spec


def test_unknown_names_are_hinted() -> None:
    with pytest.raises(ValueError, match="did you mean 'modern'"):
        recipe("modren")
    value = to_json(recipe("demo"))
    value["optim"]["learning_rate"] = 1
    with pytest.raises(ValueError, match=r"field in run\.optim 'learning_rate'"):
        Run.load(value)


@pytest.mark.parametrize("name", ["modern", "demo"])
def test_a_grasps_phases_are_not_each_others_positives(name: str) -> None:
    """Alike before, during and after the grip would mean blind to the contact."""
    assert recipe(name, GraspsConfig()).positives == "same-image"
    assert recipe(name, MaterialsConfig()).positives == "same-touch"


def test_a_new_dataset_says_itself_that_its_rows_are_phases() -> None:
    class Phased(PackConfig):
        phased = True

    assert recipe("modern", Phased()).positives == "same-image"
    assert recipe("paper", Phased()).augment.vision.grayscale == 0
    assert recipe("paper", PackConfig()).augment.vision.grayscale == 0.2


def test_a_recipe_takes_an_open_pack(pack: Pack) -> None:
    assert recipe("smoke", pack) == recipe("smoke", PackConfig(path=pack.path))


def test_records_without_later_fields_mean_what_they_meant() -> None:
    """Runs before these fields: nearly frozen prototypes, all of CMC's negatives, decayed norms. Digests are unchanged."""
    for name in ("dino", "cmc"):
        run = with_method(recipe("modern"), name)
        old = to_json(run)
        for inner, key in (("method", "prototype_norm"), ("method", "negatives_per_row"), ("optim", "decay_norms")):
            old[inner].pop(key, None)
        loaded = Run.load(old)
        assert loaded.optim.decay_norms and loaded.digest() != run.digest()
        method = loaded.method
        assert method == (
            replace(run.method, prototype_norm=16.0) if name == "dino" else replace(run.method, negatives_per_row=0.0)
        )
        written = to_json(loaded, for_digest=True)
        assert (
            not {"prototype_norm", "negatives_per_row"} & set(written["method"])
            and "decay_norms" not in written["optim"]
        )
