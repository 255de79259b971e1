"""The recipes are what the paper and the released code say, and every run survives its own record."""

import json
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pytest
from PIL import Image

from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.pack import PackConfig
from mvitac.datasets.simulated import GraspsConfig, MaterialsConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.recipes import RECIPES, recipe
from mvitac.registry import find, to_json
from mvitac.run import Run, load_run
from support.toy import with_columns


def test_paper_constants() -> None:
    run = recipe("paper")
    assert (run.batch_size, run.epochs, run.augment.size) == (256, 240, 224)
    assert (run.optim.name, run.optim.lr, run.optim.eps) == ("adam", 0.03, 1e-7)
    assert (run.optim.weight_decay, run.optim.schedule) == (0, "constant")
    assert (run.encoder.touch.trunk, run.encoder.vision.weights) == ("resnet18.tv_in1k", "imagenet")
    method = run.method
    assert isinstance(method, MViTacConfig)
    assert (method.temperature, method.out, method.dropout, method.head_norm) == (0.07, 128, 0, False)
    for view in (run.augment.vision, run.augment.touch):
        assert (view.scale, view.flip, view.grayscale, view.jitter) == ((0.2, 1.0), 0.5, 0.2, 0)


def test_authors_constants() -> None:
    """https://github.com/ligerfotis/mvitac at commit a5b572d."""
    method = (run := recipe("authors", GraspsConfig())).method
    assert isinstance(method, MViTacConfig)
    assert (method.momentum, method.lambda_inter, method.hidden, method.dropout) == (0.99, 1, 2048, 0.5)
    assert (run.optim.lr, run.optim.weight_decay, run.optim.eps, run.optim.schedule) == (1e-3, 1e-6, 1e-8, "late-step")
    assert (run.encoder.touch.stem, run.augment.whole_of("touch"), run.optim.decay_norms) == ("random", 256, True)
    assert run.augment.touch.flip == 0.25 and run.augment.touch.grayscale == 0.2
    assert (run.batch_size, run.epochs) == (256, 240)


@pytest.mark.parametrize("name", RECIPES)
@pytest.mark.parametrize("data", [MaterialsConfig(num=7), GraspsConfig(seed=3)])
def test_every_recipe_survives_its_record(name: str, data: MaterialsConfig) -> None:
    run = recipe(name, data)
    assert run.recipe == name
    again = Run.load(json.loads(json.dumps(to_json(run))))
    assert again == run and again.digest() == run.digest() and run.__doc__ and RECIPES[name].__doc__


def test_digest_is_of_the_outcome() -> None:
    run = recipe("quick")
    assert replace(run, log_every=3, device="cpu").digest() == run.digest()
    assert replace(run, data=replace(run.data, workers=7)).digest() == run.digest()
    assert replace(run, data=replace(run.data, quality=50)).digest() == run.digest()  # raw pixels have no quality
    jpeg = replace(run.data, store="jpeg")
    digests = {replace(run, data=d).digest() for d in (run.data, jpeg, replace(jpeg, quality=50))}
    assert len(digests) == 3 and replace(run, seed=5).digest() != run.digest()
    jittered = replace(run.augment.touch, jitter=0.1)
    assert replace(run, augment=replace(run.augment, touch=jittered)).digest() != run.digest()
    method = MViTacConfig(keys="end-to-end")
    crossed, paired = (replace(run, method=replace(method, pairs=pairs)) for pairs in ("crossed", "all"))
    assert crossed.digest() != paired.digest()


def test_a_grasps_phases_are_not_each_others_positives(pack: Pack) -> None:
    """Alike before, during and after the grip would mean blind to the contact. New data say so themselves."""

    class Phased(PackConfig):
        phased = True

    for name in ("modern", "quick"):
        assert recipe(name, GraspsConfig()).positives == recipe(name, Phased()).positives == "same-image"
        assert recipe(name, MaterialsConfig()).positives == "same-touch"
    assert recipe("paper", Phased()).augment.vision.grayscale == 0
    assert recipe("paper", PackConfig(), phased=False).augment.vision.grayscale == 0.2
    assert recipe("smoke", pack) == recipe("smoke", PackConfig(path=pack.path))
    hiding = PackConfig(path=pack.path, score_on="val")
    assert recipe("smoke", hiding.open()) == recipe("smoke", hiding)


@pytest.fixture(scope="module")
def grasps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("grasps")
    pack = build(GraspsConfig(num=4, size=32).source(), root / "pack", size=32, quiet=True)
    rows = []
    for i in range(pack.num):
        names = {"vision": f"v{i}.png", "left": f"l{i}.png", "right": f"r{i}.png"}
        touch = pack.images["touch"][i]
        for file, image in zip(names.values(), (pack.images["vision"][i], touch[..., :3], touch[..., 3:]), strict=True):
            Image.fromarray(image).save(root / file)
        rows.append({**names, **{name: str(pack.column(name)[i]) for name in ("phase", "group", "touch_group")}})
    pa.csv.write_csv(pa.Table.from_pylist(rows), root / "folder.csv")
    return root


@pytest.mark.parametrize(("name", "file"), [("pack", "pack"), ("folder", "folder.csv")])
def test_recipe_of_grasps(name: str, file: str, grasps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That of the simulator, however they are read, in `mvitac pretrain` too, where single fields come after it."""
    config = find(DatasetConfig, name)(size=32, path=grasps / file)
    for one in RECIPES:
        expected, found = recipe(one, GraspsConfig()), recipe(one, config)
        assert replace(found, data=expected.data) == expected, one
    monkeypatch.chdir(grasps)
    words = ["--data", name, "--data.path", file, "--recipe", "smoke", "--batch-size", "2", "--steps", "1"]
    words += ["--data.size", "32", "--quiet", "--augment.touch.grayscale", "0.1"]
    if name == "folder":
        words += ["--data.test-share", "0", "--data.val-share", "0", "--data.touch-group", "touch_group"]
    assert main(["pretrain", *words, "--out", str(tmp_path / "run")]) == 0
    run, _ = load_run(tmp_path / "run")
    assert run.positives == "same-image" and (run.augment.vision.grayscale, run.augment.touch.grayscale) == (0, 0.1)


def test_rows_with_other_phases_are_no_grasps(pack: Pack) -> None:
    for values, phased in ((["before", "during"], True), (["during", "during"], True), (["pressed", "during"], False)):
        assert with_columns(pack, phase=values * (pack.num // 2)).phased is phased
    assert not pack.phased
