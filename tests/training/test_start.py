"""Start weights from another model: what is taken, what is recorded, and what the new run inherits of leaks."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import timm
import torch
from safetensors.torch import save_file

import mvitac
from mvitac.cli.main import main
from mvitac.data.pack import Pack
from mvitac.datasets.pack import PackConfig
from mvitac.deploy.publish import publish
from mvitac.evaluation.leaks import read_sources
from mvitac.methods.byol import BYOLConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.model import fresh, load
from mvitac.nn.encoders import EncoderConfig, Encoders, PerFrame, build_trunk
from mvitac.nn.initial import Init
from mvitac.nn.momentum import Momentum
from mvitac.nn.weights import _say, adapt_stem
from mvitac.run import Run, load_run
from mvitac.training.loop import train
from mvitac.training.start import describe, load_start, load_trunk, read_start
from support.small_methods import TINY
from support.toy import toy_pack
from support.training_runs import power_cut, smoke, train_twice, weights


def started(pack: Pack, init: Init, **changes: object) -> tuple[Run, torch.nn.Module, dict[str, list[str]]]:
    run = smoke(pack, seed=5, init=init.resolved(), **changes)
    start = read_start(run.init)
    torch.manual_seed(run.seed)
    method = run.method.build(pack.spec, run.encoder)
    assert start
    return run, method, load_start(start, method)["taken"]


def assert_equal_states(a: torch.nn.Module, b: torch.nn.Module) -> None:
    torch.testing.assert_close(a.state_dict(), b.state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize("keys", ["momentum", "end-to-end"])
def test_takes_trunks_and_heads_and_copies_them_to_the_keys(pack: Pack, smoke_run: Path, keys: str) -> None:
    config = MViTacConfig(hidden=32, out=16, keys=keys)  # type: ignore[arg-type]
    _, method, taken = started(pack, Init(path=smoke_run), method=config)
    assert taken == {"vision": ["trunk", "head"], "touch": ["trunk", "head"]}
    source = load(smoke_run)
    for m in ("vision", "touch"):
        assert_equal_states(method.encoders()[m], source.encoders[m])  # type: ignore[operator]
        assert_equal_states(method.projectors()[m], source.projectors[m])  # type: ignore[operator]
        own, new = method.query[m].intra, fresh(smoke(pack), pack.spec, 32).projectors[m]  # type: ignore[index]
        assert not all(torch.equal(p, q) for p, q in zip(own.parameters(), new.parameters(), strict=True))
        for key in (module for module in method.key.values() if isinstance(module, Momentum)):  # type: ignore[operator]
            assert_equal_states(key.module, key._query[0])
    assert len(method.key) == (2 if keys == "momentum" else 0)  # type: ignore[arg-type]


def test_takes_what_fits_and_what_was_asked_for(pack: Pack, smoke_run: Path) -> None:
    source = load(smoke_run)
    run, method, taken = started(pack, Init(path=smoke_run, modalities=("touch",), heads=False))
    assert taken == {"touch": ["trunk"]}
    start = fresh(run, pack.spec, 32)
    assert_equal_states(method.encoders()["touch"], source.encoders["touch"])  # type: ignore[operator]
    assert_equal_states(method.encoders()["vision"], start.encoders["vision"])  # type: ignore[operator]
    assert_equal_states(method.projectors()["touch"], start.projectors["touch"])  # type: ignore[operator]
    # Heads of another width are not taken; another method's trunks are, and so are its momentum copies.
    _, _, taken = started(pack, Init(path=smoke_run), method=MViTacConfig(hidden=40, out=16))
    assert taken == {"vision": ["trunk"], "touch": ["trunk"]}
    _, method, _ = started(pack, Init(path=smoke_run), method=BYOLConfig(out=8, hidden=8))
    assert_equal_states(method.target["touch"].module.trunk, source.encoders["touch"])  # type: ignore[index]


def test_a_model_of_one_modality(pack: Pack, tmp_path: Path) -> None:
    touch = toy_pack(tmp_path / "touch", vision_channels=0)
    first = train(smoke(touch, steps=1, eval_every=0), tmp_path / "first", quiet=True)
    run = smoke(pack, init=Init(path=first).resolved())
    found = load_start(read_start(run.init), run.method.build(pack.spec, run.encoder))  # type: ignore[arg-type]
    assert found["taken"] == {"touch": ["trunk", "head"]}
    assert describe(found).endswith(": touch trunk and head, not vision (it has touch only)")


@pytest.mark.parametrize(("channels", "wanted"), [(3, 6), (6, 3), (6, 9), (3, 3)])
def test_stem_is_adapted_to_the_channels(channels: int, wanted: int, capsys: pytest.CaptureFixture[str]) -> None:
    """The same picture in all places gives the same features, whatever their number; fewer or other ones are said."""
    _say.cache_clear()
    torch.manual_seed(0)
    before, after = build_trunk(TINY.touch, channels).eval(), build_trunk(TINY.touch, wanted).eval()
    load_trunk(after, before.state_dict())
    said = f"a first convolution of {channels} channels is made one of {wanted}"
    assert (said in capsys.readouterr().err) == (channels > 3)
    picture = torch.randn(2, 3, 32, 32)
    expected = before(picture.repeat(1, channels // 3, 1, 1))
    assert torch.allclose(after(picture.repeat(1, wanted // 3, 1, 1)), expected, atol=1e-5)
    weight = torch.arange(12.0).view(1, 3, 2, 2)
    assert torch.equal(adapt_stem(weight, 6), torch.cat([weight, weight], 1) / 2)  # as timm does


def test_trunks_of_windows_and_of_single_images_take_each_other() -> None:
    torch.manual_seed(0)
    single, frames = build_trunk(TINY.touch, 3), build_trunk(replace(TINY.touch, temporal="mean"), 9, 3)
    assert isinstance(frames, PerFrame)
    load_trunk(frames, single.state_dict())
    assert_equal_states(frames.trunk, single)
    again = build_trunk(TINY.touch, 3)
    load_trunk(again, frames.state_dict())
    assert_equal_states(again, single)


def test_digest_is_that_of_the_content(pack: Pack, smoke_run: Path, artifact: Path, tmp_path: Path) -> None:
    copied, without = shutil.copy(smoke_run / "model.safetensors", tmp_path / "copy.safetensors"), smoke(pack)
    digests = {smoke(pack, init=Init(path=Path(p))).digest() for p in (smoke_run, artifact, copied)}
    assert len(digests) == 1 and without.digest() not in digests
    assert smoke(pack, init=Init(path=smoke_run, heads=False)).digest() not in digests
    state = weights(smoke_run)
    state["encoders.touch.conv1.0.weight"][0, 0, 0, 0] += 1e-6
    safetensors.torch.save_file(state, tmp_path / "copy.safetensors")
    assert smoke(pack, init=Init(path=Path(copied))).digest() not in digests


def test_weights_that_give_no_finite_numbers_are_refused(pack: Pack, tmp_path: Path) -> None:
    state = timm.create_model("test_resnet").state_dict()
    torch.save({n: -v - 1 if n.endswith("running_var") else v for n, v in state.items()}, tmp_path / "w.pth")
    encoder = EncoderConfig(trunk="test_resnet", weights=str(tmp_path / "w.pth"))
    with pytest.raises(ValueError, match="test_resnet of vision gives NaN or infinite features: start"):
        train(smoke(pack, encoder=Encoders(vision=encoder, touch=encoder)), tmp_path / "r", quiet=True)


def test_killed_and_resumed_equals_straight(pack: Pack, smoke_run: Path, tmp_path: Path) -> None:
    run = smoke(pack, init=Init(path=smoke_run), checkpoint_every=1, seed=3, steps=4, eval_every=0)
    early, _ = (train_twice(run, tmp_path / name, cut=cut) for name, cut in (("early", 1), ("late", 3)))
    scratch = train(replace(run, init=Init()), tmp_path / "scratch", quiet=True)
    assert not torch.equal(*(weights(path)["encoders.touch.conv1.0.weight"] for path in (early, scratch)))


def test_other_weights_are_refused_at_resume(pack: Pack, smoke_run: Path, tmp_path: Path) -> None:
    source = shutil.copytree(smoke_run, tmp_path / "source")
    run = smoke(pack, init=Init(path=source), steps=1, eval_every=0)
    out = train(run, tmp_path / "r", quiet=True)
    other = train(smoke(pack, seed=9, steps=1, eval_every=0), tmp_path / "x", quiet=True)
    shutil.copy(other / "model.safetensors", source)
    with pytest.raises(ValueError, match="holds a different run"):
        train(run, out, resume=True, quiet=True)
    with pytest.raises(ValueError, match=r"source now holds other weights than this run was recorded with"):
        train(load_run(out)[0], tmp_path / "again", quiet=True)
    with pytest.raises(ValueError, match="is of another run than"):
        train(smoke(pack, init=Init(path=source)), tmp_path / "new", quiet=True)


@pytest.fixture(scope="module")
def chain(pack: Pack, turned: Pack, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """b learned from the rows that the striped pairs test; c started from b, and d from the artifact of c."""
    folder, run = tmp_path_factory.mktemp("chain"), smoke(pack, steps=1, eval_every=0)
    runs = {"b": train(replace(run, data=PackConfig(path=turned.path)), folder / "b", quiet=True)}
    runs["c"] = train(replace(run, init=Init(path=runs["b"])), folder / "c", quiet=True)
    runs["art"] = publish(runs["c"], folder / "art", allow_leak=True)
    runs["d"] = mvitac.train(replace(run, init=mvitac.Init(path=runs["art"])), folder / "d", quiet=True)
    return runs


def test_leaks_of_ancestors_are_told(pack: Pack, chain: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("c", "d"):
        found = read_sources(chain[name])
        assert found and [len(source.ids) for source in found] == [len(pack.rows("train")), len(pack.rows("test"))]
        asked = ["probe", str(chain[name]), "--tasks", "pattern", "--modalities", "touch", "--no-controls"]
        if name == "c":
            assert main(asked) == 2
            error = capsys.readouterr().err
            assert "24 of 24 test rows" in error and "--allow-leak" in error and error.count("\n") == 1
        else:
            assert main([*asked, "--allow-leak"]) == 0 and " LEAK" in capsys.readouterr().out
    card = " ".join((chain["art"] / "README.md").read_text().split())
    assert "Started from the weights of b " in card and " LEAK" in card


def test_pretrain_warns_of_seen_test_rows(
    pack: Pack, chain: dict[str, Path], smoke_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, init in (("clean", smoke_run), ("seen", chain["d"])):
        assert capsys.readouterr().err == ""
        train(replace(smoke(pack, steps=1, eval_every=0), init=Init(path=init)), tmp_path / name, quiet=True)
    said = capsys.readouterr().err
    assert said.startswith("mvitac: warning: ") and "has seen what this data tests: 24 of 24" in said
    start = load_run(tmp_path / "seen")[1]["start"]
    assert start["taken"] == {"vision": ["trunk", "head"], "touch": ["trunk", "head"]}
    assert start["trained_on"] == ["toy"] and len(start["digest"]) == 64


def test_mistakes_are_one_line(pack: Pack, smoke_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nan = build_trunk(smoke(pack).encoder.touch, 3).state_dict()
    nan[min(nan)].fill_(float("nan"))
    save_file(nan, tmp_path / "nan.safetensors")
    with power_cut(2), pytest.raises(RuntimeError, match="power cut"):
        train(smoke(pack, checkpoint_every=1, eval_every=0), tmp_path / "unfinished", quiet=True)
    capsys.readouterr()
    data = ["pretrain", "--recipe", "smoke", "--data", "pack", "--data.path", str(pack.path), "--steps", "1", "--quiet"]
    for words, expected in (
        (["--init", str(tmp_path / "unfinished")], "its run is not finished, continue it with --resume"),
        (["--encoder.weights", str(tmp_path / "nan.safetensors")], "nan.safetensors holds NaN or infinite numbers: "),
        (["--init", str(tmp_path / "nan.safetensors")], "nan.safetensors was not written by mvitac"),
        ([f"--init={smoke_run}", "--encoder.trunk", "resnet10t"], "does not fit this run (vision: its trunk is"),
    ):
        assert main([*data, *words, "--out", str(tmp_path / "out")]) == 2, words
        error = capsys.readouterr().err
        assert expected in error and error.count("\n") == 1, error
        assert not (tmp_path / "out" / "run.json").exists()
