"""Validation while training: the start is the baseline, the best weights are kept, one sentence says how it ended."""

from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from scipy.stats import ttest_rel

import mvitac
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.evaluation.evaluate import stored_result
from mvitac.model import Model, fresh
from mvitac.registry import from_json
from mvitac.report.report import write_report
from mvitac.run import Optim
from mvitac.system.files import read_json
from mvitac.training import log, validation
from mvitac.training.loop import train
from mvitac.training.validation import Cells, validate, verdict
from support.training_runs import log_of, power_cut, smoke

LINEAR = tuple(f"{m}/linear {task}" for m in ("vision", "touch", "both") for task in ("pattern", "bright"))


@pytest.fixture(scope="module")
def run(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    changes = {"steps": 8, "eval_every": 2, "checkpoint_every": 2, "optim": Optim(name="adamw", lr=0.01)}
    return train(smoke(pack, **changes), tmp_path_factory.mktemp("validation") / "run", quiet=True)


def test_the_start_is_evaluated_first_and_the_best_weights_have_the_lowest_errors(pack: Pack, run: Path) -> None:
    settings, evaluations = mvitac.load(run).run, [entry for entry in log_of(run) if "eval" in entry]
    assert [entry["step"] for entry in evaluations] == [0, 2, 4, 6, 8]
    assert evaluations[0]["eval"] == validate(fresh(settings, pack.spec, pack.size), pack, settings)[0]
    assert set(LINEAR) < evaluations[0]["eval"].keys()
    assert [entry for entry in log_of(run) if "verdict" in entry] == evaluations[-1:]
    logs = [[np.log(max(0.01, 1 - entry["eval"][name])) for name in LINEAR] for entry in evaluations]
    errors = [float(np.exp(np.mean(each))) for each in logs]  # geometric means
    best = evaluations[int(np.argmin(errors))]  # the first of equal ones
    model = mvitac.load(run, which="best")
    assert validate(model, pack, model.run)[0] == pytest.approx(best["eval"], rel=1e-6)
    change = 100 * (min(errors) / errors[0] - 1)
    assert f"best at step {best['step']} (errors {change:+.0f} % in the mean" in evaluations[-1]["verdict"]


def test_the_first_of_equally_good_weights_is_kept(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores as given, weights as they were at each evaluation: step 4 is as good as step 6, and better than the last."""
    wrong, seen = iter([5, 6, 3, 3, 4]), []

    def scored(model: Model, *_: object) -> tuple[dict[str, float], Cells]:
        seen.append({name: value.clone() for name, value in model.state_dict().items()})
        return {}, {"touch/linear a": cell([next(wrong)] * 10)}

    monkeypatch.setattr(validation, "validate", scored)
    out = train(smoke(pack, eval_every=2), tmp_path / "r", quiet=True)
    kept = safetensors.torch.load_file(out / "model.best.safetensors")
    assert all(torch.equal(kept[name], value) for name, value in seen[2].items())
    assert not all(torch.equal(kept[name], value) for name, value in seen[3].items())
    said = log_of(out)[-1]["verdict"]
    assert said.endswith("best at step 4 (errors -40 % in the mean over tasks, model.best.safetensors)")
    assert "rose: touch/a +10.0 [+10.0, +10.0]" in said


def test_killed_and_resumed_keeps_the_same_best_weights_and_sentence(run: Path, tmp_path: Path) -> None:
    """Killed before the first checkpoint, and between two; the start is not evaluated again."""
    again, settings = tmp_path / "r", mvitac.load(run).run
    for cut in (1, 5):
        with power_cut(cut), pytest.raises(RuntimeError, match="power cut"):
            train(settings, again, resume=True, quiet=True)
    train(settings, again, resume=True, quiet=True)
    for which in ("last", "best"):
        assert mvitac.load(again, which).weights_digest() == mvitac.load(run, which).weights_digest()  # type: ignore
    first, second = ([e for e in log_of(path) if "eval" in e] for path in (run, again))
    assert first == second


def test_a_run_that_began_without_validation_is_resumed_with_it(pack: Pack, tmp_path: Path) -> None:
    settings = smoke(pack, checkpoint_every=2)
    with power_cut(5), pytest.raises(RuntimeError, match="power cut"):
        train(settings, tmp_path, quiet=True, validate=False)
    train(settings, tmp_path, resume=True, quiet=True)
    assert "eval" in log_of(tmp_path)[-1] and "verdict" not in log_of(tmp_path)[-1]


def cell(wrong: list[int], rows: int = 10) -> torch.Tensor:
    return torch.tensor([[[w, rows] for w in wrong]], dtype=torch.float64)


def test_what_rose_and_what_fell_is_told_by_a_paired_t_interval_over_groups() -> None:
    """Groups of equal size, one task: the jackknife is the paired t interval."""
    before = [5, 6, 7, 4, 5, 6, 5, 6, 7, 4]
    changes = {"a": [-3, -3, -4, -3, -3, -2, -3, -3, -4, -2], "b": [0, 0, -1, 0, 1, 0, 1, 0, 0, 0], "c": [2] * 9 + [3]}
    wrong = {name: np.array(before) + change for name, change in changes.items()}
    start: Cells = {f"touch/linear {name}": cell(before) for name in changes}
    said, texts = verdict(start, {f"touch/linear {name}": cell(list(w)) for name, w in wrong.items()}, "object"), {}
    for name, w in wrong.items():
        rates = 1 - w / 10, 1 - np.array(before) / 10
        low, high = ttest_rel(*rates).confidence_interval(0.95)
        texts[name] = f"touch/{name} {100 * (rates[0] - rates[1]).mean():+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"
    assert said[0].endswith(f"on objects of val), rose: {texts['a']}")
    assert said[1:] == [f"fell: {texts['c']}", f"neither: {texts['b']}"]
    assert verdict({}, {}, "object")[0].startswith("split val has no labels of two classes, and no values")


@pytest.mark.parametrize("num", [1, 9])
def test_few_groups_of_val_tell_nothing(num: int) -> None:
    """R2 -135 to -1 on three videos was "level: -28.6 points [-348.9, +291.8]"."""
    start, end = ({"touch/linear force": torch.tensor([[[e, 1.0]] * num])} for e in (136.0, 2.0))
    (said,) = verdict(start, end, "video")
    assert said.endswith("cannot tell with under 10 videos: touch/force +13400.0")
    assert "rose" not in said and "neither" not in said


def test_values_have_r2(measured: Pack) -> None:
    run = smoke(measured)
    values, cells = validate(fresh(run, measured.spec, measured.size), measured, run)
    light, both = cells["touch/linear light"], cells["touch/linear both"]
    assert light.shape[0] == 1 and both.shape[0] == 2
    errors, guess = light[0].sum(0).tolist()
    rows = measured.rows("val")
    level = measured.column("level")[rows]
    assert guess == pytest.approx(((level - level.mean()) ** 2).sum() / measured.column("level").var(), rel=1e-4)
    assert values["touch/linear light"] == pytest.approx(1 - errors / guess) and values["touch/linear light"] > 0.5
    assert torch.equal(both[0], light[0])  # the same target; weight has rows of its own
    weight = measured.column("weight")[rows]
    known = weight[~np.isnan(weight)]
    spread = ((known - known.mean()) ** 2).sum() / np.nanvar(measured.column("weight"))
    assert float(both[1, :, 1].sum()) == pytest.approx(spread, rel=1e-4)


def test_a_value_far_from_zero_has_the_same_r2(measured: Pack) -> None:
    """In float32 a stamp of today has steps of two minutes."""
    run, task = smoke(measured), measured.spec.values[0]
    model, shifted = fresh(run, measured.spec, measured.size), Pack(measured.path)
    for splits in ((), ("train",), ("val",)):
        shifted._answers[(repr(task), *splits)] = 1e-9 * (measured.values(task, *splits) + 1e9)
    scores = [validate(model, pack, run)[0]["touch/linear light"] for pack in (measured, shifted)]
    assert scores[0] == pytest.approx(scores[1], abs=1e-4)


def test_probe_scores_best_weights(pack: Pack, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["--weights", "best", "--tasks", "pattern", "--modalities", "touch", "--no-controls"]
    assert main(["probe", str(run), *asked]) == 0
    assert "mvitac, best" in capsys.readouterr().out and not (run / "probe.json").exists()
    result = read_json(run / "probe.best.json", "scores")
    assert from_json(list, result["models"]) and stored_result([run], pack) is None
    plain = train(smoke(pack, steps=1, eval_every=0), run.parent / "plain", quiet=True)
    assert main(["probe", str(plain), *asked]) == 2
    error = capsys.readouterr().err
    assert "has no model.best.safetensors: train with --eval-every N" in error and error.count("\n") == 1


def test_a_table_shows_each_evaluation(measured: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A column per task by both senses, R2 and accuracy told apart, within 80 columns; also of a run that is resumed."""
    settings = smoke(measured, steps=4, eval_every=2, checkpoint_every=2)
    with power_cut(3), pytest.raises(RuntimeError, match="power cut"):
        train(settings, tmp_path / "r")
    train(settings, tmp_path / "r", resume=True)
    said = [line for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert max(map(len, said)) <= 80
    start, second, last = (e["eval"] for e in log_of(tmp_path / "r") if "eval" in e)
    tasks = ["pattern", "bright", "light", "both"]
    heads = [at for at, line in enumerate(said) if line.split() == ["step", "loss", "pairs/s", *tasks, "R@5", "change"]]
    assert len(heads) == 2 and said[heads[0] + 1].split() == ["acc", "%", "acc", "%", "R2", "%", "R2", "%", "%"]
    for row, values in ((heads[0] + 2, start), (heads[0] + 3, second), (heads[1] + 2, last)):
        names = [[f"both/linear {task}"] for task in tasks] + [["vision->touch R@5", "touch->vision R@5"]]
        scores = [100 * np.mean([values[name] for name in keys]) for keys in names]
        before, cells = [100 * start[keys[0]] for keys in names[:-1]], said[row].split()
        assert (cells[1:6] if values is start else cells[3:8]) == [f"{score:.1f}" for score in scores]
        assert values is start or cells[-1] == f"{np.mean(scores[:-1]) - np.mean(before):+.1f}"


def test_many_tasks_fit_a_line() -> None:
    names = [f"vision/linear a_long_name_{i}" for i in range(20)]
    widths = log._widths(list(log.shown_scores(dict.fromkeys([*names, "b touch->vision R@5"], 0.5))))
    assert list(widths)[-1] == log.RETRIEVED and len(widths) == 8
    assert len(log._line(["1", "2", "3"], list(widths), "+100.0", widths)) <= log.WIDTH


@pytest.mark.usefixtures("undrawn")
def test_the_report_shows_the_start_and_the_sentence(run: Path, tmp_path: Path) -> None:
    page = write_report([run], tmp_path / "report", quiet=True).read_text()
    assert "linear probe, pattern" in page and "Dashed: the value at the start" in page
    assert log_of(run)[-1]["verdict"] in page.replace("\xa0", " ")
