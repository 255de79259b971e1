"""Fine-tuning: settings from held-out groups of train alone, exact resumes, ancestors in the leaks."""

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import timm
import torch
from safetensors.torch import save_file

from mvitac.cli.finetune import next_step
from mvitac.cli.main import main
from mvitac.data.build import build
from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.evaluation.controls import imagenet_trunk
from mvitac.evaluation.diagnostics import mean_error
from mvitac.evaluation.evaluate import check_unseen
from mvitac.evaluation.leaks import UNKNOWN
from mvitac.evaluation.probe import probe_model
from mvitac.experiments.finetune import FROZEN, SCRATCH, TUNED, Finetuning, _start, finetune
from mvitac.model import load
from mvitac.nn.encoders import EncoderConfig
from mvitac.report.tables import print_finetuning
from mvitac.run import load_run
from mvitac.system.device import Hardware
from mvitac.system.files import read_json
from mvitac.training.loop import train
from support.toy import Toy, altered, toy_pack
from support.training_runs import assert_equal_weights, power_cut, smoke

ASKED = Finetuning(labels=("pattern",), lr=(1e-3, 3e-3), steps=(3,), batch_size=16)


@pytest.fixture(scope="module", autouse=True)
def one_precision() -> Iterator[None]:
    """auto measures, and on a busy machine two equal runs would differ."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvitac.system.device.has_bf16", lambda device: False)
        yield


@pytest.fixture(scope="module")
def ancestor(pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(smoke(pack, eval_every=0), tmp_path_factory.mktemp("ancestor") / "run", quiet=True)


def tune(ancestor: Path, pack: Pack, out: Path, asked: Finetuning = ASKED, **options: Any) -> dict[str, Any]:
    options = {"quiet": True, "say": lambda text: None, **options}
    return finetune(ancestor, PackConfig(path=pack.path), asked, out, **options)


@pytest.fixture(scope="module")
def tuned(ancestor: Path, pack: Pack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tuned") / "out"
    tune(ancestor, pack, out, replace(ASKED, fractions=(40.0, 100.0)))
    return out


def test_the_result_is_a_model_like_any_other(ancestor: Path, pack: Pack, tuned: Path) -> None:
    result = json.loads((tuned / "scores.json").read_text())
    found = {(r["source"], r["fraction"]): r for r in result["records"]}
    assert set(found) == {(s, f) for s in ("fine-tuned", SCRATCH, FROZEN) for f in (40.0, 100.0)}
    model = load(tuned / "seed0")
    (own,) = [r for r in probe_model(model, pack, pack.spec.tasks[:1], ["both"], []) if r["probe"] == "own"]
    assert found["fine-tuned", 100.0]["group_correct"] == own["group_correct"]
    assert result["models"] == [str(tuned / "seed0")] and result["leaks"] == []
    run, record = load_run(tuned / "seed0")
    assert run.init.path == ancestor and record["start"]["taken"] == {"vision": ["trunk"], "touch": ["trunk"]}
    assert json.loads((tuned / "seed0" / "scores.json").read_text())["records"][0]["accuracy"] == own["accuracy"]
    assert not load_run(tuned / "scratch" / "seed0")[0].init
    assert not (tuned / "choice").exists()  # what was only tried takes no room


def test_the_command_continues_a_finished_one_and_prints_one_table(
    ancestor: Path, pack: Pack, tuned: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    before = (tuned / "scores.json").read_text()
    words = f"--labels pattern --lr 1e-3 3e-3 --steps 3 --batch-size 16 --fractions 40 100 --out {tuned} --resume"
    with power_cut(0):  # nothing is trained again
        assert main(["finetune", str(ancestor), "--data", str(pack.path), *words.split(), "--quiet"]) == 0
    assert (tuned / "scores.json").read_text() == before
    said = capsys.readouterr().out
    cells = [re.split("  +", line) for line in said.splitlines() if line.count("[") == 2]
    rows = {name: scores for name, *scores in cells}
    gains = [f"gain over {SCRATCH}", f"gain over {FROZEN}"]
    assert list(rows) == ["fine-tuned", SCRATCH, FROZEN, *gains]
    numbers = {name: float(cells[1].split()[0]) for name, cells in rows.items()}
    assert "40 % of instances" in said and "100 % of instances" in said
    assert "no gain over the frozen probe is sure" in said
    assert numbers[gains[0]] == pytest.approx(numbers["fine-tuned"] - numbers[SCRATCH], abs=0.11)


def test_a_gain_over_few_groups_has_no_interval(capsys: pytest.CaptureFixture[str]) -> None:
    """Two equal gaps would say that it is certain."""
    for num, shown in ((2, 2), (20, 4)):
        known: dict[str, Any] = {"task": "kind", "modality": "touch", "probe": "linear", "fraction": 100.0, "seed": 0}
        known |= {"group_sizes": [10] * num, "accuracy": 0.5, "leak": ""}
        right = {TUNED: 4, SCRATCH: 6, FROZEN: 5}
        records = [known | {"source": name, "group_correct": [k] * num} for name, k in right.items()]
        print_finetuning({"data": "d", "group_by": "object", "notes": [], "records": records})
        gains = [line for line in capsys.readouterr().out.splitlines() if line.startswith("gain")]
        assert sum(line.count("[") for line in gains) == shown - 2, gains


UNSURE = "cannot be told with under 10 objects in test (3)"
NEXT = [(3, 9, UNSURE), (20, 9, "mvitac publish"), (20, 5, "no gain"), (20, 0, "no")]


@pytest.mark.parametrize(("num", "right", "says"), NEXT)
def test_only_a_sure_gain_is_published(num: int, right: int, says: str) -> None:
    """Of 10 rows in each group, the frozen probe has 5 right, and 4 or 6 in some."""
    known: dict[str, Any] = {"task": "kind", "fraction": 100.0, "seed": 0, "group_sizes": [10] * num, "accuracy": 0.5}
    each = {TUNED: [right] * num, FROZEN: [4 + k % 3 for k in range(num)]}
    records = [known | {"source": source, "group_correct": correct} for source, correct in each.items()]
    assert says in next_step({"records": records, "group_by": "object", "models": ["runs/x/seed0"]}, 100.0)


def test_a_trunk_of_others_is_a_start_too(pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its weights are those of the frozen probe and the start, not those of the control; the forecast comes first."""
    trunk = timm.create_model("mvitac_tiny", num_classes=0)
    save_file(trunk.state_dict(), tmp_path / "w.safetensors")
    start, said = Path(f"mvitac_tiny={tmp_path / 'w.safetensors'}"), []
    model, init = _start(start, PackConfig(path=pack.path), pack)
    for encoder in model.encoders.values():
        assert all(torch.equal(encoder.state_dict()[name], value) for name, value in trunk.state_dict().items())
    assert not init and model.image_sizes("touch") == (32, 32)
    result = tune(start, pack, tmp_path / "out", replace(ASKED, lr=(1e-3,), steps=(4,)), say=said.append)
    assert said[0] == "at most 2 trainings, 8 steps of 16" and said[1].startswith("100 %: fine-tuned")
    assert re.fullmatch(r"about \d+ s for all of them, by the first \d steps", said[2])
    assert {r["source"] for r in result["records"]} == {"fine-tuned", SCRATCH, FROZEN}
    assert {r["leak"] for r in result["records"] if r["source"] == SCRATCH} == {""}
    assert {r["leak"] for r in result["records"] if r["source"] != SCRATCH} == {UNKNOWN}
    assert load_run(tmp_path / "out" / "seed0")[0].encoder.touch.weights.endswith("w.safetensors")
    monkeypatch.setattr("mvitac.experiments.finetune.fresh", lambda run, *_: run.encoder.touch)
    config, _ = _start(Path("imagenet:resnet18"), PackConfig(path=pack.path), pack)
    assert (config.trunk, config.weights) == ("resnet18", "imagenet")  # type: ignore[attr-defined]
    config, _ = _start(Path("imagenet"), PackConfig(path=pack.path), pack)
    assert config == imagenet_trunk(EncoderConfig())


