"""Training on several packs: what is drawn, that a stop changes nothing, and losses of rows that lack a modality."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.data.several import MixedPack
from mvitac.evaluation.evaluate import ProbeConfig, probe_runs
from mvitac.methods.base import MethodConfig, Views
from mvitac.methods.mvitac import MViTacConfig
from mvitac.methods.supervised import SupervisedConfig
from mvitac.nn.losses import info_nce
from mvitac.recipes import with_method
from mvitac.training.loader import ImageLoader
from mvitac.training.loop import train
from support.mixes import Gel, Slice, built, mix_run
from support.small_methods import PAIRED, build, small
from support.training_runs import assert_equal_weights, batches, log_of, smoke, train_twice, views_by


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The stripes in two packs, and 60 rows of another gel without a camera."""
    folder = tmp_path_factory.mktemp("parts")
    built(Slice(num=72), folder / "a")
    built(Slice(num=48, first=72), folder / "b")
    built(Gel(num=60), folder / "gel", size=24)
    return {name: f"{name}={folder / name}" for name in ("a", "b", "gel")}


def drawn(run: Any, epochs: int = 1) -> tuple[Any, np.ndarray]:
    """The pack of a run, and the part of each row [steps, batch_size] of its first epochs."""
    pack = run.data.open()
    rows = run.method.training_rows(pack)
    found = np.stack(list(batches(run, pack, rows, 0, epochs * run.steps_per_epoch(len(rows)))))
    assert np.isin(found, rows).all()
    return pack, found


def test_a_plain_mix_trains_as_one_pack_of_the_same_rows(pack: Pack, parts: dict[str, str], tmp_path: Path) -> None:
    whole = train(smoke(pack, steps=4), tmp_path / "whole", quiet=True)
    assert_equal_weights(whole, train(mix_run(parts["a"], parts["b"], steps=4), tmp_path / "mix", quiet=True))


def test_weights_decide_what_is_drawn(parts: dict[str, str]) -> None:
    pack, found = drawn(mix_run(f"{parts['a']}:1", f"{parts['b']}:3", batch_size=8), epochs=40)
    assert pack.shares(pack.rows("train")).tolist() == [0.25, 0.75]
    assert np.mean(pack.part_of[found] == 1) == pytest.approx(0.75, abs=0.03)
    rows = pack.rows("train")
    for part in (0, 1):  # every row of a part equally often, give or take the pass that goes on
        times = np.bincount(found.ravel(), minlength=pack.num)[rows[pack.part_of[rows] == part]]
        assert times.max() - times.min() <= 1
    assert {len(set(batch)) for batch in found.tolist()} == {8}  # no row is its own negative, where a pass ends either


def test_stopped_and_resumed_equals_straight(parts: dict[str, str], tmp_path: Path) -> None:
    """With a part that lacks the camera; across a change of epoch; scores of every part are logged."""
    given = (f"{parts['a']}:1", f"{parts['gel']}:2")
    out = train_twice(mix_run(*given, steps=8, checkpoint_every=2, log_every=1), tmp_path, cut=5)
    values = next(line["eval"] for line in reversed(log_of(tmp_path / "straight")) if "eval" in line)
    shown = {"a vision/linear pattern", "a touch/linear a/bright", "a vision->touch R@5", "gel touch/linear pattern"}
    assert shown <= values.keys() and not any(name.startswith("gel") and "vision" in name for name in values)
    with pytest.raises(ValueError, match="holds a different run"):
        train(mix_run(f"{parts['a']}:1", f"{parts['gel']}:3", steps=8), out, resume=True, quiet=True)


def test_views_are_of_the_rows_that_have_the_modality(parts: dict[str, str]) -> None:
    pack = (run := mix_run(parts["a"], parts["gel"], positives="same-touch")).data.open()
    rows = np.array([*pack.rows("train")[[2, 0]], *pack.rows("train")[-3:], pack.rows("train")[4]])
    made = views_by(ImageLoader, run, pack, rows)
    assert {m: [len(view) for view in found] for m, found in made.images.items()} == {"vision": [3, 3], "touch": [6, 6]}
    assert {m: found.tolist() for m, found in made.both.items()} == {"vision": [0, 1, 2], "touch": [0, 1, 5]}
    few = views_by(ImageLoader, run, pack, rows[:5][[0, 2, 3, 4]])  # a single camera image has no negative
    assert few.images.keys() == {"touch"} and not few.both
    whole = views_by(ImageLoader, run, pack, rows[:2])
    assert whole.images.keys() == {"vision", "touch"} and not whole.both


def ragged(method: Any, vision: int = 5, touch: int = 8) -> Views:
    """``touch`` rows, of which ``vision`` have a camera image, and one row with the camera alone."""
    generator, num = torch.Generator().manual_seed(3), {"vision": vision + 1, "touch": touch}
    images = {m: [torch.randn(n, 3, 32, 32, generator=generator) for _ in range(method.views)] for m, n in num.items()}
    both = {"vision": torch.arange(vision), "touch": torch.arange(touch - vision, touch)}
    return Views(images=images, labels={}, rows=torch.arange(3, touch + 4), both=both)


