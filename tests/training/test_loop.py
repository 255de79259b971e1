"""The loop: resumed = straight bit for bit, batches without near-duplicates, a loss that stops when it is no number."""

import copy
import os
import shutil
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.datasets.simulated import MaterialsConfig
from mvitac.evaluation.probe import probe_model
from mvitac.methods.mvitac import MViTac, MViTacConfig
from mvitac.model import fresh, load
from mvitac.recipes import recipe
from mvitac.run import Optim, Run
from mvitac.system import files
from mvitac.training import validation
from mvitac.training.checkpoint import CHECKPOINT, PREVIOUS, restore
from mvitac.training.loader import ImageLoader
from mvitac.training.log import open_loggers, read_log
from mvitac.training.loop import Diverged, train
from mvitac.training.sampler import combine_seeds, draw_positives, epoch_order
from mvitac.training.step import Step
from mvitac.transforms.random_views import Augment
from support.forged_packs import put, refuse_pipe
from support.processes import begin, finish
from support.toy import toy_pack, with_columns
from support.training_runs import assert_equal_weights, batches, log_of, power_cut, smoke, stopped_at, views_by


def test_leaves_the_promised_files_and_is_not_trained_over(pack: Pack, smoke_run: Path) -> None:
    tensors = {f"{name}.safetensors" for name in ("model", "model.best", "trained_on")}
    found = {p.name for p in smoke_run.iterdir() if not p.name.startswith("probe")}
    assert found == tensors | {"run.json", "log.jsonl", "checkpoint.pt"}
    lines = log_of(smoke_run)
    assert [line["step"] for line in lines if "loss" in line] == [2, 4, 6, 8]
    assert [line["step"] for line in lines if "eval" in line] == [0, 4, 8]
    for line in (line for line in lines if "loss" in line):
        assert line["loss"] == pytest.approx(sum(line[k] for k in ("vv", "tt", "vt", "tv")), rel=1e-5)
    with pytest.raises(ValueError, match="already holds a run"):
        train(smoke(pack), smoke_run, quiet=True)


@pytest.mark.parametrize("stop_after", [3, 7])
def test_stopped_and_resumed_equals_straight(pack: Pack, smoke_run: Path, tmp_path: Path, stop_after: int) -> None:
    """Also across a change of epoch, with dropout, and with a checkpoint older than the stop."""
    state = torch.manual_seed(99).get_state()
    train(cut_after(stop_after, pack, tmp_path / "r"), tmp_path / "r", resume=True, quiet=True)
    assert_equal_weights(smoke_run, tmp_path / "r")
    assert torch.equal(torch.get_rng_state(), state)  # the caller's own draws do not change
    steps = [line["step"] for line in log_of(tmp_path / "r")]
    assert steps == sorted(steps) and steps.count(8) == 2  # one step line, one eval line, nothing twice


def cut_after(num: int, pack: Pack, out: Path) -> Run:
    run = smoke(pack, checkpoint_every=2)
    with power_cut(num), pytest.raises(RuntimeError, match="power cut"):
        train(run, out, quiet=True)
    return run


