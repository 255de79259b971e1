"""What an owner says that weights were trained on is stated, and compared with the names of the data that is scored."""

from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch

from mvitac.bench.external import open_model
from mvitac.bench.external.timm_models import said
from mvitac.data.pack import Pack
from mvitac.evaluation.leaks import DECLARED, UNKNOWN, Scored, file_source, read_sources, weights_files
from mvitac.nn.encoders import build_trunk
from mvitac.nn.initial import Init
from mvitac.training.loop import train
from support.training_runs import smoke

SAID = [
    ("ImageNet-1k", ""),
    ("ImageNet-1k; Toy", "toy was in its owner's training, which rows is not known"),
    ("", UNKNOWN),
]


def weights(pack: Pack, folder: Path, text: str) -> Path:
    trunk = build_trunk(smoke(pack).encoder.touch, 3)
    header = {"trained_on": text} if text else None
    safetensors.torch.save_file(trunk.state_dict(), folder / "theirs.safetensors", metadata=header)
    return folder / "theirs.safetensors"


@pytest.mark.parametrize(("text", "leak"), SAID)
def test_start_weights_of_which_their_owner_says_it(
    text: str, leak: str, pack: Pack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = weights(pack, tmp_path, text)
    train(replace(smoke(pack, init=Init(path=file)), steps=1), tmp_path / "run", quiet=True)
    told = capsys.readouterr().err
    assert ("leaks of test rows cannot be excluded" in told) == (leak == UNKNOWN) and (leak in told or leak == UNKNOWN)
    own, theirs = read_sources(tmp_path / "run") or []
    assert own.name == "toy" and theirs.name == (f"{DECLARED}{text}" if text else "theirs.safetensors")
    assert Scored(pack).leak([theirs], pack.rows("test")) == leak
    run = smoke(pack)
    run = replace(run, encoder=run.encoder.changed(weights=str(file)))
    assert [file_source(file).name for file in weights_files(run)] == [theirs.name]
    encoder = open_model(f"external:{file},trunk={run.encoder.touch.trunk},size=32")
    assert encoder.trained_on == (text or UNKNOWN,)


def test_other_names_of_the_data_count_too(pack: Pack, tmp_path: Path) -> None:
    source = file_source(weights(pack, tmp_path, "Touch and Go"))
    scored, rows = Scored(pack), pack.rows("test")
    assert scored.leak([source], rows) == "" and "TAG, Touch-and-Go" not in scored.leak([source], rows)
    assert scored.leak([source], rows, ["TAG", "touch-and-go"]).startswith("touch-and-go was in its owner's training")


@pytest.mark.parametrize(
    ("tag", "expected"),
    [
        ("augreg_in21k_ft_in1k", "ImageNet-21k, ImageNet-1k (timm's tag augreg_in21k_ft_in1k)"),
        ("dino", "ImageNet-1k (timm's tag dino)"),
        ("mystery", UNKNOWN),
        ("", UNKNOWN),
    ],
)
def test_what_timm_says_of_its_weights(tag: str, expected: str) -> None:
    assert said(tag) == expected