@pytest.mark.parametrize("name", sorted(name for name, kind in MethodConfig.choices.items() if kind.takes_missing))
def test_a_loss_is_of_the_rows_that_have_its_modality(name: str) -> None:
    """Each intra-modal loss equals that of a batch of these rows alone, and so do the methods' updates."""
    batch = ragged(method := build(name))
    losses = method(batch)
    assert losses["loss"].isfinite()
    losses["loss"].backward()
    method.after_step(0.5)
    own = {"vision": "vv", "touch": "tt"} if name == "mvitac" else {"vision": "vision", "touch": "touch"}
    for modality, loss in own.items():
        other = build(name)
        alone = other(Views(images={modality: batch.images[modality]}, labels={}, rows=batch.rows))
        assert alone.keys() == {"loss", loss}
        torch.testing.assert_close(alone[loss], losses[loss])
        other.after_step(0.5)
        for key, value in other.state_dict().items():
            if f".{modality}." in f".{key}.":
                torch.testing.assert_close(value, method.state_dict()[key], msg=key)


def test_inter_modal_losses_are_of_whole_pairs() -> None:
    for changes in ({}, {"keys": "end-to-end", "pairs": "all"}):
        method: Any = build("mvitac", config=replace(small("mvitac"), **changes))
        batch = ragged(method)
        losses, z = method(batch), method.queries(batch) | method.keys(batch)
        keys = "q" if changes else "k"
        at = batch.both
        for part, (x, y) in {"vt": ("vision", "touch"), "tv": ("touch", "vision")}.items():
            views = method.view_pairs("inter")
            pairs = [(z["q", x, i, "inter"][at[x]], z[keys, y, j, "inter"][at[y]]) for i, j in views]
            torch.testing.assert_close(losses[part], torch.stack([info_nce(*pair, 0.07) for pair in pairs]).mean())
    assert method(ragged(method, vision=1)).keys() == {"loss", "vv", "tt"}  # a single pair has no negative


@pytest.mark.parametrize("name", [*PAIRED, "supervised"])
def test_a_method_that_needs_whole_pairs_names_the_rows(parts: dict[str, str], name: str, tmp_path: Path) -> None:
    run = with_method(mix_run(parts["a"], parts["gel"]), name)
    needs = rf"method '{name}' needs vision and touch of every row"
    with pytest.raises(ValueError, match=rf"{needs}, but \d+ rows of part gel have no vision: choose another"):
        train(run, tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()
    train(with_method(mix_run(parts["a"], parts["b"], steps=1, eval_every=0), name), tmp_path / "whole", quiet=True)


def test_rows_without_a_loss_are_not_drawn_and_those_with_one_are(parts: dict[str, str], tmp_path: Path) -> None:
    pack = (run := mix_run(parts["a"], parts["gel"])).data.open()
    assert isinstance(pack, MixedPack)
    for losses, num in ((("vv",), 1), (("tt",), 2), (("vt", "tv"), 1), (("vv", "tt"), 2)):
        assert set(pack.part_of[MViTacConfig(losses=losses).training_rows(pack)]) == set(range(num))
    by_touch = SupervisedConfig(modalities=("touch",), tasks=("pattern",))
    assert np.array_equal(by_touch.training_rows(pack), pack.rows("train", "val"))
    with pytest.raises(ValueError, match="method 'mvitac' learns from no row of part gel: leave it out"):
        train(replace(run, method=MViTacConfig(losses=("vv",))), tmp_path / "run", quiet=True)


def test_what_a_mix_cannot_do_is_refused(parts: dict[str, str], tmp_path: Path) -> None:
    ragged = (parts["a"], parts["gel"])
    many = "part b has 24 rows to train on, for 32 of a batch of 36: a row would be its own negative"
    for run, message in (
        (mix_run(*ragged, batch_size=8, chunk=4), "lack a modality support neither several processes nor --chunk"),
        (mix_run(*ragged, batch_size=2), "batch_size 2: parts that lack a modality need at least 3"),
        (mix_run(f"{parts['a']}:1", f"{parts['b']}:8", batch_size=36), many),
    ):
        with pytest.raises(ValueError, match=message):
            train(run, tmp_path / "run", quiet=True)


@pytest.mark.usefixtures("undrawn")
def test_a_run_on_a_mix_is_probed_by_task(parts: dict[str, str], tmp_path: Path) -> None:
    """A task of one part is of its rows alone, a common one of all rows with the modality; a control where it is known."""
    run = mix_run(parts["a"], parts["gel"], steps=1, eval_every=0)
    out = train(run, tmp_path / "run", quiet=True)
    result, pack = probe_runs([out], ProbeConfig()), run.data.open()
    records = [r for r in result["records"] if r["source"] == "mvitac"]
    own = {r["task"]: r["num_test"] for r in records if r["modality"] == "touch"}
    num = [len(part.rows("test")) for part in pack.parts.values()]
    assert own == {"pattern": sum(num), "a/bright": num[0], "gel/bright": num[1]}
    assert {r["task"] for r in result["records"] if r["source"] == "noise only"} == {"a/bright"}
    assert {r["modality"] for r in records if r["task"] == "gel/bright"} == {"touch"}
    assert {(r["modality"], r["num_test"]) for r in records if r["task"] == "pattern"} >= {("both", num[0])}
    assert not result["leaks"] and main(["report", str(out), "--out", str(tmp_path / "report.html")]) == 0
