"""What `--precision auto` becomes on which machine, and what is said and kept of it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import mvitac
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.deploy.export import ExportConfig, export
from mvitac.evaluation.evaluate import ProbeConfig
from mvitac.experiments.collect import gather, lay_out, outline
from mvitac.experiments.jobs import do, do_all
from mvitac.experiments.plan import Row
from mvitac.experiments.table import lines_of
from mvitac.experiments.table_formats import latex, markdown
from mvitac.run import Run, load_run
from mvitac.system import device as devices
from mvitac.system.device import Hardware
from mvitac.training.loop import train
from support.small_plans import small
from support.training_runs import assert_equal_weights, power_cut, smoke

CPU = torch.device("cpu")
Machine = Callable[[bool], None]


@pytest.fixture
def hardware(monkeypatch: pytest.MonkeyPatch) -> Machine:
    """Calling it with True or False moves the test to a machine that computes bf16 itself, or not."""
    monkeypatch.setattr(devices, "slowdown", lambda device, work: 0.5)
    return lambda own: monkeypatch.setattr(devices, "has_bf16", lambda device: own)


def auto(pack: Pack, **changes: object) -> Run:
    return smoke(pack, precision="auto", batch_size=4, eval_every=0, **changes)  # bf16 is slow where it is emulated


@pytest.mark.parametrize(
    ("avx512_bf16", "amx", "onednn", "expected"),
    [
        (True, False, True, "bf16"),  # EPYC from Genoa
        (False, True, True, "bf16"),  # as a Xeon from Sapphire Rapids, which has both
        (False, False, True, "fp32"),  # AVX-512 alone: oneDNN emulates bf16 there and says that it can
        (True, True, False, "fp32"),  # a chip that has it and a oneDNN that may not use it
        (None, None, True, "fp32"),  # another torch, without these private functions
        (True, True, None, "fp32"),
    ],
)
def test_auto_on_cpus(
    avx512_bf16: bool | None, amx: bool | None, onednn: bool | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, answer in (("_is_avx512_bf16_supported", avx512_bf16), ("_is_amx_tile_supported", amx)):
        if answer is None:
            monkeypatch.delattr(torch.cpu, name)
        else:
            monkeypatch.setattr(torch.cpu, name, lambda answer=answer: answer)
    known = {} if onednn is None else {"_is_mkldnn_bf16_supported": lambda: onednn}
    monkeypatch.setattr(torch.ops, "mkldnn", SimpleNamespace(**known))
    assert Hardware.choose(CPU, "auto").precision == expected
    assert [Hardware.choose(CPU, name).precision for name in ("fp32", "tf32", "bf16")] == ["fp32", "tf32", "bf16"]


@pytest.mark.parametrize(("capability", "expected"), [((7, 5), "fp32"), ((8, 0), "bf16"), ((9, 0), "bf16")])
def test_auto_on_gpus(capability: tuple[int, int], expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device", lambda device: torch.no_grad())
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: capability)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: True)
    assert Hardware.choose(torch.device("cuda:0"), "auto").precision == expected
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: including_emulation)
    assert Hardware.choose(torch.device("cuda:0"), "auto").precision == "fp32"
    assert Hardware.choose(torch.device("mps"), "auto").precision == "fp32"


@pytest.mark.parametrize("slower", [0.8, 0.95, 1.3])
def test_auto_is_the_faster_one_where_both_are_computed(slower: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A Xeon without AMX computes bf16 itself, and more slowly than fp32."""
    monkeypatch.setattr(devices, "has_bf16", lambda device: True)
    clock, now = iter(range(10**6)), [0.0]
    monkeypatch.setattr(devices.time, "perf_counter", lambda: now[0])

    def work() -> None:
        next(clock)
        now[0] += 0.01 * (slower if torch.is_autocast_enabled("cpu") else 1.0)

    found = Hardware.choose(CPU, "auto", work)
    assert found.precision == ("bf16" if slower == 0.8 else "fp32") and found.slowdown == pytest.approx(slower)
    assert f"bf16 takes {slower:.2f} of fp32's time" in found.sentence and 0.5 < now[0] < 0.6 and next(clock) > 20


@pytest.mark.parametrize("own", [True, False])
def test_what_auto_became_is_printed_and_kept(
    pack: Pack, tmp_path: Path, hardware: Machine, own: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    hardware(own)
    became = "bf16" if own else "fp32"
    asked = auto(pack, steps=2)
    out = train(asked, tmp_path / "r", validate=False)
    assert f"precision: {became} (auto" in capsys.readouterr().out
    run, record = load_run(out)
    assert (run.precision, record["precision"]) == ("auto", became) and mvitac.load(out).run.precision == became
    assert train(replace(asked, precision=became), tmp_path / "explicit", quiet=True, validate=False)  # type: ignore[arg-type]
    assert_equal_weights(out, tmp_path / "explicit")
    assert not capsys.readouterr().out
    # Another machine decides anew, and what is finished stays what it is.
    hardware(not own)
    again = ["pretrain", "--from", str(out / "run.json"), "--quiet", "--steps", "1", "--out", str(tmp_path / "again")]
    assert main(again) == 0 and load_run(tmp_path / "again")[1]["precision"] == ("fp32" if own else "bf16")
    assert train(asked, out, resume=True, quiet=True) == out


def test_a_checkpoint_goes_on_in_its_own_precision_alone(pack: Pack, tmp_path: Path, hardware: Machine) -> None:
    run, out = auto(pack, steps=4, checkpoint_every=2), tmp_path / "r"
    hardware(True)
    train(run, tmp_path / "straight", quiet=True)
    with power_cut(3), pytest.raises(RuntimeError, match="power cut"):
        train(run, out, quiet=True)
    hardware(False)
    with pytest.raises(ValueError, match="holds a different run"):
        train(replace(run, precision="fp32"), out, resume=True, quiet=True)
    train(run, out, resume=True, quiet=True)
    assert_equal_weights(tmp_path / "straight", out)


def test_compare_says_where_runs_differ(pack: Pack, tmp_path: Path, hardware: Machine) -> None:
    rows = (Row(label="MViTac"), Row(label="in fp32", set={"precision": "fp32"}))
    plan = small(pack, rows=rows, set={"steps": 2, "eval_every": 0, "precision": "auto"})
    out, session = tmp_path / "out", ProbeConfig(controls=False)
    hardware(False)
    work = lay_out(plan, pack, out, session)
    assert [line for line in outline(work) if "precision" in line] == ["on this machine: precision: fp32"]
    do(work.jobs[0])
    hardware(True)  # another machine does the rest
    do_all(lay_out(plan, pack, out, session), quiet=True)
    result = gather(work, out, session)
    said = "the networks of 'MViTac, seed 1' in bf16, those of all other runs in fp32"
    lines = lines_of(result)
    assert f"Note: {said}." in markdown(result, lines) and f"% Note: {said}." in latex(result, lines)
    same = {**result, "run_precisions": dict.fromkeys(result["run_precisions"], "fp32")}
    assert "the networks of" not in markdown(same, lines)


def test_bf16_exports_need_a_cpu(smoke_run: Path, pack: Pack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvitac.deploy.export.has_bf16", lambda device: False)
    with pytest.raises(ValueError, match="--precision bf16: this CPU does not compute bf16 itself"):
        export(mvitac.load(smoke_run), pack, tmp_path / "e", ExportConfig(precision="bf16"))
    assert not (tmp_path / "e").exists()