def test_a_rate_that_diverges_is_not_chosen(ancestor: Path, pack: Pack, tmp_path: Path) -> None:
    said: list[str] = []
    found = tune(ancestor, pack, tmp_path / "out", replace(ASKED, lr=(1e12, 1e-3), from_scratch=False), say=said.append)
    assert found["chosen"]["100"]["fine-tuned"]["lr"] == 1e-3 and any("diverged" in line for line in said)


def test_a_share_that_is_raised_to_one_of_each_class_is_noted(ancestor: Path, pack: Pack, tmp_path: Path) -> None:
    asked = replace(ASKED, lr=(1e-3,), steps=(1,), fractions=(1.0, 100.0), from_scratch=False)
    notes = tune(ancestor, pack, tmp_path / "out", asked)["notes"]
    assert [note for note in notes if " % " in note] == ["1 % of instances is 3 of 48, the fewest with every class"]


def tried_in(folder: Path) -> dict[str, float]:
    """Error by settings, without the digest of run and data."""
    tried = read_json(folder / "choice.json", "").items()
    return {name.split(" (")[0]: mean_error(scores.values()) for name, scores in tried}


def test_settings_are_the_best_on_held_out_groups(tuned: Path) -> None:
    chosen = json.loads((tuned / "scores.json").read_text())["chosen"]
    for fraction, folder in (("40", tuned / "40-percent"), ("100", tuned)):
        assert len(tried := tried_in(folder)) == 4  # two rates, also from scratch
        for kind, best in chosen[fraction].items():
            name = f"{kind}: lr {best['lr']}, steps {best['steps']}"
            assert tried[name] == min(error for other, error in tried.items() if other.startswith(kind))
            run, _ = load_run(folder / ("scratch/seed0" if kind == SCRATCH else "seed0"))
            assert (run.optim.lr, run.steps) == (best["lr"], best["steps"])
            assert not run.method.hold_out  # type: ignore[attr-defined]