def flip(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        weights = max(map(archive.read, archive.namelist()), key=len)
    data = bytearray(path.read_bytes())
    data[data.index(weights) + len(weights) // 2] ^= 1
    path.write_bytes(data)


def test_a_damaged_checkpoint(pack: Pack, smoke_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Gives way to the one before: of one flipped bit. Once it is resumed and cut again, both are good ones."""
    out = tmp_path / "r"
    run = cut_after(5, pack, out)
    flip(out / CHECKPOINT)
    with power_cut(3), pytest.raises(RuntimeError, match="power cut"):
        train(run, out, resume=True, quiet=True)
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"{out / CHECKPOINT} is damaged" in said
    assert f"continuing from {out / PREVIOUS}, step 2" in said
    assert [torch.load(out / name, weights_only=True)["step"] for name in (PREVIOUS, CHECKPOINT)] == [2, 4]
    train(run, out, resume=True, quiet=True)
    assert_equal_weights(smoke_run, out)
    assert capsys.readouterr().err == "" and not (out / PREVIOUS).exists()


def test_a_checkpoint_of_other_kinds_gives_way_to_the_one_before(pack: Pack, tmp_path: Path) -> None:
    run = cut_after(5, pack, tmp_path)
    whole = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    for *where, value in (
        *(("step", 9), ("step", -1), ("step", "x"), ("validation", None), ("method", {}), ("optimiser", None)),
        ("optimiser", "state", 0, "exp_avg", "x"),
    ):
        put(*where, value=value)(state := copy.deepcopy(whole))
        torch.save(state, tmp_path / CHECKPOINT)
        method = run.method.build(pack.spec, run.encoder)
        optimiser = Step(run, method, torch.device("cpu")).optimiser
        assert restore(tmp_path, run, method, optimiser, 8)[0] == 2, (where, value)


def test_a_log_ends_before_what_is_none(tmp_path: Path) -> None:
    good = '{"step": 0, "eval": {}, "verdict": "x"}', '{"step": 2, "loss": 1}'
    for bad in ("[]", '{"step": 4, "loss": {}}', '{"step": 4, "eval": null}', '{"step": 4, "eval": {"a": []}}'):
        (tmp_path / "log.jsonl").write_text("\n".join([*good, bad]))
        assert [entry["step"] for entry in read_log(tmp_path)] == [0, 2], bad
    refuse_pipe(tmp_path / "log.jsonl", lambda: read_log(tmp_path))


def test_a_run_that_could_not_be_read_again_does_not_begin(pack: Pack, tmp_path: Path) -> None:
    run = smoke(pack, positives="same_image")
    with pytest.raises(ValueError, match=r"unknown value of run\.positives 'same_image': .* did you mean"):
        train(run, tmp_path / "r", quiet=True)


def test_killed_between_two_checkpoints(pack: Pack, smoke_run: Path, tmp_path: Path) -> None:
    run = cut_after(5, pack, tmp_path / "r")
    os.replace(tmp_path / "r" / CHECKPOINT, tmp_path / "r" / PREVIOUS)
    other = pack.with_splits({"split": pack.column("split")[::-1]})
    with pytest.raises(ValueError, match=r"different run \(other settings or data\)"):
        train(run, tmp_path / "r", resume=True, quiet=True, pack=other)
    with power_cut(4):  # steps 5 to 8 and no more
        train(run, tmp_path / "r", resume=True, quiet=True)
    assert_equal_weights(smoke_run, tmp_path / "r")


@pytest.mark.parametrize("resume", [False, True])
def test_killed_before_its_record_has_its_name(pack: Pack, smoke_run: Path, tmp_path: Path, resume: bool) -> None:
    """The folder then holds nothing but a temporary file; a foreign file in it is still refused."""
    (tmp_path / "r").mkdir()
    for name in ("run.json", "log.jsonl"):
        (left := tmp_path / "r" / f".{name}.{'a' * 32}.tmp").touch()
        os.utime(left, (0, 0))
    train(smoke(pack), tmp_path / "r", resume=resume, quiet=True)
    assert_equal_weights(smoke_run, tmp_path / "r")
    assert not list((tmp_path / "r").glob(".*"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / ".thesis.tex.tmp").touch()
    with pytest.raises(ValueError, match="exists and is not a run"):
        train(smoke(pack), tmp_path / "other", resume=resume, quiet=True)


def test_temporary_files_of_others_stay(tmp_path: Path) -> None:
    names = (f".a.{'0' * 32}.tmp", f".b.{'1' * 32}.tmp", "a.tmp")
    for name in names:
        (tmp_path / name).touch()
    for name in names[1:]:
        os.utime(tmp_path / name, (0, 0))
    files.write_json(tmp_path / "a", 1)
    assert {path.name for path in tmp_path.iterdir()} == {*names, "a"}


def test_a_folder_that_is_deleted_during_training_is_an_error(pack: Pack, tmp_path: Path) -> None:
    def delete(step: int, values: dict[str, float]) -> None:
        if step == 4:
            shutil.rmtree(tmp_path / "r", ignore_errors=True)  # called twice: losses, evaluation

    with pytest.raises(ValueError, match=r"run\.json is gone: .* was deleted or moved during training"):
        train(smoke(pack, checkpoint_every=2), tmp_path / "r", quiet=True, loggers=(delete,))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("step", "says"), [(4, "4 of 8; {} continues with resume"), (8, "8 of 8; {} is trained")])
def test_ctrl_c_saves_and_is_told(step: int, says: str, pack: Pack, smoke_run: Path, tmp_path: Path) -> None:
    """In a process of its own: libraries of other tests may leave one in which no signal can be handled."""
    finish(begin(stopped_at, step, pack.path, tmp_path / "r", output=tmp_path / "said"), tmp_path / "said")
    assert f"stopped after step {says.format(tmp_path / 'r')}" in (tmp_path / "said").read_text()
    assert torch.load(tmp_path / "r" / "checkpoint.pt", weights_only=True)["step"] == step
    train(smoke(pack), tmp_path / "r", resume=True, quiet=True)
    assert_equal_weights(smoke_run, tmp_path / "r")


def test_not_a_number_stops_and_keeps_the_last_good_checkpoint(
    pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where losses are reported, with step, parts and advice, and before each checkpoint is written."""
    run = smoke(pack, optim=Optim(name="sgd", lr=1e30), log_every=1)
    with pytest.raises(Diverged, match=r"not finite at step \d \(.*vv .*\).*lower --optim\.lr"):
        train(run, tmp_path / "told", quiet=True)
    with pytest.raises(Diverged, match="the last checkpoint is kept"):
        train(replace(run, log_every=8, checkpoint_every=1), tmp_path / "r", quiet=True)
    kept = torch.load(tmp_path / "r" / "checkpoint.pt", weights_only=True)
    assert 1 <= kept["step"] < 8 and all(torch.isfinite(value).all() for value in kept["method"].values())
    assert not list(tmp_path.glob("*/model.safetensors"))
    for losses in ({"other": torch.zeros(())}, {"loss": torch.zeros(2)}, {"loss": torch.zeros(())}, None):
        monkeypatch.setattr(MViTac, "contrast", lambda self, z, losses=losses: losses)
        with pytest.raises(ValueError, match="MViTac returned no dict with a differentiable scalar 'loss'"):
            train(run, tmp_path / "no", quiet=True, resume=True)


def test_learns_the_stripes(tmp_path: Path) -> None:
    """50 steps on three patterns: neighbours of unseen instances far beyond the untrained trunk's, by touch and vision."""
    pack = toy_pack(tmp_path / "pack", num=240)
    optim = Optim(name="adamw", lr=3e-3, schedule="cosine", warmup=0.1)
    run = smoke(pack, steps=50, batch_size=60, optim=optim, eval_every=0)
    out = train(run, tmp_path / "r", quiet=True)
    before, after = (
        [r["accuracy"] for r in probe_model(model, pack, pack.spec.tasks[:1], ["touch", "vision"], ["knn"])]
        for model in (fresh(run, pack.spec, pack.size), load(out))
    )
    assert all(end > start + 0.1 for start, end in zip(before, after, strict=True)), (before, after)
    lines = log_of(out)
    for part in ("vv", "tt", "vt", "tv"):
        assert lines[-2][part] < 0.9 * lines[1][part], part


def test_evaluation_never_reads_test_rows(pack: Pack, smoke_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[np.ndarray] = []
    real = validation.pack_features
    monkeypatch.setattr(validation, "pack_features", lambda *given, **how: used.append(given[3]) or real(*given, **how))
    validation.validate(load(smoke_run), pack, smoke(pack))
    assert used and not set(np.concatenate(used)) & set(pack.rows("test"))


def test_spread_has_no_tail_of_duplicates() -> None:
    """With groups of unequal size, one row of each group in turn would end the epoch with rows of the large ones."""
    rng = np.random.default_rng(0)
    groups = rng.permutation(np.repeat(np.arange(300), np.ceil(5 * np.exp(rng.normal(0, 1, 300))).astype(int)))

    def duplicates(order: np.ndarray) -> np.ndarray:
        return np.array([64 - len(set(batch)) for batch in groups[order[: len(order) // 64 * 64]].reshape(-1, 64)])

    spread, plain = (duplicates(epoch_order(len(groups), use, 1, spread=True)) for use in (groups, None))
    first, second = (epoch_order(len(groups), groups, epoch, spread=True) for epoch in (1, 2))
    assert np.array_equal(epoch_order(len(groups), groups, 1), first) and not np.array_equal(first, second)
    assert sorted(first) == list(range(len(groups)))
    assert spread.max() < plain.mean() and spread.mean() < plain.mean() / 2
    equal = rng.permutation(np.repeat(np.arange(50), 4))  # one row of each group, then a second one
    order = epoch_order(200, equal, 4)
    assert sorted(order) == list(range(200)) and (np.sort(equal[order].reshape(4, 50)) == np.arange(50)).all()


def test_the_spread_sampler_spreads(pack: Pack) -> None:
    run, rows = smoke(pack, sampler="spread"), pack.rows("train")
    order = epoch_order(len(rows), pack.touch_groups[rows], combine_seeds(run.seed, 1, 0), spread=True)
    found = np.concatenate(list(batches(run, pack, rows, 0, run.steps_per_epoch(len(rows)))))
    assert np.array_equal(found, rows[order[: len(found)]])


def test_positives_are_other_rows_of_the_same_touch(pack: Pack) -> None:
    rows, groups = np.arange(pack.num), pack.touch_groups
    found = draw_positives(pack, rows, torch.Generator().manual_seed(0))
    assert (found != rows).all()  # every toy instance has two rows
    assert np.array_equal(groups[found], groups[rows])
    assert np.array_equal(found, draw_positives(pack, rows, torch.Generator().manual_seed(0)))
    split = pack.column("split").astype(str)
    rows = np.flatnonzero(split != "test")  # those already in test keep their partner there
    split[groups.argsort(kind="stable")[::2]] = "test"  # one row of each group: its partner must not follow it there
    assert np.array_equal(draw_positives(with_columns(pack, split=split), rows, torch.Generator().manual_seed(0)), rows)


def asked(run: Run, pack: Pack, rows: np.ndarray, num: int = 2) -> tuple[list[int], dict[str, list[np.ndarray]]]:
    """How many views there are of vision and of touch for ``rows``, and the rows that the feed is asked for."""
    seen: dict[str, list[np.ndarray]] = {"vision": [], "touch": []}

    class Spy(ImageLoader):
        def __call__(self, modality: str, rows: np.ndarray) -> torch.Tensor:
            seen[modality].append(rows)
            return super().__call__(modality, rows)

    made = views_by(Spy, run, pack, rows, num).images
    return [len(made["vision"]), len(made["touch"])], seen


@pytest.mark.parametrize("num_views", [1, 2])
@pytest.mark.parametrize("positives", ["same-image", "same-touch", "same-touch-pairs"])
def test_which_rows_a_view_is_of(pack: Pack, positives: Any, num_views: int) -> None:
    rows, touch_groups = pack.rows("train")[:16], pack.touch_groups
    num, views = asked(smoke(pack, positives=positives), pack, rows, num_views)
    assert num == [num_views, num_views]
    for found in (*views["vision"], *views["touch"]):
        assert np.array_equal(touch_groups[found], touch_groups[rows])
    other = {m: [bool((found != rows).all()) for found in each] for m, each in views.items()}
    if num_views == 2:
        assert other["vision"] == other["touch"] == ([False] if positives == "same-image" else [False, True])
    else:
        assert other == {"vision": [False], "touch": [positives == "same-touch-pairs"]}


def test_a_logger_that_fails_is_named_and_training_goes_on_once_it_works(
    pack: Pack, smoke_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wandb = Mock(init=Mock(side_effect=[RuntimeError("no key"), None]), finish=Mock(side_effect=OSError("offline")))
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    for why in ("no key", "offline"):  # the second at the end
        says = rf"^--logger wandb: {why}; .* --resume$"
        with pytest.raises(ValueError, match=says), open_loggers("wandb", tmp_path / "r", smoke(pack)) as loggers:
            train(smoke(pack), tmp_path / "r", quiet=True, resume=True, loggers=loggers)
    assert wandb.log.call_args.kwargs == {"step": 8}
    assert_equal_weights(smoke_run, tmp_path / "r")


def test_learning_rate_schedules() -> None:
    """Of the authors: StepLR(10, .9), stepped after every epoch from epoch 10 on."""
    late = Optim(lr=1.0, schedule="late-step")
    assert [late.rate(0, 1, epoch) for epoch in (0, 19, 20, 29, 30)] == pytest.approx([1, 1, 0.9, 0.9, 0.81])
    warm = Optim(lr=1.0, schedule="cosine", warmup=0.1)
    assert [warm.rate(s, 100, 0) for s in (0, 9, 10)] == pytest.approx([0.1, 1.0, 1.0])
    assert warm.rate(55, 100, 0) == pytest.approx(0.5)
    assert [Optim(lr=1.0, schedule="step").rate(0, 1, e) for e in (0, 9, 10, 25)] == pytest.approx([1, 1, 0.9, 0.81])


def test_the_other_sensors_view_is_of_the_same_press(pack: Pack, tmp_path: Path) -> None:
    config = MaterialsConfig(num=40, touches=2, sensors_per_press=2, size=16)
    twice = build(config.source(), tmp_path / "p", size=16, quiet=True)
    rows = twice.rows("train")
    run = replace(recipe("smoke", PackConfig(path=twice.path)), augment=Augment(size=16))
    assert asked(run, twice, rows)[0] == [2, 2]
    num, views = asked(replace(run, method=MViTacConfig(hidden=32, out=16, lambda_sensor=0.5)), twice, rows)
    found = views["touch"][-1]
    assert num == [2, 3] and np.array_equal(twice.presses[found], twice.presses[rows])
    assert (twice.sensors[found] != twice.sensors[rows]).all()
    with pytest.raises(ValueError, match="rows of one press"):
        MViTacConfig(lambda_sensor=1.0).training_rows(pack)