def edited(pack: Pack, to: Path, **columns: Any) -> Path:
    """A pack of the same images, with other values in some columns: functions of an item's own columns."""
    other = altered(Toy(), lambda sample, _: {name: value(sample.columns) for name, value in columns.items()})
    return build(other, to, size=pack.size, workers=1, quiet=True).path


def test_test_labels_decide_nothing(ancestor: Path, pack: Pack, tuned: Path, tmp_path: Path) -> None:
    wrong = {"label_pattern": lambda row: (row["label_pattern"] + (row["split"] == "test")) % 3}
    other = Pack(edited(pack, tmp_path / "other", **wrong))
    assert other.digest != pack.digest
    result = tune(ancestor, other, tmp_path / "out", replace(ASKED, from_scratch=False))
    assert len(tried := tried_in(tmp_path / "out")) == 2 and tried.items() <= tried_in(tuned).items()
    assert_equal_weights(tmp_path / "out" / "seed0", tuned / "seed0")
    before = json.loads((tuned / "scores.json").read_text())["records"]
    frozen = [r for r in (*before, *result["records"]) if r["source"] == FROZEN and r["fraction"] == 100]
    right, now = (record["accuracy"] for record in frozen)
    assert now <= 1 - right + 1e-9  # the rows that were right are wrong now


@pytest.mark.parametrize("after", [4, 7])  # while settings are tried, and in the final run
def test_killed_and_resumed_is_straight(
    ancestor: Path, pack: Pack, tuned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    monkeypatch.setattr("mvitac.training.loop.MIN_BETWEEN_CHECKPOINTS", 1)  # also of short runs, after every step
    monkeypatch.setattr(Hardware, "choose", choose := Mock(wraps=Hardware.choose))
    asked = replace(ASKED, from_scratch=False)
    with power_cut(after), pytest.raises(RuntimeError, match="power cut"):
        tune(ancestor, pack, tmp_path / "out", asked)
    assert (tmp_path / "out" / "choice").exists() == (after == 4)
    with pytest.raises(ValueError, match="give 1 to 1000"):
        replace(ASKED, seeds=10**20)
    with pytest.raises(ValueError, match=r"out is not empty: continue it with --resume"):
        tune(ancestor, pack, tmp_path / "out", asked)
    result = tune(ancestor, pack, tmp_path / "out", asked, resume=True)
    assert [call.args[1] for call in choose.call_args_list].count("auto") == 1  # another choice may differ
    assert_equal_weights(tmp_path / "out" / "seed0", tuned / "seed0")
    straight = [r for r in json.loads((tuned / "scores.json").read_text())["records"] if r["fraction"] == 100]
    for record in result["records"]:
        assert record["group_correct"] == next(r for r in straight if r["source"] == record["source"])["group_correct"]


def test_what_was_tried_on_other_labels_is_tried_again(ancestor: Path, pack: Pack, tmp_path: Path) -> None:
    asked, out = replace(ASKED, from_scratch=False), tmp_path / "out"
    changing = Pack(edited(pack, tmp_path / "data"))
    with power_cut(4), pytest.raises(RuntimeError, match="power cut"):
        tune(ancestor, changing, out, asked)
    (first,) = tried_in(out)
    shutil.rmtree(changing.path)
    edited(pack, changing.path, label_pattern=lambda row: (row["label_pattern"] + 1) % 3)
    tune(ancestor, Pack(changing.path), out, asked, resume=True)
    tried = read_json(out / "choice.json", "")
    assert [name.split(" (")[0] for name in tried].count(first) == 2
    shutil.rmtree(changing.path)
    edited(pack, changing.path, label_pattern=lambda row: (row["label_pattern"] + 2) % 3)
    with pytest.raises(ValueError, match="seed0 holds a different run"):
        tune(ancestor, Pack(changing.path), out, asked, resume=True)
    with pytest.raises(ValueError, match="seed0 holds a different run"):
        tune(ancestor, Pack(changing.path), out, replace(asked, lr=(7e-3, 8e-3)), resume=True)
    assert read_json(out / "choice.json", "") == tried  # at once


def test_bad_input_is_refused(
    ancestor: Path, pack: Pack, turned: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, run = tmp_path / "out", str(ancestor)
    first = {"label_pattern": lambda row: row["label_pattern"] * (row["split"] == "test")}
    three = {"group": lambda row: row["split"] + str(row["label_pattern"]) * (row["split"] == "train")}
    one_class, few = edited(pack, tmp_path / "single", **first), edited(pack, tmp_path / "few", **three)
    for path, words in (
        (one_class, ["labels of one class only in train (columns)"]),
        (few, ["too few to hold some out", "give one --lr and one --steps"]),
        (toy_pack(tmp_path / "six", touch_channels=6).path, ["has 6 channels of touch"]),
        (turned.path, ["has seen what", "--allow-leak"]),
    ):
        assert main(["finetune", run, "--data", str(path), "--labels", "pattern", "--out", str(out)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and all(word in said for word in words), said
    assert main(["finetune", run, "--data", str(pack.path), "--values", "pattern", "--out", str(out)]) == 2
    assert "pattern: --labels is for tasks with classes" in capsys.readouterr().err and not out.exists()


def test_a_leak_of_the_ancestor_is_beside_the_score(ancestor: Path, pack: Pack, turned: Pack, tmp_path: Path) -> None:
    records = tune(ancestor, turned, tmp_path / "out", replace(ASKED, lr=(1e-3,), allow_leak=True))["records"]
    leaks = {r["source"]: r["leak"] for r in records}
    assert "72 of 72 test rows" in leaks["fine-tuned"] and "72 of 72" in leaks[FROZEN] and leaks[SCRATCH] == ""
    scratch = tmp_path / "out" / "scratch" / "seed0"  # saw its own train alone, which the other split tests
    with pytest.raises(ValueError, match=r"has seen what .* (\d+) of \1 test rows"):
        check_unseen([scratch], pack, pack.spec.tasks, allow_leak=False)
